#!/usr/bin/python3 -IS
"""Brings a release into the slot that does not run: checks it, writes it, reads it back. One command at a time.

  begin     standard input: {"manifest": TEXT, "signatures": [TEXT, ...]}; the release is taken if it is signed as the
            running one asks, made for this board and card, neither older than the running one nor expired. It stays
            known until another one begins. With "accept_old": NUMBER the operator accepts the release of that number
            although it is older or expired, but not below the floor of the running one.
  copy      take what the running release has in the same place
  write     standard input: chunks, each behind its number and length (two unsigned 32-bit numbers, little-endian)
  delta     standard input: a delta from the running release's content, as flotilla-patch reads it
  finish    read all back from the card, and write the header: from now on the slot holds the release; remove the spool
            of /usr/lib/flotilla/receive
  activate  try it at the next start; the layer above /etc begins as a copy of the running release's

Each prints one object of JSON: `release`, `slot`, `base` (SHA-256 of the running release's content), `running` (the
release runs already), `staged` (the slot holds it), `missing` (numbers of chunks that the slot does not hold yet),
`unchecked` (why `begin` and `activate` did not check the expiry, or nothing), `chunk_bytes`, `memory_kib` (the peak so
far, with that of flotilla-patch). Whatever is cut off, by power or by the
radio, begins again with `begin`, and goes on where it was. Status 1: refused, with the reason on standard error.

The header is cleared before anything else of the slot is written, and written when all of it is on the card
(flotilla/images/slot.py). Reads and writes go past the page cache, which belongs to the control tasks. What this module
imports counts as memory on a robot, of which an update may take 16 MB (docs/decisions/0055-updater-within-16-mb.md).
"""

from __future__ import annotations

import json
import mmap
import os
import struct
import sys
import time

TYPE_CHECKING = False
if TYPE_CHECKING:  # without an import: it takes time
    from collections.abc import Iterator
    from hashlib import sha256
    from typing import Any, BinaryIO
else:
    try:
        from _sha256 import sha256  # Python's own: hashlib loads OpenSSL's library, which takes 3 MB
    except ImportError:  # Python 3.12 and later
        from hashlib import sha256

KNOWN = "/data/update"
RUN = "/run"
LAYERS = "/data"
FORMAT = 1
NAMESPACE = "flotilla-release"
SIGNATURE = b"# GRUB Environment Block\n"
HEADER_ROOM, HEADER_BYTES = 4096, 1024
SECTOR = 512
LARGEST_CHUNK = 1 << 18
ORPHANS = 10
"""Stratum of a clock that no station leads (/etc/chrony/chrony.conf)."""
_ANY_DIGIT = dict.fromkeys(range(ord("1"), ord("9") + 1), "0")
SIGKILL = 9  # without `signal`, which takes a quarter of a MB


class Refused(Exception):
    """A reason, for whoever asked."""


INVALID = (Refused, OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError)
"""Exceptions that end a command with one line: the input is no release for this robot."""


def slots() -> dict[str, Any]:
    """The answer of `flotilla-slot show`."""
    fd, pid = piped("flotilla-slot", "show")
    with open(fd, "rb") as shown:
        text = shown.read()
    check("flotilla-slot show", ended(pid))
    found: dict[str, Any] = json.loads(text)
    return found


# Programs are started without `subprocess`, whose import takes 0.7 MB.


def start(*argv: str, out: int | None = None, given: str = "", quiet: bool = False) -> int:
    """Start a program; its number. `out`: where its standard output goes. `given`: the file that it reads."""
    actions: list[tuple[Any, ...]] = []
    if given:
        actions.append((os.POSIX_SPAWN_OPEN, 0, given, os.O_RDONLY, 0))
    if out is not None:
        actions.append((os.POSIX_SPAWN_DUP2, out, 1))
    if quiet:
        actions += [(os.POSIX_SPAWN_OPEN, number, os.devnull, os.O_WRONLY, 0) for number in (1, 2)]
    return os.posix_spawnp(argv[0], argv, os.environ, file_actions=actions)


