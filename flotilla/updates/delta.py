"""What a robot needs of a release that it does not have: a delta from the release that it runs.

`flotilla-patch` on the robot applies it, from the running slot's block device to a stream. A delta is VCDIFF (RFC 3284)
that the locked xdelta3 makes: the same releases yield the same bytes.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

from flotilla.common import cache, durable, paths, progress
from flotilla.common.errors import UserError
from flotilla.debian import pool, tools
from flotilla.debian.lock import read_lock
from flotilla.robot.release import Bundle, delta_of

WINDOW = 1 << 18
"""Bytes of the release that a robot makes at a time; `flotilla-patch` has memory for no more."""
LEAST_SOURCE = 1 << 20
"""Bytes that xdelta3 is told to keep of a base, at least."""


def command() -> list[str]:
    """The locked xdelta3, unpacked; downloaded where the pool lacks it."""
    lock = read_lock("updates")
    with cache.exclusive():
        pool.fill([lock])
        return tools.command(tools.tree(lock), "usr/bin/xdelta3")


def make(base: Path, release: Path, delta: Path) -> None:
    """Write the delta that makes `release` of `base`; all three are files."""
    unfinished = delta.with_name(f"{delta.name}.part")
    # All of the base at once: whatever moved is found. Neither names nor checksums, which only xdelta3 would read, nor
    # compression, since both releases are compressed.
    window = 1 << max(base.stat().st_size - 1, LEAST_SOURCE).bit_length()
    argv = [*command(), "-e", "-f", "-9", "-n", "-A", "-S", "none", "-B", str(window), "-W", str(WINDOW)]
    argv += ["-s", str(base), str(release), str(unfinished)]
    progress.command(argv)
    done = subprocess.run(argv, env={"LC_ALL": "C.UTF-8"}, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        unfinished.unlink(missing_ok=True)
        raise UserError(f"{delta}: xdelta3 failed (status {done.returncode}): {done.stderr.strip()}")
    durable.rename(unfinished, delta)


def between(old: Bundle, new: Bundle) -> Path | None:
    """The delta that robots with the release of one bundle need for that of another; None where they need none."""
    if old.header["BLOB"] == new.header["BLOB"]:
        return None
    final = delta_of(old.header["BLOB"], new.header["BLOB"])
    final.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=paths.BUNDLES) as directory:
        base, content = Path(directory, "base"), Path(directory, "content")
        old.extract(base)
        new.extract(content)
        make(base, content, final)
    return final
