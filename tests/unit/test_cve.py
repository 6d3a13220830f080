"""Known vulnerabilities of the locks: the tracker's data, the sources of packages, the verdicts, and what fails.

The excerpt has the tracker's form: keys and values as its users' tests have them (anchore/vunnel,
tests/unit/providers/debian/test-fixtures/input/debian.json; l3montree-dev/devguard, vulndb, the tracker's entry of
openssl). Entries are real where a comment says so, else planted.
"""

from __future__ import annotations

import gzip
import json
import lzma
import subprocess
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from debsbom.dpkg.package import SourcePackage
from debsbom.securityscan.scanner import CveTriage

from flotilla.cli import main as command_line
from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.debian import pool
from flotilla.debian.lock import Lock, Package, Suite, read_lock
from flotilla.debian.mirror import DEBIAN, SECURITY
from flotilla.fleet import inventory
from flotilla.images import cve

TODAY = date(2026, 11, 23)
RELEASED = datetime(2026, 11, 20, 2, 11, 10, tzinfo=UTC)


def entry(status: str, version: str, fixed: str = "", urgency: str = "not yet assigned", **more: str) -> dict[str, Any]:
    said: dict[str, Any] = {"status": status, "repositories": {"bookworm": version}, "urgency": urgency, **more}
    return said | ({"fixed_version": fixed} if fixed else {})


def issue(bookworm: dict[str, Any], **releases: dict[str, Any]) -> dict[str, Any]:
    return {"description": "A flaw.", "scope": "local", "releases": {"bookworm": bookworm, **releases}}


DATA: dict[str, Any] = {
    "openssl": {
        # Real: the entry of openssl in devguard's vulndb, with its repositories.
        "CVE-2023-5678": issue(entry("resolved", "3.0.13-1~deb12u1", fixed="3.0.13-1~deb12u1")),
        "CVE-2026-1000": issue(entry("resolved", "3.0.15-1~deb12u1", fixed="0", urgency="unimportant")),
        "CVE-2026-1001": issue(entry("resolved", "3.0.13-1~deb12u1")),
    },
    # Real: open in bookworm, and why, as scanners' authors report it; its version has an epoch.
    "zlib": {
        "CVE-2023-45853": issue(
            entry(
                "open",
                "1:1.2.13.dfsg-1",
                nodsa="contrib/minizip not built and src:zlib not producing binary packages",
                nodsa_reason="ignored",
            )
        ),
        "CVE-2018-25032": issue(entry("resolved", "1:1.2.13.dfsg-1", fixed="1:1.2.11.dfsg-4", urgency="high**")),
        "CVE-2026-2000": issue(entry("resolved", "1:1.2.13.dfsg-1", fixed="1:1.2.13.dfsg-1+deb12u1")),
    },
    # Real: open and unimportant in every release.
    "apt": {"CVE-2011-3374": issue(entry("open", "2.6.1", urgency="unimportant"))},
    "util-linux": {
        "CVE-2024-28085": issue(entry("resolved", "2.38.1-5+deb12u3", fixed="2.38.1-5+deb12u1")),
        "CVE-2026-3000": issue(entry("undetermined", "2.38.1-5+deb12u3")),
        "CVE-2026-3001": issue(entry("open", "2.38.1-5+deb12u3", nodsa="Minor issue", nodsa_reason="postponed")),
    },
    "linux": {"CVE-2026-4000": issue(entry("resolved", "6.1.192-2", fixed="6.1.192-3"))},
    "linux-6.12": {"CVE-2026-4000": issue(entry("resolved", "6.12.117-1~deb12u1", fixed="6.12.117-1~deb12u1"))},
    "glibc": {"CVE-2026-5000": issue(entry("resolved", "2.36-9+deb12u14", fixed="2.36-9+deb12u14"))},
    "chromium-browser": {"CVE-2022-0358": {"releases": []}},  # real: vunnel's fixture; of no release
    "bash": {"CVE-2026-6000": {"description": "Of others only.", "releases": {"sid": entry("open", "5.3-1")}}},
}