def piped(*argv: str) -> tuple[int, int]:
    """Start a program whose standard output can be read: from where, and its number."""
    read, write = os.pipe()
    try:
        return read, start(*argv, out=write)
    finally:
        os.close(write)


def ended(pid: int) -> int:
    """The exit status of a program, when it has ended; negative where a signal ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def check(what: str, status: int) -> None:
    if status:
        raise Refused(f"{what} failed (status {status})")


def run(*argv: str) -> None:
    """Run a program, which must not fail."""
    check(" ".join(argv), ended(start(*argv)))


class Slot:
    """A slot of the card this system runs from."""

    def __init__(self, name: str, state: dict[str, Any] | None = None, *, writable: bool = False) -> None:
        """`state`: what flotilla-slot said, which reads both kinds of partition tables."""
        self.name = name
        place = (state or slots())["slots"][name]
        self.start, self.size = place["start"], place["size"]
        self._fd = os.open(disk(), (os.O_RDWR if writable else os.O_RDONLY) | os.O_DIRECT | os.O_CLOEXEC)
        self._buffer = mmap.mmap(-1, LARGEST_CHUNK)  # direct access needs whole pages

    def read(self, offset: int, length: int) -> memoryview:
        """Bytes of the slot; good until the next call."""
        view = memoryview(self._buffer)[:length]
        if os.preadv(self._fd, [view], self.start + offset) != length:
            raise Refused(f"slot {self.name}: byte {offset} cannot be read")
        return view

    def write(self, offset: int, content: bytes) -> None:
        self._buffer[: len(content)] = content
        view = memoryview(self._buffer)[: len(content)]
        if os.pwritev(self._fd, [view], self.start + offset) != len(content):
            raise Refused(f"slot {self.name}: byte {offset} cannot be written")

    def flush(self) -> None:
        os.fdatasync(self._fd)

    def header(self) -> dict[str, str]:
        """What the header says; nothing where there is none."""
        block = bytes(self.read(self.size - HEADER_ROOM, HEADER_BYTES))
        if not block.startswith(SIGNATURE):
            return {}
        lines = block.decode("ascii", "replace").splitlines()
        return dict(line.split("=", 1) for line in lines if "=" in line and not line.startswith("#"))


def disk() -> str:
    """The disk of the running root."""
    with open("/proc/self/mountinfo") as mounts:
        roots = [words[2] for words in map(str.split, mounts) if words[4] == "/"]
    with open(f"/sys/dev/block/{roots[-1]}/uevent") as events:
        name = dict(line.strip().split("=", 1) for line in events)["DEVNAME"]
    return "/dev/" + (name[:-2] if name[-3:-1].endswith("p") and name[-3].isdigit() else name[:-1])


def partition(slot: str) -> str:
    """The block device of a slot."""
    whole = disk()
    return f"{whole}{'p' if whole[-1].isdigit() else ''}{2 + 'AB'.index(slot)}"


class Release:
    """A release that this robot may take."""

    def __init__(self, text: str, signatures: list[str], accept_old: int | None = None) -> None:
        """Refused unless it is signed as the running release asks, made for this board and card, and not too old.

        `accept_old`: the number of a release that may be too old, by the operator's word.
        """
        state = slots()
        if not state["running"]:
            raise Refused("this robot was started from no slot")
        if state["trial"] == state["running"]:
            raise Refused("the running release is on trial: confirm it first, or let it go back")
        running = Slot(state["running"], state)
        present = running.header()
        verify(text, signatures, keys_of(running, present))
        manifest: dict[str, Any] = json.loads(text)
        if manifest["format"] != FORMAT:
            raise Refused(f"the release has format {manifest['format']}, this robot reads {FORMAT}")
        self.header: dict[str, str] = manifest["header"]
        for name, what in (("BOARD", "board"), ("LAYOUT", "layout of the card")):
            if self.header[name] != present[name]:
                raise Refused(f"the release is for {what} {self.header[name]}, this robot has {present[name]}")
        self.running = present == self.header
        number = int(self.header["RELEASE"])
        if not self.running:
            check_number(number, present, accept_old)
        self.number, self.accepted = number, number == accept_old
        self.expires: str = manifest.get("expires", "")  # none in bundles of earlier versions
        if "expires" in manifest and not is_day(self.expires):  # which is compared as text
            raise Refused(f"expires of the manifest is {self.expires!r}, and no day such as 2027-01-31")
        self.unchecked = ""
        self.chunk_bytes: int = manifest["chunk_bytes"]
        self.chunks: list[str] = manifest["chunks"]
        self.slot = Slot("B" if running.name == "A" else "A", state, writable=True)
        size = int(self.header["BYTES"])
        if not SECTOR <= self.chunk_bytes <= LARGEST_CHUNK or size > self.slot.size - HEADER_ROOM or size % SECTOR:
            raise Refused(f"a release of {size} bytes does not fit into a slot of {self.slot.size}")
        if len(self.chunks) != -(-size // self.chunk_bytes):
            raise Refused(f"{len(self.chunks)} chunks are not what {size} bytes have")
        self.size = size
        self.present = present
        self.base = running

    def check_expiry(self) -> None:
        """Reject an expired release by a credible clock; `unchecked` is the reason why that was not checked."""
        if self.running or not self.expires:
            return
        if self.accepted:
            self.unchecked = f"expiry on {self.expires} not checked, by accept_old={self.number}"
        elif not (source := time_source()):
            self.unchecked = f"expiry on {self.expires} not checked: no station gives this robot the time"
        elif (today := time.strftime("%Y-%m-%d", time.gmtime())) > self.expires:
            raise Refused(
                f"release {self.number} expired on {self.expires}, and the time from {source} is {today}: make the "
                f"bundle again (make bundle BOARD={self.header['BOARD']}), or {by_operator(self.number)}"
            )

    def length(self, number: int) -> int:
        return min(self.chunk_bytes, self.size - number * self.chunk_bytes)

    def holds(self, number: int) -> bool:
        """Whether the slot has this chunk."""
        content = self.slot.read(number * self.chunk_bytes, self.length(number))
        return sha256(content).hexdigest() == self.chunks[number]

    def missing(self) -> list[int]:
        return [number for number in range(len(self.chunks)) if not self.holds(number)]

    def take(self, number: int, content: bytes) -> None:
        """Write a chunk, if it is the one that the release names."""
        if number >= len(self.chunks) or sha256(content).hexdigest() != self.chunks[number]:
            raise Refused(f"chunk {number} is not what the release says")
        self.slot.write(number * self.chunk_bytes, content)

    def staged(self) -> bool:
        """Whether the slot's header is this release's."""
        return self.slot.header() == self.header

    def empty_slot(self) -> None:
        """Clear the header of the slot, unless there is none: what is written next is nobody's."""
        if self.slot.header():
            run("flotilla-slot", "clear", self.slot.name)

    def said(self, missing: list[int]) -> dict[str, Any]:
        return {
            "release": self.header["RELEASE"],
            "slot": self.slot.name,
            "base": self.present["BLOB"],
            "running": self.running,
            "staged": self.staged(),
            "missing": missing,
            "chunk_bytes": self.chunk_bytes,
            "unchecked": self.unchecked,
        }


