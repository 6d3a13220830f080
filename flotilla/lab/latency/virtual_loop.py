"""Control loops inside one guest in virtual time: every figure repeats to the byte, so it may be judged.

The board's shipped system with our kernel, booted from memory as for latency measurements. Tasks and the plug-in with
the loop's other end enter from outside. `make latency-accept` makes a new run the accepted one.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.debian import runtime
from flotilla.fleet import inventory
from flotilla.fleet.model import Board, Fleet
from flotilla.lab.latency import flood, gate, machine, results, subject
from flotilla.lab.latency.results import Latency
from flotilla.lab.latency.subject import DIRECTORY

BASELINE = Path(__file__).with_suffix(".json")
"""The accepted histogram of the whole chain, from a frame's first byte to the valve."""
PLUGIN = Path(__file__).with_name("loopback.c")
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

# The robot's controller sets the motor's current. Two CAN boards are on one bus: the robot's own, and the drive's, for
# which an emulator runs in the guest, because the host may have no CAN.
CAN_BOARDS = ("-object", "can-bus,id=bus", *("-device", "kvaser_pci,canbus=bus") * 2)
EMULATOR = ("flotilla/lab/emulators/can_bus.py", "flotilla/lab/emulators/epos2.py")
TARGET_RAD_S = 5.0
VELOCITY = f"""
period: 10 ms
priority: 60
blocks:
  drive:
    type: epos2
    in: {{target: limit.out, enable: 1, age: 0}}
    parameters: {{interface: can0, node: 3, mode: current, counts: 2000, gear: 10, heartbeat: 0.5, timeout: 0.5}}
  before: {{type: delay, in: {{in: drive.velocity}}}}
  controller:
    type: pid
    in: {{set_point: {TARGET_RAD_S}, measurement: before.out}}
    parameters: {{kp: 0.05, ki: 0.2, min: -1, max: 1}}
  limit: {{type: limit, in: {{in: controller.out}}, parameters: {{min: -1, max: 1}}}}
"""
WATCH = ("--watch", "drive.velocity,drive.enabled,drive.flag,drive.abort")
# The drive's state after the task is the last line.
DRIVE = """
import subprocess, sys
from flotilla.lab.emulators.can_bus import SocketCanBus
from flotilla.lab.emulators.epos2 import Epos2, Epos2Server
for interface in ("can0", "can1"):
    subprocess.run(["ip", "link", "set", interface, "up", "type", "can", "bitrate", "1000000"], check=True)
drive = Epos2(3)
with Epos2Server(SocketCanBus("can1"), drive).running():
    status = subprocess.run(sys.argv[1:]).returncode
    print(drive.axis.name)
sys.exit(status)
"""

SIGNALS = 8
WATCHED = "\n".join(
    [
        "period: 1 ms",
        "priority: 80",
        "blocks:",
        "  b0: {type: integrator, in: {in: 1}}",
        *(
            f"  b{i}: {{type: gain, in: {{in: b{i - 1}.out}}, parameters: {{factor: 1.001}}}}"
            for i in range(1, SIGNALS)
        ),
        "",
    ]
)
CLIENTS = 4
"""As many as may watch a task."""
WATCH_ROWS = 1000
_NAMES = " ".join(f"b{i}.out" for i in range(SIGNALS))
# The clients come one after the other while the task runs, and are gone before it ends.
WATCHING = f"""
{{run}} --control /run/watched.control & task=$!
until [ -S /run/watched.control ]; do sleep 0.01; done
clients=
for client in $(seq {CLIENTS}); do
  flotilla-scope --control /run/watched.control --rows {WATCH_ROWS} watched {_NAMES} >/run/watched.$client &
  clients="$clients $!"
done
for client in $clients; do wait $client || exit 1; done
wait $task || exit 1
cat /run/watched.json
"""

RUN = "flotilla-run --blocks {directory} --steps {steps} --statistics /run/{name}.json {directory}/{name}.yml"


def board_of(fleet: Fleet, name: str | None = None) -> Board:
    return fleet.board(name).model_copy(update={"kernel": "lean"})


