"""From a board to results: pack, boot in virtual time, make sense of what comes back."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flotilla.common import cache, paths, progress
from flotilla.fleet.model import Board
from flotilla.lab.latency import machine, results, subject
from flotilla.lab.latency.controls import NOTHING, Control
from flotilla.lab.latency.results import Plan, Results
from flotilla.lab.latency.scenarios import SCENARIOS, Scenario

SECONDS: dict[Plan, float] = {"standard": 60, "quick": 5, "disk": 60}
"""Virtual duration of a scenario."""
VIRTUAL = "virtual time"
_DISK_BYTES = 256 << 20
BOOT_HOST_S = 60
HOST_S = 2
"""Of two cores, about: for a boot, and for each virtual second."""
_BOOT_LIMIT_S = 600
_LIMIT_PER_SECOND = 30
"""Of the host's clock, for each virtual second: finite, and generous to a busy host."""


def directory(board: Board, plan: Plan, control: Control = NOTHING) -> Path:
    """Where a run leaves `results.json`, `raw-N` for each boot, and `console.log` and `qemu.command` of the last."""
    return paths.BUILD / "latency" / name(board.name, control.kernel or board.kernel, plan)


def name(board: str, kernel: str, plan: Plan) -> str:
    """`smartcoret3-debian`, `smartcoret3-debian-quick`, `smartcoret3-no-rt-quick`."""
    return f"{board}-{kernel}" + ("" if plan == "standard" else f"-{plan}")


def host_s(plan: Plan) -> float:
    """How long a plan takes two cores, about."""
    boots = {scenario.without for scenario in planned(plan)}
    return BOOT_HOST_S * len(boots) + HOST_S * sum(SECONDS[plan] * scenario.share for scenario in planned(plan))


def planned(plan: Plan) -> list[Scenario]:
    if plan == "disk":
        return [scenario for scenario in SCENARIOS if scenario.limit_us]
    return [scenario for scenario in SCENARIOS if not scenario.limit_us and (plan == "standard" or scenario.quick)]


def measure(board: Board, plan: Plan, out: Path, control: Control = NOTHING) -> Results:
    """Measure a board's system; `results.json` is in `out` when it is done. `control`: what is wrong with it."""
    measured = subject.build(board, control.kernel and f"{board.name}-{control.kernel}")
    emulator = machine.emulator()
    out.mkdir(parents=True, exist_ok=True)
    boots: dict[tuple[str, ...], list[Scenario]] = {}
    for scenario in planned(plan):
        boots.setdefault(scenario.without, []).append(scenario)
    documents: list[dict[str, Any]] = []
    inputs, commands = [], []
    for without, scenarios in boots.items():
        initrd = out / "initrd.img"
        described = [scenario.describe(SECONDS[plan], control.load) for scenario in scenarios]
        todo = {"scenarios": described, "commands": control.commands(subject.DIRECTORY)}
        inputs.append(subject.write_initrd(measured, initrd, todo, control.files(board, subject.DIRECTORY)))
        disk = _empty_disk(out / "disk.img") if plan == "disk" else None
        arguments = measured.arguments(without)
        guest = machine.Machine(emulator, board, measured.kernel, initrd, arguments, disk, modules=measured.modules)
        commands.append(machine.without_paths(guest.command_line(Path("/c"), Path("/r"))))
        seconds = sum(SECONDS[plan] * scenario.share for scenario in scenarios)
        title = " without ".join([f"latency of {name(board.name, control.kernel or board.kernel, plan)}", *without])
        console = out / machine.CONSOLE
        console.unlink(missing_ok=True)  # of an earlier boot
        shares = {scenario.name: SECONDS[plan] * scenario.share for scenario in scenarios}
        with progress.step(title, functools.partial(_look, console, shares)):
            content = guest.run(out, _BOOT_LIMIT_S + _LIMIT_PER_SECOND * seconds)
        initrd.unlink()
        (out / f"raw-{len(documents)}").write_bytes(content)
        documents.append(results.received(content))
    binding = results.Binding(
        **measured.hashes(),
        measurement=cache.digest(*inputs),
        machine=cache.digest(*commands),
        qemu=emulator.version("qemu-system-x86"),
        firmware=emulator.version("seabios"),
    )
    found = results_of(board, plan, binding, documents, planned(plan), VIRTUAL, misses=bool(control.kernel))
    if control.kernel:
        found = found.model_copy(update={"kernel": control.kernel})
    (out / "results.json").write_text(found.text())
    return found


def _look(console: Path, scenarios: Mapping[str, float]) -> progress.Far:
    return far(progress.text(console), scenarios)


def far(console: str, scenarios: Mapping[str, float]) -> progress.Far:
    """How far a boot is whose guest has written `console`; `scenarios`: virtual seconds of each, in their order.

    Of the one that runs nobody knows how far it is: the guest is not disturbed by the question.
    """
    total = sum(scenarios.values())
    begun = [name for name in re.findall(r"latency: (\S+)\n", console) if name in scenarios]
    if not begun:
        return progress.Far(0, total, "virtual seconds", part="boot")
    names = list(scenarios)
    number = names.index(begun[-1])
    done = sum(scenarios[name] for name in names[:number])
    part = f"{begun[-1]} ({number + 1} of {len(names)})"
    return progress.Far(done, total, "virtual seconds", part=part)


def _empty_disk(path: Path) -> Path:
    with path.open("wb") as file:
        file.truncate(_DISK_BYTES)
    return path


def results_of(
    board: Board,
    plan: Plan,
    binding: results.Binding,
    documents: list[dict[str, Any]],
    scenarios: list[Scenario],
    where: str,
    *,
    misses: bool = False,
) -> Results:
    """Make sense of what the boots of a run sent. `misses`: the system may be so late as to miss periods."""
    first = documents[0]
    raw = {name: outcome for document in documents for name, outcome in document["scenarios"].items()}
    return Results(
        board=board.name,
        kernel=board.kernel,
        plan=plan,
        where=where,
        release=first["release"],
        version=first["version"],
        binding=binding,
        boot=results.Boot(**first["boot"]),
        scenarios={
            scenario.name: results.outcome(scenario, raw[scenario.name], scenario.samples(SECONDS[plan]), misses=misses)
            for scenario in scenarios
        },
    )