def is_day(value: object) -> bool:
    """Whether it is a date by ISO 8601. A month or day may be out of range, since dates are compared as text."""
    return isinstance(value, str) and value.translate(_ANY_DIGIT) == "0000-00-00"


def check_number(number: int, present: dict[str, str], accept_old: int | None) -> None:
    """Check the number of a release for a robot whose running slot has the header `present`.

    That header was written before the running release was confirmed, and is not written while it runs. So the floor
    needs no state of its own: it rises with a release that is confirmed, and falls when the other slot runs again.
    """
    if number < int(present["FLOOR"]):
        raise Refused(f"release {number} is below {present['FLOOR']}, the oldest that the running one admits")
    if number < int(present["RELEASE"]) and number != accept_old:
        raise Refused(
            f"release {number} is older than {present['RELEASE']}, which this robot runs: raise `release:` in "
            f"images/release.yml and make the bundle again, or {by_operator(number)}"
        )


def by_operator(number: int) -> str:
    return f'accept this one: make update ARGS="-e accept_old={number}"'


def time_source() -> str:
    """Address of the computer from which chronyd has a time that is not the fleet's own; empty where there is none.

    Without a station robots follow the battery clock of one of them, at the stratum of orphans and above.
    """
    try:
        fd, pid = piped("chronyc", "-n", "-c", "tracking")
    except OSError:
        return ""
    with open(fd) as answer:
        fields = answer.read().strip().split(",")
    if ended(pid) or len(fields) < 14 or fields[13] == "Not synchronised":
        return ""
    return fields[1] if fields[2].isdecimal() and int(fields[2]) < ORPHANS else ""


