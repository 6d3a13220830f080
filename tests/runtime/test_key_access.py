"""The private keys that commands read are those that key_access.py declares.

The commands run as users run them, with all keys in a directory that the kernel watches: it reports each file that any
process reads, so `ssh`, `ssh-keygen` and Ansible count, too. A program `ssh` reads the files that its options name, as
the real one does, and reaches no robot.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import pty
import re
import select
import shutil
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator, Set
from contextlib import contextmanager
from pathlib import Path

import pytest

from flotilla.cli.key_access import PRIVATE_KEYS
from flotilla.cli.main import commands
from flotilla.common import paths
from flotilla.fleet import identity, inventory, keys
from flotilla.fleet.model import Releases
from flotilla.lab.acceptance import outcome
from flotilla.lab.wheeled import by_wires
from flotilla.updates import bundle
from tests.running import PATIENCE
from tests.station import ADDRESS, on_loopback

SSH = f"""#!{sys.executable}
import re, sys
for word in sys.argv:
    if named := re.match('(?:IdentityFile|UserKnownHostsFile)="?(.*?)"?$', word.replace("'", "")):
        open(named[1]).read()
sys.exit("no route to the robot")
"""
PHRASE = "staple horse orbit vivid canoe"
ALL = {key.name for key in PRIVATE_KEYS}
IN_ACCESS = 0x1
"""Of inotify(7): a file was read."""

RUN = {
    "admit-operator": ["alice", "{place}/alice.pub", "--out", "{place}/out"],
    "backup-keys": ["{place}/backup", "--password-file", "{place}/phrase"],
    "check-fleet": [],
    "deploy": ["3", "examples/saw-tooth", "--run", "status"],
    "fetch": ["3", "control"],
    "hwcheck": ["3"],
    "live": ["0", "--seconds", "0.1", "--address", ADDRESS],
    "operators": [],
    "param": ["3", "control"],
    "record": ["{place}/a.mcap", "--seconds", "0.1", "--address", ADDRESS],
    "releases": ["3"],
    "revoke-key": ["2"],
    "rotate-key": ["operator", "--retire"],
    "scope": ["3", "control"],
    "ssh": ["3"],
    "station-time": [],
    "top": ["--ask", "--seconds", "1", "--address", ADDRESS],
}
"""Commands that end by themselves, with arguments; `{place}` is a directory."""
UNTIL_INTERRUPTED = {
    "drive": ["1", "--address", ADDRESS],
    "positions": ["1", "--port", "0"],
    "station": ["--port", "0", "--address", ADDRESS],
}
"""Commands that begin to serve."""
IN_PARTS = {
    "accept": "test_reports_of_acceptance_need_the_operators_key_alone",
    "bundle": "test_releases_need_their_own_keys_alone",
    "image": "test_robots_files_need_no_key_that_signs",
    "provision": "test_ansible_needs_no_key_that_signs",
    "restore-keys": "test_a_backup_has_all_keys",
    "verify": "test_a_second_build_gets_no_key_that_signs",
}
"""Commands that need root, minutes or robots: the test of their part that reads keys."""
UNWATCHED = {
    "make": "runs another one of these commands",
    "fleet": "starts guests, and logs in to them by `ssh.command`, as `releases` does",
    "power-cuts": "starts guests; signs a release by `keys.usable`, as `accept` signs",
}
WITHOUT_KEYS = {
    "boot", "boot-time", "completion", "convert", "cve", "emulate", "fleet-scale", "flash", "import-model", "init",
    "kernel", "latency", "latency-accept", "lock", "new-app", "radio-capacity", "report", "revoke-operator",
    "scenarios", "scenarios-accept", "size", "station-join", "station-leave", "verify-bundle", "wheeled",
    "wheeled-down",
}  # fmt: skip
"""Commands that are about no robot of the fleet, or make keys of their own; none may be declared to read one."""


def declared(command: str) -> set[str]:
    return {key.name for key in PRIVATE_KEYS if command in key.commands}


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    return on_loopback(tmp_path / "inventory")


@pytest.fixture(scope="module")
def made_keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All keys of the fleet, while the operator's is rotated."""
    place = tmp_path_factory.mktemp("made")
    described = inventory.load_fleet(on_loopback(place / "inventory"))
    secure = described.model_copy(update={"network": described.network.model_copy(update={"dds_security": True})})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paths, "KEYS", place / "keys")
        for robot in secure.robots.values():
            identity.render(secure, robot)
        keys.make("release_ed25519", "release")
        keys.rotate_operator_key()
    return place / "keys"


