"""Judges what a robot answered by the limits of its board's file. A check is a row of `CHECKS`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

from flotilla.fleet.model import Board, Fleet, Robot
from flotilla.lab.acceptance import relays
from flotilla.lab.acceptance.facts import Facts
from flotilla.lab.acceptance.outcome import Acceptance, Outcome, State
from flotilla.robot import health, state

EMULATED = "an emulator's, which depends on its host"
_GROWN_SLACK_BYTES = 8 << 20
_FREE = 0.1
"""Of the data partition, at least."""
_BATTERY_CLOCK_S = 60
"""A clock that keeps time without power is off by two seconds a day; one without a battery by years."""
TROUBLES = (
    (r"irq \d+: nobody cared", "an interrupt without an owner: the board's jumpers, or `irqpoll` in kernel_arguments"),
    (r"I/O error, dev|failed command: |exception Emask", "the card, its socket or its cable"),
    (r"EXT4-fs error|SQUASHFS error", "the card: flash another one"),
    (r"Hardware Error|Machine [Cc]heck", "processor or memory"),
    (r"BUG: |Oops: |Call Trace|rcu: .* stall|blocked for more than", "the kernel: send it with `make hwcheck`"),
    (r"[Dd]irect firmware load for \S+ failed", "the adapter's firmware is missing in images/packages"),
    (r"over-current|device descriptor read|cannot enumerate", "a USB device, its cable or its power"),
    (r"[Ll]ow voltage|[Uu]nder-voltage|temperature above threshold", "power supply or cooling"),
)
"""Kernel messages that tell of trouble, and where to look."""


@dataclass(frozen=True)
class Asked:
    """What checks look at."""

    fleet: Fleet
    robot: Robot
    facts: Facts

    @property
    def board(self) -> Board:
        return self.fleet.boards[self.robot.board]

    @property
    def emulated(self) -> bool:
        return str(self.facts.parts.get("computer", {}).get("vendor")) == "QEMU"

    def timed(self, *, holds: bool) -> State:
        """Of a check that an emulator can only fail by its host."""
        return "not judged" if self.emulated else "holds" if holds else "fails"

    def words(self, found: str) -> str:
        return f"{found}: {EMULATED}" if self.emulated else found


def _description(asked: Asked) -> Iterator[Outcome]:
    """Provisioning's own judgement."""
    found, part = asked.facts.state, "description"
    provision = f"make provision ROBOT={asked.robot.number}"
    wrong = [f"{file['path']} {file['why']}" for file in found["drift"]]
    yield _outcome(part, "files", wrong, "all are the inventory's", provision)
    faults = state.faults(found, state.wanted(asked.fleet, asked.robot))
    for role, said in faults.items():
        yield _outcome(part, role.replace("_", " "), said, "as the inventory says", provision)
    missing = sorted(set(state.wanted(asked.fleet, asked.robot)["uarts"]) - set(found["uarts"]))
    board = f"compare `ports:` in board_{asked.robot.board}.yml with the board"
    yield _outcome(part, "serial ports", [f"no {tty}" for tty in missing], "all are there", board)
    failed = [f"{unit} failed" for unit in found["failed"]]
    yield _outcome(part, "units", failed, "none failed", "`systemctl status` on the robot has the reason")
    drift = state.release_drift(found["release"], asked.facts.release)
    if asked.facts.release is None:
        absent = f"its image is not on this computer: make image ROBOT={asked.robot.number}"
        yield Outcome(part=part, what="release", state="not judged", found=absent)
    else:
        yield _outcome(part, "release", [drift] if drift else [], "the one of its image on this computer", "")
    complaints = health.complaints(found, asked.fleet.health)
    tasks = len(found["tasks"])
    yield _outcome(
        part, "health", complaints, f"{tasks} control tasks are as `health:` wants", "look at them: make top ASK=1"
    )


def _outcome(part: str, what: str, wrong: list[str], right: str, remedy: str) -> Outcome:
    if not wrong:
        return Outcome(part=part, what=what, state="holds", found=right)
    return Outcome(part=part, what=what, state="fails", found="; ".join(wrong), remedy=remedy)