def keys_of(slot: Slot, header: dict[str, str]) -> dict[str, Any]:
    """Who signs what comes after the release in `slot`: `signatures`, how many are needed, and `keys`."""
    first, count = map(int, header["KEYS"].split("+"))
    found: dict[str, Any] = json.loads(bytes(slot.read(first * SECTOR, count * SECTOR)).rstrip(b" \0"))
    return found


def verify(text: str, signatures: list[str], trusted: dict[str, Any]) -> None:
    """Refused unless enough of the trusted keys, each counted once, have signed the text."""
    signed = set()
    directory = f"{RUN}/flotilla-update-{os.getpid()}"
    os.mkdir(directory, 0o700)
    try:
        write_file(f"{directory}/text", text)
        for key in trusted["keys"]:
            write_file(f"{directory}/allowed", f'{key["name"]} namespaces="{NAMESPACE}" {key["key"]}\n')
            argv = ["ssh-keygen", "-Y", "verify", "-f", f"{directory}/allowed", "-I", key["name"], "-n", NAMESPACE]
            argv += ["-s", f"{directory}/signature"]
            for signature in signatures:
                write_file(f"{directory}/signature", signature)
                if ended(start(*argv, given=f"{directory}/text", quiet=True)) == 0:
                    signed.add(key["name"])
    finally:
        run("rm", "-rf", directory)
    if len(signed) < trusted["signatures"]:
        names = ", ".join(key["name"] for key in trusted["keys"])
        raise Refused(
            f"the release has {len(signed)} of the {trusted['signatures']} signatures that the running one asks for, "
            f"by the keys {names}"
        )


def write_file(path: str, text: str) -> None:
    with open(path, "w", newline="") as file:  # what is signed, to the byte
        file.write(text)


def known() -> Release:
    """The release that has begun."""
    try:
        with open(f"{KNOWN}/release") as file:
            told = json.load(file)
    except FileNotFoundError:
        raise Refused("no release has begun: `begin` first") from None
    return Release(told["manifest"], told["signatures"], told.get("accept_old"))


def begin() -> dict[str, Any]:
    told = json.load(sys.stdin)
    release = Release(told["manifest"], told["signatures"], told.get("accept_old"))
    release.check_expiry()
    os.makedirs(KNOWN, mode=0o700, exist_ok=True)
    beside = f"{KNOWN}/release.new"
    with open(beside, "w") as file:
        json.dump(told, file)
        file.flush()
        os.fsync(file.fileno())
    os.rename(beside, f"{KNOWN}/release")
    return release.said([] if release.running else release.missing())


