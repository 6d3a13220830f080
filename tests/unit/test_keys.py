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

import pyrage
import pytest

from flotilla.cli import main as command_line
from flotilla.common import ansible, paths
from flotilla.common.errors import UserError
from flotilla.fleet import age, identity, key_backup, keys, passphrases
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


WORDS = "staple horse orbit vivid canoe"


@pytest.fixture(autouse=True)
def cheap(monkeypatch: pytest.MonkeyPatch) -> None:
    """Backups that take no second and no 256 MiB each."""
    monkeypatch.setattr(age, "LOG2_COST", 4)


@pytest.fixture
def password(tmp_path: Path) -> Path:
    file = tmp_path / "password"
    file.write_text(f"{WORDS}\n")
    return file


def test_keys_come_back_from_a_backup(tmp_path: Path, password: Path) -> None:
    """Encrypted: nothing of a key is in the file. What is there already is no obstacle, if it is the same."""
    before, out = content(), tmp_path / "keys.backup"
    assert key_backup.backup(out, password) == len(before)
    assert stat.S_IMODE(out.stat().st_mode) == 0o600
    assert out.read_bytes().startswith(b"age-encryption.org/v1\n-> scrypt ")
    assert not [name for name, data in before.items() if data in out.read_bytes()]
    shutil.rmtree(paths.KEYS)
    assert key_backup.restore(out, password) == len(before)
    assert content() == before
    assert {stat.S_IMODE(file.stat().st_mode) for file in paths.KEYS.iterdir()} == {0o600}
    (paths.KEYS / "robot1_ed25519").unlink()
    key_backup.restore(out, password)
    assert content() == before


