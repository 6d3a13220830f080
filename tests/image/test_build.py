"""Builds that do not end well: what they leave, and what they say."""

from __future__ import annotations

import hashlib
import os
import random
import re
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from flotilla.common import namespace, paths, progress
from flotilla.fleet import inventory
from flotilla.images import build as builder

ROBOT = 3
BOARD = inventory.load_fleet().robots[ROBOT].board
MOMENTS = 10
_PATIENCE_S = 1500
"""Some 30 s on an idle host; on a busy one it took 300."""


def _link(source: str | Path, target: str | Path) -> None:
    """The same file, or a copy where that is on another disk."""
    try:
        Path(target).hardlink_to(source)
    except OSError:
        shutil.copy2(source, target)


@pytest.fixture
def build(tmp_path: Path) -> Path:
    """An empty build directory with the pool of the real one, and an image that a failure must not harm."""
    directory = tmp_path / "build"
    (directory / "pool").mkdir(parents=True)
    for package in paths.POOL.glob("*.deb"):
        _link(package, directory / "pool" / package.name)
    (directory / "images").mkdir()
    (directory / "images" / "robot3.img").write_text("the last good image")
    return directory


def _argv(build: Path) -> tuple[list[str], dict[str, str]]:
    return [sys.executable, "-m", "flotilla", "image", str(ROBOT)], os.environ | {"BUILD": str(build)}


def _begin(build: Path) -> subprocess.Popen[str]:
    argv, environment = _argv(build)
    return subprocess.Popen(
        ["env", "--default-signal=INT", *argv],  # background jobs of a script inherit that it is ignored
        env=environment, cwd=paths.PROJECT, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True,
        start_new_session=True,
    )  # fmt: skip