def frames(source: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Numbers and contents, until the input ends."""
    while head := source.read(8):
        if len(head) < 8:
            raise Refused("the input ends within a chunk")
        number, length = struct.unpack("<II", head)
        if length > LARGEST_CHUNK:
            raise Refused(f"chunk {number} has {length} bytes, at most {LARGEST_CHUNK} are read")
        content = source.read(length)
        if len(content) < length:
            raise Refused("the input ends within a chunk")
        yield number, content


def copy() -> dict[str, Any]:
    release = known()
    if release.running:
        raise Refused("this release runs already")
    release.empty_slot()
    for number in release.missing():
        content = release.base.read(number * release.chunk_bytes, release.length(number))
        if sha256(content).hexdigest() == release.chunks[number]:
            release.take(number, bytes(content))
    release.slot.flush()
    return release.said(release.missing())


def write() -> dict[str, Any]:
    release = known()
    if release.running:
        raise Refused("this release runs already")
    release.empty_slot()
    wrong = None
    for number, content in frames(sys.stdin.buffer):
        try:
            release.take(number, content)
        except Refused as error:  # a wrong chunk spoils no other
            wrong = wrong or error
    release.slot.flush()
    if wrong:
        raise wrong
    return release.said(release.missing())


def delta() -> dict[str, Any]:
    release = known()
    if release.running:
        raise Refused("this release runs already")
    release.empty_slot()
    beside_kib = 0
    fd, pid = piped("flotilla-patch", partition(release.base.name))
    with open(fd, "rb") as patched:
        for number in range(len(release.chunks)):
            content = patched.read(release.length(number))
            beside_kib = max(beside_kib, peak_kib(pid))
            if sha256(content).hexdigest() != release.chunks[number]:
                os.kill(pid, SIGKILL)  # of another base, or cut off: what is missing comes as chunks
                break
            if not release.holds(number):
                release.take(number, content)
    ended(pid)
    release.slot.flush()
    return release.said(release.missing()) | {"beside_kib": beside_kib}


def finish() -> dict[str, Any]:
    release = known()
    missing = [] if release.running else release.missing()
    if not missing and not release.running and not release.staged():
        lines = "".join(f"{name}={value}\n" for name, value in release.header.items())
        block = (SIGNATURE + lines.encode()).ljust(HEADER_BYTES, b"#")
        release.slot.flush()
        release.slot.write(release.slot.size - HEADER_ROOM, block)
        release.slot.flush()
    if not missing:  # nothing of it is needed any more
        run("rm", "-rf", f"{KNOWN}/spool")
    return release.said(missing)


def activate() -> dict[str, Any]:
    release = known()
    if release.running:
        raise Refused("this release runs already")
    if not release.staged():
        raise Refused(f"slot {release.slot.name} does not hold release {release.header['RELEASE']} yet: `finish` first")
    release.check_expiry()  # again: a station may have given the time since then
    run("rm", "-rf", f"{LAYERS}/{release.slot.name}")
    os.sync()
    run("flotilla-slot", "trial", release.slot.name)
    return release.said([])


def yield_to_tasks() -> None:
    """Use the processor and the card when nobody else does."""
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    run("ionice", "-c", "3", "-p", str(os.getpid()))


def peak_kib(process: int | str = "self") -> int:
    """The most memory that a process has had; 0 when it has ended. What getrusage(2) says may be its parent's."""
    with open(f"/proc/{process}/status") as status:
        return int(next((line.split()[1] for line in status if line.startswith("VmHWM:")), "0"))


def main() -> int:
    commands = {each.__name__: each for each in (begin, copy, write, delta, finish, activate)}
    if len(sys.argv) != 2 or sys.argv[1] not in commands:
        print(__doc__, file=sys.stderr)
        return 2
    yield_to_tasks()
    try:
        said = commands[sys.argv[1]]()
    except INVALID as error:
        print(f"update: {error}" if isinstance(error, Refused) else f"update: {error!r}", file=sys.stderr)
        return 1
    said["memory_kib"] = peak_kib() + said.pop("beside_kib", 0)
    print(json.dumps(said))
    return 0


if __name__ == "__main__":
    sys.exit(main())
