"""The last day of a bundle: what chooses it, and what it changes."""

from __future__ import annotations

import json
import tarfile
from collections.abc import Mapping
from datetime import date
from pathlib import Path

import pytest

from flotilla.cli import commands
from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet.model import Releases
from flotilla.robot import release
from flotilla.updates import bundle, published
from tests.runtime.test_update import CHUNK, header_of, manifest_of
from tests.runtime.test_update import pack as pack_signed

TODAY, DAY = date(2026, 3, 1), date(2026, 8, 28)
RELEASES = Releases()
BLOB = bytes(8 * CHUNK)


@pytest.fixture
def content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The content of a slot; keys are made beside it."""
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")
    made = tmp_path / "content"
    made.mkdir()
    (made / "slot.img").write_bytes(BLOB)
    (made / "header.json").write_text(json.dumps(header_of(BLOB)))
    return made


def members(file: Path) -> Mapping[str, bytes]:
    with tarfile.open(file) as archive:
        return {member.name: archive.extractfile(member).read() for member in archive}  # type: ignore[union-attr]


def test_the_last_day_is_in_the_manifest_alone(content: Path, tmp_path: Path) -> None:
    """The same day gives the same bytes; slot.img and its header are the same on any day."""
    files = [tmp_path / name for name in ("one", "again", "later", "before")]
    for file, expires in zip(files, (DAY, DAY, TODAY, None), strict=True):
        bundle.pack(file, content, RELEASES, {}, 0, expires=expires)
    assert files[0].read_bytes() == files[1].read_bytes()
    one, _, later, before = map(members, files)
    assert {name for name in one if one[name] != later[name]} == {"manifest.json", "manifest.json.release.sig"}
    described = [json.loads(each["manifest.json"]) for each in (one, later, before)]
    assert [each.pop("expires", None) for each in described] == [DAY.isoformat(), TODAY.isoformat(), None]
    assert described[0] == described[1] == described[2]
    assert [release.read(file).expires for file in files] == [DAY.isoformat()] * 2 + [TODAY.isoformat(), ""]


def test_what_chooses_the_last_day(content: Path) -> None:
    """The option, else the manifest that others have signed, else the inventory. Seen to fail where signatures made
    yesterday are compared with the manifest of today."""
    signed = content / "some.manifest.json"
    assert bundle.expiry(RELEASES, TODAY, None, signed) == DAY, "180 days from then on"
    assert bundle.expiry(Releases(lifetime_days=1), TODAY, None, None) == date(2026, 3, 2)
    signed.write_bytes(bundle.manifest_of(content, {}, date(2026, 8, 1)))
    assert bundle.expiry(RELEASES, TODAY, None, signed) == date(2026, 8, 1)
    assert bundle.expiry(RELEASES, TODAY, DAY, signed) == DAY
    assert bundle.expiry(RELEASES, TODAY, TODAY, None) == TODAY
    signed.write_bytes(bundle.manifest_of(content, {}))
    assert bundle.expiry(RELEASES, TODAY, None, signed) == DAY, "it had none"


def test_a_day_that_is_over_is_rejected(content: Path) -> None:
    yesterday = date(2026, 2, 28)
    with pytest.raises(UserError, match=r"EXPIRES=2026-02-28: that day is over, .* EXPIRES=2026-08-28$"):
        bundle.expiry(RELEASES, TODAY, yesterday, None)
    signed = content / "some.manifest.json"
    signed.write_bytes(bundle.manifest_of(content, {}, yesterday))
    with pytest.raises(
        UserError, match=r"some\.manifest\.json: expires=2026-02-28: .*, and have the manifest signed again"
    ):
        bundle.expiry(RELEASES, TODAY, None, signed)


def test_a_bundle_is_expired_after_its_last_day(tmp_path: Path) -> None:
    text = manifest_of(BLOB, header_of(BLOB), expires=TODAY.isoformat())
    made = release.read(pack_signed(tmp_path / "some.bundle", text, [], BLOB))
    assert made.expired(TODAY) == ""
    assert "release 5 expired on 2026-03-01" in made.expired(date(2026, 3, 2))


FORMS = [
    "20260828",
    "2026-W35-5",
    "2026-8-28",
    "2026-08-28T00:00:00",
    "28.08.2026",
    " 2026-08-28",
    "",
    20260828,
    None,
    [DAY.isoformat()],
]
"""Of the last day of a bundle. Robots compare texts: 20260828 comes after each day that they write."""


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_a_day_in_another_form_is_rejected(content: Path, tmp_path: Path, form: object) -> None:
    """In a bundle, in a manifest that is signed elsewhere, and in a published bundle. Seen to fail: the station
    accepted 20260828, which robots accept for ever; the signature of a manifest with it was called none."""
    text = manifest_of(BLOB, header_of(BLOB), expires=form)
    file = pack_signed(tmp_path / "some.bundle", text, [], BLOB)
    wrong = r"some\.bundle: manifest\.json: expires=.*: give a day such as 2027-01-31"
    with pytest.raises(UserError, match=wrong):
        release.read(file)
    with pytest.raises(UserError, match=r"some\.bundle: is no bundle: (?s:.*)expires"):
        published._read(file)
    signed = content / "some.manifest.json"
    signed.write_text(text)
    with pytest.raises(UserError, match=r"some\.manifest\.json: expires=.*: give a day such as 2027-01-31"):
        bundle.expiry(RELEASES, TODAY, None, signed)


@pytest.mark.parametrize("form", FORMS[:6])
def test_the_option_has_the_form_of_the_manifest(form: str) -> None:
    with pytest.raises(ValueError, match="such as 2027-01-31"):
        commands._day(form)
    assert commands._day(DAY.isoformat()) == DAY


@pytest.mark.parametrize("text", ["[]", "{", "{}", '{"header": []}', '{"header": {"BYTES": "x"}}'])
def test_a_bundle_with_another_manifest_is_none(tmp_path: Path, text: str) -> None:
    """Seen to fail: in a traceback."""
    with pytest.raises(UserError, match=r"some\.bundle is no bundle: .*; make it again: `make bundle`"):
        release.read(pack_signed(tmp_path / "some.bundle", text, [], BLOB))


def test_another_release_with_the_same_number_is_named(tmp_path: Path) -> None:
    """Robots take it for equally new. Seen to fail: nothing was printed."""
    other = bytes([1]) * len(BLOB)
    made = [
        release.read(pack_signed(tmp_path / name, manifest_of(blob, header_of(blob, RELEASE=number)), [], blob))
        for name, blob, number in (
            ("one", BLOB, "5"),
            ("again", BLOB, "5"),
            ("other", other, "5"),
            ("next", other, "6"),
        )
    ]
    named = [bool(release.same_number(made[0], each)) for each in made]
    assert named == [False, False, True, False]
