"""What is measured, under what load. Adding a line to `SCENARIOS` is all that a further measurement takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

_FILES = "/run/latency"
"""Where the measurement's own files are in the guest."""
OUTPUT = f"{_FILES}/output"

# Loads: ordinary processes unless said otherwise. Each runs until it is killed.

Command = tuple[str, ...]

_UDP = """
import socket
port = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
port.bind(("127.0.0.1", 0))
while True:
    port.sendto(bytes(1400), port.getsockname())
    port.recv(2000)
"""
_TCP = """
import os, socket
listener = socket.create_server(("127.0.0.1", 0), backlog=16)
for _ in range(10):
    sender = socket.create_connection(listener.getsockname())
    receiver = listener.accept()[0]
    if not os.fork():
        while True:
            sender.sendall(bytes(100))
    if not os.fork():
        while True:
            receiver.recv(100)
os.wait()
"""
"""hackbench does this with `-i`, but that of Debian 13 (rt-tests 2.8) cannot connect."""
CPU: tuple[Command, ...] = (("sh", "-c", "while :; do :; done"),) * 4
MEMORY: tuple[Command, ...] = (("python3", "-c", "while True: b'x' * (8 << 20)"),) * 2
"""Page faults: 8 MiB are mapped, filled and given back."""
TIMERS: tuple[Command, ...] = (("cyclictest", "-q", "-t", "10", "-p", "60", "-i", "2000", "-d", "100"),)
"""Ten threads with timers of their own, SCHED_FIFO 60 and below. Many more would leave ordinary processes less than the
5 % that the kernel keeps for them, by holding up every real-time thread for 50 ms."""
SCHEDULER: tuple[Command, ...] = (("hackbench", "-g", "4", "-l", "100000000"),)
"""160 processes that send each other messages."""
NETWORK: tuple[Command, ...] = (("python3", "-c", _UDP),) * 2 + (("python3", "-c", _TCP),)
"""UDP and TCP over the loopback interface."""
FILES: tuple[Command, ...] = (
    ("sh", "-c", "while :; do echo 3 >/proc/sys/vm/drop_caches; cat /usr/bin/* >/dev/null; done"),
)
"""Reading the compressed root with cold caches."""
SERIAL: tuple[Command, ...] = ((f"{_FILES}/serial_latency", "/dev/robot/uart_shared", "load"),)
"""A port as busy as 115200 Bd make it."""
DISK: tuple[Command, ...] = (
    ("sh", "-c", "while :; do dd if=$0 of=/dev/null bs=128k count=512 iflag=direct; done", "/dev/sda"),
    ("sh", "-c", "while :; do dd if=/dev/zero of=$0 bs=128k count=512 oflag=direct; done", "/dev/sda"),
)
"""Reading and writing a disk past the cache."""
EVERYTHING = (*MEMORY, *SCHEDULER, *NETWORK, *FILES)

# Meters


@dataclass(frozen=True)
class Meter:
    """A program that measures."""

    command: Command
    """`{samples}`: how many. It writes JSON in the shape of `cyclictest --json` to `OUTPUT`, or prints it."""
    quantities: dict[str, str]
    """What its histograms are, by their names in its output."""
    period_ms: int
    needs: tuple[str, ...] = ()
    """Paths without which this kernel or board cannot be measured so."""


# Above the load, so that it starts and ends at once whatever the load is. What measures is the thread of priority 90.
_START = ("chrt", "--fifo", "1")


def _cyclictest(phase_us: int) -> Meter:
    """Wake-ups that long after each whole millisecond, when the kernel's tick may be due: in step, they are later
    by its time, and whether they are must not be an accident of when the program started."""
    options = f"-q -m -p 90 -i 1000 --secaligned={phase_us} -h 20000".split()
    return Meter(
        (*_START, "cyclictest", *options, "-l", "{samples}", f"--json={OUTPUT}"), {"0": "wake-up"}, period_ms=1
    )


CYCLICTEST = _cyclictest(500)
"""In the phase of a task that says nothing about its own (`runtime/executive/task_file.c`)."""
IN_STEP = _cyclictest(0)
TIMERLAT = Meter(
    (*_START, "python3", f"{_FILES}/timerlat.py", "{samples}"),
    {"irq": "interrupt", "thread": "wake-up"},
    period_ms=1,
    needs=("/sys/kernel/tracing/osnoise/timerlat_period_us",),
)