def run(board: Board, out: Path) -> dict[str, str]:
    """What the commands in the guest said, as text."""
    if not (port := subject.tested_ports(board).get("uart_own")):
        raise UserError(
            f"group_vars/board_{board.name}.yml: board.ports: {', '.join(board.ports) or '(none)'}: the loop needs a "
            "port with an interrupt of its own, ttyS1 beside a console on ttyS0; add it"
        )
    device = f"/dev/{board.ports[port].tty}"
    chain = RUN.format(name="chain", steps=SECONDS * 100, directory=DIRECTORY)
    fast = RUN.format(name="fast", steps=SECONDS * 100, directory=DIRECTORY)
    slow = RUN.format(name="slow", steps=SECONDS * 10, directory=DIRECTORY)
    velocity = RUN.format(name="velocity", steps=SECONDS * 100, directory=DIRECTORY).split()
    alone = RUN.format(name="alone", steps=SECONDS * 1000, directory=DIRECTORY)
    watched = RUN.format(name="watched", steps=SECONDS * 1000, directory=DIRECTORY)
    commands = {  # which run in the order of their names
        "chain": ["sh", "-c", f"{chain} && cat /run/latencies.json"],
        "drive": ["python3", f"{DIRECTORY}/drive.py", *velocity, *WATCH],
        "both": ["sh", "-c", f"{{ {fast}; echo fast: $?; }} 2>&1 & {{ {slow}; echo slow: $?; }} 2>&1; wait"],
        "fast": ["cat", "/run/fast.json"],
        "slow": ["cat", "/run/slow.json"],
        "task_alone": ["sh", "-c", f"{alone} && cat /run/alone.json"],
        "task_watched": ["sh", "-c", WATCHING.format(run=watched)],
        "watched_rows": ["sh", "-c", "cat /run/watched.[0-9]"],
        flood.NAME: flood.command(DIRECTORY),
    }
    files = {
        "chain.yml": CHAIN.format(device=device).encode(),
        "fast.yml": FAST.encode(),
        "slow.yml": SLOW.encode(),
        "velocity.yml": VELOCITY.encode(),
        "alone.yml": WATCHED.encode(),
        "watched.yml": WATCHED.encode(),
        "drive.py": DRIVE.encode(),
        "loopback.so": runtime.compile_plugin(PLUGIN, board.system),
    }
    files |= {name: (paths.IMPORTS / name).read_bytes() for name in EMULATOR}
    files |= flood.files(board, DIRECTORY)
    measured = subject.build(board)
    out.mkdir(parents=True, exist_ok=True)
    initrd = out / "initrd.img"
    subject.write_initrd(
        measured, initrd, {"scenarios": [], "commands": commands},
        {str(DIRECTORY / name): content for name, content in files.items()},
    )  # fmt: skip
    extra = (*CAN_BOARDS, *machine.RELAYS)
    guest = machine.Machine(machine.emulator(), board, measured.kernel, initrd, measured.arguments(), extra=extra)
    document = results.received(guest.run(out, 600))
    initrd.unlink()
    outputs: dict[str, str] = document["commands"]
    return outputs


def chain(outputs: dict[str, str]) -> Latency:
    """From the first byte's write to the port, through line, driver, controller and relay board's I/O port."""
    return _latency(json.loads(outputs["chain"])["histogram_us"])


def check(found: Latency, file: Path = BASELINE) -> None:
    """UserError with what moved."""
    if not file.exists():
        raise UserError(f"{paths.shown(file)} is missing: nothing to compare with; make it: {gate.ACCEPT}")
    accepted = _latency(json.loads(file.read_text()))
    if found != accepted:
        raise UserError(
            f"frame to valve: {gate.differences(accepted, found)}; accepted is {paths.shown(file)}; if this is meant: "
            f"{gate.ACCEPT}, commit it"
        )


def _latency(counts: dict[str, int]) -> Latency:
    return Latency.of({int(us): count for us, count in counts.items()})


def accept() -> None:
    """Make a new run the accepted one."""
    with progress.step("control loops in virtual time"), tempfile.TemporaryDirectory(dir=paths.BUILD) as out:
        found = chain(run(board_of(inventory.load_fleet()), Path(out)))
    gate.keep(BASELINE, json.dumps(found.histogram_us) + "\n")
    print(f"{paths.shown(BASELINE)} is what was measured; commit it with the reason for the difference")
