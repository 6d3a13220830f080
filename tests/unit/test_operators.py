"""Operators by certificate: admitted for some days, renewed, revoked; what robots get of that."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path, PurePosixPath

import pytest

from flotilla.cli import main as command_line
from flotilla.common import durable, paths
from flotilla.common.errors import UserError
from flotilla.fleet import identity, key_backup, keys, operators
from flotilla.fleet.model import Fleet
from tests import terminal

NOW = datetime(2026, 11, 26, 12, 30, 45, tzinfo=UTC)


pytestmark = pytest.mark.usefixtures("own_keys")


@pytest.fixture(autouse=True)
def _now_and_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paths, "OPERATORS", tmp_path / "operators")
    monkeypatch.setattr(operators, "_now", lambda: NOW)


def later(monkeypatch: pytest.MonkeyPatch, days: int) -> None:
    monkeypatch.setattr(operators, "_now", lambda: NOW + timedelta(days=days))


def key(directory: Path, name: str, *kind: str) -> Path:
    """The file of a new public key."""
    file = directory / name
    argv = ["ssh-keygen", "-q", "-t", *(kind or ("ed25519",)), "-N", "", "-C", f"{name}@home", "-f", str(file)]
    subprocess.run(argv, check=True, capture_output=True)
    return file.with_name(f"{name}.pub")


@pytest.fixture
def alice(tmp_path: Path) -> Path:
    return key(tmp_path, "alice")


def bare(public: Path) -> str:
    return " ".join(public.read_text().split()[:2])


def described(certificate: Path) -> str:
    argv = ["ssh-keygen", "-L", "-f", str(certificate)]
    return subprocess.run(
        argv, check=True, capture_output=True, text=True, env=os.environ | {"TZ": "UTC"}
    ).stdout.replace("\t", " ")


def admit(fleet: Fleet, name: str, file: Path, days: int = 30) -> Path:
    return operators.admit(fleet, name, file, days, None)[0] / operators.CERTIFICATE


def on_robot(fleet: Fleet, name: str) -> str:
    content, mode = identity.render(fleet, fleet.robots[3])[PurePosixPath("/etc/ssh") / name]
    assert mode == 0o644
    return content.decode()


@pytest.mark.parametrize(
    "kind", [("ed25519",), ("ecdsa", "-b", "384"), ("rsa", "-b", "2048")], ids=lambda kind: kind[0]
)
def test_a_certificate_is_for_the_robots_user_until_its_day(
    fleet: Fleet, tmp_path: Path, kind: tuple[str, ...]
) -> None:
    """In any time zone, from always, and without a right but a terminal.

    Seen to fail: without `TZ`, another `-n`, without `-O clear`, without the suffix of days.
    """
    public = key(tmp_path, "bob", *kind)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TZ", "Asia/Tokyo")
        admit(fleet, "alice", key(tmp_path, "alice"))
        said = described(admit(fleet, "bob", public))
    assert "user certificate" in said
    assert re.search(r'^ +Key ID: "bob"\n +Serial: 2\n +Valid: before 2026-12-26T12:30:45$', said, re.MULTILINE), said
    principals = re.search(r"Principals:\s*\n(.*?) +Critical Options: (.*)\n +Extensions:\s*\n(.*)", said, re.DOTALL)
    assert principals
    assert [part.split() for part in principals.groups()] == [["robot"], ["(none)"], ["permit-pty"]]
    signer = subprocess.run(
        ["ssh-keygen", "-l", "-f", f"{operators.authority()}.pub"], check=True, capture_output=True, text=True
    ).stdout
    assert signer.split()[1] in said.partition("Signing CA:")[2].splitlines()[0]


def test_the_folder_has_what_plain_ssh_needs(fleet: Fleet, tmp_path: Path, alice: Path) -> None:
    """The robots' pinned keys, also in a folder of one's own, and nothing private."""
    folder, admission = operators.admit(fleet, "alice", alice, 7, tmp_path / "a folder" / "own")
    assert folder == tmp_path / "a folder" / "own"
    assert admission.until == NOW + timedelta(days=7)
    assert {file.name for file in folder.iterdir()} == {"operator_ed25519-cert.pub", "known_hosts"}
    assert (folder / "known_hosts").read_text() == (paths.KEYS / "known_hosts").read_text()
    assert len((folder / "known_hosts").read_text().splitlines()) == len(fleet.robots)
    assert admit(fleet, "alice", alice).parent == paths.OPERATORS / "alice"
    taken = tmp_path / "file"
    taken.touch()
    before = (paths.KEYS / "operators").read_text()
    with pytest.raises(UserError, match=r"file: File exists; OUT= is the folder"):
        operators.admit(fleet, "alice", alice, 7, taken)
    assert (paths.KEYS / "operators").read_text() == before


@pytest.mark.parametrize("name", ["", "Alice", "3a", "a b", "../a", "a.b", "-a", "a\n"])
def test_a_name_is_a_simple_word(fleet: Fleet, alice: Path, name: str) -> None:
    with pytest.raises(UserError, match=rf"^NAME={re.escape(name)}: is no name; take small letters"):
        admit(fleet, name, alice)


def test_a_certificate_may_be_for_some_addresses_alone(fleet: Fleet, alice: Path) -> None:
    """Within the robots' network; `make operators` shows them."""
    folder, _ = operators.admit(fleet, "alice", alice, 30, None, "10.42.0.100,10.42.0.128/28,10.42.0.101/32")
    options = described(folder / operators.CERTIFICATE).partition("Critical Options:")[2].partition("Extensions:")[0]
    assert options.split() == ["source-address", "10.42.0.100,10.42.0.128/28,10.42.0.101"]
    shown = "alice  until 2026-12-26 12:30 UTC  from 10.42.0.100, 10.42.0.128/28, 10.42.0.101"
    assert operators.table() == shown
    operators.revoke("alice")
    assert operators.table() == f"{shown}  revoked"


