"""The package pool against a server on this computer, and the repository for debootstrap."""

from __future__ import annotations

import errno
import hashlib
import os
import subprocess
import threading
from collections.abc import Iterator
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from images.builder import mirror, pool
from images.builder.lock import Lock, Package, Suite
from images.builder.mirror import DEBIAN, SECURITY, Mirrors

RELEASED = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
SUITES = (Suite(DEBIAN, "bookworm", RELEASED), Suite(SECURITY, "bookworm-security", RELEASED.replace(day=4)))


class Server:
    """Serves `files` by path; a path in `failures` fails that many times first."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.failures: dict[str, int] = {}
        self.cut: set[str] = set()
        """Paths whose connection breaks half way."""
        self.requests: list[str] = []
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        self.base = f"http://127.0.0.1:{self._server.server_port}"
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.01})
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def _handler(server) -> type[BaseHTTPRequestHandler]:
        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                server.requests.append(self.path)
                body = server.files.get(self.path)
                if server.failures.get(self.path, 0):
                    server.failures[self.path] -= 1
                    return self.send_error(503)
                if body is None:
                    return self.send_error(404)
                self.send_response(200)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body[: len(body) // 2] if self.path in server.cut else body)
                return None

            def log_message(self, *_: object) -> None:
                pass

        return Handler

    @property
    def mirrors(self) -> Mirrors:
        return Mirrors({archive: f"{self.base}/{archive}" for archive in mirror.ARCHIVES})


@pytest.fixture
def server() -> Iterator[Server]:
    running = Server()
    yield running
    running.close()


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


def serve(server: Server, below: str = f"/{DEBIAN}") -> None:
    server.files |= {f"{below}/{each.path}": CONTENTS[each.name] for each in LOCK.packages}


def names() -> set[str]:
    return {path.name for path in paths.POOL.iterdir() if path.name != ".lock"}


FULL = {f"{each.sha256}.deb" for each in LOCK.packages}


def test_fill_downloads_what_is_missing_once(server: Server) -> None:
    serve(server)
    pool.fill([LOCK, LOCK], server.mirrors)
    assert names() == FULL
    assert len(server.requests) == 3
    pool.verify_hashes(LOCK)

    pool.file(ONE).unlink()
    pool.fill([LOCK], server.mirrors)
    assert len(server.requests) == 4


def test_full_pool_needs_neither_mirror_nor_network(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    serve(server)
    pool.fill([LOCK], server.mirrors)
    monkeypatch.setattr(mirror, "resolve", lambda: Mirrors())
    pool.fill([LOCK])
    assert len(server.requests) == 3

    pool.file(ONE).unlink()
    with pytest.raises(UserError, match="set MIRROR"):
        pool.fill([LOCK])


def test_wrong_content_from_the_mirror_stays_out(server: Server) -> None:
    serve(server)
    server.files[f"/{DEBIAN}/{ONE.path}"] = b"x" * ONE.size
    with pytest.raises(UserError, match=rf"package one 1\.0 \(i386\): .* has SHA-256 [0-9a-f]+ .*{ONE.sha256}"):
        pool.fill([LOCK], server.mirrors)
    assert names() == FULL - {f"{ONE.sha256}.deb"}


def test_wrong_size_in_the_pool(server: Server) -> None:
    serve(server)
    pool.fill([LOCK], server.mirrors)
    pool.file(ONE).write_bytes(b"short")
    with pytest.raises(UserError, match=rf"package one .*{ONE.sha256}\.deb has SHA-256 .*{ONE.sha256}; delete"):
        pool.fill([LOCK], server.mirrors)


def test_wrong_content_of_the_right_size_in_the_pool(server: Server, tmp_path: Path) -> None:
    serve(server)
    pool.fill([LOCK], server.mirrors)
    pool.file(ONE).write_bytes(b"x" * ONE.size)
    pool.fill([LOCK], server.mirrors)  # looks at sizes alone
    found = hashlib.sha256(b"x" * ONE.size).hexdigest()
    with pytest.raises(UserError, match=rf"^package one .* has SHA-256 {found}, the lock says {ONE.sha256}; delete"):
        pool.verify_hashes(LOCK)
    with pytest.raises(UserError, match="package one"):
        pool.repository(LOCK, tmp_path / "repository")


def test_verify_reports_missing_packages() -> None:
    with pytest.raises(UserError, match=r"package one .*missing[^\0]*package three .*missing"):
        pool.verify_hashes(LOCK)


def test_gone_packages_are_reported_at_once(server: Server) -> None:
    serve(server)
    del server.files[f"/{DEBIAN}/{ONE.path}"], server.files[f"/{DEBIAN}/{LOCK.packages[2].path}"]
    with pytest.raises(UserError) as caught:
        pool.fill([LOCK], server.mirrors)
    lines = str(caught.value).splitlines()
    assert [line.split(":")[0] for line in lines] == ["package one 1.0 (i386)", "package three 1.0 (i386)"]
    assert all("`make lock`" in line and "SNAPSHOT=" in line for line in lines)
    assert names() == {f"{LOCK.packages[1].sha256}.deb"}


@pytest.mark.parametrize("time", ["20260102T030405Z", "20260103T030405Z"])
def test_gone_package_comes_from_the_snapshot_of_its_day(server: Server, time: str) -> None:
    serve(server, f"/archive/{DEBIAN}/{time}")
    pool.fill([LOCK], Mirrors(server.mirrors.archives, f"{server.base}/archive"))
    assert names() == FULL


def test_snapshot_of_each_archive_has_its_own_date(server: Server) -> None:
    fixed = package("one", CONTENTS["one"], SECURITY)
    server.files[f"/archive/{SECURITY}/20260104T030405Z/{fixed.path}"] = CONTENTS["one"]
    pool.fill([lock_of(fixed)], Mirrors({}, f"{server.base}/archive"))
    assert names() == {f"{fixed.sha256}.deb"}


def test_gone_even_from_the_snapshot(server: Server) -> None:
    with pytest.raises(UserError, match=r"package one .*/debian/pool.*/archive/debian/20260102.*`make lock`") as caught:
        pool.fill([LOCK], Mirrors(server.mirrors.archives, f"{server.base}/archive"))
    assert "set SNAPSHOT" not in str(caught.value)


def test_passing_failures_are_tried_again(server: Server) -> None:
    serve(server)
    server.failures[f"/{DEBIAN}/{ONE.path}"] = 2
    pool.fill([LOCK], server.mirrors)
    assert names() == FULL


def test_lasting_failure_names_the_package(server: Server) -> None:
    serve(server)
    server.failures[f"/{DEBIAN}/{ONE.path}"] = 100
    with pytest.raises(UserError, match=r"package one .*503"):
        pool.fill([LOCK], server.mirrors)


def test_broken_connection_leaves_no_half_file(server: Server) -> None:
    serve(server)
    server.cut.add(f"/{DEBIAN}/{ONE.path}")
    with pytest.raises(UserError, match="package one"):
        pool.fill([LOCK], server.mirrors)
    assert names() == FULL - {f"{ONE.sha256}.deb"}


def test_left_over_of_a_killed_download_does_no_harm(server: Server) -> None:
    serve(server)
    paths.POOL.mkdir()
    pool.file(ONE).with_suffix(".part").write_bytes(CONTENTS["one"] * 2)
    pool.fill([LOCK], server.mirrors)
    assert names() == FULL
    pool.verify_hashes(LOCK)


def test_full_disk(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    serve(server)
    receive = pool._receive

    def fails_late(*arguments: object) -> tuple[str, int]:
        receive(*arguments)  # type: ignore[arg-type]
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(pool, "_receive", fails_late)
    with pytest.raises(UserError, match=r"^no space left for .*BUILD="):
        pool.fill([LOCK], server.mirrors)
    assert names() == set()


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


def test_pool_file_that_is_no_package(tmp_path: Path) -> None:
    broken = package("broken", b"no archive")
    paths.POOL.mkdir()
    pool.file(broken).write_bytes(b"no archive")
    with pytest.raises(UserError, match="package broken"):
        pool.repository(lock_of(broken), tmp_path / "repository")
