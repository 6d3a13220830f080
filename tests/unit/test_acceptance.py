"""How a robot's answers are judged, signed and shown: by those of a guest, told as a board's where times matter."""

from __future__ import annotations

import argparse
import copy
import html
import io
import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, cast

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import keys
from flotilla.fleet.model import Fleet, Robot
from flotilla.lab.acceptance import answers, checks, command, facts, outcome, relays, report
from flotilla.lab.acceptance.facts import Facts
from flotilla.lab.acceptance.outcome import Acceptance
from flotilla.lab.acceptance.relays import Relay
from flotilla.lab.latency import results, target
from flotilla.lab.latency.results import Latency
from flotilla.lab.qemu.ssh import Ssh
from flotilla.lab.qemu.timing import LabError

ANSWERED = json.loads((Path(__file__).parent / "acceptance.json").read_text())
"""Parts and state that a guest of robot 3 answered, but for its vendor, its times and a sensor's temperature."""
NOON = datetime(2026, 11, 26, 12, tzinfo=UTC)


@pytest.fixture
def robot(fleet: Fleet) -> Robot:
    return fleet.robots[3]


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")
    monkeypatch.setattr(outcome, "directory", lambda: tmp_path / "acceptance")
    keys.make("operator_ed25519", "operator")
    return tmp_path / "acceptance"


def answered() -> Facts:
    found = copy.deepcopy(ANSWERED)
    link = found["parts"]["network"]
    return Facts(parts=found["parts"], errors={}, state=found["state"], release=None, link=(link, copy.deepcopy(link)))


def failures(fleet: Fleet, robot: Robot, found: Facts) -> list[str]:
    return [str(each) for each in checks.judge(fleet, robot, found, "none").failures]


def test_a_board_that_does_what_its_file_asks_is_accepted(fleet: Fleet, robot: Robot) -> None:
    made = checks.judge(fleet, robot, answered(), "none")
    assert not made.emulated
    assert made.failures == []
    assert {each.what for each in made.outcomes if each.state == "not judged"} == {"release", "bite", "COM1 (ttyS0)"}


def _set(*path: str) -> Callable[[Facts, Any], None]:
    def change(found: Facts, value: Any) -> None:
        at = found.parts
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "value", "said"),
    [
        (_set("computer", "version"), "#1 SMP PREEMPT_DYNAMIC Debian", "computer: real-time kernel: "),
        (_set("computer", "clock_source"), "acpi_pm", "computer: clock source: acpi_pm of "),
        (_set("computer", "battery_clock_off_s"), None, "computer: clock on battery: there is none"),
        (_set("computer", "battery_clock_off_s"), -61.0, "computer: clock on battery: off by -61 s; change its"),
        (_set("computer", "messages"), ["irq 7: nobody cared"] * 3, "computer: kernel messages: irq 7: nobody cared, "),
        (_set("temperatures", "cpu temp"), 91.0, "computer: temperature of cpu temp: 91 °C, more than 85; look after"),
        (_set("watchdog", "is_there"), False, "watchdog: device: /dev/watchdog is missing; `modules:`"),
        (_set("watchdog", "fed_s_ago"), None, "watchdog: fed: systemd does not feed it"),
        (_set("serial", "COM5", "interrupts"), 0, "serial: COM5 (ttyS4): interrupt 11 is lost: bytes come late"),
        (_set("serial", "COM5", "came"), False, "serial: COM5 (ttyS4): bytes do not come back"),
        (_set("card", "read_mb_s"), 1.2, "card: reading: 1.2 MB/s, at least 4; another card"),
        (_set("card", "written_mb_s"), 0.1, "card: writing: 0.1 MB/s, at least 0.5"),
        (_set("card", "data_end_bytes"), 500_000_000, "card: data partition: 476 MiB of the card are behind it"),
        (_set("card", "file_system_errors"), 2, "card: file system: 2 errors"),
        (_set("real_time", "slower_us"), 101, "real time: preemption: 101 µs at the latest, at most 100"),
        (_set("real_time", "switch_us"), 130, "real time: task switch: 130 µs at the latest"),
        (_set("hardware_latency", "longest_us"), 400, "real time: hardware: 400 µs at the latest, at most 20; the B"),
    ],
)  # fmt: skip
def test_each_fault_is_named(
    fleet: Fleet, robot: Robot, change: Callable[[Facts, Any], None], value: Any, said: str
) -> None:
    found = answered()
    change(found, value)
    (fault,) = failures(fleet, robot, found)
    assert fault.startswith(said)