@pytest.mark.parametrize(
    ("sources", "problem"),
    [
        ("10.42.0.1/24", "10.42.0.1/24 has host bits set; take addresses, or networks as 10.0.0.0/24, commas between"),
        ("10.42.0.0/33", "'33' is not a valid netmask"),
        ("10.42.0.1 10.42.0.2", "Expected 4 octets in '10.42.0.1 10.42.0.2'"),
        ("alice.local", "Expected 4 octets in 'alice.local'"),
        ("10.42.0.1,192.168.1.0/24", "192.168.1.0/24 is outside of 10.42.0.0/24, and nobody reaches a robot"),
    ],
)
def test_addresses_are_of_the_robots_network(fleet: Fleet, alice: Path, sources: str, problem: str) -> None:
    with pytest.raises(UserError, match=rf"^FROM={re.escape(sources)}: {re.escape(problem)}"):
        operators.admit(fleet, "alice", alice, 30, None, sources)
    assert not (paths.KEYS / "operators").exists()


@pytest.mark.parametrize("days", [-1, 0, 366])
def test_days_have_limits(fleet: Fleet, alice: Path, days: int) -> None:
    with pytest.raises(UserError, match=rf"^DAYS={days}: take 1 to 365"):
        admit(fleet, "alice", alice, days)
    admit(fleet, "alice", alice, 365)
    admit(fleet, "alice", alice, 1)


def test_only_a_public_key_is_signed(fleet: Fleet, tmp_path: Path, alice: Path) -> None:
    kind, encoded, _ = alice.read_text().split()
    wrong = {
        "garbage": ("hello\n", "is no public key; give a file with one public key"),
        "empty": ("", "is no public key"),
        "two": (alice.read_text() * 2, "is no public key"),
        "options": (f'command="true" {alice.read_text()}', "is no public key"),
        "certificate": (admit(fleet, "carol", key(tmp_path, "carol")).read_text(), "is no public key"),
        "another kind": (f"ssh-rsa {encoded}\n", "cannot be signed: .*"),
        "short": (f"{kind} {encoded[:40]}\n", "cannot be signed: .*"),
        "base64": (f"{kind} {encoded[:-1]}\n", "is no public key: .*padding"),
        "dsa": (f"ssh-dss {encoded}\n", "is no public key"),
    }
    before = (paths.KEYS / "operators").read_text()
    for name, (text, problem) in wrong.items():
        file = tmp_path / name
        file.write_text(text)
        with pytest.raises(UserError, match=f"{name}: {problem}"):
            admit(fleet, "alice", file)
    file.write_bytes(b"\xff\xfe")
    with pytest.raises(UserError, match="dsa: is no text"):
        admit(fleet, "alice", file)
    with pytest.raises(UserError, match="none: No such file or directory; give a file"):
        admit(fleet, "alice", tmp_path / "none")
    for format_ in ("RFC4716", "PEM"):
        private = key(tmp_path, format_, "rsa", "-m", format_).with_suffix("")
        with pytest.raises(UserError, match=rf"{format_}: is a private key, .*; give the public half, {format_}\.pub"):
            admit(fleet, "alice", private)
    assert (paths.KEYS / "operators").read_text() == before
    assert not (paths.OPERATORS / "alice" / operators.CERTIFICATE).exists()