def test_a_stranger_restores_keys_without_this_tool(
    tmp_path: Path, password: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By an implementation of age that nobody here wrote, and tar."""
    monkeypatch.undo()  # keys of the same user, and scrypt at its full cost
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")
    out, elsewhere = tmp_path / "keys.age", tmp_path / "elsewhere"
    key_backup.backup(out, password)
    assert out.read_bytes().splitlines()[1].endswith(b" 18"), "2^18: 256 MiB for each guess"
    elsewhere.mkdir()
    archive = pyrage.passphrase.decrypt(out.read_bytes(), WORDS)
    subprocess.run(["tar", "-x", "-C", elsewhere], input=archive, check=True)
    assert {file.name: file.read_bytes() for file in elsewhere.iterdir()} == content()


@pytest.mark.parametrize("size", [0, 1, (1 << 16) - 1, 1 << 16, (1 << 16) + 1, 3 << 16])
def test_files_of_every_length_are_as_ages_specification_has_them(size: int) -> None:
    data = bytes(range(256)) * (size // 256) + bytes(size % 256)
    assert pyrage.passphrase.decrypt(age.encrypt(data, WORDS), WORDS) == data
    assert age.decrypt(age.encrypt(data, WORDS), WORDS) == data


def test_what_another_implementation_encrypted_is_read() -> None:
    assert age.decrypt(pyrage.passphrase.encrypt(b"keys", WORDS), WORDS) == b"keys"


def test_no_byte_of_an_encrypted_file_may_change() -> None:
    data = age.encrypt(b"keys", WORDS)
    for at in range(len(data)):
        with pytest.raises(age.DecryptionError):
            age.decrypt(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :], WORDS)
        with pytest.raises(age.DecryptionError):
            age.decrypt(data[:at], WORDS)
    with pytest.raises(age.DecryptionError):
        age.decrypt(data + b"\0", WORDS)


def test_a_file_of_two_chunks_does_not_lose_one() -> None:
    chunk = (1 << 16) + 16
    data = age.encrypt(bytes(2 << 16), WORDS)
    for damaged in (data[:-chunk], data[: -2 * chunk] + data[-chunk:] + data[-2 * chunk : -chunk]):
        with pytest.raises(age.DecryptionError, match="its end is missing"):
            age.decrypt(damaged, WORDS)


def test_a_file_that_would_take_all_memory_is_rejected() -> None:
    """The writer of a backup chooses scrypt's cost."""
    data = age.encrypt(b"keys", WORDS).replace(b" 4\n", b" 30\n", 1)
    with pytest.raises(age.DecryptionError, match=r"scrypt's cost is 2\^30"):
        age.decrypt(data, WORDS)


def test_a_backup_of_the_earlier_kind_is_restored(
    tmp_path: Path, password: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a passphrase that today is too short."""
    before, out = content(), tmp_path / "keys.vault"
    password.write_text("correct horse\n")
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w") as tar:
        for name in before:
            tar.add(paths.KEYS / name, name)
    vault = Path(sys.executable).with_name("ansible-vault")
    argv = [str(vault), "encrypt", "--vault-password-file", str(password), "--output", str(out), "-"]
    subprocess.run(argv, input=archive.getvalue(), env=ansible.environment(), capture_output=True, check=True)
    shutil.rmtree(paths.KEYS)
    assert key_backup.restore(out, password) == len(before)
    assert content() == before
    assert (
        "keys.vault: has the earlier, weaker encryption; `make backup-keys` makes a new one" in capsys.readouterr().err
    )
    password.write_text("another\n")
    with pytest.raises(UserError, match=r"keys\.vault: ansible-vault decrypt: .+"):
        key_backup.restore(out, password)


@pytest.mark.parametrize(
    ("passphrase", "reason"),
    [
        ("", "has 0 characters, and needs at least 16"),
        ("correct horse", "has 13 characters, and needs at least 16"),
        ("aaaaaaaaaaaaaaaaaaaaaaaa", "has 1 characters that count"),
        ("passwordpassword", "has 7 characters that count"),
        ("123456789012345678901234", "has 1 characters that count"),
        ("zyxwvutsrqponmlkjihgfedcba", "has 1 characters that count"),
        ("QwertyUiopAsdfghjklZxcvbnm", "has 3 characters that count"),
        ("robotrobotrobotrobot", "has 5 characters that count"),
    ],
)
def test_a_passphrase_that_is_found_by_trying_is_rejected(
    tmp_path: Path, password: Path, passphrase: str, reason: str
) -> None:
    """Seen to fail: a backup was encrypted with an empty passphrase's file, or with one letter."""
    password.write_text(f"{passphrase}\n")
    out = tmp_path / "keys.backup"
    with pytest.raises(UserError, match=rf"^the passphrase {reason}.*; take five words from a list, or what `openssl"):
        key_backup.backup(out, password)
    assert not out.exists()


@pytest.mark.parametrize("passphrase", [WORDS, "3Jx9QpLz7vKe2WmT", "hn4/kGZ+3qTbXd0sVw1y", "ein Pferd frißt Äpfel"])
def test_a_good_passphrase_is_accepted(passphrase: str) -> None:
    passphrases.check(passphrase)


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


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        ("passphrase", "the passphrase is wrong, or the file was changed"),
        ("bytes", "the file was changed, or its end is missing"),
        ("no age file", "is no age file that is encrypted with a passphrase"),
        ("no tar", "no backup of keys: "),
    ],
)
def test_a_backup_that_cannot_be_read_changes_nothing(tmp_path: Path, password: Path, damage: str, reason: str) -> None:
    before, out = content(), tmp_path / "keys.backup"
    key_backup.backup(out, password)
    if damage == "passphrase":
        password.write_text("another\n")
    elif damage == "bytes":
        data = out.read_bytes()
        out.write_bytes(data[:-200] + bytes([data[-200] ^ 1]) + data[-199:])
    else:
        out.write_bytes(age.encrypt(b"no tar", WORDS) if damage == "no tar" else b"no tar")
    with pytest.raises(
        UserError, match=rf"keys\.backup: no backup of keys: .*{reason.removeprefix('no backup of keys: ')}"
    ):
        key_backup.restore(out, password)
    assert content() == before


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
def test_a_backup_brings_nothing_but_keys(
    tmp_path: Path, password: Path, name: str, changed: dict[str, object], said: str
) -> None:
    """Seen to fail where tarfile unpacked: in the directory of keys, directories and links were restored."""
    before, archive = content(), io.BytesIO()
    for each, fields in (("known_hosts", {}), (name, changed)):
        member = tarfile.TarInfo(each)
        vars_of = {"size": 1} | fields
        for field, value in vars_of.items():
            setattr(member, field, value)
        archive.write(member.tobuf(tarfile.PAX_FORMAT) + b"x".ljust(512, b"\0"))
    out = tmp_path / "keys.backup"
    out.write_bytes(age.encrypt(archive.getvalue() + bytes(1024), WORDS))
    with pytest.raises(UserError, match=said):
        key_backup.restore(out, password)
    assert content() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["keys", "keys.backup", "password"]