def uart(name: str) -> Meter:
    """Bytes through a serial port in loopback."""
    device = f"/dev/robot/{name}"
    return Meter(
        (*_START, f"{_FILES}/serial_latency", device, "{samples}"), {"0": "byte"}, period_ms=10, needs=(device,)
    )


UART_OWN, UART_SHARED = uart("uart_own"), uart("uart_shared")

# Scenarios


@dataclass(frozen=True)
class Scenario:
    name: str
    title: str
    meter: Meter
    loads: tuple[Command, ...] = ()
    without: tuple[str, ...] = ()
    """Words left out of the shipped kernel command line: such scenarios share a boot of their own."""
    quick: bool = False
    """Part of the short run, too."""
    share: float = 1.0
    """Of the usual duration."""
    limit_us: int | None = None
    """With a disk attached, whose answers depend on the host, results do not repeat: they have a bound instead. Such
    scenarios are a plan of their own."""

    def samples(self, seconds: float) -> int:
        return max(1, round(seconds * self.share * 1000 / self.meter.period_ms))

    def describe(self, seconds: float, planted: tuple[Command, ...] = ()) -> dict[str, Any]:
        """The scenario as `measure.py` reads it; `planted`: more to run beside it."""
        samples = self.samples(seconds)
        needs = [word for load in self.loads for word in load if word.startswith("/dev/")] + list(self.meter.needs)
        return {
            "name": self.name,
            "meter": [word.format(samples=samples) for word in self.meter.command],
            "loads": [list(load) for load in (*planted, *self.loads)],
            "needs": needs,
            "timeout_s": 60 + 10 * samples * self.meter.period_ms / 1000,
        }


_SHORT = 1 / 3
"""Serial ports: their periods are longer, and under load their latencies are far apart anyway."""

SCENARIOS = (
    Scenario("idle", "idle", CYCLICTEST, quick=True),
    Scenario("cpu", "four processes that only compute", CYCLICTEST, CPU),
    Scenario("memory", "page faults", CYCLICTEST, MEMORY),
    Scenario("timers", "ten real-time threads of lower priority", CYCLICTEST, TIMERS),
    Scenario("scheduler", "160 processes exchanging messages", CYCLICTEST, SCHEDULER, quick=True),
    Scenario("network", "UDP and TCP over loopback", CYCLICTEST, NETWORK),
    Scenario("files", "reading the compressed root", CYCLICTEST, FILES),
    Scenario("serial", "a serial port at 115200 Bd", CYCLICTEST, SERIAL),
    Scenario("everything", "memory, messages, network and files at once", CYCLICTEST, EVERYTHING),
    Scenario("in-step", "idle, in step with the kernel's tick", IN_STEP),
    Scenario("in-step-everything", "everything at once, in step with the kernel's tick", IN_STEP, EVERYTHING),
    Scenario("timerlat", "idle, by the kernel's tracer", TIMERLAT, share=1 / 6),
    Scenario(
        "timerlat-everything",
        "everything at once, by the kernel's tracer",
        TIMERLAT,
        EVERYTHING,
        share=1 / 6,
        quick=True,
    ),
    Scenario("uart-own", "port with its own interrupt, idle", UART_OWN, share=_SHORT, quick=True),
    Scenario("uart-own-cpu", "port with its own interrupt, computing", UART_OWN, CPU, share=_SHORT),
    Scenario(
        "uart-own-everything", "port with its own interrupt, everything", UART_OWN, EVERYTHING, share=_SHORT, quick=True
    ),
    Scenario("uart-shared", "port with a shared interrupt, idle", UART_SHARED, share=_SHORT),
    Scenario(
        "uart-shared-everything", "port with a shared interrupt, everything", UART_SHARED, EVERYTHING, share=_SHORT
    ),
    Scenario("uart-own-no-irqpoll", "own interrupt, without irqpoll", UART_OWN, share=_SHORT, without=("irqpoll",)),
    Scenario(
        "uart-shared-no-irqpoll", "shared interrupt, without irqpoll", UART_SHARED, share=_SHORT, without=("irqpoll",)
    ),
    Scenario("disk-idle", "a disk attached, idle", CYCLICTEST, share=_SHORT, limit_us=150),
    Scenario("disk", "reading and writing a disk", CYCLICTEST, DISK, share=_SHORT, limit_us=250),
)