WRONG = (None, True, -1, 1e400, "x" * (1 << 18), "\x1b[2J", [1], {"x": 1})
"""In place of each member of an answer."""


def _members(value: object, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    yield path
    for key, each in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        yield from _members(each, (*path, key))


def _changed(value: Any, path: tuple[str | int, ...], new: object) -> Any:
    if not path:
        return new
    value = copy.deepcopy(value)
    at = value
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = new
    return value


@pytest.mark.parametrize("part", ANSWERED["parts"])
def test_a_robot_in_other_hands_is_judged_or_rejected(fleet: Fleet, robot: Robot, part: str) -> None:
    """Each member is another one, or missing. Seen to fail: an answer without `part` ended in a traceback."""
    reasons, judged = [], 0
    ports = fleet.boards[robot.board].ports
    for path in _members(ANSWERED["parts"][part]):
        for new in WRONG:
            line = json.loads(json.dumps({"part": part, "facts": _changed(ANSWERED["parts"][part], path, new)}))
            whole = answered()
            try:
                found = answers.part(robot.name, line, ports)
                whole.parts[part] = found["facts"]
            except UserError as error:
                reasons.append(str(error))
                continue
            if part == "network":
                whole = replace(whole, link=(found["facts"], found["facts"]))
            made = checks.judge(fleet, robot, whole, "none")
            assert "\x1b" not in command.said(made)
            assert not [value for value in made.figures.values() if not math.isfinite(value)]
            judged += 1
    assert judged
    assert len(reasons) > len(WRONG) // 2
    assert not [reason for reason in reasons if not reason.startswith("robot3: ") or "\x1b" in reason]


@pytest.mark.parametrize(
    "text", ["", "hello", "[]", "1", "null", "{}", '{"part": 1}', '{"part": "x", "facts": {}}', "[" * 100_000, "\x00"]
)
def test_what_is_no_answer_is_rejected(robot: Robot, text: str) -> None:
    with pytest.raises(UserError, match=r"^robot3: "):
        [answers.part(robot.name, line, ()) for line in answers.lines(robot.name, io.StringIO(text + "\n"))]
    with pytest.raises(UserError, match=r"^robot3: "):
        answers.state(robot.name, text)


def test_a_console_that_nobody_uses_is_not_judged(fleet: Fleet, robot: Robot) -> None:
    """Seen to fail: its bytes were said to have come back, though none were sent."""
    found = answered()
    found.parts["serial"]["COM1"]["users"] = []
    (console,) = [each for each in checks.judge(fleet, robot, found, "none").outcomes if each.what == "COM1 (ttyS0)"]
    assert (console.state, console.found) == ("not judged", "in use by the console")


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ({"flags": ["UP"], "linkinfo": {"info_data": {"state": "BUS-OFF"}}}, "CAN: can0: BUS-OFF"),
        ({"flags": []}, "CAN: can0: is down"),
        ({"missing": 'Device "can0" does not exist.'}, 'CAN: can0: Device "can0" does not exist.'),
        ({"flags": ["UP"], "linkinfo": {"info_data": {"state": "ERROR-ACTIVE"}}}, None),
    ],
)
def test_can(fleet: Fleet, robot: Robot, found: dict[str, Any], said: str | None) -> None:
    whole = answered()
    whole.link[1]["can0"] = found
    said_of_it = failures(fleet, robot, whole)
    assert [each.startswith(said or "") for each in said_of_it] == ([True] if said else [])