CONTROL = {
    "libssl3": ("3.0.13-1~deb12u1", "Source: openssl\n"),
    "openssl": ("3.0.13-1~deb12u1", ""),
    "zlib1g": ("1:1.2.13.dfsg-1", "Source: zlib\n"),
    "apt": ("2.6.1", ""),
    "bsdutils": ("1:2.38.1-5+deb12u3", "Source: util-linux (2.38.1-5+deb12u3)\n"),
    "linux-image-6.1.0-56-rt-amd64": (
        "6.1.192-2",
        "Source: linux-signed-amd64 (6.1.192+2)\nBuilt-Using: linux (= 6.1.192-2)\n",
    ),
    "linux-source-6.12": ("6.12.117-1~deb12u1", "Source: linux-6.12\n"),
    "busybox-static": (
        "1:1.35.0-4+deb12u1+b1",
        "Source: busybox (1:1.35.0-4+deb12u1)\nBuilt-Using: glibc (= 2.36-9+deb12u7), kernel-x (= 1)\n",
    ),
    "bash": ("5.2.15-2+b13", "Source: bash (5.2.15-2)\n"),
}


def package(name: str) -> Package:
    return Package(name, CONTROL[name][0], "amd64", "userland", DEBIAN, 1, "0" * 64, f"pool/{name}.deb")


def control(package: Package) -> str:
    version, more = CONTROL[package.name]
    return f"Package: {package.name}\nVersion: {version}\nArchitecture: amd64\n{more}Description: x\n more\n"


def locked(*names: str, name: str = "x86_64", released: datetime = RELEASED) -> Lock:
    suites = ((DEBIAN, "bookworm"), (DEBIAN, "bookworm-updates"), (SECURITY, "bookworm-security"))
    return Lock(name, "amd64", tuple(Suite(*suite, released) for suite in suites), tuple(map(package, sorted(names))))


@pytest.fixture(autouse=True)
def packages_of_the_pool(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "fill", lambda _: None)
    monkeypatch.setattr(pool, "control", control)


def found(*names: str, data: dict[str, Any] = DATA) -> dict[str, tuple[str, str | None]]:
    report = cve.judge([locked(*names)], data, TODAY)
    return {each.cve: (each.kind, each.fixed_version) for each in report.findings}


# --- verdicts ---


def test_what_is_fixed_or_never_was_vulnerable_is_not_named() -> None:
    """Seen to fail where `0` was taken for no version, and `>` for `>=`."""
    assert found("libssl3", "openssl") == {}


def test_open_with_and_without_a_fix_and_epochs_count() -> None:
    """Seen to fail where versions are compared without their epochs: 1:1.2.13 then is below 1:1.2.11's 4."""
    assert found("zlib1g") == {
        "CVE-2023-45853": ("open", None),
        "CVE-2026-2000": ("fix", "1:1.2.13.dfsg-1+deb12u1"),
    }


def test_unimportant_undetermined_and_postponed() -> None:
    """Seen to fail where what is `undetermined` was not taken."""
    report = cve.judge([locked("apt", "bsdutils")], DATA, TODAY)
    assert [(each.cve, each.kind, each.urgency, each.remark) for each in report.findings] == [
        ("CVE-2026-3001", "open", "not yet assigned", "postponed; Minor issue"),
        ("CVE-2026-3000", "undetermined", "not yet assigned", ""),
        ("CVE-2011-3374", "unimportant", "unimportant", ""),
    ]
    assert report.failures == ()


def test_resolved_without_a_version_is_what_the_release_has() -> None:
    data = {"openssl": {"CVE-2026-1001": issue(entry("resolved", "3.0.15-1~deb12u1"))}}
    assert found("openssl", data=data) == {"CVE-2026-1001": ("fix", "3.0.15-1~deb12u1")}


def test_a_release_that_never_had_it_is_not_vulnerable() -> None:
    """Seen to fail where what is said of other releases was taken."""
    assert found("bash") == {}


# --- sources ---


def test_versions_are_those_of_the_source() -> None:
    """Seen to fail where the binary's version was compared: its epoch, which the source lacks, hid the fix."""
    data = {"util-linux": {"CVE-2026-3002": issue(entry("resolved", "2.38.1-5+deb12u4", fixed="2.38.1-5+deb12u4"))}}
    assert found("bsdutils", data=data) == {"CVE-2026-3002": ("fix", "2.38.1-5+deb12u4")}


def test_a_signed_kernel_is_judged_by_what_was_signed() -> None:
    """Seen to fail without Built-Using: the tracker has no entry of linux-signed-amd64, and nothing was found."""
    assert found("linux-image-6.1.0-56-rt-amd64") == {"CVE-2026-4000": ("fix", "6.1.192-3")}


