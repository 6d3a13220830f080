"""SSH keys of a fleet and their life: made once, when first needed, rotated, revoked. They lie in `paths.KEYS`.

| file | what |
|---|---|
| `robotN_ed25519` | host key of a robot, pinned everywhere |
| `operator_ed25519` | every robot admits it; it may have a passphrase, if an agent has it |
| `NAME_ed25519.retired` | the former one, accepted until it is retired: public of a robot, private of the operator |
| `revoked_keys` | public host keys that nobody accepts any more, a line each with the robot's name |
| `operator_authority` | what signs certificates of further operators: operators.py |
| `operators` | who has such a certificate, and until when |
| `revoked_operators` | public keys of operators whom robots refuse |
| `fleet_secret` | where keys of messages come from: message_keys.py |
| `dds_authority` | what signs who may send which DDS topics: dds_security.py |
| `known_hosts` | what of that `ssh` on this computer accepts; written anew when it differs |

Beside each SSH key is its public half, `NAME.pub`. Where that is alone, the private half is elsewhere: in an agent, on
a hardware token, or on another computer. Nothing makes another one in its place.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from flotilla.common import durable, paths
from flotilla.common.errors import UserError
from flotilla.fleet import ssh_signatures
from flotilla.fleet.model import Fleet, Robot

_OPERATOR = "operator_ed25519"


def make(name: str, comment: str) -> Path:
    """The private key `name`, made if neither it nor its public half is there."""
    path = paths.KEYS / name
    if not _public_file(path).exists():
        with alone():  # provisioning renders robots' files in processes of their own
            if not path.exists() and not _public_file(path).exists():
                _generate(path, comment)
            elif not _public_file(path).exists():  # power failed between the two renames
                durable.write(_public_file(path), _public_half(path, comment))
    return path


def _generate(path: Path, comment: str) -> None:
    """The public half gets its name last: alone it means that the private one is elsewhere."""
    beside = path.with_name(f".{path.name}.new")
    beside.unlink(missing_ok=True)
    argv = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", comment, "-f", str(beside)]
    try:
        subprocess.run(argv, check=True, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    except subprocess.CalledProcessError as error:
        raise UserError(f"cannot make the key {paths.shown(path)}: {error.stderr.strip()}") from error
    durable.rename(beside, path)
    durable.rename(_public_file(beside), _public_file(path))


def _public_half(private: Path, comment: str) -> str:
    """Of a key whose public half is missing. Such a key is new, so it has no passphrase yet."""
    argv = ["ssh-keygen", "-y", "-P", "", "-f", str(private)]
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    if done.returncode:
        file = paths.shown(private)
        raise UserError(f"{file}.pub is missing: {done.stderr.strip()}; make it: `ssh-keygen -y -f {file} >{file}.pub`")
    return f"{' '.join(done.stdout.split()[:2])} {comment}\n"


@contextmanager
def alone() -> Iterator[None]:
    """No other process is in here for the same directory of keys. Not to be nested."""
    paths.KEYS.mkdir(parents=True, exist_ok=True, mode=0o700)
    directory = os.open(paths.KEYS, os.O_RDONLY)
    try:
        fcntl.flock(directory, fcntl.LOCK_EX)
        yield
    finally:
        os.close(directory)


def public(private: Path) -> str:
    """The public half, without its comment."""
    return " ".join(_public_file(private).read_text().split()[:2])


def _public_file(private: Path) -> Path:
    return private.with_name(private.name + ".pub")


def here(private: Path) -> Path:
    """The private key's file; UserError where it is elsewhere."""
    if not private.exists():
        raise UserError(
            f"{paths.shown(private)}: the private key is not on this computer; run this command where the key is, or "
            "bring it: `make restore-keys`. If it is lost, remove "
            f"{paths.shown(_public_file(private))}, and a new key is made"
        )
    return private


def usable(private: Path) -> Path:
    """The file by which SSH's programs use a key: the private one, or the public half of a key in an agent.

    UserError where the private half is neither here nor in an agent.
    """
    public_file = _public_file(private)
    if private.exists():
        return private
    if ssh_signatures.is_in_agent(public(private)):
        return public_file
    raise UserError(
        f"{paths.shown(private)}: the private key is not on this computer, and no ssh-agent has it; load it "
        "(`ssh-add FILE`, or `ssh-add -s LIBRARY` for a token), run this command where the key is, or bring it: "
        "`make restore-keys`"
    )


def copy_for_image(robot: Robot, to: Path) -> None:
    """Copy what the image of a robot depends on: of all SSH keys' private halves that of its host key alone."""
    own = f"{robot.name}_ed25519"
    shutil.copytree(
        paths.KEYS, to, ignore=lambda _, names: [each for each in names if f"{each}.pub" in names and each != own]
    )