def _in_namespace(script: str, argv: list[str], environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """Run a build after a shell script that changes the mounts it sees."""
    whole = [*namespace.prefix(), "sh", "-c", script, "sh", *argv]
    return subprocess.run(whole, env=environment, cwd=paths.PROJECT, capture_output=True, text=True)


def _processes(build: Path) -> set[int]:
    """Everything that works in or for a build directory, inside its namespaces too."""
    found = set()
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words = (process / "environ").read_bytes()
            root = (process / "root").readlink()
        except OSError:
            continue  # ended meanwhile, or is the kernel's
        if str(build).encode() in words or root.is_relative_to(build):
            found.add(int(process.name))
    return found


@pytest.fixture
def running(build: Path) -> Iterator[subprocess.Popen[str]]:
    """A build in the middle of debootstrap. What comes before that, tools and runtime, is the real build's."""
    for kind in ("tools", "runtime"):
        for result in paths.CACHE.glob(f"{kind}-*[0-9a-f]"):
            shutil.copytree(result, build / "cache" / result.name, symlinks=True, copy_function=_link)
    process = _begin(build)
    log = build / f"rootfs-{BOARD}.log"
    timer = select.poll()  # waits for the process's end, and wakes now and then to look at the log
    descriptor = os.pidfd_open(process.pid)
    timer.register(descriptor, select.POLLIN)
    try:
        for _ in range(_PATIENCE_S * 10):
            if log.exists() and "Configuring" in log.read_text():
                break
            assert not timer.poll(100), process.communicate()[1]
        else:
            pytest.fail("the build never reached debootstrap's second stage")
        yield process
    finally:
        process.kill()
        process.wait()
        if process.stderr:
            process.stderr.close()
        os.close(descriptor)


def _gone(pids: set[int]) -> bool:
    """Whether all of them end in time."""
    for pid in pids:
        try:
            descriptor = os.pidfd_open(pid)
        except ProcessLookupError:
            continue
        ended = select.select([descriptor], [], [], _PATIENCE_S)[0]
        os.close(descriptor)
        if not ended:
            return False
    return True


def test_an_interrupted_build_leaves_the_last_good_image_and_nothing_else(
    build: Path, running: subprocess.Popen[str]
) -> None:
    pids = _processes(build)
    assert len(pids) >= 2, "the negative control: a running build is seen"
    os.killpg(running.pid, signal.SIGINT)
    _, errors = running.communicate(timeout=_PATIENCE_S)
    assert running.returncode == 130, errors
    assert "interrupted; the last good outputs are untouched" in errors
    assert _gone(pids)
    assert _processes(build) == set()
    assert str(build) not in Path("/proc/self/mounts").read_text()
    assert (build / "images" / "robot3.img").read_text() == "the last good image"
    assert [path.name for path in (build / "images").iterdir()] == ["robot3.img"]
    assert not list((build / "cache").glob("*.part"))
    assert not list((build / "cache").glob("rootfs-*"))


@pytest.mark.nightly  # it is interrupted each time
def test_a_killed_build_leaves_no_process_and_no_result(build: Path, running: subprocess.Popen[str]) -> None:
    pids = _processes(build)
    running.kill()
    running.wait()
    assert _gone(pids)
    assert _processes(build) == set()
    assert [path.suffix for path in (build / "cache").glob("rootfs-*")] == [".part"], "half, and named so"
    assert (build / "images" / "robot3.img").read_text() == "the last good image"


def _events(build: Path) -> list[str]:
    """What a build has done so far: results and images begun and made, parts of the root, every tenth package."""
    files = [*build.glob("cache/*-*"), *build.glob("images/.*.part")]
    made = sorted(path.relative_to(build).as_posix() for path in files if not path.name.endswith((".json", ".lock")))
    log = build / f"rootfs-{BOARD}.log"
    lines = re.findall(r"^(?:== \w+$|I: (?:Unpacking|Configuring)|Setting up).*", progress.text(log), re.MULTILINE)
    return made + [line for number, line in enumerate(lines) if line.startswith("==") or not number % 10]


def _wait_for_events(build: Path, process: subprocess.Popen[str], count: int) -> str:
    """Until so many have come since now; what the last one is. Or until the build ends: nothing."""
    before = set(_events(build))
    end = time.monotonic() + _PATIENCE_S
    descriptor = os.pidfd_open(process.pid)
    try:
        while not select.select([descriptor], [], [], 0.05)[0]:
            new = [event for event in _events(build) if event not in before]
            if len(new) >= count:
                return new[-1]
            assert time.monotonic() < end, "the build makes no progress"
    finally:
        os.close(descriptor)
    return ""


def _sha256(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _right_image(directory: Path) -> str:
    """SHA-256 of what an undisturbed build makes."""
    fleet = inventory.load_fleet()
    (image,) = builder.build(fleet, [fleet.robots[ROBOT]], directory)
    return _sha256(image)


@pytest.mark.nightly  # the tests above interrupt and kill a build once
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL], ids=["ctrl-c", "kill-9"])
def test_interrupted_at_any_moments_the_next_build_makes_the_right_image(
    build: Path, tmp_path: Path, how: signal.Signals
) -> None:
    """Each build begins with what the one before has left, until one ends; then another begins without results."""
    seed = random.SystemRandom().randrange(1 << 32)
    print(f"seed {seed}")  # shown if it fails
    chosen = random.Random(seed)
    right = _right_image(tmp_path / "right")
    interrupted = 0
    while interrupted < MOMENTS:
        (build / f"rootfs-{BOARD}.log").unlink(missing_ok=True)  # an earlier build's events do not count
        process = _begin(build)
        event = _wait_for_events(build, process, chosen.randint(1, 40))
        if not event:
            _, errors = process.communicate()
            assert process.returncode == 0, errors
            assert _sha256(build / "images" / "robot3.img") == right
            shutil.rmtree(build / "cache")
            continue
        interrupted += 1
        print(f"{interrupted}: {event}")
        pids = _processes(build)
        if how == signal.SIGINT:
            os.killpg(process.pid, how)
        else:
            process.kill()
        _, errors = process.communicate(timeout=60)
        assert _gone(pids)
        assert _processes(build) == set()
        assert str(build) not in Path("/proc/self/mounts").read_text()
        if how == signal.SIGINT:
            assert process.returncode == 130, errors
            assert "interrupted; the last good outputs are untouched" in errors
            assert "Traceback" not in errors
            assert not [*(build / "cache").glob("*.part"), *(build / "images").glob(".*")]
    process = _begin(build)
    _, errors = process.communicate(timeout=_PATIENCE_S)
    assert process.returncode == 0, errors
    assert _sha256(build / "images" / "robot3.img") == right
    assert not [*(build / "cache").glob("*.part"), *(build / "images").glob(".*")]


