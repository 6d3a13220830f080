"""What robots' DDS programs prove who they are with. tests/runtime/test_dds_security.py has Cyclone DDS judge it."""

from __future__ import annotations

import re
import stat
import xml.etree.ElementTree as ET
from pathlib import Path, PurePosixPath

import pytest
from cryptography import x509

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import dds_security, identity, keys
from flotilla.fleet.model import Fleet
from flotilla.lab.scenarios import virtual

FILE = PurePosixPath("/etc/flotilla/dds-security.xml")


@pytest.fixture(autouse=True)
def _keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")


@pytest.fixture
def fleet() -> Fleet:
    """The laboratory's, whose control tasks talk to each other."""
    return virtual.fleet("dds", {"robot4": "control"}, dds_security=True)


def parts(fleet: Fleet, number: int) -> dict[str, str]:
    """Of a robot's card, by the element's name."""
    content, mode = identity.render(fleet, fleet.robots[number])[FILE]
    assert mode == 0o600
    elements = {element.tag.rpartition("}")[2]: element.text or "" for element in ET.fromstring(content).iter()}
    return {name: text.removeprefix("data:,") for name, text in elements.items() if text.startswith("data:,")}


def rules(document: str) -> ET.Element:
    """What a signed document says."""
    return ET.fromstring(document[document.index("<dds>") : document.index("</dds>") + len("</dds>")])


def topics(permissions: str, what: str) -> list[str | None]:
    return [topic.text for topic in rules(permissions).iterfind(f".//{what}//topic")]


def test_a_robot_may_what_its_tasks_do(fleet: Fleet) -> None:
    """And a hot standby what the task does for which it stands by."""
    expected = {
        1: (["sensors"], ["valves"]), 2: (["state"], ["sensors"]), 3: (["wrench"], ["state"]),
        4: (["wrench", "valves"], ["state", "wrench"]),
    }  # fmt: skip
    for number, (published, subscribed) in expected.items():
        permissions = parts(fleet, number)["Permissions"]
        assert (topics(permissions, "publish"), topics(permissions, "subscribe")) == (published, subscribed)
        assert rules(permissions).findtext(".//subject_name") == f"CN=robot{number}"
        assert rules(permissions).findtext(".//default") == "DENY"


def test_messages_between_tasks_are_protected(fleet: Fleet) -> None:
    governance = rules(parts(fleet, 1)["Governance"])
    assert governance.findtext(".//domains/id") == str(fleet.network.dds_domain)
    kinds = {
        rule.findtext("topic_expression"): (
            rule.findtext("metadata_protection_kind"),
            rule.findtext("enable_write_access_control"),
        )
        for rule in governance.iterfind(".//topic_rule")
    }
    between = {name for name, message in fleet.messages.items() if message.receiver != "stations"}
    assert kinds == dict.fromkeys(between, ("SIGN", "true")) | {"*": ("NONE", "false")}


def test_each_rendering_gives_the_same(fleet: Fleet, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What differs is drift. Seen to fail with the random words that S/MIME has between its parts."""
    one = parts(fleet, 3)
    dds_security._authority.cache_clear()
    assert parts(fleet, 3) == one
    assert parts(fleet, 4)["PrivateKey"] != one["PrivateKey"]
    monkeypatch.setattr(paths, "KEYS", tmp_path / "others")
    others = parts(fleet, 3)
    assert not [name for name in one if one[name] == others[name]]


def test_a_revoked_robot_is_on_everybodys_list(fleet: Fleet) -> None:
    """And gets another certificate for its next card. Seen to fail with an empty list."""

    def serial(number: int) -> int:
        return x509.load_pem_x509_certificate(parts(fleet, number)["IdentityCertificate"].encode()).serial_number

    def listed(number: int) -> list[int]:
        return [one.serial_number for one in x509.load_pem_x509_crl(parts(fleet, number)["CRL"].encode())]

    before = serial(3)
    assert listed(4) == []
    keys.revoke_host_key(fleet, fleet.robots[3])
    assert listed(3) == listed(4) == [before]
    assert serial(3) != before


def test_the_authoritys_key_is_private_and_made_once(fleet: Fleet) -> None:
    parts(fleet, 1)
    file = dds_security.authority_file()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    text = file.read_text()
    rendered = identity.render(fleet, fleet.robots[2])
    assert file.read_text() == text
    secret = re.findall("^[A-Za-z0-9+/]+$", text, re.M)[-1].encode()
    assert not [path for path, (content, _) in rendered.items() if secret in content]


@pytest.mark.parametrize("text", ["", "-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n"])
def test_a_broken_authority_is_named(fleet: Fleet, text: str) -> None:
    """Nothing is made instead of it: robots have what the one that is lost signed."""
    keys.write_once(dds_security.authority_file(), text)
    with pytest.raises(UserError, match=r"dds_authority: is no RSA key in PEM without a passphrase; restore it"):
        parts(fleet, 1)