def test_what_a_package_contains_is_named_and_fails_nothing() -> None:
    """Seen to fail where it was judged as if a new lock would help."""
    report = cve.judge([locked("busybox-static")], DATA, TODAY)
    (only,) = report.findings
    assert (only.cve, only.installed.source, only.installed.embedded, only.kind) == (
        "CVE-2026-5000", "glibc", True, "open"
    )  # fmt: skip
    assert "embedded" in only.remark
    assert report.failures == ()


def test_packages_and_locks_of_a_source_share_a_line() -> None:
    report = cve.judge([locked("apt", "bsdutils"), locked("apt", name="smartcoret3")], DATA, TODAY)
    assert [(each.cve, each.installed.locks) for each in report.findings][-1] == (
        "CVE-2011-3374",
        ("smartcoret3", "x86_64"),
    )


def test_the_pool_says_what_a_package_is_made_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a package that dpkg-deb made, and not this file's table."""
    monkeypatch.undo()
    monkeypatch.setattr(paths, "POOL", tmp_path)
    (tmp_path / "root/DEBIAN").mkdir(parents=True)
    wanted = package("bsdutils")
    text = control(wanted).replace("Description", "Maintainer: A Developer <a@example.org>\nDescription")
    (tmp_path / "root/DEBIAN/control").write_text(text)
    argv = ["dpkg-deb", "--root-owner-group", "--build", str(tmp_path / "root"), str(pool.file(wanted))]
    subprocess.run(argv, check=True, capture_output=True)
    (only,) = cve.sources([replace(locked("bsdutils"), packages=(wanted,))])
    assert (only.source, only.version, only.packages) == ("util-linux", "2.38.1-5+deb12u3", ("bsdutils",))


def test_another_reader_of_the_data_agrees() -> None:
    """debsbom's verdicts on the same sources. Seen to fail where `undetermined` was left out of ours."""
    names = [name for name in CONTROL if name != "busybox-static"]
    data = {source: issues for source, issues in DATA.items() if source != "chromium-browser"}
    text = json.dumps(data).replace("high**", "high")  # it knows none with stars
    installed = cve.sources([locked(*names)])
    triage = CveTriage(json.loads(text), "bookworm")
    theirs = {
        (each.source, candidate.cve)
        for each in installed
        for package in [SourcePackage(each.source, each.version)]
        for candidate in triage.candidates(package)
        if triage.affected_by(package, candidate)
        if candidate.fixed_version or candidate.status.name != "RESOLVED"  # else it takes what is fixed for vulnerable
    }
    ours = cve.judge([locked(*names)], DATA, TODAY).findings
    assert {(each.installed.source, each.cve) for each in ours} == theirs
    assert len(theirs) > 5


# --- what fails ---


def test_a_fix_in_the_suite_fails() -> None:
    report = cve.judge([locked("zlib1g")], DATA, TODAY)
    assert report.failures == (
        "x86_64: 1 open CVEs have a fix in the suite; `make lock ONLY=x86_64`, then build the images",
    )


def test_a_lock_without_the_security_suite_fails() -> None:
    """Seen to fail with `missing_suites` not asked."""
    lock = locked("openssl")
    report = cve.judge([replace(lock, suites=lock.suites[:2])], DATA, TODAY)
    (said,) = report.failures
    assert said.startswith(
        "x86_64: note: the lock has no packages of bookworm-security, because the mirror had no signed"
    )
    assert cve.judge([lock], DATA, TODAY).failures == ()


def test_the_lock_of_today_lacks_that_suite() -> None:
    """The real one, of which no package is looked at."""
    lock = replace(read_lock("smartcoret3"), packages=())
    failures = cve.judge([lock], DATA, TODAY).failures
    assert any("bookworm-security" in each for each in failures) == bool(lock.missing_suites)


@pytest.mark.parametrize(("days", "failures"), [(30, 0), (31, 1)])
def test_an_old_lock_fails(days: int, failures: int) -> None:
    """By its newest suite's release, unless it was found unchanged since. Seen to fail with `>=`."""
    report = cve.judge([locked("openssl", released=RELEASED - timedelta(days=days - 3))], DATA, TODAY)
    assert len(report.failures) == failures
    checked = replace(report.locks[0], checked=RELEASED)
    assert cve.judge([checked], DATA, TODAY).failures == ()
    assert all("x86_64.lock: is 31 days old, more than 30; run" in each for each in report.failures)