@pytest.mark.parametrize(
    "name", ["operator_ed25519", "operator_ed25519.retired", "operator_authority", "robot3_ed25519"]
)
def test_a_key_of_the_fleet_is_no_persons(fleet: Fleet, name: str) -> None:
    """Seen to fail: the operator's own key was admitted, and `revoke-operator` would have locked everybody out."""
    keys.rotate_operator_key()
    with pytest.raises(UserError, match=r"\.pub: is a key of .*keys; take one of alice's own"):
        admit(fleet, "alice", paths.KEYS / f"{name}.pub")


def test_a_renewal_is_another_certificate_of_the_same_key(
    fleet: Fleet, alice: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table has a key's last day, since an earlier certificate lasts though a later one is shorter."""
    admit(fleet, "alice", alice, 30)
    later(monkeypatch, 1)
    said = described(admit(fleet, "alice", alice, 2))
    assert "Serial: 2" in said
    assert "before 2026-11-29T12:30:45" in said
    assert operators.table() == "alice  until 2026-12-26 12:30 UTC"
    admit(fleet, "alice", alice, 60)
    assert operators.table() == "alice  until 2027-01-26 12:30 UTC"


def test_another_key_waits_for_the_first_ones_end(
    fleet: Fleet, tmp_path: Path, alice: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    admit(fleet, "alice", alice)
    other = key(tmp_path, "other")
    with pytest.raises(
        UserError, match=r"^NAME=alice: is admitted with another key until 2026-12-26 12:30 UTC; `make revoke-operator"
    ):
        admit(fleet, "alice", other)
    with pytest.raises(UserError, match=r"alice\.pub: is the key of alice, .*; bob needs one of their own"):
        admit(fleet, "bob", alice)
    later(monkeypatch, 30)
    admit(fleet, "alice", other)
    assert operators.table().splitlines() == sorted(
        ["alice  until 2026-12-26 12:30 UTC  expired", "alice  until 2027-01-25 12:30 UTC"],
        key=lambda line: (bare(alice) > bare(other)) == ("expired" in line),
    )


def test_robots_refuse_who_is_revoked(fleet: Fleet, tmp_path: Path, alice: Path) -> None:
    """Each key of that name, once, and nobody else's; a new key is admitted again."""
    comment, *none = on_robot(fleet, "revoked_operators").splitlines()
    assert (comment[0], none) == ("#", [])
    admit(fleet, "alice", alice)
    admit(fleet, "alice", alice)
    admit(fleet, "bob", key(tmp_path, "bob"))
    assert on_robot(fleet, "revoked_operators") == f"{comment}\n"
    operators.revoke("alice")
    operators.revoke("alice")
    assert (paths.KEYS / "revoked_operators").read_text() == f"{bare(alice)} alice\n"
    assert on_robot(fleet, "revoked_operators") == f"{comment}\n{bare(alice)}\n"
    until = "until 2026-12-26 12:30 UTC"
    assert operators.table().splitlines() == [f"alice  {until}  revoked", f"bob    {until}"]
    with pytest.raises(
        UserError, match=r"alice\.pub: this key was revoked, and robots reject it; alice needs a new one"
    ):
        admit(fleet, "alice", alice)
    other = key(tmp_path, "other")
    admit(fleet, "alice", other)
    operators.revoke("alice")
    assert operators.revoked() == [bare(alice), bare(other)]


def test_whom_nobody_knows_is_not_revoked(fleet: Fleet, tmp_path: Path, alice: Path) -> None:
    with pytest.raises(UserError, match=r"^NAME=eve: no operator of that name was admitted; nobody was"):
        operators.revoke("eve")
    admit(fleet, "bob", key(tmp_path, "bob"))
    admit(fleet, "alice", alice)
    with pytest.raises(UserError, match=r"^NAME=eve: no operator of that name was admitted; take one of: alice, bob$"):
        operators.revoke("eve")
    assert not (paths.KEYS / "revoked_operators").exists()


def test_robots_trust_the_authority_and_always_have_a_list(fleet: Fleet) -> None:
    """sshd refuses every key without the list. The layer above /etc of a robot that takes its release from an older one
    has none yet, so the root has one.

    Seen to fail without the root's list, and with a path that is none of the robot's files.
    """
    assert on_robot(fleet, "operator_authority.pub") == f"{keys.public(operators.authority())}\n"
    settings = (paths.OVERLAY / "etc/ssh/sshd_config.d/flotilla.conf").read_text()
    named = dict(re.findall(r"^(TrustedUserCAKeys|RevokedKeys) (\S+)$", settings, re.MULTILINE))
    assert sorted(named) == ["RevokedKeys", "TrustedUserCAKeys"]
    assert {PurePosixPath(file) for file in named.values()} <= set(identity.render(fleet, fleet.robots[3]))
    default = paths.OVERLAY / named["RevokedKeys"].lstrip("/")
    assert {line[0] for line in default.read_text().splitlines()} == {"#"}


def test_all_of_it_is_in_a_backup(fleet: Fleet, tmp_path: Path, alice: Path) -> None:
    admit(fleet, "alice", alice)
    operators.revoke("alice")
    (password := tmp_path / "password").write_text("correct horse\n")
    before = {file.name: file.read_bytes() for file in paths.KEYS.iterdir()}
    assert {"operator_authority", "operator_authority.pub", "operators", "revoked_operators"} <= set(before)
    key_backup.backup(tmp_path / "backup", password)
    shutil.rmtree(paths.KEYS)
    key_backup.restore(tmp_path / "backup", password)
    assert {file.name: file.read_bytes() for file in paths.KEYS.iterdir()} == before


@pytest.mark.parametrize("content", ["", "{", "[1]", '[{"name": "alice"}]'])
def test_a_list_that_cannot_be_read_is_named(fleet: Fleet, alice: Path, content: str) -> None:
    """And stays as it is: a certificate that is on no list cannot be revoked."""
    (paths.KEYS / "operators").write_text(content)
    with pytest.raises(UserError, match=r"keys/operators: is no list of operators: .*; restore it"):
        admit(fleet, "alice", alice)
    assert (paths.KEYS / "operators").read_text() == content


def test_whatever_is_handed_out_is_on_the_list(fleet: Fleet, alice: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupted before each of the files. Seen to fail with the list written last."""
    write = durable.write
    for interrupted_at in (1, 2, 3):
        written: list[Path] = []

        def interrupted(file: Path, text: str, at: int = interrupted_at, written: list[Path] = written) -> None:
            written.append(file)
            if len(written) == at:
                raise KeyboardInterrupt
            write(file, text)

        with monkeypatch.context() as patch:
            patch.setattr(durable, "write", interrupted)
            with pytest.raises(KeyboardInterrupt):
                admit(fleet, "alice", alice)
        listed = (paths.KEYS / "operators").exists()
        assert listed == (interrupted_at > 1)
        assert not (paths.OPERATORS / "alice" / operators.CERTIFICATE).exists()


def test_the_commands_say_what_comes_next(
    fleet: Fleet, alice: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def said(*words: str) -> str:
        monkeypatch.setattr(sys, "argv", ["flotilla", *words])
        assert command_line.main() == 0
        return capsys.readouterr().out

    assert said("operators") == "no operator was admitted by a certificate; `make admit-operator` does so\n"
    admitted = said("admit-operator", "alice", str(alice), "--days", "2")
    assert admitted.startswith(f"{paths.OPERATORS}/alice: a certificate for alice until 2026-11-28 12:30 UTC, ")
    assert (
        "ssh -i KEY -o CertificateFile=operator_ed25519-cert.pub -o UserKnownHostsFile=known_hosts robot@" in admitted
    )
    assert "`make provision`" in said("revoke-operator", "alice")
    assert said("operators") == "alice  until 2026-11-28 12:30 UTC  revoked\n"


def test_the_authoritys_passphrase_is_asked_on_the_terminal(alice: Path, tmp_path: Path) -> None:
    """Seen to fail with ssh-keygen in a session of its own."""
    argv = ["ssh-keygen", "-q", "-p", "-N", "correct horse", "-f", str(operators.authority())]
    subprocess.run(argv, check=True, capture_output=True)
    arguments = ["admit-operator", "alice", str(alice), "--out", str(tmp_path / "out")]
    terminal.answered(arguments, {"Enter passphrase": "correct horse"})
    assert (tmp_path / "out" / operators.CERTIFICATE).exists()


def test_the_list_is_json(fleet: Fleet, alice: Path) -> None:
    admit(fleet, "alice", alice)
    (one,) = json.loads((paths.KEYS / "operators").read_text())
    assert one == {"name": "alice", "serial": 1, "key": bare(alice), "until": "2026-12-26T12:30:45Z", "sources": []}