@pytest.mark.nightly  # two builds that wait for each other are in tests/unit/test_cache.py
def test_three_builds_at_once_make_the_right_image(build: Path, tmp_path: Path) -> None:
    right = _right_image(tmp_path / "right")
    processes = [_begin(build) for _ in range(3)]
    said = [process.communicate(timeout=_PATIENCE_S)[1] for process in processes]
    assert [process.returncode for process in processes] == [0, 0, 0], said
    assert sum("wait for another command that holds" in each for each in said) == 2
    assert _sha256(build / "images" / "robot3.img") == right
    assert not [*(build / "cache").glob("*.part"), *(build / "images").glob(".*")]


@pytest.mark.parametrize(
    ("room", "fill", "message"),
    [
        pytest.param("100m", "", "a build needs 908.0 MiB", id="from the start"),
        pytest.param(
            "1200m", f"(for _ in $(seq 600); do [ ! -s $BUILD/rootfs-{BOARD}.log ] || break; sleep 0.1; done; "
            "dd if=/dev/zero of=$BUILD/filler bs=1M 2>/dev/null) &", "no space left", id="while building",
            marks=pytest.mark.nightly,  # each write that finds no room is said by tests/unit/test_host.py
        ),
    ],
)  # fmt: skip
def test_a_full_disk_is_said_so(build: Path, tmp_path: Path, room: str, fill: str, message: str) -> None:
    """A disk that is too small from the start, and one that something else fills while the build runs."""
    argv, environment = _argv(build)
    pool = tmp_path / "pool"
    (build / "pool").rename(pool)
    script = f'mount -t tmpfs -o size={room} none "$BUILD" && ln -s {pool} "$BUILD/pool" && {fill or ":;"} exec "$@"'
    done = _in_namespace(script, argv, environment)
    assert done.returncode == 1, done.stderr
    assert message in done.stderr
    assert "BUILD=" in done.stderr
    assert "Traceback" not in done.stderr


WITHOUT_ESTIMATE = """
import sys
from flotilla.common import host
from flotilla.cli.main import main
host._missing_space = lambda needed: []
sys.exit(main())
"""


def _written_on(size_kib: int, argv: list[str], build: Path) -> tuple[int, str, list[str]]:
    """Status and errors of a card's making on a disk of so many KiB that has the last image, and the files after that
    with their hashes. Pool and cache are the usual ones."""
    script = f"""mount -t tmpfs -o size={size_kib}k none "$BUILD" && cd "$BUILD" && mkdir images &&
        ln -s {paths.POOL} pool && ln -s {paths.CACHE} cache && echo "the last good image" >images/robot3.img &&
        cd "$PROJECT" && status=0 && {{ "$@" >&2 || status=$?; }} &&
        cd "$BUILD/images" && ls -A | xargs sha256sum && exit $status"""
    _, environment = _argv(build)
    done = _in_namespace(script, argv, environment | {"PROJECT": str(paths.PROJECT)})
    return done.returncode, done.stderr, done.stdout.splitlines()


