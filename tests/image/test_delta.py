"""A release from the one before and a delta, made by the locked xdelta3 and applied as a robot does."""

from __future__ import annotations

import random
import subprocess
from pathlib import Path

import pytest

from flotilla.common.errors import UserError
from flotilla.updates import delta

MEMORY = 10 << 20
"""Bytes of address space that a robot gives it, the C library's included."""
SECONDS = 60


@pytest.fixture(scope="module")
def program(flotilla_run: Path) -> Path:
    return flotilla_run.with_name("flotilla-patch")


@pytest.fixture(scope="module")
def releases(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two releases of 6 MiB. In the second a part moved far, one is new, one repeats itself, and odd bytes went."""
    directory = tmp_path_factory.mktemp("releases")
    chance = random.Random(7)
    old = chance.randbytes(6 << 20)
    new = old[4 << 20 : (6 << 20) - 77] + chance.randbytes(100_001) + old[3:-9][: 3 << 20] + b"slot" * 300_000
    new += bytes(70_000) + old[1 << 20 : (1 << 20) + 12_345]
    (directory / "old").write_bytes(old)
    (directory / "new").write_bytes(new)
    return directory / "old", directory / "new"


def patch(program: Path, base: Path, content: bytes) -> tuple[int, bytes]:
    """Exit status and result."""
    argv = ["prlimit", f"--as={MEMORY}", str(program), str(base)]
    done = subprocess.run(argv, input=content, capture_output=True, timeout=SECONDS, check=False)
    assert done.returncode == 0 or done.stderr, done.returncode
    return done.returncode, done.stdout


def test_a_delta_has_the_size_of_what_is_new_and_makes_the_release(
    program: Path, releases: tuple[Path, Path], tmp_path: Path
) -> None:
    """In 10 MiB of address space, less than the release's size and the base's.

    Seen to fail: a source window of 1 MiB at the station, by the size.
    """
    base, release = releases
    delta.make(base, release, tmp_path / "delta")
    content = (tmp_path / "delta").read_bytes()
    assert len(content) < 101_000
    assert patch(program, base, content) == (0, release.read_bytes())


def test_each_kind_of_instruction_is_obeyed(program: Path, tmp_path: Path) -> None:
    """Words in another order, with other bytes between them, make short copies, from near and same addresses too.

    Seen to fail: pairs of an addition and a copy of which one lacks; near addresses that are not remembered; same
    addresses of another number.
    """
    chance = random.Random(11)
    words = [chance.randbytes(chance.randint(3, 30)) for _ in range(700)]
    base, release = (
        b"".join(chance.choice(words) + chance.randbytes(chance.randint(0, 5)) for _ in range(20_000)) for _ in range(2)
    )
    (tmp_path / "old").write_bytes(base)
    (tmp_path / "new").write_bytes(release)
    delta.make(tmp_path / "old", tmp_path / "new", tmp_path / "delta")
    assert patch(program, tmp_path / "old", (tmp_path / "delta").read_bytes()) == (0, release)


def test_the_same_releases_have_the_same_delta(releases: tuple[Path, Path], tmp_path: Path) -> None:
    """Under other names, too. Seen to fail: without -A, which leaves the names out."""
    made = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        base, release = (tmp_path / name / f"{name}{each.name}" for each in releases)
        base.write_bytes(releases[0].read_bytes())
        release.write_bytes(releases[1].read_bytes())
        delta.make(base, release, tmp_path / name / "delta")
        made.append((tmp_path / name / "delta").read_bytes())
    assert made[0] == made[1]


def test_no_delta_does_harm(program: Path, releases: tuple[Path, Path], tmp_path: Path) -> None:
    """What is cut off or changed ends with a status, whatever it makes: checksums of the result are the reader's.

    Seen to fail: without the comparison of a copy's size with what is left of the window, by a signal.
    """
    base, release = releases
    delta.make(base, release, tmp_path / "delta")
    content = (tmp_path / "delta").read_bytes()
    chance = random.Random(3)
    for length in (0, 4, 6, 20, len(content) // 2, len(content) - 1):
        assert patch(program, base, content[:length])[0] == 3
    # Sizes, addresses and instructions lie around the new bytes.
    places = [*range(5, 400), *range(len(content) - 600, len(content))]
    for _ in range(400):
        changed = bytearray(content)
        for place in chance.sample(places, 3):
            changed[place] = chance.choice([0, 0x7F, 0xFF, chance.randrange(256)])
        assert patch(program, base, bytes(changed))[0] in (0, 3)


def test_what_cannot_be_read_is_said(program: Path, releases: tuple[Path, Path], tmp_path: Path) -> None:
    """Seen to fail: an error of xdelta3 that is not looked at."""
    with pytest.raises(UserError, match=r"delta: xdelta3 failed \(status 1\): .*No such file or directory"):
        delta.make(releases[0], tmp_path / "none", tmp_path / "delta")
    assert not (tmp_path / "delta").exists()
    done = subprocess.run([program, tmp_path / "none"], capture_output=True, text=True, timeout=SECONDS, check=False)
    assert (done.returncode, done.stderr) == (1, f"flotilla-patch: {tmp_path}/none: No such file or directory\n")