def _computer(asked: Asked) -> Iterator[Outcome]:
    found, part, limits = asked.facts.parts["computer"], "computer", asked.board.acceptance
    wrong = [] if "PREEMPT_RT" in found["version"] else [f"{found['release']} is none"]
    yield _outcome(part, "real-time kernel", wrong, found["release"], "flash the image of `make image`")
    mib = found["memory_mib"]
    wrong = [f"{mib:.0f} MiB, not {limits.memory_mib}"] if mib < limits.memory_mib else []
    yield _outcome(
        part, "memory", wrong, f"{mib:.0f} MiB", "a module is missing, or the BIOS takes more than it should"
    )
    source = found["clock_source"]
    yield Outcome(
        part=part, what="clock source", state=asked.timed(holds=source == limits.clock_source),
        found=asked.words(f"{source} of {', '.join(found['clock_sources'])}"),
        remedy=f"{limits.clock_source} is required: `dmesg` has the reason why the kernel left it",
    )  # fmt: skip
    off_s = found["battery_clock_off_s"]
    said = "there is none" if off_s is None else f"off by {off_s:.0f} s"
    wrong = [said] if off_s is None or abs(off_s) > _BATTERY_CLOCK_S else []
    yield _outcome(part, "clock on battery", wrong, said, "change its battery")
    yield from _messages(found["messages"])


def _messages(lines: list[str]) -> Iterator[Outcome]:
    troubles = {where: [line for line in lines if re.search(pattern, line)] for pattern, where in TROUBLES}
    for where, (first, *more) in ((where, found) for where, found in troubles.items() if found):
        said = f"{first}, and {len(more)} more" if more else first
        yield Outcome(part="computer", what="kernel messages", state="fails", found=said, remedy=where)
    if not any(troubles.values()):
        yield Outcome(part="computer", what="kernel messages", state="holds", found="none tells of trouble")


def _temperatures(asked: Asked) -> Iterator[Outcome]:
    limit_c, found = asked.board.acceptance.temperature_c, asked.facts.parts["temperatures"]
    if not found:
        yield Outcome(part="computer", what="temperature", state="not judged", found="no sensor has a driver here")
    for name, celsius in found.items():
        wrong = [f"{celsius:.0f} °C, more than {limit_c}"] if celsius > limit_c else []
        yield _outcome("computer", f"temperature of {name}", wrong, f"{celsius:.0f} °C", "look after its cooling")


def _watchdog(asked: Asked) -> Iterator[Outcome]:
    found, part = asked.facts.parts["watchdog"], "watchdog"
    if not asked.board.watchdog and not found["is_there"]:
        said = "the board's file names none"
        yield Outcome(part=part, what="device", state="not judged", found=said)
        return
    wrong = [] if found["is_there"] else ["/dev/watchdog is missing"]
    yield _outcome(part, "device", wrong, found["device"], "`modules:` of the board's file names its driver")
    is_fed = found["fed_s_ago"] is not None and found["timeout"] not in ("", "0", "infinity")
    wrong = [] if is_fed else ["systemd does not feed it, so a hang lasts"]
    yield _outcome(part, "fed", wrong, f"every {found['timeout']} at the latest", "RuntimeWatchdogSec=, and its driver")
    bite_s = asked.facts.bite_s
    if bite_s is None:
        said = f"a hang was not tried: make accept ROBOT={asked.robot.number} WATCHDOG=1"
        yield Outcome(part=part, what="bite", state="not judged", found=said)
    elif math.isinf(bite_s) and asked.emulated:
        yield Outcome(part=part, what="bite", state="not judged", found="this emulator's watchdog does nothing")
    else:
        wrong = ["a hang was not ended"] if math.isinf(bite_s) else []
        yield _outcome(part, "bite", wrong, f"{bite_s:.0f} s after a hang it answers again", "does it reset the board?")


def _serial(asked: Asked) -> Iterator[Outcome]:
    for name, fact in asked.facts.parts["serial"].items():
        tty = asked.board.ports[name].tty
        what = f"{name} ({tty})"
        if fact.get("users") or tty == asked.board.console_tty:
            users = ", ".join(fact.get("users", ())) or "the console"
            yield Outcome(part="serial", what=what, state="not judged", found=f"in use by {users}")
            continue
        wrong, remedy = [], ""
        if "came" not in fact and "error" not in fact:
            wrong = [f"its UART is {fact['uart']}"]
            remedy = f"compare `ports:` in board_{asked.robot.board}.yml with the board and its jumpers"
        elif "error" in fact:
            wrong, remedy = [fact["error"]], "its UART, or a driver without loopback"
        elif fact.get("came") is False:
            wrong, remedy = ["bytes do not come back through its own UART"], "its base address or interrupt is wrong"
        elif fact.get("came") and tty.startswith("ttyS") and not fact["interrupts"]:
            wrong = [f"interrupt {fact['irq']} is lost: bytes come late, by the kernel's timer"]
            remedy = "its jumpers, or another card on the same interrupt"
        yield _outcome("serial", what, wrong, f"{fact['uart']} on interrupt {fact['irq']}: 256 bytes came back", remedy)


