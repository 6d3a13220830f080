"""Control loops inside one guest in virtual time: every figure repeats to the byte, so it may be judged.

The board's shipped system with our kernel, booted from memory as for latency measurements. Tasks and the plug-in with
the loop's other end enter from outside.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from images.builder import paths, runtime
from images.builder.fleet import Board, Fleet
from tests.latency import machine, results, subject
from tests.latency.subject import DIRECTORY

pytestmark = pytest.mark.boot

PLUGIN = paths.PROJECT / "runtime" / "tests" / "plugin" / "loopback.c"
SECONDS = 5

CHAIN = """
period: 10 ms
priority: 80
blocks:
  frames: {{type: frames, parameters: {{device: {device}}}}}
  gyro: {{type: dsp3000, parameters: {{device: {device}}}}}
  attitude: {{type: pid, in: {{set_point: 0, measurement: gyro.rate}}, parameters: {{kp: 1000, min: -1, max: 1}}}}
  valve: {{type: schmitt-trigger, in: {{in: attitude.out}}, parameters: {{on: 0.01, off: 0}}}}
  relays: {{type: ir104-pbf, in: {{command: valve.on, flag: gyro.flag}}, parameters: {{channels: [1]}}}}
  chain: {{type: chain, in: {{rate: gyro.rate, after: relays.mismatch}}, parameters: {{file: /run/latencies.json}}}}
"""

FAST = """
period: 10 ms
priority: 80
blocks:
  wave: {type: trajectory, parameters: {waypoints: [0, 1], times: [0, 10]}}
  out: {type: queue-send, in: {data: wave.position}, parameters: {name: /wave}}
"""

SLOW = """
period: 100 ms
phase: 5 ms
priority: 70
blocks:
  in: {type: queue-receive, parameters: {name: /wave}}
  filtered: {type: low-pass, in: {in: in.data}, parameters: {time_constant: 1}}
"""

RUN = "flotilla-run --blocks {directory} --steps {steps} --statistics /run/{name}.json {directory}/{name}.yml"


@pytest.fixture(scope="module")
def board(fleet: Fleet) -> Board:
    return fleet.boards["smartcoret3"].model_copy(update={"kernel": "lean"})


def run(board: Board, out: Path) -> dict[str, str]:
    """What the commands in the guest said, as text."""
    device = f"/dev/{board.ports[subject.tested_ports(board)['uart_own']].tty}"
    chain = RUN.format(name="chain", steps=SECONDS * 100, directory=DIRECTORY)
    fast = RUN.format(name="fast", steps=SECONDS * 100, directory=DIRECTORY)
    slow = RUN.format(name="slow", steps=SECONDS * 10, directory=DIRECTORY)
    commands = {  # which run in the order of their names
        "chain": ["sh", "-c", f"{chain} && cat /run/latencies.json"],
        "both": ["sh", "-c", f"{{ {fast}; echo fast: $?; }} 2>&1 & {{ {slow}; echo slow: $?; }} 2>&1; wait"],
        "fast": ["cat", "/run/fast.json"],
        "slow": ["cat", "/run/slow.json"],
    }
    files = {
        "chain.yml": CHAIN.format(device=device).encode(),
        "fast.yml": FAST.encode(),
        "slow.yml": SLOW.encode(),
        "loopback.so": runtime.compile_plugin(PLUGIN, board.architecture),
    }
    measured = subject.build(board)
    out.mkdir(parents=True, exist_ok=True)
    initrd = out / "initrd.img"
    subject.write_initrd(
        measured, initrd, {"scenarios": [], "commands": commands},
        {str(DIRECTORY / name): content for name, content in files.items()},
    )  # fmt: skip
    guest = machine.Machine(machine.emulator(), board, measured.kernel, initrd, measured.arguments())
    document = results.received(guest.run(out, 600))
    initrd.unlink()
    said: dict[str, str] = document["commands"]
    return said


@pytest.fixture(scope="module")
def said(board: Board, session_artefacts: Path) -> dict[str, str]:
    return run(board, session_artefacts / "virtual-loop")


def read(text: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(text)
    return content


def test_a_frame_becomes_a_valve_within_two_periods(said: dict[str, str]) -> None:
    """From the first byte's write to the port, through line, driver, controller and relay board's I/O port."""
    chain = read(said["chain"])
    histogram = {int(us): count for us, count in chain["histogram_us"].items()}
    assert chain["late"] == 0
    assert sum(histogram.values()) >= SECONDS * 100 - 60, "frames are lost"
    print(f"frame to valve: {min(histogram)} to {max(histogram)} µs")
    assert max(histogram) < 20_000


def test_two_rates_on_one_computer_keep_their_time(said: dict[str, str]) -> None:
    assert sorted(said["both"].splitlines()) == ["fast: 0", "slow: 0"]
    fast, slow = read(said["fast"]), read(said["slow"])
    assert (fast["overruns"], slow["overruns"]) == (0, 0)
    assert fast["step"]["count"] == SECONDS * 100
    assert slow["step"]["count"] == SECONDS * 10
    print(f"jitter: {fast['jitter']['max_ns'] / 1000} µs at 10 ms, {slow['jitter']['max_ns'] / 1000} µs at 100 ms")
    assert fast["jitter"]["max_ns"] < 100_000
    assert slow["jitter"]["max_ns"] < 100_000


def test_loops_repeat_to_the_byte(said: dict[str, str], board: Board, artefacts: Path) -> None:
    """Seen to fail with a plug-in that writes its process number into a file that is shown."""
    assert run(board, artefacts) == said