def test_an_own_kernel_that_the_tracker_does_not_know_fails() -> None:
    """Seen to fail where a source without an entry passes."""
    lock = locked("linux-source-6.12", name="toolchain")
    assert cve.judge([lock], DATA, TODAY).failures == ()
    rest = {source: issues for source, issues in DATA.items() if source != "linux-6.12"}
    (said,) = cve.judge([lock], rest, TODAY).failures
    assert said.startswith("linux-6.12: the tracker's data know nothing of our own kernel's source")


# --- the tracker's data ---


@pytest.mark.parametrize(
    ("name", "pack"),
    [
        ("json", lambda content: content),
        ("json.gz", gzip.compress),
        ("json.xz", lzma.compress),
        ("data", gzip.compress),
    ],
)
def test_files_packed_or_not_and_addresses(tmp_path: Path, name: str, pack: Callable[[bytes], bytes]) -> None:
    file = tmp_path / name
    file.write_bytes(pack(json.dumps(DATA).encode()))
    assert cve.read_tracker(str(file)) == DATA
    assert cve.read_tracker(file.as_uri()) == DATA


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"<html>", "is not JSON"),
        (b"\x1f\x8bcut", "is not JSON"),
        (gzip.compress(b"{}", mtime=0)[:-9], "is not JSON"),
        (b"[]", "is JSON, but not the tracker's"),
        (b'{"a": 1}', "is JSON, but not the tracker's"),
        (None, "No such file"),
    ],
)
def test_what_is_no_data(tmp_path: Path, content: bytes | None, said: str) -> None:
    file = tmp_path / "data"
    if content is not None:
        file.write_bytes(content)
    for tracker in (str(file), file.as_uri()):
        with pytest.raises(UserError, match=said) as raised:
            cve.read_tracker(tracker)
        assert str(raised.value).startswith(f"TRACKER={tracker}: ")


def test_data_of_other_releases_are_refused() -> None:
    """Data that the tracker has dropped the release from would find nothing. Seen to fail without that check."""
    with pytest.raises(UserError, match="TRACKER: no entry about bookworm"):
        cve.judge([locked("bash")], {"bash": DATA["bash"]}, TODAY)


def test_an_entry_of_another_form_is_named() -> None:
    data = {"apt": {"CVE-2011-3374": issue(entry("maybe", "2.6.1"))}}
    with pytest.raises(UserError, match=r"TRACKER: apt\.CVE-2011-3374\.releases\.bookworm\.status: maybe: "):
        cve.judge([locked("apt")], data, TODAY)


# --- the command ---


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr("sys.argv", ["flotilla", "cve", *words])
    return command_line.main()


@pytest.fixture
def tracker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Data in a file, and locks in the place of the project's."""
    locks = {"toolchain": locked("linux-source-6.12", "zlib1g", name="toolchain")}
    monkeypatch.setattr(cve, "board_lock", lambda board: locks.get(board.name, locked("apt", name=board.name)))
    monkeypatch.setattr(cve, "read_lock", locks.__getitem__)
    file = tmp_path / "tracker.json"
    file.write_text(json.dumps(DATA))
    return file


def test_command_without_data_says_how_to_get_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch) == 1
    assert "make cve TRACKER=FILE" in capsys.readouterr().err


def test_command_names_and_judges(
    tracker: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of the toolchain, only the kernel's source counts. Seen to fail with the status always 0."""
    words = ["--tracker", str(tracker), "--today"]
    assert run(monkeypatch, *words, "2026-11-23") == 0
    said = capsys.readouterr().out.splitlines()
    boards = " ".join(sorted(inventory.load_fleet().boards))
    assert said[1].split() == [
        "CVE-2011-3374",
        "apt",
        "2.6.1",
        "no",
        "fix",
        "yet",
        "unimportant",
        *boards.split(),
        "apt",
    ]
    assert "x86_64: 0 with a fix, 0 without one yet, 0 undetermined, 1 unimportant; lock 3 days old" in said
    assert said[-1] == "2 source packages looked up"

    assert run(monkeypatch, *words, "2027-02-01", "--json") == 1
    output = capsys.readouterr()
    report = json.loads(output.out)
    assert [each["cve"] for each in report["findings"]] == ["CVE-2011-3374"]
    assert report["locks"]["toolchain"] == {"age_days": 73, "missing_suites": []}
    assert len(report["failures"]) == len(boards.split()) + 1
    assert output.err.count("days old, more than 30; run `make lock ONLY=") == len(report["failures"])
