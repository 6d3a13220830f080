"""Emulates a MaxBotix HRXL-MaxSonar-WR at a pseudo terminal: `python3 emulator.py` prints the path of the port.

Lines on standard input change the messages that it sends: a range in m such as `1.5`, or `silence`, `garbage`,
`garbage 1.5` (a range follows each time), `near` (the target is too near), `none` (there is no target). The end of
standard input ends it.
"""

import contextlib
import os
import select
import sys
import tty

RATE_HZ = 7.5
"""Data sheet, free run of the MB7360; other models have 5.2 to 7.5."""
MIN_RANGE_M, MAX_RANGE_M = 0.3, 5.0
"""The sensor reports these for a target that is too near, and for none."""
GARBAGE = b"\x00\xff\x8d\nR999\rR12345\rr1234\rR 234\r1234\rR-234\rR12x34\rR12"
"""Noise, and pieces that are nearly a frame of a wrong range; the last one breaks off."""


def frame(range_m: float) -> bytes:
    """The bytes of one measurement: R, four digits in mm, carriage return."""
    return b"R%04d\r" % round(1000 * min(max(range_m, MIN_RANGE_M), MAX_RANGE_M))


def message(command: str) -> bytes:
    """The bytes of one period. ValueError for a command that there is not."""
    name, _, argument = command.partition(" ")
    if name == "silence":
        return b""
    if name == "garbage":
        return GARBAGE + (frame(float(argument)) if argument else b"")
    return frame({"near": MIN_RANGE_M, "none": MAX_RANGE_M}.get(name) or float(name))


def main() -> None:
    """Send a message in each period and after each command, until the end of standard input."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    os.set_blocking(ours, False)
    print(os.ttyname(theirs), flush=True)
    command = "1"
    while True:
        if select.select([sys.stdin], [], [], 1 / RATE_HZ)[0]:
            text = os.read(sys.stdin.fileno(), 4096).decode()
            if not text:
                return
            command = text.splitlines()[-1].strip()
        with contextlib.suppress(BlockingIOError):  # a full buffer: a wire does not wait for its reader
            os.write(ours, message(command))


if __name__ == "__main__":
    main()
