"""Files from the network, by apt's own downloader, so that proxies, certificates and passwords are those of apt.

`apt-helper download-file` pipelines its requests, resumes a transfer that broke off and checks SHA-256. It gives up at
once where a server answers 429 or 503, and tries a host that nothing reaches once for each file; so retries are made
here: rounds of one call each, and a host that has not yet answered is asked for a single file first.
"""

from __future__ import annotations

import errno
import hashlib
import os
import random
import re
import select
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import urlsplit

from flotilla.common import processes, progress, together
from flotilla.common.errors import UserError

HELPER = Path("/usr/lib/apt/apt-helper")
_DELAYS_S = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Before each further try of a host from which nothing came, 31 s in all."""
_RETRY_AFTER_S = 60.0
"""The longest wait that a server may ask for (Retry-After)."""
_DATES = ("%a, %d %b %Y %H:%M:%S GMT", "%A, %d-%b-%y %H:%M:%S GMT", "%a %b %d %H:%M:%S %Y")
"""Forms of a date in Retry-After (RFC 9110, section 5.6.7)."""
_CONNECT_S = 15
"""To reach a host and to get its first byte."""
_SILENCE_S = 30
"""Without a byte from a host that has answered before."""
_STALL_S = 45.0
"""Without a byte in a whole round: longer than one file's time-out, much shorter than that of all files."""
_LOOK_S = 0.2
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
_PAGE = re.compile(rb"\s*<")


@dataclass(frozen=True)
class Kind:
    """A way in which a download fails, and what follows from it."""

    reason: str
    """Pattern of the reasons that apt gives."""
    tries: int
    """How often a file is asked for, while nothing else comes from that host."""
    whole: bool
    """Whether it is the matter of the host, so that none of its other files need be tried."""
    remedy: str


_OTHER_MIRROR = "run again, or set another mirror with MIRROR= and SECURITY_MIRROR="
GONE = Kind(r"(404|410) |.*No such file or directory", 1, False, "")
PAGE = Kind(
    r"511 ", 1, True, "the network answers with a page of its own (captive portal?): log in with a browser, run again"
)
WRONG = Kind(r"Hash Sum mismatch|File has unexpected size", 3, False, _OTHER_MIRROR)
UNTRUSTED = Kind(
    r".*([Cc]ertificate|TLS|handshake)", 2, True,
    "if a proxy inspects TLS here, install its certificate in /usr/local/share/ca-certificates and run "
    "`sudo update-ca-certificates`; apt uses the same",
)  # fmt: skip
UNREACHABLE = Kind(
    r"(Could not|Unable to|Cannot|Failed to) (connect|resolve|initiate)|Temporary failure resolving|Something wicked|"
    r".*(Connection refused|Network is unreachable|[Pp]roxy)|407 ", 2, True,
    "check the network; behind a firewall set apt's proxy (Acquire::http::Proxy in /etc/apt/apt.conf.d, or "
    "http_proxy=), or name a mirror that it lets through with MIRROR= and SECURITY_MIRROR=",
)  # fmt: skip
BUSY = Kind(r"(408|425|429|5\d\d) ", 6, True, _OTHER_MIRROR)
REFUSED = Kind(r"4\d\d ", 1, False, "ask who runs the proxy or the mirror, or set another one with MIRROR=")
SILENT = Kind(r".*timed out", 3, True, UNREACHABLE.remedy)
BROKEN = Kind(r"", 6, False, _OTHER_MIRROR)
_KINDS = (GONE, PAGE, WRONG, UNTRUSTED, UNREACHABLE, BUSY, REFUSED, SILENT, BROKEN)
"""The first that fits a reason."""


@dataclass(frozen=True)
class File:
    """A file that is wanted."""

    name: str
    """In the directory that it comes to."""
    addresses: tuple[str, ...]
    """Where it may be, the likeliest place first."""
    sha256: str = ""
    """None: nothing checks it."""
    size: int = 0


@dataclass(frozen=True)
class Failure:
    """Why a file did not come."""

    kind: Kind
    reason: str
    tried: tuple[str, ...]
    """Addresses; what failed is the last one."""

    @property
    def address(self) -> str:
        return self.tried[-1]

    @property
    def host(self) -> str:
        return _host(self.address)


def fetch(
    files: Iterable[File], directory: Path, report: Callable[[int], None] = lambda size: None
) -> dict[File, Failure]:
    """Download into a directory; what did not come, and why. OSError where the disk is full.

    `report` is given the number of bytes so far.
    """
    work = _Work(list(files), directory, report)
    while work.waiting:
        work.round()
    return work.failed