def _links(asked: Asked) -> Iterator[Outcome]:
    before, after = asked.facts.link
    wired = asked.fleet.interface(asked.robot)
    for name, found in (after or {}).items():
        part = "network" if name == wired else "CAN"
        if "missing" in found:
            yield _outcome(part, name, [found["missing"]], "", "its adapter, or its driver in `modules:`")
        elif "UP" not in found["flags"]:
            yield _outcome(part, name, ["is down"], "", "`systemctl status` and `dmesg` on the robot have the reason")
        elif part == "CAN":
            can = found.get("linkinfo", {}).get("info_data", {})
            bad = can.get("state") not in (None, "ERROR-ACTIVE")
            wrong = [f"{can.get('state')}, errors {can.get('berr_counter', {})}"] if bad else []
            yield _outcome(part, name, wrong, "up, ERROR-ACTIVE", "termination, bit rate, or a bus without a partner")
        else:
            rose = {
                f"{way} {kind}": count - (before or {}).get(name, {}).get("stats64", {}).get(way, {}).get(kind, 0)
                for way in ("rx", "tx")
                for kind, count in found["stats64"][way].items()
                if kind.endswith("errors") or kind == "collisions"
            }
            wrong = [f"{count} {kind} while 4 MiB went each way" for kind, count in rose.items() if count]
            yield _outcome(part, name, wrong, "no error while 4 MiB went each way", "cable, switch, duplex, antenna")


def _card(asked: Asked) -> Iterator[Outcome]:
    found, limits, part = asked.facts.parts["card"], asked.board.acceptance, "card"
    for what, key, least in (
        ("reading", "read_mb_s", limits.card_read_mb_s),
        ("writing", "written_mb_s", limits.card_write_mb_s),
    ):
        yield Outcome(
            part=part, what=what, state=asked.timed(holds=found[key] >= least),
            found=asked.words(f"{found[key]:.1f} MB/s, at least {least:g}"), remedy="another card, or DMA in the BIOS",
        )  # fmt: skip
    for name, slot in sorted(found["slots"].items()):
        wrong = [slot["error"]] if "error" in slot else []
        if not wrong and slot["header"] != slot["content"]:
            wrong = [f"its content is {slot['content'][:16]}…, not {slot['header'][:16]}…"]
        yield _outcome(part, f"slot {name}", wrong, "reads as it was written", "the card forgets: flash another one")
    short = found["disk_bytes"] - found["data_end_bytes"]
    wrong = [f"{short >> 20} MiB of the card are behind it"] if short > _GROWN_SLACK_BYTES else []
    remedy = "`journalctl -u flotilla-grow` on the robot has the reason why it did not grow"
    yield _outcome(part, "data partition", wrong, f"{found['data_bytes'] / 1e6:.0f} MB", remedy)
    free = found["data_free_bytes"] / found["data_bytes"]
    wrong = [f"{100 * free:.0f} % are free, less than {100 * _FREE:.0f}"] if free < _FREE else []
    yield _outcome(part, "room", wrong, f"{100 * free:.0f} % are free", "fetch and remove recorder files: make fetch")
    errors = found["file_system_errors"]
    wrong = [f"{errors} errors of the file system"] if errors else []
    yield _outcome(part, "file system", wrong, "no errors", "`fsck` it at the next boot; then the card is at its end")


def _real_time(asked: Asked) -> Iterator[Outcome]:
    limit_us = asked.board.acceptance.wake_up_us
    found = asked.facts.parts["real_time"]
    yield _late(asked, "preemption", max(found["faster_us"], found["slower_us"]), limit_us)
    yield _late(asked, "task switch", found["switch_us"], limit_us)


def _late(asked: Asked, what: str, worst_us: float, limit_us: int) -> Outcome:
    return Outcome(
        part="real time", what=what, state=asked.timed(holds=worst_us <= limit_us),
        found=asked.words(f"{worst_us:g} µs at the latest, at most {limit_us}"),
        remedy="`make hwcheck`, `make latency TARGET=ssh:…` and docs/troubleshooting.md help to find the cause",
    )  # fmt: skip


def _hardware_latency(asked: Asked) -> Iterator[Outcome]:
    limits, longest_us = asked.board.acceptance, asked.facts.parts["hardware_latency"]["longest_us"]
    outcome = _late(asked, "hardware", longest_us, limits.hardware_latency_us)
    yield outcome.model_copy(update={"remedy": "the BIOS takes the processor away: switch off USB legacy support"})


