"""The package pool against a server on this computer, and the repository for debootstrap."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import quote

import pytest

from flotilla.common import namespace, paths
from flotilla.common.errors import UserError
from flotilla.debian import download, mirror, pool
from flotilla.debian.lock import Lock, Package, Suite
from flotilla.debian.mirror import DEBIAN, SECURITY, Mirrors
from tests.unit.fault_server import PAGE, Answer, FaultServer, certificate

NOW = int(datetime(2026, 3, 1, tzinfo=UTC).timestamp())
RELEASED = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
SUITES = (Suite(DEBIAN, "bookworm", RELEASED), Suite(SECURITY, "bookworm-security", RELEASED.replace(day=4)))


@pytest.fixture
def server() -> Iterator[FaultServer]:
    running = FaultServer()
    yield running
    running.close()


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Seconds that would have been waited before a server was asked again."""
    waited: list[float] = []
    monkeypatch.setattr(download, "_sleep", waited.append)
    return waited


@pytest.fixture(autouse=True)
def empty_pool(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(paths, "POOL", tmp_path / "pool")


CONTENTS = {name: f"content of {name}".encode() * 1000 for name in ("one", "two+plus", "three")}


def package(name: str, content: bytes, archive: str = DEBIAN) -> Package:
    sha256 = hashlib.sha256(content).hexdigest()
    return Package(name, "1.0", "i386", "userland", archive, len(content), sha256, f"pool/main/{name}_1.0_i386.deb")


def lock_of(*packages: Package) -> Lock:
    return Lock("board", "i386", SUITES, packages)


LOCK = lock_of(*(package(name, content) for name, content in CONTENTS.items()))
ONE = LOCK.packages[0]


def serve(server: FaultServer, below: str = f"/{DEBIAN}") -> None:
    server.files |= {f"{below}/{each.path}": CONTENTS[each.name] for each in LOCK.packages}


def names() -> set[str]:
    return {path.name for path in paths.POOL.iterdir() if not path.name.startswith(".")}


FULL = {f"{each.sha256}.deb" for each in LOCK.packages}


def test_fill_downloads_what_is_missing_once(server: FaultServer) -> None:
    serve(server)
    pool.fill([LOCK, LOCK], server.mirrors)
    assert names() == FULL
    assert len(server.requests) == 3
    pool.verify_hashes(LOCK)

    pool.file(ONE).unlink()
    pool.fill([LOCK], server.mirrors)
    assert len(server.requests) == 4


def test_full_pool_needs_neither_mirror_nor_network(server: FaultServer, monkeypatch: pytest.MonkeyPatch) -> None:
    serve(server)
    pool.fill([LOCK], server.mirrors)
    monkeypatch.setattr(mirror, "resolve", lambda: Mirrors())
    pool.fill([LOCK])
    assert len(server.requests) == 3

    pool.file(ONE).unlink()
    with pytest.raises(UserError, match="command MIRROR"):
        pool.fill([LOCK])


def only(package: Package, answer: Answer) -> Callable[[str, int], Answer | None]:
    """A fault of one package, whenever it is asked for."""
    return lambda path, number: answer if path.endswith(package.path) else None


def test_wrong_content_from_the_mirror_stays_out(server: FaultServer, waits: list[float]) -> None:
    """Seen to advise `make lock`, which is no remedy against a proxy that changes files."""
    serve(server)
    server.fault = only(ONE, Answer(body=b"x" * ONE.size))
    with pytest.raises(UserError, match=rf"^package one 1\.0 \(i386\): .* has SHA-256 \w+ .*{ONE.sha256}") as caught:
        pool.fill([LOCK], server.mirrors)
    assert names() == FULL - {f"{ONE.sha256}.deb"}
    assert "MIRROR=" in str(caught.value)
    assert "make lock" not in str(caught.value)


@pytest.mark.parametrize("content", [b"short", b""])
def test_wrong_size_in_the_pool(server: FaultServer, content: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    """Seen to end in an error that asked for the file to be deleted by hand."""
    serve(server)
    pool.fill([LOCK], server.mirrors)
    damage(ONE, content)
    pool.fill([LOCK], server.mirrors)
    pool.verify_hashes(LOCK)
    assert "package one 1.0 (i386)" in capfd.readouterr().err


def test_wrong_content_of_the_right_size_in_the_pool(
    server: FaultServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Seen to end in an error that asked for the file to be deleted by hand."""
    serve(server)
    monkeypatch.setattr(mirror, "resolve", lambda: server.mirrors)
    pool.fill([LOCK])
    damage(ONE, b"x" * ONE.size)
    pool.fill([LOCK])  # looks at sizes alone
    assert len(server.requests) == 3
    pool.verify_hashes(LOCK)
    assert pool.file(ONE).read_bytes() == CONTENTS["one"]
    assert len(server.requests) == 4
    assert "is damaged" in capfd.readouterr().err


def test_damaged_package_without_a_mirror(server: FaultServer, monkeypatch: pytest.MonkeyPatch) -> None:
    serve(server)
    pool.fill([LOCK], server.mirrors)
    damage(ONE, b"x" * ONE.size)
    monkeypatch.setattr(mirror, "resolve", lambda: Mirrors())
    with pytest.raises(UserError, match="command MIRROR"):
        pool.verify_hashes(LOCK)


def damage(package: Package, content: bytes) -> None:
    pool.file(package).unlink()
    pool.file(package).write_bytes(content)


def test_verify_reports_missing_packages() -> None:
    with pytest.raises(UserError, match=r"package one .*missing[^\0]*package three .*missing"):
        pool.verify_hashes(LOCK)


def test_gone_packages_are_reported_at_once(server: FaultServer) -> None:
    serve(server)
    del server.files[f"/{DEBIAN}/{ONE.path}"], server.files[f"/{DEBIAN}/{LOCK.packages[2].path}"]
    with pytest.raises(UserError) as caught:
        pool.fill([LOCK], server.mirrors)
    lines = str(caught.value).splitlines()
    assert [line.split(":")[0] for line in lines] == ["package one 1.0 (i386)", "package three 1.0 (i386)"]
    assert all("`make lock`" in line and "SNAPSHOT=" in line for line in lines)
    assert names() == {f"{LOCK.packages[1].sha256}.deb"}


@pytest.mark.parametrize("time", ["20260102T030405Z", "20260103T030405Z"])
def test_gone_package_comes_from_the_snapshot_of_its_day(server: FaultServer, time: str) -> None:
    serve(server, f"/archive/{DEBIAN}/{time}")
    pool.fill([LOCK], Mirrors(server.mirrors.archives, f"{server.base}/archive"))
    assert names() == FULL


def test_snapshot_of_each_archive_has_its_own_date(server: FaultServer) -> None:
    fixed = package("one", CONTENTS["one"], SECURITY)
    server.files[f"/archive/{SECURITY}/20260104T030405Z/{fixed.path}"] = CONTENTS["one"]
    pool.fill([lock_of(fixed)], Mirrors({}, f"{server.base}/archive"))
    assert names() == {f"{fixed.sha256}.deb"}


def test_gone_even_from_the_snapshot(server: FaultServer) -> None:
    with pytest.raises(UserError, match=r"package one .*/debian/pool.*/archive/debian/20260102.*`make lock`") as caught:
        pool.fill([LOCK], Mirrors(server.mirrors.archives, f"{server.base}/archive"))
    assert "set SNAPSHOT" not in str(caught.value)


# --- networks that fail ---


def first(times: int, *answers: Answer) -> Callable[[str, int], Answer | None]:
    """A fault of the package `one`, so many times."""
    return lambda path, number: answers[0] if path.endswith(ONE.path) and number <= times else None


@pytest.mark.parametrize(
    "answer",
    [Answer(503), Answer(429), Answer(500), Answer(cut=0), Answer(cut=ONE.size // 2), Answer(body=b"x" * ONE.size)],
    ids=["503", "429", "500", "dropped", "truncated", "changed"],
)
def test_passing_failures_are_tried_again(server: FaultServer, answer: Answer, waits: list[float]) -> None:
    """Seen to give up a throttled archive after three tries in a second."""
    serve(server)
    server.fault = first(2, answer)
    pool.fill([LOCK], server.mirrors)
    assert names() == FULL
    pool.verify_hashes(LOCK)
    assert len(waits) == 2 or answer.cut is not None, "apt itself connects anew, once"


def test_waits_grow_up_to_a_bound(server: FaultServer, waits: list[float]) -> None:
    server.fault = lambda path, number: Answer(503)
    with pytest.raises(UserError, match=r"^package one .* and 2 more: .*503.*MIRROR="):
        pool.fill([LOCK], server.mirrors)
    assert len(waits) == len(download._DELAYS_S)
    assert all(0.75 * delay <= wait <= 1.25 * delay for delay, wait in zip(download._DELAYS_S, waits, strict=True))
    assert len(server.requests) == len(waits) + 1, "one file is enough to find that out"


def at(seconds: int, form: str = "%a, %d %b %Y %H:%M:%S GMT") -> str:
    """A time in the forms that RFC 9110 permits, so many seconds after NOW."""
    return time.strftime(form, time.gmtime(NOW + seconds))


@pytest.mark.parametrize(
    ("asked", "waited"),
    [
        ("7", 7.0),
        ("100000", 60.0),
        ("1" * 400, 60.0),
        (at(7), 7.0),
        (at(7, "%A, %d-%b-%y %H:%M:%S GMT"), 7.0),
        (at(7, "%a %b %e %H:%M:%S %Y"), 7.0),
        (at(100000), 60.0),
        (at(-7), 1.25),
        ("soon", 1.25),
        ("Fri, 31 Feb 2026 08:00:00 GMT", 1.25),
        ("Sun, 01 Mar 2026 99999999999999999999:00:00 GMT", 1.25),
        ("1 Mar 0001 00:00:00 GMT", 1.25),
        ("Fri, 31 Dec 99999 08:00:00 GMT", 1.25),
    ],
)
def test_server_says_when_to_come_back(
    server: FaultServer, asked: str, waited: float, waits: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seen to fail: a date had no effect."""
    monkeypatch.setattr(download, "_now", lambda: NOW)
    serve(server)
    server.fault = first(1, Answer(429, Retry_After=asked))
    pool.fill([LOCK], server.mirrors)
    assert names() == FULL
    assert len(waits) == 1
    assert waits[0] == waited or 0.75 <= waits[0] <= waited == 1.25


def test_a_throttle_that_lets_some_through(server: FaultServer, waits: list[float]) -> None:
    """However many rounds it takes, as long as something comes in each."""
    many = [package(f"p{number}", f"{number}".encode() * 100) for number in range(30)]
    server.files = {f"/{DEBIAN}/{each.path}": str(number).encode() * 100 for number, each in enumerate(many)}
    served: list[int] = []

    def throttle(path: str, number: int) -> Answer | None:
        served.append(1)
        return Answer(429) if len(served) % 11 > 3 else None

    server.fault = throttle
    pool.fill([lock_of(*many)], server.mirrors)
    assert names() == {f"{each.sha256}.deb" for each in many}


def test_proxy_that_drops_every_tenth_request(
    server: FaultServer, waits: list[float], apt_settings: Callable[..., None]
) -> None:
    many = [package(f"p{number}", f"{number}".encode() * 100) for number in range(60)]
    server.files = {f"/{DEBIAN}/{each.path}": str(number).encode() * 100 for number, each in enumerate(many)}
    server.fault = lambda path, number: Answer(cut=0) if len(server.requests) % 10 == 0 else None
    apt_settings(f'Acquire::http::Proxy "{server.base}";')
    pool.fill([lock_of(*many)], Mirrors({DEBIAN: "http://mirror.invalid/debian"}))
    assert names() == {f"{each.sha256}.deb" for each in many}


def test_broken_connection_leaves_no_half_file(server: FaultServer, waits: list[float]) -> None:
    serve(server)
    server.fault = only(ONE, Answer(cut=0))
    with pytest.raises(UserError, match="package one"):
        pool.fill([LOCK], server.mirrors)
    assert names() == FULL - {f"{ONE.sha256}.deb"}


def test_host_that_refuses_connections_is_given_up_as_a_whole(server: FaultServer, waits: list[float]) -> None:
    """Seen to be tried three times for each package."""
    mirrors = server.mirrors
    server.close()
    with pytest.raises(UserError) as caught:
        pool.fill([LOCK], mirrors)
    (line,) = str(caught.value).splitlines()
    assert line.startswith("package one 1.0 (i386) and 2 more: http://127.0.0.1:")
    assert "connect" in line
    assert "Acquire::http::Proxy" in line
    assert "MIRROR=" in line
    assert len(waits) == 1


def test_mirror_that_hangs(server: FaultServer, waits: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    """In the middle of a file, once: given up when no byte has come, and resumed."""
    serve(server)
    monkeypatch.setattr(download, "_SILENCE_S", 1)
    monkeypatch.setattr(download, "_CONNECT_S", 1)
    over = threading.Event()
    server.fault = first(1, Answer(pause=over, cut=ONE.size // 2))
    try:
        pool.fill([LOCK], server.mirrors)
    finally:
        over.set()
    assert names() == FULL
    assert len(waits) == 1


@pytest.mark.parametrize("status", [200, 302, 511])
def test_captive_portal(server: FaultServer, status: int, waits: list[float]) -> None:
    """Seen to advise `make lock`."""
    serve(server)
    page = Answer(200, PAGE, "text/html")
    login = Answer(302, b"", Location="/login") if status == 302 else Answer(status, PAGE, "text/html")
    server.fault = lambda path, number: page if path == "/login" else login
    with pytest.raises(UserError, match=r"page of its own \(captive portal\?\)") as caught:
        pool.fill([LOCK], server.mirrors)
    assert "make lock" not in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
    assert not waits
    assert names() == set()


def test_forbidden_is_not_asked_for_again(server: FaultServer, waits: list[float]) -> None:
    serve(server)
    server.fault = only(ONE, Answer(403))
    with pytest.raises(UserError, match=r"package one 1\.0 \(i386\): .*403"):
        pool.fill([LOCK], server.mirrors)
    assert not waits
    assert names() == FULL - {f"{ONE.sha256}.deb"}


# --- this computer's apt: proxies, certificates ---


@pytest.fixture
def apt_settings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., None]:
    """Settings of apt beside those that this computer has."""
    for name in ("http_proxy", "https_proxy", "no_proxy", "SSL_CERT_FILE"):
        monkeypatch.delenv(name, raising=False)

    def configure(*lines: str) -> None:
        (tmp_path / "apt.conf").write_text("\n".join(lines))
        monkeypatch.setenv("APT_CONFIG", str(tmp_path / "apt.conf"))

    return configure


def test_proxy_of_apt(server: FaultServer, apt_settings: Callable[..., None]) -> None:
    """Seen to fail: `mirror.invalid` was looked up, for each package."""
    serve(server)
    apt_settings(f'Acquire::http::Proxy "{server.base}";')
    pool.fill([LOCK], Mirrors({DEBIAN: "http://mirror.invalid/debian"}))
    assert names() == FULL
    assert all(each.startswith("http://mirror.invalid/debian/pool/") for each in server.requests)


def test_host_without_the_proxy_of_apt(server: FaultServer, apt_settings: Callable[..., None]) -> None:
    serve(server)
    apt_settings('Acquire::http::Proxy "http://127.0.0.1:1";', 'Acquire::http::Proxy::127.0.0.1 "DIRECT";')
    pool.fill([LOCK], server.mirrors)
    assert names() == FULL


def test_proxy_that_a_program_finds(server: FaultServer, apt_settings: Callable[..., None], tmp_path: Path) -> None:
    serve(server)
    (tmp_path / "find").write_text(f"#!/bin/sh\necho {server.base}\n")
    (tmp_path / "find").chmod(0o755)
    apt_settings(f'Acquire::http::Proxy-Auto-Detect "{tmp_path}/find";')
    pool.fill([LOCK], Mirrors({DEBIAN: "http://mirror.invalid/debian"}))
    assert names() == FULL


def test_proxy_of_the_environment(
    server: FaultServer, apt_settings: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    serve(server)
    apt_settings()
    monkeypatch.setenv("http_proxy", server.base)
    pool.fill([LOCK], Mirrors({DEBIAN: "http://mirror.invalid/debian"}))
    assert names() == FULL


def test_proxy_that_cannot_be_reached(
    server: FaultServer, apt_settings: Callable[..., None], waits: list[float]
) -> None:
    apt_settings('Acquire::http::Proxy "http://127.0.0.1:1";')
    with pytest.raises(UserError, match=r"^package one .* and 2 more: .*127\.0\.0\.1:1.*Acquire::http::Proxy"):
        pool.fill([LOCK], server.mirrors)


def test_settings_of_apt_that_apt_cannot_read(server: FaultServer, apt_settings: Callable[..., None]) -> None:
    apt_settings("Acquire::http::Proxy")
    with pytest.raises(UserError, match=r"apt\.conf"):
        pool.fill([LOCK], server.mirrors)


@pytest.fixture
def inspected(tmp_path: Path) -> Iterator[FaultServer]:
    """A mirror whose certificate is of an authority of its own, as it appears behind a proxy that inspects TLS."""
    running = FaultServer(certificate(tmp_path))
    serve(running)
    yield running
    running.close()


def test_certificate_that_nobody_knows(
    inspected: FaultServer, apt_settings: Callable[..., None], waits: list[float]
) -> None:
    apt_settings()
    with pytest.raises(UserError, match=r"and 2 more: https://.*[Cc]ertificate.*update-ca-certificates"):
        pool.fill([LOCK], inspected.mirrors)


@pytest.mark.parametrize("of", ["apt", "environment"])
def test_certificate_of_an_inspecting_proxy(
    inspected: FaultServer, apt_settings: Callable[..., None], of: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    apt_settings(f'Acquire::https::CAInfo "{tmp_path}/ca.pem";' if of == "apt" else "")
    if of == "environment":
        monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "ca.pem"))
    pool.fill([LOCK], inspected.mirrors)
    assert names() == FULL


# --- this computer ---


def test_mirror_on_this_computer(tmp_path: Path) -> None:
    for each in LOCK.packages:
        place = tmp_path / "my mirror" / each.path
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(CONTENTS[each.name])
    pool.fill([LOCK], Mirrors({DEBIAN: f"file://{quote(str(tmp_path))}/my%20mirror"}))
    assert names() == FULL
    assert not pool.file(ONE).is_symlink()
    pool.file(ONE).unlink()
    (tmp_path / "my mirror" / ONE.path).unlink()
    with pytest.raises(UserError, match=r"package one .* any more"):
        pool.fill([LOCK], Mirrors({DEBIAN: f"file://{quote(str(tmp_path))}/my%20mirror"}))


def test_left_over_of_a_killed_download_does_no_harm(server: FaultServer, waits: list[float]) -> None:
    """What had come whole is taken, half a file is resumed, and a wrong one is fetched anew."""
    serve(server)
    incoming = paths.POOL / ".incoming"
    incoming.mkdir(parents=True)
    one, two, three = (incoming / pool.file(each).name for each in LOCK.packages)
    one.write_bytes(CONTENTS["one"])
    two.write_bytes(CONTENTS[LOCK.packages[1].name][:100])
    three.write_bytes(b"x" * 100)
    pool.fill([LOCK], server.mirrors)
    assert names() == FULL
    pool.verify_hashes(LOCK)
    assert not server.asked(f"/{DEBIAN}/{ONE.path}")
    assert [path.name for path in incoming.iterdir()] == []


def test_full_disk(server: FaultServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """apt's downloader on a disk of 4 KiB."""
    serve(server)
    script = f"""
import sys
from pathlib import Path
from flotilla.common import namespace, paths
from flotilla.debian import pool
from flotilla.debian.mirror import Mirrors
from tests.unit.test_pool import LOCK
from flotilla.common.errors import UserError
paths.POOL = Path({str(paths.POOL)!r})
try:
    pool.fill([LOCK], Mirrors({{"debian": "{server.base}/debian"}}))
except UserError as error:
    sys.exit(str(error))
"""
    paths.POOL.mkdir()
    mounted = f'mount -t tmpfs -o size=4k none {paths.POOL} && exec {sys.executable} -c "$1"'
    done = subprocess.run(
        [*namespace.prefix(), "sh", "-c", mounted, "sh", script], capture_output=True, text=True, cwd=paths.PROJECT
    )
    assert re.search(r"^no space left for .*BUILD=", done.stderr, re.MULTILINE), done.stderr
    assert done.returncode == 1


# --- repository ---


def deb(directory: Path, name: str, **fields: str) -> Package:
    """A real package in the pool."""
    root = directory / name
    (root / "DEBIAN").mkdir(parents=True)
    values = {"Package": name, "Version": "1.0", "Architecture": "i386", "Maintainer": "x <x@localhost>"} | fields
    control = "".join(f"{key}: {value}\n" for key, value in values.items()) + "Description: x\n more\n"
    (root / "DEBIAN/control").write_text(control)
    built = directory / f"{name}.deb"
    subprocess.run(["dpkg-deb", "--root-owner-group", "-b", str(root), str(built)], check=True, capture_output=True)
    made = package(name, built.read_bytes())
    paths.POOL.mkdir(exist_ok=True)
    built.replace(pool.file(made))
    return made


@pytest.fixture
def real(tmp_path: Path) -> Lock:
    libc = deb(tmp_path, "libc6", Priority="optional")
    tool = deb(tmp_path, "tool", Priority="required", Depends="libc6")
    required = Package(**(vars(libc) | {"role": "required"}))
    return lock_of(required, tool)


def test_repository_says_what_the_archive_said(real: Lock, tmp_path: Path) -> None:
    directory = tmp_path / "repository"
    pool.repository(real, directory)
    text = (directory / "dists/bookworm/main/binary-i386/Packages").read_text()
    assert text.endswith("\n\n"), "debootstrap misses the last stanza otherwise"
    found = {stanza["Package"]: stanza for stanza in mirror.stanzas(text)}
    assert {name: stanza["Priority"] for name, stanza in found.items()} == {"libc6": "required", "tool": "optional"}
    assert found["tool"]["Depends"] == "libc6"
    for each in real.packages:
        assert found[each.name]["Filename"] == each.path
        assert (found[each.name]["Size"], found[each.name]["SHA256"]) == (str(each.size), each.sha256)
        assert (directory / each.path).samefile(pool.file(each))


def test_repository_without_compression(real: Lock, tmp_path: Path) -> None:
    """dpkg-deb finds the same in it; the kernel stays as it is. Seen to fail with the former name, data.tar.xz."""
    tool, kernel = real.packages[1], Package(**(vars(deb(tmp_path, "image")) | {"role": "kernel"}))
    directory = tmp_path / "repository"
    pool.repository(lock_of(tool, kernel), directory, compressed=False)
    made, packed = directory / tool.path, pool.file(tool)

    def content(package: Path) -> list[bytes]:
        return [
            subprocess.run(["dpkg-deb", f"--{part}-tarfile", str(package)], check=True, capture_output=True).stdout
            for part in ("ctrl", "fsys")
        ]

    assert content(made) == content(packed)
    assert content(packed)[1] in made.read_bytes()
    text = (directory / "dists/bookworm/main/binary-i386/Packages").read_text()
    found = {stanza["Package"]: stanza for stanza in mirror.stanzas(text)}
    assert found["tool"]["Size"] == str(made.stat().st_size)
    assert found["tool"]["SHA256"] == hashlib.sha256(made.read_bytes()).hexdigest()
    assert (directory / kernel.path).samefile(pool.file(kernel))


def test_release_covers_the_index(real: Lock, tmp_path: Path) -> None:
    pool.repository(real, tmp_path / "repository")
    root = tmp_path / "repository/dists/bookworm"
    listed = [line.split() for line in (root / "Release").read_text().splitlines() if line.startswith(" ")]
    assert {name for _, _, name in listed} == {"main/binary-i386/Packages"}
    for sha256, size, name in listed:
        content = (root / name).read_bytes()
        assert (sha256, size) == (hashlib.sha256(content).hexdigest(), str(len(content)))


def test_repository_repeats_to_the_byte(real: Lock, tmp_path: Path) -> None:
    def content(directory: Path) -> dict[str, bytes]:
        return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}

    for name in ("first", "second"):
        pool.repository(real, tmp_path / name)
    assert content(tmp_path / "first") == content(tmp_path / "second")
    pool.repository(lock_of(real.packages[0]), tmp_path / "third")
    assert content(tmp_path / "third") != content(tmp_path / "first")


def test_repository_on_another_disk_copies(real: Lock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def crosses(*_: object) -> None:
        raise OSError(errno.EXDEV, os.strerror(errno.EXDEV))

    monkeypatch.setattr(Path, "hardlink_to", crosses)
    pool.repository(real, tmp_path / "repository")
    for each in real.packages:
        assert (tmp_path / "repository" / each.path).read_bytes() == pool.file(each).read_bytes()


def test_damaged_description(real: Lock) -> None:
    """Seen to ask for the file to be deleted by hand."""
    (tool,) = [each for each in real.packages if each.name == "tool"]
    damage(tool, b"x" * tool.size)
    with pytest.raises(UserError, match=r"package tool .*run again"):
        pool.control(tool)
    assert not pool.file(tool).exists()


def test_pool_file_that_is_no_package(tmp_path: Path) -> None:
    broken = package("broken", b"no archive")
    paths.POOL.mkdir()
    pool.file(broken).write_bytes(b"no archive")
    with pytest.raises(UserError, match="package broken"):
        pool.repository(lock_of(broken), tmp_path / "repository")
