"""Keys of a fleet: made once, rotated, revoked, backed up; the files that lie in its directory of keys."""

from __future__ import annotations

import io
import os
import re
import shutil
import stat
import subprocess
import sys
import tarfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import pytest

from flotilla.cli import main as command_line
from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import identity, key_backup, keys
from flotilla.fleet.model import Fleet, Robot
from flotilla.robot import operator_key, ssh
from tests import terminal

pytestmark = pytest.mark.usefixtures("own_keys")


def content() -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in paths.KEYS.iterdir()}


def known_hosts() -> list[str]:
    return (paths.KEYS / "known_hosts").read_text().splitlines()


def test_keys_are_made_once_pinned_and_private(fleet: Fleet) -> None:
    first = keys.host_keys(fleet)
    assert keys.host_keys(fleet) == first
    assert len(set(first.values())) == len(fleet.robots)
    assert stat.S_IMODE((paths.KEYS / "robot3_ed25519").stat().st_mode) == 0o600
    known = (paths.KEYS / "known_hosts").read_text()
    assert f"robot3,{fleet.robots[3].address} {first['robot3']}\n" in known
    content, mode = identity.render(fleet, fleet.robots[3])[PurePosixPath("/etc/ssh/ssh_host_ed25519_key")]
    assert mode == 0o600
    assert content == (paths.KEYS / "robot3_ed25519").read_bytes()


def test_a_rotated_host_key_is_accepted_beside_the_old_one_until_that_is_retired(fleet: Fleet) -> None:
    robot = fleet.robots[3]
    old = keys.host_keys(fleet)["robot3"]
    keys.rotate_host_key(fleet, robot)
    new = keys.host_keys(fleet)["robot3"]
    known = paths.KEYS / "known_hosts"
    assert new != old
    assert {f"robot3,10.42.0.3 {key}" for key in (old, new)} <= set(known.read_text().splitlines())
    keys.retire_host_key(fleet, robot)
    assert old not in known.read_text()
    assert new in known.read_text()


def test_a_revoked_host_key_is_refused_everywhere(fleet: Fleet) -> None:
    """One that was being rotated, too, so both. Who has the robot meets `ssh`'s refusal, whatever address it takes."""
    assert (
        "@revoked" not in identity.render(fleet, fleet.robots[4])[PurePosixPath("/etc/ssh/ssh_known_hosts")][0].decode()
    )
    robot = fleet.robots[3]
    old = keys.host_keys(fleet)["robot3"]
    keys.rotate_host_key(fleet, robot)
    newer = keys.host_keys(fleet)["robot3"]
    keys.revoke_host_key(fleet, robot)
    newest = keys.host_keys(fleet)["robot3"]
    assert len({old, newer, newest}) == 3
    assert keys.revoked() == [newer, old]
    lines = [f"@revoked * {key}" for key in (newer, old)]
    assert known_hosts()[-2:] == lines
    assert [line for line in known_hosts()[:-2] if line.startswith("robot3,")] == [f"robot3,10.42.0.3 {newest}"]
    on_robot, _ = identity.render(fleet, fleet.robots[4])[PurePosixPath("/etc/ssh/ssh_known_hosts")]
    assert on_robot.decode().splitlines()[-2:] == lines
    keys.revoke_host_key(fleet, robot)
    assert keys.revoked() == [newer, old, newest]


