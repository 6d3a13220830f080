"""Private keys that are not on this computer: in an agent, or nowhere within reach."""

from __future__ import annotations

import subprocess
import tarfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import identity, keys, operators, ssh_signatures
from flotilla.fleet.model import Fleet, Releases
from flotilla.lab.acceptance import outcome
from flotilla.robot import playbook, ssh
from flotilla.updates import bundle

pytestmark = pytest.mark.usefixtures("own_keys")


@pytest.fixture(autouse=True)
def agent(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A real ssh-agent without keys, of this test alone."""
    socket = tmp_path_factory.mktemp("agent") / "s"
    with subprocess.Popen(["ssh-agent", "-D", "-a", socket], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        assert "SSH_AUTH_SOCK" in process.stdout.readline()  # it listens
        monkeypatch.setenv("SSH_AUTH_SOCK", str(socket))
        yield
        process.terminate()


def moved(name: str, *, to_agent: bool) -> Path:
    """Take a private key from the directory; its path there."""
    private = keys.make(name, name)
    if to_agent:
        subprocess.run(["ssh-add", "-q", private], check=True)
    private.unlink()
    return private


@pytest.fixture
def alice(tmp_path: Path) -> Path:
    file = tmp_path / "alice"
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "alice", "-f", file], check=True)
    return file.with_name("alice.pub")


@pytest.fixture
def slot(tmp_path: Path) -> Path:
    """A release as `slot.build` makes it, of some bytes."""
    (tmp_path / "slot").mkdir()
    (tmp_path / "slot/slot.img").write_bytes(bytes(1 << 18))
    (tmp_path / "slot/header.json").write_text("{}")
    return tmp_path / "slot"


def test_an_agent_signs_certificates(fleet: Fleet, alice: Path, tmp_path: Path) -> None:
    private = moved("operator_authority", to_agent=True)
    authority = keys.public(private)
    folder, _ = operators.admit(fleet, "alice", alice, 7, tmp_path / "out", "10.42.0.100")
    described = subprocess.run(
        ["ssh-keygen", "-L", "-f", folder / operators.CERTIFICATE], check=True, capture_output=True, text=True
    ).stdout
    fingerprint = subprocess.run(
        ["ssh-keygen", "-l", "-f", f"{private}.pub"], check=True, capture_output=True, text=True
    ).stdout.split()[1]
    assert fingerprint in described.partition("Signing CA:")[2].splitlines()[0]
    assert not private.exists()
    assert keys.public(private) == authority


@pytest.mark.parametrize("given", ["name", "public key"])
def test_an_agent_signs_releases(slot: Path, tmp_path: Path, given: str) -> None:
    """By a key that is named, and by one whose public half alone is in the inventory."""
    private = moved("release_ed25519", to_agent=True)
    public = keys.public(private)
    releases = Releases(keys=["release"] if given == "name" else [f"{public} alice"])
    if given == "public key":
        private.with_name("release_ed25519.pub").unlink()
    assert bundle.pack(tmp_path / "made.bundle", slot, releases, {}, 0) == ["release" if given == "name" else "alice"]
    with tarfile.open(tmp_path / "made.bundle") as made:
        (member,) = (name for name in made.getnames() if name.endswith(".sig"))
        content = made.extractfile(member)
        assert content
        signature = tmp_path / member
        signature.write_bytes(content.read())
    assert bundle.signed_by(tmp_path / "made.manifest.json", signature, {"key": public})
    assert not private.exists()


def test_an_agent_has_the_operators_key(fleet: Fleet) -> None:
    private = moved("operator_ed25519", to_agent=True)
    assert f'IdentityFile="{private}.pub"' in ssh.options(fleet.robots[3])
    signature = ssh_signatures.sign(b"report", keys.usable(keys.operator()), outcome.NAMESPACE)
    assert signature.startswith(b"-----BEGIN SSH SIGNATURE-----")


def test_a_key_that_is_nowhere_is_named_and_not_replaced(fleet: Fleet, alice: Path, slot: Path, tmp_path: Path) -> None:
    """Seen to fail: a new authority, release and operator's key replaced the public halves, so robots would have
    rejected everything that the true keys sign."""
    for name in ("operator_authority", "release_ed25519", "operator_ed25519", "robot3_ed25519"):
        moved(name, to_agent=False)
    before = {file.name: file.read_bytes() for file in paths.KEYS.iterdir()}
    remedy = r"keys/{}: the private key is not on this computer, and no ssh-agent has it; load it \(`ssh-add FILE`"
    with pytest.raises(UserError, match=remedy.format("operator_authority")):
        operators.admit(fleet, "alice", alice, 7, tmp_path / "out")
    with pytest.raises(UserError, match=r"0 of 1 signatures, by keys of .*keys and of the ssh-agent; load a key"):
        bundle.pack(tmp_path / "made.bundle", slot, Releases(), {}, 0)
    with pytest.raises(UserError, match=remedy.format("operator_ed25519")):
        ssh.command(fleet.robots[3])
    with pytest.raises(UserError, match=remedy.format("operator_ed25519")):
        playbook.play("fleet", robot=3, guests=False, words=[])
    here = r"keys/{0}: the private key is not on this computer; run this command where .* remove .*keys/{0}\.pub"
    with pytest.raises(UserError, match=here.format("robot3_ed25519")):
        identity.render(fleet, fleet.robots[3])
    with pytest.raises(UserError, match=here.format("operator_ed25519")):
        keys.rotate_operator_key()
    after = {file.name: file.read_bytes() for file in paths.KEYS.iterdir()}
    assert {name: after[name] for name in before} == before
    assert after.keys() - before.keys() <= {"operators"}


def test_robots_files_need_no_key_that_signs(fleet: Fleet) -> None:
    """Images and provisioning: a robot's files are the same without them, and no key is made."""
    robot = fleet.robots[3]
    before = identity.render(fleet, robot)
    for name in ("operator_authority", "operator_ed25519", "robot1_ed25519"):
        moved(name, to_agent=False)
    there = sorted(paths.KEYS.iterdir())
    assert identity.render(fleet, robot) == before
    assert sorted(paths.KEYS.iterdir()) == there


def test_a_public_half_that_a_power_cut_took_is_made_again() -> None:
    private = keys.operator()
    public = private.with_name(f"{private.name}.pub")
    before = public.read_text()
    public.unlink()
    assert keys.public(keys.operator()) == " ".join(before.split()[:2])
    assert public.read_text() == before