def test_modes_of_a_backup_do_not_count(tmp_path: Path, password: Path) -> None:
    """Whatever the umask, and whatever the tar says: setuid, or readable by all."""
    archive, out = io.BytesIO(), tmp_path / "keys.backup"
    member = tarfile.TarInfo("robot9_ed25519")
    member.mode, member.uid, member.size = 0o6777, 1234, 3
    with tarfile.open(fileobj=archive, mode="w") as tar:
        tar.addfile(member, io.BytesIO(b"key"))
    out.write_bytes(age.encrypt(archive.getvalue(), WORDS))
    shutil.rmtree(paths.KEYS)
    assert key_backup.restore(out, password) == 1
    found = (paths.KEYS / "robot9_ed25519").stat()
    assert (stat.S_IMODE(found.st_mode), found.st_uid) == (0o600, os.geteuid())


def test_the_first_python_of_debian_12_restores_keys(
    tmp_path: Path, password: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seen to fail: its tarfile knows no filters, which came with Python 3.11.4."""

    def extract_all(
        self: tarfile.TarFile, path: str = ".", members: object = None, *, numeric_owner: bool = False
    ) -> None:
        raise AssertionError("keys are not unpacked by tarfile")

    before, out = content(), tmp_path / "keys.backup"
    key_backup.backup(out, password)
    shutil.rmtree(paths.KEYS)
    monkeypatch.setattr(tarfile.TarFile, "extractall", extract_all)
    key_backup.restore(out, password)
    assert content() == before


def test_a_key_that_is_a_link_is_in_the_backup(tmp_path: Path, password: Path) -> None:
    """Seen to fail: the link was in the backup, and a restore refused it."""
    key, elsewhere, out = paths.KEYS / "operator_ed25519", tmp_path / "elsewhere", tmp_path / "keys.backup"
    key.rename(elsewhere)
    key.symlink_to(elsewhere)
    key_backup.backup(out, password)
    shutil.rmtree(paths.KEYS)
    key_backup.restore(out, password)
    assert not key.is_symlink()
    assert key.read_bytes() == elsewhere.read_bytes()


def test_what_could_not_be_restored_is_not_backed_up(tmp_path: Path, password: Path) -> None:
    (paths.KEYS / "my key").write_text("x")
    with pytest.raises(UserError, match=r"keys/my key: is no name of a key.*move it away, or give it another name"):
        key_backup.backup(tmp_path / "keys.backup", password)


@pytest.mark.parametrize("done", [0, 1, 5])
def test_an_interrupted_restore_can_be_repeated(
    tmp_path: Path, password: Path, monkeypatch: pytest.MonkeyPatch, done: int
) -> None:
    """Wherever it stops no file is half there."""
    before, out = content(), tmp_path / "keys.backup"
    key_backup.backup(out, password)
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
            key_backup.restore(out, password)
    assert content() == {path.name: before[path.name] for path in replaced}
    key_backup.restore(out, password)
    assert content() == before


def test_a_backup_that_fails_leaves_the_last_good_one(tmp_path: Path, password: Path) -> None:
    out = tmp_path / "keys.backup"
    out.write_text("the last good one")
    with pytest.raises(UserError, match=r"nowhere: No such file or directory; give a file that contains the p"):
        key_backup.backup(out, tmp_path / "nowhere")
    assert out.read_text() == "the last good one"
    with pytest.raises(UserError, match=r"there is no terminal to ask for the passphrase; .*PASSWORD_FILE="):
        key_backup.backup(out, None)
    with pytest.raises(UserError, match=r"OUT=.*none/keys: No such file or directory; give a file in a directory"):
        key_backup.backup(tmp_path / "none" / "keys", password)
    with pytest.raises(UserError, match=r"no such file; `make backup-keys OUT=FILE` makes one"):
        key_backup.restore(tmp_path / "none", tmp_path / "nowhere")


def test_the_passphrase_is_asked_on_the_terminal(tmp_path: Path, password: Path) -> None:
    """Twice, and not shown."""
    out = tmp_path / "keys.backup"
    questions = ("Passphrase of the backup: ", "The same passphrase again: ")
    said = terminal.answered(["backup-keys", str(out)], dict.fromkeys(questions, WORDS))
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
