"""Who the robot is, and who gets in."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.fleet import operators
from flotilla.fleet.model import Board, Fleet
from flotilla.robot import ssh
from tests.boot.guests import SECONDS, has_its_identity, sh
from tests.conftest import RobotGuest


def test_identity(robot: RobotGuest, fleet: Fleet) -> None:
    has_its_identity(robot, fleet)


def test_it_has_its_address_and_no_other(robot: RobotGuest, board: Board, fleet: Fleet) -> None:
    found = {
        interface["ifname"]: {f"{address['local']}/{address['prefixlen']}" for address in interface["addr_info"]}
        for interface in json.loads(sh(robot, "ip -json address"))
    }
    own = f"{robot.robot.address}/{fleet.network.subnet.prefixlen}"
    assert found == {"lo": {"127.0.0.1/8", "::1/128"}, board.network_interface: {own}}
    routes = [route["dst"] for route in json.loads(sh(robot, "ip -json route"))]
    assert routes == [str(fleet.network.subnet)], f"routes to {routes}"


def _ssh(robot: RobotGuest, command: str, **changes: str) -> subprocess.CompletedProcess[str]:
    """A connection of its own, with other settings than everybody's."""
    options = [word for word in ssh.options(robot.robot) if word != "-o"]
    settings = dict(option.split("=", 1) for option in options) | changes
    argv = ["ssh", "-F", "none", *(f"-o{name}={value}" for name, value in settings.items())]
    argv += ["-p", str(robot.machine.ssh_port()), "127.0.0.1", command]
    return subprocess.run(argv, capture_output=True, text=True, timeout=SECONDS, check=False)


def test_host_key_is_the_pinned_one(robot: RobotGuest, tmp_path: Path) -> None:
    """All other tests come in by the pinned key; with another's pinned, nobody does."""
    known = tmp_path / "known_hosts"
    other = (paths.KEYS / "operator_ed25519.pub").read_text().split()[:2]
    known.write_text(f"{robot.robot.name} {' '.join(other)}\n")
    done = _ssh(robot, "true", UserKnownHostsFile=str(known))
    assert done.returncode == 255, f"let in with a wrong host key pinned: {done}"
    assert "Host key verification failed" in done.stderr, done.stderr
    assert _ssh(robot, "echo in").stdout == "in\n"


_KNOCK = """
import socket
knocks = [socket.create_connection(("127.0.0.1", 22)) for _ in range(7)]
print([knock.recv(100).startswith(b"SSH-2.0-") for knock in knocks])
"""


def test_connections_without_a_login_are_few(robot: RobotGuest) -> None:
    """From one address; others get in meanwhile."""
    greeted = sh(robot, f"python3 - <<'END'\n{_KNOCK}END")
    assert greeted == str([True] * 5 + [False] * 2)
    settings = sh(robot, "sshd -T").splitlines()
    assert {"logingracetime 60", "maxstartups 20:30:60", "persourcemaxstartups 5"} <= {*settings}


@pytest.fixture
def stranger(tmp_path: Path) -> Path:
    """The private key of somebody whom nobody has admitted yet."""
    return _key(tmp_path / "alice")


def _key(private: Path) -> Path:
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(private)], check=True)
    return private


def test_nobody_else_gets_in(robot: RobotGuest, stranger: Path) -> None:
    as_root = _ssh(robot, "true", User="root")
    assert as_root.returncode == 255, f"root was let in: {as_root}"
    assert "Permission denied (publickey)" in as_root.stderr, as_root.stderr
    refused = _ssh(robot, "true", IdentityFile=str(stranger))
    # The only method named is the one offered: passwords are not asked for.
    assert "Permission denied (publickey)" in refused.stderr, f"a strange key: {refused}"