def test_an_operators_key_is_rotated_and_the_former_one_serves_until_it_is_retired(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = fleet.robots[3]
    before = keys.operator().read_bytes()
    assert identities(robot) == [str(paths.KEYS / "operator_ed25519")]
    keys.rotate_operator_key()
    former = keys.former_operator()
    assert former
    assert former.read_bytes() == before != keys.operator().read_bytes()
    assert stat.S_IMODE(former.stat().st_mode) == 0o600
    assert identities(robot) == [str(paths.KEYS / "operator_ed25519"), str(former)]
    admitted, _ = identity.render(fleet, robot)[PurePosixPath("/etc/ssh/authorized_keys/robot")]
    assert admitted.decode().split() == keys.public(keys.operator()).split(), "the new one alone"
    with pytest.raises(UserError, match=r"operator_ed25519\.retired: an earlier rotation has not ended; .*RETIRE=1"):
        keys.rotate_operator_key()

    asked: list[str] = []

    def output(robot: Robot, words: Sequence[str], by: Sequence[str]) -> str:
        assert not [word for word in by if "retired" in word], "the key that is to go would let itself in"
        asked.append(robot.name)
        if robot.name == "robot2":
            raise UserError("robot2 did not answer: Permission denied")
        return ""

    monkeypatch.setattr(ssh, "output", output)
    kept = content()
    with pytest.raises(
        UserError, match=r"^robot2 did not answer.*\nthe former operator's key is kept: .*make provision"
    ):
        operator_key.retire(fleet, force=False)
    assert sorted(asked) == ["robot1", "robot2", "robot3", "robot4"]
    assert content() == kept
    operator_key.retire(fleet, force=True)
    assert identities(robot) == [str(paths.KEYS / "operator_ed25519")]
    assert not [name for name in content() if "retired" in name]
    with pytest.raises(UserError, match="there is no former operator's key"):
        operator_key.retire(fleet, force=False)


def identities(robot: Robot) -> list[str]:
    return re.findall(r'IdentityFile="(.*?)"', "\n".join(ssh.options(robot)))


@pytest.mark.parametrize("interrupted_at", [1, 2])
def test_an_interrupted_rotation_leaves_a_key_that_robots_admit(
    interrupted_at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before either of the two renames."""
    before = keys.operator().read_bytes()
    replace, calls = Path.replace, []

    def interrupted(file: Path, target: Path) -> Path:
        calls.append(file)
        if len(calls) == interrupted_at:
            raise KeyboardInterrupt
        return replace(file, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", interrupted)
        with pytest.raises(KeyboardInterrupt):
            keys.rotate_operator_key()
    now = keys.operator()
    assert keys.public(now) in subprocess.run(["ssh-keygen", "-y", "-f", now], capture_output=True, text=True).stdout
    assert before in {now.read_bytes(), (former := keys.former_operator()) and former.read_bytes()}


MAKE = """
from flotilla.fleet import keys
print("ready", flush=True)
input()
keys.operator()
"""


def test_processes_at_once_make_one_key() -> None:
    """Provisioning renders robots' files in processes of their own, and a newer checkout may need one key more.

    Seen to fail without `keys.alone`: one process found the key that another was about to rename.
    """
    for file in paths.KEYS.glob("operator_ed25519*"):
        file.unlink()
    argv, environment = [sys.executable, "-c", MAKE], os.environ | {"KEYS": str(paths.KEYS)}
    processes = [
        subprocess.Popen(
            argv, cwd=paths.PROJECT, env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        for _ in range(6)
    ]  # fmt: skip
    for process in processes:
        assert process.stdout
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        assert process.stdin
        process.stdin.write("\n")
        process.stdin.flush()
    for process in processes:
        _, stderr = process.communicate()
        assert process.returncode == 0, stderr
    private = paths.KEYS / "operator_ed25519"
    read = subprocess.run(["ssh-keygen", "-y", "-f", private], check=True, capture_output=True, text=True).stdout
    assert read.split()[:2] == keys.public(private).split()


# --- backup ---


@pytest.fixture
def password(tmp_path: Path) -> Path:
    file = tmp_path / "password"
    file.write_text("correct horse\n")
    return file


@pytest.fixture
def in_the_clear(monkeypatch: pytest.MonkeyPatch) -> None:
    """Backups without Ansible's vault, which takes a second each time."""

    def vault(what: str, password: Path | None, content: bytes, out: Path | None = None) -> bytes:
        if out:
            out.write_bytes(content)
        return content

    monkeypatch.setattr(key_backup, "_vault", vault)


def test_keys_come_back_from_a_backup(tmp_path: Path, password: Path) -> None:
    """Encrypted: nothing of a key is in the file. What is there already is no obstacle, if it is the same."""
    before, out = content(), tmp_path / "keys.backup"
    assert key_backup.backup(out, password) == len(before)
    assert stat.S_IMODE(out.stat().st_mode) == 0o600
    assert out.read_bytes().startswith(b"$ANSIBLE_VAULT;1.1;AES256\n")
    shutil.rmtree(paths.KEYS)
    assert key_backup.restore(out, password) == len(before)
    assert content() == before
    assert {stat.S_IMODE(file.stat().st_mode) for file in paths.KEYS.iterdir()} == {0o600}
    (paths.KEYS / "robot1_ed25519").unlink()
    key_backup.restore(out, password)
    assert content() == before


def test_a_backup_replaces_no_other_keys(fleet: Fleet, tmp_path: Path, password: Path) -> None:
    out = tmp_path / "keys.backup"
    key_backup.backup(out, password)
    keys.rotate_host_key(fleet, fleet.robots[3])
    before = content()
    with pytest.raises(
        UserError, match=r"keys: known_hosts, robot3_ed25519, .*not those of the backup; move them away"
    ):
        key_backup.restore(out, password)
    assert content() == before


@pytest.mark.parametrize("damage", ["passphrase", "bytes", "no tar"])
def test_a_backup_that_cannot_be_read_changes_nothing(tmp_path: Path, password: Path, damage: str) -> None:
    before, out = content(), tmp_path / "keys.backup"
    key_backup.backup(out, password)
    if damage == "passphrase":
        password.write_text("another\n")
    elif damage == "bytes":
        text = out.read_text()
        out.write_text(text[:200] + ("0" if text[200] != "0" else "1") + text[201:])
    else:
        done = key_backup._vault("encrypt", password, b"no tar")
        out.write_bytes(done)
    with pytest.raises(UserError, match=r"no backup of keys" if damage == "no tar" else r"ansible-vault decrypt: .+"):
        key_backup.restore(out, password)
    assert content() == before


@pytest.mark.usefixtures("in_the_clear")
@pytest.mark.parametrize(
    ("name", "changed", "said"),
    [
        ("/etc/cron.d/x", {}, "'/etc/cron.d/x' is no name of a key"),
        ("../robot1_ed25519", {}, "'../robot1_ed25519' is no name of a key"),
        ("a/b", {}, "'a/b' is no name of a key"),
        (".", {}, "'.' is no name of a key"),
        (".ssh", {}, "'.ssh' is no name of a key"),
        ("a\nb", {}, r"'a\\nb' is no name of a key"),
        ("x" * 201, {}, "is no name of a key"),
        (".", {"type": tarfile.DIRTYPE}, "'.' is no plain file"),
        ("robot9", {"type": tarfile.SYMTYPE, "linkname": "/etc/passwd"}, "'robot9' is no plain file"),
        ("robot9", {"type": tarfile.LNKTYPE, "linkname": "known_hosts"}, "'robot9' is no plain file"),
        ("robot9", {"type": tarfile.FIFOTYPE}, "'robot9' is no plain file"),
        ("robot9", {"type": tarfile.BLKTYPE}, "'robot9' is no plain file"),
        ("robot9", {"type": tarfile.CONTTYPE}, "'robot9' is no plain file"),
        ("robot9", {"pax_headers": {"GNU.sparse.map": "0,1", "GNU.sparse.size": "999"}}, "'robot9' is no plain file"),
        ("robot9", {"size": (1 << 20) + 1}, "'robot9' has 1048577 bytes"),
        ("robot9", {"size": 1 << 40}, "'robot9' has 1099511627776 bytes"),
        ("robot9", {"size": 1 << 19}, "no backup of keys: unexpected end of data"),
        ("known_hosts", {}, "'known_hosts' stands twice"),
    ],
)
def test_a_backup_brings_nothing_but_keys(tmp_path: Path, name: str, changed: dict[str, object], said: str) -> None:
    """Seen to fail where tarfile unpacked: in the directory of keys, directories and links were restored."""
    before, archive = content(), io.BytesIO()
    for each, fields in (("known_hosts", {}), (name, changed)):
        member = tarfile.TarInfo(each)
        vars_of = {"size": 1} | fields
        for field, value in vars_of.items():
            setattr(member, field, value)
        archive.write(member.tobuf(tarfile.PAX_FORMAT) + b"x".ljust(512, b"\0"))
    out = tmp_path / "keys.backup"
    out.write_bytes(archive.getvalue() + bytes(1024))
    with pytest.raises(UserError, match=said):
        key_backup.restore(out, None)
    assert content() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["keys", "keys.backup"]


@pytest.mark.usefixtures("in_the_clear")
def test_modes_of_a_backup_do_not_count(tmp_path: Path) -> None:
    """Whatever the umask, and whatever the tar says: setuid, or readable by all."""
    archive, out = io.BytesIO(), tmp_path / "keys.backup"
    member = tarfile.TarInfo("robot9_ed25519")
    member.mode, member.uid, member.size = 0o6777, 1234, 3
    with tarfile.open(fileobj=archive, mode="w") as tar:
        tar.addfile(member, io.BytesIO(b"key"))
    out.write_bytes(archive.getvalue())
    shutil.rmtree(paths.KEYS)
    assert key_backup.restore(out, None) == 1
    found = (paths.KEYS / "robot9_ed25519").stat()
    assert (stat.S_IMODE(found.st_mode), found.st_uid) == (0o600, os.geteuid())


@pytest.mark.usefixtures("in_the_clear")
def test_the_first_python_of_debian_12_restores_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen to fail: its tarfile knows no filters, which came with Python 3.11.4."""

    def extract_all(
        self: tarfile.TarFile, path: str = ".", members: object = None, *, numeric_owner: bool = False
    ) -> None:
        raise AssertionError("keys are not unpacked by tarfile")

    before, out = content(), tmp_path / "keys.backup"
    key_backup.backup(out, None)
    shutil.rmtree(paths.KEYS)
    monkeypatch.setattr(tarfile.TarFile, "extractall", extract_all)
    key_backup.restore(out, None)
    assert content() == before


@pytest.mark.usefixtures("in_the_clear")
def test_a_key_that_is_a_link_is_in_the_backup(tmp_path: Path) -> None:
    """Seen to fail: the link was in the backup, and a restore refused it."""
    key, elsewhere, out = paths.KEYS / "operator_ed25519", tmp_path / "elsewhere", tmp_path / "keys.backup"
    key.rename(elsewhere)
    key.symlink_to(elsewhere)
    key_backup.backup(out, None)
    shutil.rmtree(paths.KEYS)
    key_backup.restore(out, None)
    assert not key.is_symlink()
    assert key.read_bytes() == elsewhere.read_bytes()


@pytest.mark.usefixtures("in_the_clear")
def test_what_could_not_be_restored_is_not_backed_up(tmp_path: Path) -> None:
    (paths.KEYS / "my key").write_text("x")
    with pytest.raises(UserError, match=r"keys/my key: is no name of a key.*move it away, or give it another name"):
        key_backup.backup(tmp_path / "keys.backup", None)


@pytest.mark.usefixtures("in_the_clear")
@pytest.mark.parametrize("done", [0, 1, 5])
def test_an_interrupted_restore_can_be_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, done: int) -> None:
    """Wherever it stops no file is half there."""
    before, out = content(), tmp_path / "keys.backup"
    key_backup.backup(out, None)
    shutil.rmtree(paths.KEYS)
    replaced: list[Path] = []

    def replace(self: Path, target: Path) -> Path:
        if len(replaced) == done:
            raise KeyboardInterrupt
        replaced.append(target)
        os.replace(self, target)  # noqa: PTH105 - Path's own is this
        return target

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", replace)
        with pytest.raises(KeyboardInterrupt):
            key_backup.restore(out, None)
    assert content() == {path.name: before[path.name] for path in replaced}
    key_backup.restore(out, None)
    assert content() == before


def test_a_backup_that_fails_leaves_the_last_good_one(tmp_path: Path) -> None:
    out = tmp_path / "keys.backup"
    out.write_text("the last good one")
    with pytest.raises(UserError, match=r"nowhere: no such file; it holds the passphrase"):
        key_backup.backup(out, tmp_path / "nowhere")
    assert out.read_text() == "the last good one"
    with pytest.raises(UserError, match=r"no such file; `make backup-keys OUT=FILE` makes one"):
        key_backup.restore(tmp_path / "none", tmp_path / "nowhere")


def test_the_passphrase_is_asked_on_the_terminal(tmp_path: Path, password: Path) -> None:
    """Twice, and not shown."""
    out = tmp_path / "keys.backup"
    questions = (r"\n?New Vault password[^\n]*: ", r"\n?Confirm New Vault password[^\n]*: ")
    said = terminal.answered(["backup-keys", str(out)], dict.fromkeys(questions, "correct horse"))
    assert "encrypted" in said
    assert "horse" not in said
    shutil.rmtree(paths.KEYS)
    assert key_backup.restore(out, password)


@pytest.mark.parametrize("whose", ["operators", "0x3"])
def test_whose_key_is_named(whose: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["flotilla", "rotate-key", whose])
    with pytest.raises(SystemExit):
        command_line.main()
    assert f"invalid robot's number or 'operator' value: '{whose}'" in capsys.readouterr().err