# --- robots' host keys ---


def of_robot(robot: Robot) -> Path:
    """The robot's private host key, made if there is none."""
    return make(f"{robot.name}_ed25519", robot.name)


def host_keys(fleet: Fleet) -> dict[str, str]:
    """Public host key of every robot by name; makes what is missing, and the `known_hosts` that pins them."""
    robots = sorted(fleet.robots.values(), key=lambda robot: robot.number)
    keys = {robot.name: public(of_robot(robot)) for robot in robots}
    accepted = [(robot, keys[robot.name]) for robot in robots]
    accepted += [(robot, _retired(robot).read_text().strip()) for robot in robots if _retired(robot).exists()]
    pinned = "".join(f"{robot.name},{robot.address} {key}\n" for robot, key in accepted)
    pinned += "".join(f"@revoked * {key}\n" for key in revoked())
    known = paths.KEYS / "known_hosts"
    if not known.exists() or known.read_text() != pinned:
        durable.write(known, pinned)
    return keys


def revoked() -> list[str]:
    """Public host keys that nobody accepts, whoever has them."""
    return listed(_revoked())


def revocations() -> Counter[str]:
    """How many host keys nobody accepts, by the robot's name."""
    file = _revoked()
    return Counter(line.split()[2] for line in file.read_text().splitlines()) if file.exists() else Counter()


def rotate_host_key(fleet: Fleet, robot: Robot) -> None:
    """Give a robot a new host key. The old one is accepted on this computer until `retire_host_key`."""
    durable.write(_retired(robot), host_keys(fleet)[robot.name] + "\n")
    _remove(of_robot(robot))
    host_keys(fleet)


def retire_host_key(fleet: Fleet, robot: Robot) -> None:
    """Accept the old host key of a robot no more."""
    _retired(robot).unlink(missing_ok=True)
    host_keys(fleet)


def revoke_host_key(fleet: Fleet, robot: Robot) -> None:
    """The robot or its card is in other hands: its keys are refused from now on, and its next card gets a new one."""
    lost = [host_keys(fleet)[robot.name]]
    if _retired(robot).exists():
        lost.append(_retired(robot).read_text().strip())
    before = _revoked().read_text() if _revoked().exists() else ""
    durable.write(_revoked(), before + "".join(f"{key} {robot.name}\n" for key in lost))
    _retired(robot).unlink(missing_ok=True)
    _remove(of_robot(robot))
    host_keys(fleet)


def _retired(robot: Robot) -> Path:
    """The public host key that a robot may still have, while its new one is on the way."""
    return paths.KEYS / f"{robot.name}_ed25519.retired"


def _revoked() -> Path:
    return paths.KEYS / "revoked_keys"


def listed(file: Path) -> list[str]:
    """Public keys of a file that has one a line, each with a name; none where there is no file."""
    return [" ".join(line.split()[:2]) for line in file.read_text().splitlines()] if file.exists() else []


# --- the operator's key ---


def operator() -> Path:
    """The operator's private key, made if there is none."""
    return make(_OPERATOR, "operator")


def former_operator() -> Path | None:
    """The private key that robots may still want, while the new one is on the way to them."""
    return path if (path := _former()).exists() else None


def rotate_operator_key() -> None:
    """A new operator's key. The former one is kept, because robots admit it until they are provisioned."""
    now, former = here(operator()), _former()
    if former.exists():
        raise UserError(
            f"{paths.shown(former)}: an earlier rotation has not ended; `make provision`, then "
            "`make rotate-key KEY=operator RETIRE=1`"
        )
    durable.write(_public_file(former), _public_file(now).read_text())
    _public_file(now).unlink()  # first: alone it means that the private half is elsewhere
    durable.rename(now, former)  # from here on the next use makes a new one
    operator()


def retire_operator_key() -> None:
    """Nothing on this computer uses the former key any more."""
    if former := former_operator():
        former.unlink()
        _public_file(former).unlink(missing_ok=True)


def _former() -> Path:
    return paths.KEYS / f"{_OPERATOR}.retired"


# --- files ---


def _remove(private: Path) -> None:
    """The public half first: alone it means that the private one is elsewhere."""
    _public_file(private).unlink(missing_ok=True)
    private.unlink(missing_ok=True)


def write_once(file: Path, text: str) -> None:
    """Make a private file, unless there is one; whole or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    beside = file.with_name(f".{file.name}.{os.getpid()}")
    beside.unlink(missing_ok=True)
    with os.fdopen(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
    try:
        os.link(beside, file)
        durable.sync_names(file.parent)
    except FileExistsError:
        pass  # another process was first
    finally:
        beside.unlink()