def test_errors_of_the_link_are_those_of_the_transfer(fleet: Fleet, robot: Robot) -> None:
    found = answered()
    for link, errors in zip(found.link, (5, 7), strict=True):
        link["eth0"]["stats64"]["rx"]["errors"] = errors
    assert failures(fleet, robot, found) == [
        "network: eth0: 2 rx errors while 4 MiB went each way; cable, switch, duplex, antenna"
    ]


def test_a_part_that_cannot_be_asked_fails_by_its_name(fleet: Fleet, robot: Robot) -> None:
    found = replace(answered(), errors={"card": "OSError: /dev/sda: no medium"})
    assert failures(fleet, robot, found) == ["card: could not be asked: OSError: /dev/sda: no medium"]


@pytest.mark.parametrize(("bite_s", "said"), [(float("inf"), ["watchdog: bite: a hang was not ended"]), (42.0, [])])
def test_the_watchdogs_bite(fleet: Fleet, robot: Robot, bite_s: float, said: list[str]) -> None:
    found = failures(fleet, robot, replace(answered(), bite_s=bite_s))
    assert [each.split(";")[0] for each in found] == said


def test_relays_are_judged_by_who_watched(fleet: Fleet) -> None:
    robot = fleet.robots[1]
    (board,) = relays.boards(robot)
    assert (board.task, board.base, board.channels) == ("heading", 0x300, tuple(range(1, 9)))
    made = checks.judge(fleet, robot, answered(), "none")
    (unwatched,) = [each for each in made.outcomes if each.part == "relays"]
    assert unwatched.found == "nobody watched: make accept ROBOT=1 RELAYS=1"
    watched = [Relay(board, 1, seen=True, mismatch=False), Relay(board, 2, seen=False, mismatch=True)]
    said = failures(fleet, robot, replace(answered(), relays=watched))
    assert [each for each in said if each.startswith("relays")] == [
        "relays: heading: relay 2: whoever watched saw another than it should; its register reads back other than "
        "written; `relays:` of the task, the board, its wiring"
    ]


