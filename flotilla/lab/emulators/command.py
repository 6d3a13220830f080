"""`flotilla emulate dsp3000`: a serial device until interrupted."""

from __future__ import annotations

import argparse
import math
import signal
import threading
from pathlib import Path

from flotilla.lab.emulators.dsp3000 import Dsp3000
from flotilla.lab.emulators.micromag3 import MicroMag3
from flotilla.lab.emulators.oceanserver import OceanServer
from flotilla.lab.emulators.serial_line import Device, Faults, Pty, SerialLine, UnixSocket
from flotilla.lab.emulators.urg import Urg


def device(options: argparse.Namespace) -> Device:
    match options.device:
        case "dsp3000":
            return Dsp3000(lambda seconds: 10 * math.sin(seconds), options.format, deaf=options.deaf, seed=options.seed)
        case "micromag3":
            return MicroMag3(lambda seconds: 10 * seconds % 360, sums=options.sums, seed=options.seed)
        case "oceanserver":
            return OceanServer()
    return Urg(lambda step, seconds: 1000 + 500 * (step // 100 % 2), old=options.old, seed=options.seed)


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("device", choices=["dsp3000", "micromag3", "oceanserver", "urg"], help="which one")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--link", type=Path, help="path of the pseudo terminal; else one is made up")
    where.add_argument("--connect", help="path of a Unix socket instead, QEMU's chardev for one")
    parser.add_argument("--seed", type=int, default=0, help="of what is random (%(default)s)")
    for name in ("garbage", "half", "corrupt"):
        parser.add_argument(f"--{name}", type=float, default=0, help="share of messages")
    parser.add_argument("--silence", action="store_true", help="say nothing")
    parser.add_argument("--burst", type=int, default=1, help="messages that leave at once")
    parser.add_argument("--baud", type=int, help="a wrong rate")
    parser.add_argument("--format", choices=["text", "words"], default="text", help="of the gyro")
    parser.add_argument("--deaf", type=float, default=0.2, help="share of commands that the gyro misses")
    parser.add_argument("--sums", choices=["xor", "unknown"], default="xor", help="checksums of the magnetometer")
    parser.add_argument("--old", action="store_true", help="the scanner has to be switched to SCIP 2.0")


def run(options: argparse.Namespace) -> None:
    faults = Faults(options.garbage, options.half, options.corrupt, options.silence, options.burst, options.baud)
    endpoint = UnixSocket(options.connect) if options.connect else Pty(options.link)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # what a shell starts in the background ignores it
    with SerialLine(device(options), endpoint, faults=faults, seed=options.seed) as line:
        print(line.path, flush=True)
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            return