class _Work:
    """Files to download, and what is known of their hosts."""

    def __init__(self, files: list[File], directory: Path, report: Callable[[int], None]) -> None:
        self.waiting = {file: list(file.addresses) for file in files}
        """The addresses that are still to be tried."""
        self.failed: dict[File, Failure] = {}
        self._directory = directory
        self._report = report
        self._answered: set[str] = set()
        self._tries: dict[str, int] = {}
        """Of hosts: rounds in a row in which nothing came."""

    def round(self) -> None:
        """Ask each host once, and wait where it is to be asked again."""
        asked = self._batch()
        patient = all(_host(self.waiting[file][0]) in self._answered for file in asked)
        call = _Call(self._directory, {file: self.waiting[file][0] for file in asked})
        call.run(patient, self._report)
        by_host: dict[str, list[File]] = {}
        for file in asked:
            by_host.setdefault(_host(self.waiting[file][0]), []).append(file)
        if delay := max(self._take(host, of_host, call.failures) for host, of_host in by_host.items()):
            _sleep(max(delay, min(call.retry_after, _RETRY_AFTER_S)))

    def _batch(self) -> list[File]:
        """All files of hosts that have answered, and the smallest one of each other host."""
        batch = []
        scouts: dict[str, File] = {}
        for file, (address, *_) in self.waiting.items():
            host = _host(address)
            if host in self._answered:
                batch.append(file)
            elif host not in scouts or file.size < scouts[host].size:
                scouts[host] = file
        return batch + list(scouts.values())

    def _take(self, host: str, asked: list[File], reasons: Mapping[File, tuple[Kind, str]]) -> float:
        """Note what came of the files asked of a host; for how many seconds it is then left alone."""
        bad = {}
        for file in asked:
            if file not in reasons:
                del self.waiting[file]
            elif reasons[file][0] is not GONE:
                bad[file] = reasons[file]
            elif self.waiting[file][1:]:
                self.waiting[file].pop(0)
            else:
                self._end(file, *reasons[file])
        self._tries[host] = self._tries.get(host, 0) + 1 if len(bad) == len(asked) else 0
        over = {file: (kind, reason) for file, (kind, reason) in bad.items() if self._tries[host] >= kind.tries}
        for file, (kind, reason) in over.items():
            self._end(file, kind, reason)
        for kind, reason in over.values():
            if kind.whole:
                for file in [file for file, (address, *_) in self.waiting.items() if _host(address) == host]:
                    self._end(file, kind, reason)
        if not bad.keys() & self.waiting.keys():
            self._answered.add(host)
            self._tries[host] = 0
            return 0.0
        if self._tries[host] == 0:
            self._answered.add(host)
        delay = _DELAYS_S[max(self._tries[host] - 1, 0)]
        return delay * random.uniform(0.75, 1.25)  # so that those who failed together do not come back together

    def _end(self, file: File, kind: Kind, reason: str) -> None:
        tried = len(file.addresses) - len(self.waiting.pop(file)) + 1
        self.failed[file] = Failure(kind, reason, file.addresses[:tried])