def test_relays_want_a_terminal(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    with pytest.raises(UserError, match="RELAYS=1 asks whoever watches the relays: run it on a terminal"):
        command.run(argparse.Namespace(robot=1, plan="none", seconds=1, relays=True, watchdog=False))


def test_a_robot_without_relays_is_not_asked_for_them(robot: Robot) -> None:
    """Before anything is asked of it."""
    with pytest.raises(UserError, match="robot3 has no control task with a block ir104-pbf: leave out RELAYS=1"):
        relays.watch(robot, cast(Ssh, None), lambda _: True)


def _results(worst_us: int) -> results.Results:
    scenario = results.Outcome(title="idle", latencies={"wake-up": Latency.of({12: 999, worst_us: 1})})
    lacking = results.Outcome(title="disk", missing=["/dev/sda"])
    return results.Results(
        board="smartcoret3", kernel="debian", plan="quick", where="robot3, real time", release="6.1", version="#1",
        binding=results.Binding(kernel="", root="", measurement="", machine="", qemu="", firmware=""),
        boot=results.Boot(before_kernel_us=0, userspace_us=1, first_step_us=1, finished_us=1, failed_units=[]),
        scenarios={"idle": scenario, "disk": lacking},
    )  # fmt: skip


def test_latency_is_judged_by_the_boards_limit(fleet: Fleet, robot: Robot) -> None:
    assert failures(fleet, robot, replace(answered(), latency=_results(100))) == []
    (late,) = failures(fleet, robot, replace(answered(), latency=_results(101)))
    assert late.startswith("real time: wake-up, idle: 101 µs at the latest, at most 100; ")


def test_no_time_of_a_guest_is_judged(fleet: Fleet, robot: Robot) -> None:
    found = replace(answered(), latency=_results(5000))
    found.parts["computer"]["vendor"] = "QEMU"
    found.parts["card"]["read_mb_s"] = 0.1
    made = checks.judge(fleet, robot, found, "quick")
    assert made.emulated
    assert made.failures == []
    shown = {each.what: each.found for each in made.outcomes if each.state == "not judged"}
    assert shown["wake-up, idle"] == f"5000 µs at the latest, at most 100: {checks.EMULATED}"


def test_limits_enter_no_image(fleet: Fleet) -> None:
    board = fleet.boards["smartcoret3"]
    stricter = board.model_copy(update={"acceptance": board.acceptance.model_copy(update={"wake_up_us": 7})})
    assert stricter != board
    assert stricter.model_dump_json() == board.model_dump_json()


def _made(fleet: Fleet, robot: Robot, found: Facts, days: int = 0) -> Acceptance:
    return checks.judge(fleet, robot, found, "quick", NOON + timedelta(days=days))


def test_what_is_not_as_it_was_signed_is_refused(fleet: Fleet, robot: Robot, directory: Path) -> None:
    made = _made(fleet, robot, answered())
    file = outcome.write(made)
    assert file.name == "robot3-20261126T120000Z.json"
    assert list(outcome.of_board("smartcoret3")) == [made]
    assert list(outcome.of_board("x86_64")) == []
    file.write_text(file.read_text().replace('"fails"', '"holds"').replace("ttyS11", "ttyS12"))
    with pytest.raises(UserError, match=r"robot3-20261126T120000Z\.json: is not as the operator's key signed it"):
        outcome.read(file)


def test_the_page_compares_robots_and_times(fleet: Fleet, robot: Robot, directory: Path) -> None:
    before = _made(fleet, robot, replace(answered(), latency=_results(40)))
    other = answered()
    other.parts["card"]["read_mb_s"] = 2.5
    beside = checks.judge(fleet, fleet.robots[4], other, "none", NOON)
    made = _made(fleet, robot, replace(answered(), latency=_results(120)), days=30)
    outcome.write(made)
    page = html.unescape(report.write(made, [before, beside]).read_text())
    assert "robot3 is not accepted" in page
    assert "wake-up, idle" in page
    (row,) = [row for row in report.rows([before, beside, made]) if row.name == "card, read MB/s"]
    assert row.values == [8.0, 2.5, 8.0]
    (row,) = [row for row in report.rows([before, beside, made]) if row.name == "wake-up, idle, µs"]
    assert row.values == [40, None, 120]
    assert page.count("<svg") == 1
    for said in (">before<", ">now<", *checks.BY_HAND):
        assert said in page


@contextmanager
def _shell(_: Robot) -> Iterator[None]:
    yield


def test_a_robot_that_fails_is_an_error_and_is_reported(
    fleet: Fleet, robot: Robot, directory: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = answered()
    found.parts["watchdog"]["is_there"] = False
    monkeypatch.setattr(target, "connect", _shell)
    monkeypatch.setattr(facts, "ask", lambda *_, **__: found)
    asked = argparse.Namespace(robot=3, plan="none", seconds=1, relays=False, watchdog=False)
    with pytest.raises(UserError, match=r"^robot3 is not accepted: 1 of \d+ checks fail$"):
        command.run(asked)
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("fails: watchdog: device: /dev/watchdog is missing")
    assert len(list(directory.glob("robot3-*.html"))) == 1
    assert len(list(directory.glob("robot3-*.json.sig"))) == 1


def test_a_robot_that_does_not_answer(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def silent(*_: object, **__: object) -> Facts:
        raise LabError("no SSH within 600 s: no route")

    monkeypatch.setattr(target, "connect", _shell)
    monkeypatch.setattr(facts, "ask", silent)
    with pytest.raises(UserError, match="robot3: no SSH within 600 s: no route; is it on and reachable"):
        command.run(argparse.Namespace(robot=3, plan="none", seconds=1, relays=False, watchdog=False))
    assert not directory.exists()