def _sign(key: Path, authority: Path, principal: str, valid: str, *options: str) -> Path:
    """A certificate for a key, as no command of ours makes it."""
    argv = ["ssh-keygen", "-q", "-s", str(authority), "-I", "alice", "-n", principal, "-V", valid]
    subprocess.run([*argv, *(f"-O{option}" for option in options), f"{key}.pub"], check=True)
    return key.with_name(f"{key.name}-cert.pub").rename(key.with_name("certificate"))


def _gets_in(robot: RobotGuest, key: Path, certificate: Path) -> bool:
    done = _ssh(robot, "sudo -n id -u", IdentityFile=str(key), CertificateFile=str(certificate))
    assert done.stdout == "0\n" or "Permission denied (publickey)" in done.stderr, f"neither in nor refused: {done}"
    return done.returncode == 0


def test_who_has_a_certificate_gets_in_until_it_is_revoked(
    robot: RobotGuest, fleet: Fleet, stranger: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the files that `make admit-operator` hands out. sshd reads the list at each log-in; others still get in."""
    shutil.copytree(paths.KEYS, tmp_path / "keys")
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")
    folder, _ = operators.admit(fleet, "boot-test", stranger.with_suffix(".pub"), 30, tmp_path / "folder")
    certificate, revoked = folder / operators.CERTIFICATE, "/etc/ssh/revoked_operators"
    changes = {"IdentityFile": str(stranger), "CertificateFile": str(certificate)}
    done = _ssh(robot, "sudo -n id -u", UserKnownHostsFile=str(folder / "known_hosts"), **changes)
    assert done.stdout == "0\n", done
    key = " ".join(stranger.with_suffix(".pub").read_text().split()[:2])
    sh(robot, f"cp {revoked} /run/revoked_operators && echo '{key}' >>{revoked}")
    try:
        assert not _gets_in(robot, stranger, certificate), "revoked, and let in"
        assert _ssh(robot, "echo in").stdout == "in\n", "the operator is refused, too"
    finally:
        sh(robot, f"cat /run/revoked_operators >{revoked} && rm /run/revoked_operators")
    assert _gets_in(robot, stranger, certificate)


def test_a_certificate_that_has_ended_or_is_not_for_robots_is_refused(
    robot: RobotGuest, stranger: Path, tmp_path: Path
) -> None:
    authority, another = operators.authority(), _key(tmp_path / "another")
    assert _gets_in(robot, stranger, _sign(stranger, authority, "robot", "always:forever"))
    assert not _gets_in(robot, stranger, _sign(stranger, another, "robot", "always:forever")), "of another authority"
    assert not _gets_in(robot, stranger, _sign(stranger, authority, "root", "always:forever")), "for another user"
    assert not _gets_in(robot, stranger, _sign(stranger, authority, "robot", "20200101:20200102")), "expired"


def test_a_certificate_for_other_addresses_is_refused(robot: RobotGuest, stranger: Path, tmp_path: Path) -> None:
    """Seen to fail with a certificate without addresses."""
    here = robot.shell.run(["printenv", "SSH_CONNECTION"]).stdout.split()[0]
    authority, valid = operators.authority(), "always:forever"
    assert _gets_in(robot, stranger, _sign(stranger, authority, "robot", valid, f"source-address={here}"))
    assert not _gets_in(robot, stranger, _sign(stranger, authority, "robot", valid, "source-address=10.42.0.100"))


def test_nobody_has_a_password(robot: RobotGuest) -> None:
    fields = [line.split(":") for line in sh(robot, "cat /etc/shadow").splitlines()]
    assert len(fields) > 10, f"that is not the shadow file: {fields}"
    assert not (found := [line[0] for line in fields if line[1] not in ("!", "*", "!*")]), f"not locked: {found}"
    done = robot.shell.run(["su", "-c", "id"], check=False, stdin="robot\n")
    assert done.returncode, f"became root by a password: {done.stdout}"


def test_robot_becomes_root(robot: RobotGuest) -> None:
    assert robot.shell.run(["id", "-u"]).stdout == "1000\n"
    assert robot.shell.run(["sudo", "-n", "id", "-u"]).stdout == "0\n"