class _Call:
    """One run of apt's downloader."""

    def __init__(self, directory: Path, addresses: Mapping[File, str]) -> None:
        self._directory = directory
        self._addresses = addresses
        self.failures: dict[File, tuple[Kind, str]] = {}
        self.retry_after = 0.0
        """Seconds, the most that a server asked for."""

    def run(self, patient: bool, report: Callable[[int], None]) -> None:
        argv = [*processes.DIE_WITH_PARENT, str(HELPER), *_options(patient), "download-file"]
        for file, address in self._addresses.items():
            hashed = [f"SHA256:{file.sha256}"] if file.sha256 else []
            argv += [_for_apt(address), str(self._directory / file.name), *hashed]
        progress.command(argv)
        environment = os.environ | {"LC_ALL": "C.UTF-8"}
        # The second holds passwords of proxies: a file without a name.
        with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as debug:
            try:
                process = subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=output, stderr=debug, env=environment)
            except FileNotFoundError as error:
                raise UserError(f"{error.filename}: missing; packages are downloaded with it: install apt") from None
            stalled = self._watch(process, _STALL_S if patient else _STALL_S - _SILENCE_S + _CONNECT_S, report)
            output.seek(0)
            debug.seek(0)
            self._read(output.read().decode(errors="replace"), debug.read().decode(errors="replace"), stalled)

    def _watch(self, process: subprocess.Popen[bytes], stall: float, report: Callable[[int], None]) -> bool:
        """Wait for its end; whether it had to be ended because nothing came any more."""
        size, moved = -1, time.monotonic()
        end = os.pidfd_open(process.pid)
        ended = select.poll()  # Python cannot sleep by the altered clock that `make verify` builds by
        ended.register(end, select.POLLIN)
        try:
            with together.ending(process):
                while process.poll() is None and time.monotonic() - moved < stall:
                    ended.poll(1000 * _LOOK_S)
                    if (now := self._size()) != size:
                        size, moved = now, time.monotonic()
                        report(now)
            return process.returncode is None
        finally:
            os.close(end)
            process.kill()
            process.wait()

    def _size(self) -> int:
        total = 0
        for each in self._directory.iterdir():
            with suppress(FileNotFoundError):  # apt renames what has failed
                total += each.stat().st_size
        return total

    def _read(self, output: str, debug: str, stalled: bool) -> None:
        """What apt wrote: reasons by address, and the headers of servers' answers."""
        reasons = dict(re.findall(r"^Err:\d+ (\S+).*\n {2}(.*)", output, re.MULTILINE))
        if full := [errno for errno in _DISK_FULL if any(os.strerror(errno) in each for each in reasons.values())]:
            raise OSError(full[0], os.strerror(full[0]))
        asked = re.findall(r"^Retry-After:(.*)$", debug, re.MULTILINE | re.IGNORECASE)
        self.retry_after = max(map(_seconds, asked), default=0.0)
        for file, address in self._addresses.items():
            reason = reasons.get(_for_apt(address))
            if reason is not None:
                self._fail(file, " ".join(reason.split()))
            elif stalled and not self._complete(file):
                self._fail(file, "Connection timed out")
        came = [file for file in self._addresses if file not in self.failures]
        if not all((self._directory / file.name).is_file() for file in came):
            raise UserError(
                f"{HELPER}: {debug.strip().rpartition(chr(10))[2] or 'failed'}; does `apt-get update` work?"
            )

    def _complete(self, file: File) -> bool:
        place = self._directory / file.name
        return bool(file.size) and place.is_file() and _sha256(place) == file.sha256

    def _fail(self, file: File, reason: str) -> None:
        kind = next(kind for kind in _KINDS if re.match(kind.reason, reason))
        received = self._directory / f"{file.name}.FAILED"
        if kind is WRONG and received.is_file():
            with received.open("rb") as content:
                page = _PAGE.match(content.read(512))
            kind, reason = (PAGE, "has a page of HTML") if page else (kind, _difference(file, received))
        received.unlink(missing_ok=True)
        self.failures[file] = kind, reason


def _seconds(retry_after: str) -> float:
    """Of the header's value: a number, or a date in a form of RFC 9110. Zero for any other value."""
    value = retry_after.strip()
    if re.fullmatch("[0-9]+", value):
        return float(value)
    for form in _DATES:
        with suppress(ValueError):
            return datetime.strptime(value, form).replace(tzinfo=UTC).timestamp() - _now()
    return 0.0


def _difference(file: File, received: Path) -> str:
    return (
        f"has SHA-256 {_sha256(received)} and {received.stat().st_size} bytes, the lock has {file.sha256} and "
        f"{file.size} bytes"
    )


def _options(patient: bool) -> list[str]:
    """Of apt's configuration, beside that of this computer."""
    settings = {
        "quiet": 1,
        "APT::Sandbox::User": "root",  # nobody else may write where the files go to
        "Acquire::Retries": 0,
        "Debug::Acquire::http": "true",  # answers' headers, for Retry-After
        "Debug::Acquire::https": "true",
    }
    for scheme in ("http", "https"):
        settings[f"Acquire::{scheme}::Timeout"] = _SILENCE_S if patient else _CONNECT_S
    if certificates := os.environ.get("SSL_CERT_FILE"):
        settings["Acquire::https::CAInfo"] = certificates
    return [f"-o{name}={value}" for name, value in settings.items()]


def _for_apt(address: str) -> str:
    """apt links to a file of this computer, where a copy is wanted."""
    return re.sub(r"^file:", "copy:", address)


def _host(address: str) -> str:
    parts = urlsplit(address)
    return f"{parts.scheme}://{parts.netloc}"


def _sha256(path: Path) -> str:
    with path.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


_sleep = time.sleep
_now = time.time