@pytest.fixture
def environment(made_keys: Path, tmp_path: Path, fleet: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Of commands: the keys, and no way to robots."""
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")
    shutil.copytree(made_keys, paths.KEYS)
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", tmp_path / "alice"], check=True)
    (tmp_path / "phrase").write_text(PHRASE)
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/ssh").write_text(SSH)
    (tmp_path / "bin/ssh").chmod(0o755)
    assert {kind(file.name) for file in paths.KEYS.iterdir()} - {None} == ALL
    return os.environ | {
        "KEYS": str(paths.KEYS), "BUILD": str(tmp_path / "build"), "INVENTORY": str(fleet),
        "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}",
    }  # fmt: skip


def kind(file: str) -> str | None:
    """The private key in a file; None for public halves and lists."""
    if re.fullmatch(r"robot\d+_ed25519", file):
        return "robotN_ed25519"
    name = {"release_ed25519": "NAME_ed25519", "operator_ed25519.retired": "operator_ed25519"}.get(file, file)
    return name if name in ALL else None


class Watch:
    """Of the directory of keys."""

    def __init__(self) -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        self.fd = libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        if self.fd < 0 or libc.inotify_add_watch(self.fd, os.fsencode(paths.KEYS), IN_ACCESS) < 0:
            raise OSError(ctypes.get_errno(), "inotify")

    def read(self) -> set[str]:
        """Private keys that were read since the last call."""
        found = set[str]()
        while True:
            try:
                data = os.read(self.fd, 1 << 16)
            except BlockingIOError:
                return found
            at = 0
            while at < len(data):
                length = struct.unpack_from("iIII", data, at)[3]
                if key := kind(data[at + 16 : at + 16 + length].rstrip(b"\0").decode()):
                    found.add(key)
                at += 16 + length


@contextmanager
def watching() -> Iterator[Watch]:
    watch = Watch()
    try:
        yield watch
    finally:
        os.close(watch.fd)


def run(argv: list[str], environment: dict[str, str]) -> Set[str]:
    """Keys that `flotilla` reads until it ends."""
    with watching() as watch:
        done = subprocess.run(
            [sys.executable, "-m", "flotilla", *argv], cwd=paths.PROJECT, env=environment, stdin=subprocess.DEVNULL,
            capture_output=True, text=True, timeout=PATIENCE,
        )  # fmt: skip
        assert "Traceback" not in done.stderr, done.stderr
        assert "usage:" not in done.stderr, done.stderr
        return watch.read()


def test_every_command_is_in_one_of_the_lists() -> None:
    listed = [*RUN, *UNTIL_INTERRUPTED, *IN_PARTS, *UNWATCHED, *WITHOUT_KEYS]
    assert sorted(listed) == sorted(command.name for command in commands())
    assert {name for key in PRIVATE_KEYS for name in key.commands} <= set(listed) - WITHOUT_KEYS
    assert not [name for name, test in IN_PARTS.items() if test not in globals()]


THREATS = (paths.PROJECT / "docs/explanation/threats.md").read_text(encoding="utf-8")


def test_the_page_of_threats_has_the_declaration() -> None:
    """Its table has the commands that need a private key's file; what an agent may have, none needs."""
    rows = re.findall(r"^\| `(\w+)` \| [^|]+ \| [^|]+ \| ([^|]+) \| (yes|no) \|$", THREATS, re.MULTILINE)
    assert {name: (set(re.findall(r"`([a-z-]+)`", read)), agent == "yes") for name, read, agent in rows} == {
        key.name: (set(key.commands), key.in_agent) for key in PRIVATE_KEYS
    }


@pytest.mark.nightly  # together they take most of a minute of processor time
@pytest.mark.parametrize("command", sorted(RUN.keys() - {"backup-keys"}))
def test_a_command_reads_the_private_keys_that_are_declared(
    command: str, environment: dict[str, str], tmp_path: Path
) -> None:
    """No more, and no fewer."""
    arguments = [word.format(place=tmp_path) for word in RUN[command]]
    assert run([command, *arguments], environment) == declared(command)


@pytest.mark.nightly  # together they take most of a minute of processor time
@pytest.mark.parametrize("command", sorted(UNTIL_INTERRUPTED))
def test_a_command_that_serves_reads_the_private_keys_that_are_declared(
    command: str, environment: dict[str, str], tmp_path: Path
) -> None:
    if command == "drive":
        shutil.rmtree(tmp_path / "inventory")
        on_loopback(tmp_path / "inventory", fleet=by_wires.INVENTORY)
    controller, terminal = pty.openpty()
    argv = [sys.executable, "-m", "flotilla", command, *UNTIL_INTERRUPTED[command]]
    with watching() as watch:
        process = subprocess.Popen(argv, cwd=paths.PROJECT, env=environment, stdin=terminal, stdout=terminal,
                                   stderr=terminal, start_new_session=True)  # fmt: skip
        os.close(terminal)
        shown, found, ended = b"", set[str](), False
        try:
            while not ended:
                ready, _, _ = select.select([watch.fd, controller], [], [], PATIENCE)
                assert ready, f"{declared(command) - found} not read: {shown.decode()}"
                found |= watch.read()
                if controller in ready:
                    with contextlib.suppress(OSError):  # EIO: the program has ended
                        more = os.read(controller, 1 << 12)
                        shown += more
                        continue
                    ended = True
                elif found >= declared(command):
                    process.send_signal(signal.SIGINT)
        finally:
            process.kill()
        process.wait()
        os.close(controller)
    assert found == declared(command), shown.decode()


def test_a_backup_has_all_keys(environment: dict[str, str], tmp_path: Path) -> None:
    arguments = [word.format(place=tmp_path) for word in RUN["backup-keys"]]
    assert run(["backup-keys", *arguments], environment) == ALL
    assert run(["restore-keys", *arguments], environment) == ALL


def test_ansible_needs_no_key_that_signs(environment: dict[str, str], tmp_path: Path) -> None:
    """Of the example's inventory, whose robots send no DDS messages that are signed."""
    del environment["INVENTORY"]
    assert run(["provision", "--robot", "3"], environment) == declared("provision") - {"dds_authority"}


@pytest.mark.parametrize("signed", [False, True])
def test_robots_files_need_no_key_that_signs(environment: dict[str, str], fleet: Path, signed: bool) -> None:
    described = inventory.load_fleet(fleet)
    network = described.network.model_copy(update={"dds_security": signed})
    with watching() as watch:
        identity.render(described.model_copy(update={"network": network}), described.robots[3])
        assert watch.read() == declared("image") - (set() if signed else {"dds_authority"})


def test_releases_need_their_own_keys_alone(environment: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "slot").mkdir()
    (tmp_path / "slot/slot.img").write_bytes(bytes(512))
    (tmp_path / "slot/header.json").write_text("{}")
    with watching() as watch:
        bundle.pack(tmp_path / "made.bundle", tmp_path / "slot", Releases(), {}, 0)
        assert watch.read() == declared("bundle")


def test_reports_of_acceptance_need_the_operators_key_alone(environment: dict[str, str]) -> None:
    with watching() as watch:
        outcome.signature(b"report")
        assert watch.read() == declared("accept")


def test_a_second_build_gets_no_key_that_signs(environment: dict[str, str], tmp_path: Path, fleet: Path) -> None:
    """Seen to fail: `make verify` copied all keys to a directory that another user may read."""
    described = inventory.load_fleet(fleet)
    before = identity.render(described, described.robots[3])
    with watching() as watch:
        keys.copy_for_image(described.robots[3], tmp_path / "copy")
        assert watch.read() == declared("verify")
    copied = {file.name for file in (tmp_path / "copy").iterdir()}
    assert {name for name in copied if kind(name)} == {"fleet_secret", "dds_authority", "robot3_ed25519"}
    paths.KEYS.rename(tmp_path / "away")
    (tmp_path / "copy").rename(paths.KEYS)
    assert identity.render(described, described.robots[3]) == before
