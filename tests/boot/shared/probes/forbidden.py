"""System calls that any user may make, and that a control task has no use for."""

from __future__ import annotations

import ctypes
import json
import mmap
import os

_NEW_USER_NAMESPACE = 0x10000000
_NO_RANDOM_ADDRESSES = 0x0040000
_TRACE_ME = 0


def main() -> list[str]:
    """Those that succeed."""
    libc = ctypes.CDLL(None, use_errno=True)
    timex = ctypes.create_string_buffer(256)  # all zero: asks, and sets nothing
    attempts = {
        "a clock's state": lambda: libc.adjtimex(timex),
        "tracing": lambda: libc.ptrace(_TRACE_ME, 0, 0, 0),
        "another personality": lambda: libc.personality(_NO_RANDOM_ADDRESSES),
        "a user namespace": lambda: libc.unshare(_NEW_USER_NAMESPACE),
        "a file that gives its user's rights": _set_user_id,
        "memory both written and run": _written_and_run,
    }
    return sorted(name for name, attempt in attempts.items() if attempt() >= 0)


def _set_user_id() -> int:
    try:
        os.chmod(os.open("/dev/shm", os.O_TMPFILE | os.O_WRONLY), 0o4700)  # noqa: PTH101
    except OSError:
        return -1
    return 0


def _written_and_run() -> int:
    try:
        mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    except OSError:
        return -1
    return 0


if __name__ == "__main__":
    print(json.dumps(main()))