def _latency(asked: Asked) -> Iterator[Outcome]:
    found, limits = asked.facts.latency, asked.board.acceptance
    if not found:
        return
    for quantity, limit_us in (("wake-up", limits.wake_up_us), ("byte", limits.byte_us)):
        worst = {
            name: outcome.latencies[quantity].max_us
            for name, outcome in found.scenarios.items()
            if quantity in outcome.latencies
        }
        for name, worst_us in worst.items():
            yield _late(asked, f"{quantity}, {found.scenarios[name].title}", worst_us, limit_us)
    for name, outcome in found.scenarios.items():
        if outcome.missing:
            said = f"needs {', '.join(outcome.missing)}"
            yield Outcome(part="real time", what=f"{outcome.title} ({name})", state="not judged", found=said)


def _relays(asked: Asked) -> Iterator[Outcome]:
    for board in relays.boards(asked.robot) if asked.facts.relays is None else ():
        said = f"nobody watched: make accept ROBOT={asked.robot.number} RELAYS=1"
        yield Outcome(part="relays", what=f"of {board.task}", state="not judged", found=said)
    for relay in asked.facts.relays or ():
        wrong = [] if relay.seen else ["whoever watched saw another than it should"]
        if relay.mismatch:
            wrong.append("its register reads back other than written")
        what = f"{relay.board.task}: relay {relay.number}"
        yield _outcome("relays", what, wrong, "switches", f"`{relay.board.block}:` of the task, the board, its wiring")


CHECKS: Mapping[str, Callable[[Asked], Iterator[Outcome]]] = {
    "computer": _computer,
    "temperatures": _temperatures,
    "watchdog": _watchdog,
    "serial": _serial,
    "network": _links,
    "card": _card,
    "real_time": _real_time,
    "hardware_latency": _hardware_latency,
}
"""By the part of `on_robot.py` that they need."""
BY_HAND = (
    "what leaves a serial connector: the UART's own loopback ends before the line drivers",
    "sensors that no control task of the robot reads",
    "the radio's range, and a power failure while the robot moves",
    "the card's age: such cards do not report it",
)
"""What only a person or a bench shows."""


def judge(fleet: Fleet, robot: Robot, facts: Facts, plan: str, now: datetime | None = None) -> Acceptance:
    """All checks. A part that could not be asked fails by its name."""
    asked = Asked(fleet, robot, facts)
    outcomes = list(_description(asked))
    for name, check in CHECKS.items():
        if name in facts.errors:
            part = name.replace("_", " ")
            outcomes.append(Outcome(part=part, what="could not be asked", state="fails", found=facts.errors[name]))
        else:
            outcomes += check(asked)
    outcomes += [*_relays(asked), *_latency(asked)]
    computer = facts.parts.get("computer", {})
    slots = facts.state["release"] or {"running": None, "slots": {}}
    running = slots["slots"].get(slots["running"], {})
    return Acceptance(
        robot=robot.name,
        board=robot.board,
        made=now or datetime.now(UTC).replace(microsecond=0),
        emulated=asked.emulated,
        computer=" ".join(str(computer.get(key, "")) for key in ("vendor", "product", "processor")).strip(),
        kernel=str(computer.get("release", "")),
        release=str(running.get("release") or ""),
        plan=plan,
        outcomes=[each if each.state == "fails" else each.model_copy(update={"remedy": ""}) for each in outcomes],
        figures=figures(facts),
        histograms_us={
            f"{outcome.title}: {quantity}": latency.histogram_us
            for outcome in (facts.latency.scenarios.values() if facts.latency else ())
            for quantity, latency in outcome.latencies.items()
        },
    )


def figures(facts: Facts) -> dict[str, float]:
    """What compares between robots, and over time."""
    card, late = facts.parts.get("card", {}), facts.parts.get("real_time", {})
    found = {
        "memory, MiB": facts.parts.get("computer", {}).get("memory_mib"),
        "card, read MB/s": card.get("read_mb_s"),
        "card, written MB/s": card.get("written_mb_s"),
        "hottest, °C": max(facts.parts.get("temperatures", {}).values(), default=None),
        "taken by the hardware, µs": facts.parts.get("hardware_latency", {}).get("longest_us"),
        "preemption, µs": max(late["faster_us"], late["slower_us"]) if late else None,
        "task switch, mean µs": late.get("switch_mean_us"),
        "task switch, µs": late.get("switch_us"),
        "watchdog's bite, s": facts.bite_s if facts.bite_s and math.isfinite(facts.bite_s) else None,
    }
    for outcome in facts.latency.scenarios.values() if facts.latency else ():
        for quantity, latency in outcome.latencies.items():
            found[f"{quantity}, {outcome.title}, µs"] = latency.max_us
    return {name: round(float(value), 2) for name, value in found.items() if value is not None}