LAST_GOOD = [hashlib.sha256(b"the last good image\n").hexdigest() + "  robot3.img"]
SIZES_KIB = [0, 1 << 10, 20 << 10, 78 << 10, 79 << 10, 80 << 10, 82 << 10, 83 << 10, 84 << 10, 85 << 10]
"""A card of this robot takes 84 MiB and some."""


@pytest.mark.nightly
def test_a_disk_that_fills_while_a_card_is_written(build: Path) -> None:
    """At any write, of the base, the data partition, the block map, the manifest: one line, and the last image is as it
    was. Seen to fail: a traceback, and where debugfs was the one that wrote a card without its last files."""
    command = [sys.executable, "-c", WITHOUT_ESTIMATE, "image", str(ROBOT)]
    status, said, right = _written_on(120 << 10, command, build)
    assert status == 0, said
    assert len(right) == 6
    outcomes = set()
    for size in SIZES_KIB:
        status, said, left = _written_on(size or 64, command, build)
        outcomes.add(status)
        assert "Traceback" not in said
        if status:
            assert left == LAST_GOOD
            (line,) = [line for line in said.splitlines() if line.startswith("error: ")]
            assert re.search(r": no space left on its disk, .* free, so the build failed; .* BUILD=directory", line)
        else:
            assert left == right
    assert outcomes == {0, 1}


@pytest.mark.nightly
def test_a_disk_is_refused_where_it_is_too_small_alone(build: Path) -> None:
    """Seen to fail: 1 GiB was asked for a card of 84 MiB."""
    outcomes = set()
    for size_mib in (60, 87, 90, 95):
        status, said, _ = _written_on(size_mib << 10, _argv(build)[0], build)
        outcomes.add((status, size_mib > 88))
        assert status == 0 or re.search(
            r"error: .*: \d\S* MiB free on its disk, a build needs 88\.\d MiB; make room", said
        )
    assert outcomes == {(1, False), (0, True)}


def test_a_damaged_package_enters_no_image(build: Path) -> None:
    """It is removed, and where no mirror has it the build ends."""
    from flotilla.debian.lock import read_lock

    package = read_lock(BOARD).packages[0]
    file = build / "pool" / f"{package.sha256}.deb"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.unlink()  # it is a link to the real pool's
    file.write_bytes(content)
    argv, environment = _argv(build)
    nobody = "http://127.0.0.1:9/debian"
    environment |= {"MIRROR": nobody, "SECURITY_MIRROR": nobody, "no_proxy": "127.0.0.1"}
    done = subprocess.run(argv, env=environment, cwd=paths.PROJECT, capture_output=True, text=True)
    assert done.returncode == 1
    assert f"package {package.name} {package.version}" in done.stderr
    assert "is damaged; it is removed and downloaded anew" in done.stderr
    assert "or name a mirror that it lets through with MIRROR=" in done.stderr
    assert not file.exists()
    assert (build / "images" / "robot3.img").read_text() == "the last good image"


def test_without_a_mirror_the_remedy_is_named(build: Path, tmp_path: Path) -> None:
    """An empty pool where apt knows no Debian: the host's configuration is hidden."""
    shutil.rmtree(build / "pool")
    argv, environment = _argv(build)
    for name in ("MIRROR", "SECURITY_MIRROR", "SNAPSHOT"):
        environment.pop(name, None)
    done = _in_namespace('mount -t tmpfs none /etc/apt && exec "$@"', argv, environment)
    assert done.returncode == 1
    assert "MIRROR=" in done.stderr
    assert "Traceback" not in done.stderr


def test_an_unknown_robot_is_refused_with_the_known_ones(build: Path) -> None:
    argv, environment = _argv(build)
    done = subprocess.run([*argv[:-1], "9"], env=environment, cwd=paths.PROJECT, capture_output=True, text=True)
    assert done.returncode == 1
    assert "robot 9" in done.stderr
    assert "1, 2, 3, 4" in done.stderr
