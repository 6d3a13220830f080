"""Messages between control tasks: every check of messages.yml has an edit here that makes it speak, once and at the
right place; what tasks and the station make of messages."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from google.protobuf import descriptor_pb2

from flotilla.common import paths, yaml_file
from flotilla.common.errors import Problem, ProblemsError, UserError
from flotilla.common.signals import CODES
from flotilla.fleet import identity, inventory, messages, transport
from flotilla.fleet.model import Fleet
from flotilla.lab.scenarios import virtual
from flotilla.station import telemetry
from flotilla.station.schema import Schema

FILE = paths.TASKS / paths.MESSAGES


class Case(NamedTuple):
    """An edit (`old` → `new`, first occurrence), and the one problem that it makes."""

    old: str
    new: str
    key: str
    words: str
    """In message and remedy, in this order, `…` between."""
    at: str
    """In the line that is named."""
    value: str = ""
    """What is said to stand there, if it matters."""
    also: int = 0
    """Further problems of the same edit."""


CASES = {
    # Single values
    "key": Case("  rate_hz: 100", "  rate: 100", "sensors.rate", "not known…mean rate_hz?", "rate: 100", "100", also=1),
    "missing": Case("  port: 5011\n", "", "sensors.port", "is missing…add it", "sensors:", "(missing)"),
    "message's name": Case("state:\n  s", "State_2:\n  s", "State_2", "not a task's name…small letter", "State_2"),
    "sender's name": Case("sender: navigation", "sender: Nav.", "state.sender", "not a task's name", "Nav.", "Nav."),
    "port": Case("5011", "80", "sensors.port", "out of range…1024 to 65535", "80", "80"),
    "quoted port": Case("5011", '"5011"', "sensors.port", "not a whole number…without quotes", "5011"),
    "rate": Case("rate_hz: 100", "rate_hz: 0", "sensors.rate_hz", "out of range…up to 10000", "rate_hz: 0", "0"),
    "every": Case("every: 10", "every: 0", "control-report.every", "out of range…1 to 10000 steps", "every: 0"),
    "deadline": Case("deadline_ms: 50", "deadline_ms: soon", "sensors.deadline_ms", "not a whole number", "soon"),
    "standby": Case("standby: true", "standby: 1", "wrench.standby", "neither true nor false", "standby: 1"),
    "signals": Case(
        "  signals:\n    step: { type: uint64 }", "  signals: [step]\n  x:\n    y: {}", "sensors.signals",
        "is not a mapping", "signals: [step]", also=1,
    ),
    "no signal": Case(
        "    wanted: { type: double, width: 2, unit: m }", "    wanted: 2", "control-report.signals.wanted",
        "is not a mapping", "wanted: 2", "2",
    ),
    "signal's name": Case("force_x", "forceX", "sensors.signals.forceX", "not a signal's name…sensed_ns", "forceX"),
    "signal's name is a port": Case("igps:", "flag:", "sensors.signals.flag", "pack and unpack…not in, out", "flag"),
    "type": Case("{ type: uint32 }", "{ type: uint33 }", "sensors.signals.sequence.type", "type…uint32", "uint33"),
    "width": Case("width: 2", "width: 0", "sensors.signals.position.width", "out of range…1 to 1472", "width: 0"),
    "unit": Case("unit: m }", "unit: 1 }", "sensors.signals.position.unit", "not a list", "unit: 1"),
    "signal's key": Case("width: 2", "shape: 2", "sensors.signals.position.shape", "known are type, unit", "shape"),
    # Against each other
    "name twice": Case("state:\n  s", "sensors:\n  s", "sensors", "stands twice…another name", "sensors:"),
    "signal twice": Case(
        "    gyro: {", "    igps: { type: boolean }\n    gyro: {", "sensors.signals.igps", "stands twice", "igps",
    ),
    "no such sender": Case(
        "sender: navigation", "sender: stars", "state.sender", "no file…stars.yml…one of control…heading", "stars",
    ),
    "stations send": Case("sender: navigation", "sender: stations", "state.sender", "no file…one of", "stations"),
    "no such receiver": Case(
        "receiver: control\n", "receiver: contrl\n", "state.receiver", "no file…or stations", "contrl", "contrl"
    ),
    "to itself": Case("receiver: navigation", "receiver: sensors", "sensors.receiver", "is the sender", "sensors"),
    "port twice": Case("5012", "5011", "state.port", "is the port of sensors…next free one is 5012", "5011"),
    "rates of a sender": Case(
        "rate_hz: 10\n", "rate_hz: 20\n", "control-report.rate_hz", "every 5 ms by this…10 ms by wrench; 10, or", "20",
    ),
    "no deadline": Case(
        "  deadline_ms: 50\n", "", "sensors.deadline_ms", "is missing; more than 10, the milliseconds", "sensors:",
    ),
    "deadline too short": Case(
        "deadline_ms: 50", "deadline_ms: 10", "sensors.deadline_ms", "passes before…after 10 ms; more than 10", "10",
    ),
    "deadline of a station": Case(
        "rate_hz: 10\n", "rate_hz: 10\n  deadline_ms: 500\n", "control-report.deadline_ms", "no station…remove", "500",
    ),
    "report's name": Case(
        "control-report:\n  s", "report:\n  s", "report", "not named after its sender…such as control-report", "report"
    ),
    "report without a name": Case("control-report:\n  s", "control-:\n  s", "control-", "not named after", "control-"),
    "standby of a report": Case(
        "rate_hz: 10\n", "rate_hz: 10\n  standby: true\n", "control-report.standby", "distinguish robots", "true",
    ),
    "charge of a message between tasks": Case(
        "  standby: true", "  charge: good", "wrench.charge", "thruster-mapping has no use…stations", "charge",
    ),
    "charge that is none": Case(
        "rate_hz: 10\n", "rate_hz: 10\n  charge: wanted\n", "control-report.charge", "single or double…one", "charge",
    ),
    "charge that is not there": Case(
        "rate_hz: 10\n", "rate_hz: 10\n  charge: soc\n", "control-report.charge", "not a signal of", "soc", "soc",
    ),
    "attempts of a message between tasks": Case(
        "  standby: true", "  attempts: [step]", "wrench.attempts", "no use for…stations", "[",
    ),
    "attempts that are none": Case(
        "rate_hz: 10\n", "rate_hz: 10\n  attempts: [step, wanted]\n", "control-report.attempts.1", "one integer",
        "wanted",
    ),
    "drawing of a message between tasks": Case(
        "  standby: true", "  foxglove: { pose: { type: PoseInFrame } }", "wrench.foxglove", "no use for", "foxglove",
    ),
    "drawing that is none": Case(
        "PoseInFrame", "PoseInTime", "control-report.foxglove.pose.type", "no schema of Foxglove…such as", "PoseInTime",
    ),
    "drawing of what is not there": Case(
        "estimated[2]", "estimate[2]", "control-report.foxglove.pose.signals.pose.orientation",
        "not a signal of this message…one of step", "estimate[2]",
    ),
    "no signals": Case(
        "    flying: { type: boolean }\n    done: { type: boolean }\n",
        "heartbeat-idle: { sender: heartbeat, receiver: stations, port: 5040, rate_hz: 1, every: 100, signals: {} }\n",
        "heartbeat-idle.signals", "there are none…at least one", "heartbeat-idle",
    ),
    "too long": Case(
        "width: 2, unit: m", "width: 200, unit: m", "sensors.signals", "of 1654 bytes; at most 1472", "signals:"
    ),
    "no unit": Case(", unit: rad/s", "", "sensors.signals.rate.unit", 'missing…m/s; "1" for a double', "rate:"),
    "units": Case(
        "[m, m, rad, m/s, m/s, rad/s]", "[m, rad]", "state.signals.state.unit", "2 units for 6 elements", "state:"
    ),
    "names alike": Case(
        "    gyro: {", "    gy_ro: { type: boolean }\n    gyro: {", "sensors.signals.gyro",
        "the same as gy_ro to protobuf", "gyro:",
    ),
}  # fmt: skip


@pytest.fixture
def tasks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of the control tasks and their messages, which is used instead of them."""
    directory = tmp_path / "control_tasks"
    shutil.copytree(paths.TASKS, directory)
    monkeypatch.setattr(paths, "TASKS", directory)
    identity._environment.cache_clear()
    yield directory
    identity._environment.cache_clear()


def edited(tasks: Path, old: str, new: str) -> list[Problem]:
    """What is said of the messages after an edit below the file's explanation."""
    file = tasks / paths.MESSAGES
    head, mark, body = file.read_text().partition("\nsensors:\n")
    assert old in mark + body, f"no {old!r} to edit"
    file.write_text(head + (mark + body).replace(old, new, 1))
    return messages.load()[1]


@pytest.mark.parametrize("name", CASES)
def test_check(name: str, tasks: Path) -> None:
    case = CASES[name]
    problems = edited(tasks, case.old, case.new)
    assert len(problems) == 1 + case.also, "\n".join(map(str, problems))
    (problem,) = [problem for problem in problems if problem.key == case.key]
    file, _, line = problem.file.partition(":")
    assert Path(file) == tasks / paths.MESSAGES
    assert case.at in Path(file).read_text().splitlines()[int(line) - 1]
    assert problem.value == (case.value or problem.value)
    said = f"{problem.message}; {problem.remedy}"
    assert re.search(".*".join(map(re.escape, case.words.split("…"))), said), said


def test_all_problems_at_once(tasks: Path) -> None:
    """Whoever loads a fleet hears of them, those of what is right beside what is not included."""
    edited(tasks, "port: 5011", "port: 80")
    edited(tasks, "port: 5013", "port: 5012")
    edited(tasks, "width: 3, unit: [N, N, N·m]", "width: 3")
    with pytest.raises(ProblemsError) as caught:
        inventory.load_fleet()
    assert {problem.key for problem in caught.value.problems} == {
        "sensors.port", "wrench.port", "wrench.signals.wrench.unit",
    }  # fmt: skip


def places(value: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Paths of everything inside nested mappings and lists."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in inner:
        yield (*path, key)
        yield from places(child, (*path, key))


@pytest.mark.parametrize("odd", [None, 5, "x", {}, [], True, -1.5], ids=repr)
def test_no_odd_value_confuses_the_checks(odd: object, tasks: Path) -> None:
    """Whatever stands in whatever place, the answer is messages or problems with remedies, never an exception."""
    content = yaml.safe_load(FILE.read_text())
    some = {name: content[name] for name in ("wrench", "control-report")}
    problems: list[Problem] = []
    for *above, last in [*places(some)]:
        changed = yaml.safe_load(yaml.safe_dump(some, sort_keys=False))
        inside = changed
        for step in above:
            inside = inside[step]
        inside[last] = odd
        (tasks / paths.MESSAGES).write_text(yaml.safe_dump(changed, sort_keys=False))
        problems += messages.load()[1]
    assert len(problems) > 20
    assert not [problem for problem in problems if problem.remedy == yaml_file.UNEXPLAINED]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x: [1\ny: 2\n", "is not YAML"),
        ("- state\n", "is not a mapping"),
        ("5\n", "is not a mapping"),
        ("state: !duck {}\n", "is missing"),
        ("state: { port: !!int duck }\n", "is not a whole number"),
        ("on: { 1: 2 }\n", "is missing"),
    ],
)
def test_what_is_no_description_at_all(text: str, words: str, tasks: Path) -> None:
    (tasks / paths.MESSAGES).write_text(text)
    found, problems = messages.load()
    assert not found
    assert words in {problem.message.partition(":")[0] for problem in problems}
    assert all(re.match(r".*messages\.yml:[12]$", problem.file) for problem in problems)


def test_without_a_file_there_are_no_messages(tasks: Path) -> None:
    file = tasks / paths.MESSAGES
    file.write_text("# nothing yet\n")
    assert messages.load() == ({}, [])
    file.unlink()
    assert messages.load() == ({}, [])


def test_the_messages_file_is_no_task(tasks: Path) -> None:
    assert {"heading", "control"} < set(messages.task_names())
    assert "messages" not in messages.task_names()


def test_the_manual_s_example_is_right(tasks: Path) -> None:
    text = (paths.PROJECT / "docs" / "how-to" / "control-tasks.md").read_text()
    entry = text.split("## Add a message\n")[1].split("```yaml\n")[1].split("```")[0]
    with (tasks / paths.MESSAGES).open("a") as file:
        file.write(f"\n{entry}")
    found, problems = messages.load()
    assert not problems
    assert found["attitude"].bytes == 32


# What tasks make of them


def rendered(fleet: Fleet, task: str) -> dict[str, Any]:
    """A task's blocks on the first robot that has it."""
    robot = fleet.robots_with(task)[0]
    return dict(yaml.load(identity.control_tasks(fleet, robot)[task], yaml.BaseLoader)["blocks"])


def in_task(tasks: Path, name: str, old: str, new: str) -> None:
    file = tasks / f"{name}.yml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new, 1))


@pytest.mark.parametrize(
    ("task", "old", "new", "words"),
    [
        ("control", 'message("wrench").layout', 'message("wrnch").layout', "wrnch: is not in …did you mean wrench"),
        ("control", 'message("state").receive', 'message("valves").receive', "valves: valves receives it, and control"),
        ("control", 'message("wrench").send', 'message("state").send', "state: navigation sends it, and control wants"),
        ("control", "period: 10 ms", "period: 20 ms", "period: 20 ms: with it wrench comes 50 …has 100; "),
        ("control", "period: 10 ms", "period: 0.02s", "control-report comes 5 times a …messages.yml has 10;"),
    ],
)  # fmt: skip
def test_a_task_that_uses_a_message_wrongly(task: str, old: str, new: str, words: str, tasks: Path) -> None:
    in_task(tasks, task, old, new)
    with pytest.raises(UserError, match=".*".join(map(re.escape, words.split("…")))) as caught:
        rendered(virtual.fleet("udp"), task)
    assert str(tasks / f"{task}.yml") in str(caught.value)


def test_a_message_that_firewalls_drop() -> None:
    """By DDS the port counts for nothing."""

    def admitting(transport: str, *ports: str) -> Fleet:
        fleet = virtual.fleet(transport)
        network = fleet.network.model_copy(update={"udp_ports": list(ports)})
        return fleet.model_copy(update={"network": network})

    words = r"control_tasks/messages\.yml: state\.port: 5012: robots' firewalls drop it; a port of 5000-5011, 5013, or"
    with pytest.raises(UserError, match=words):
        rendered(admitting("udp", "5000-5011", "5013"), "control")
    assert rendered(admitting("udp", "5012"), "control")["state"]["parameters"]["port"] == "5012"
    assert rendered(admitting("dds", "5013"), "control")


@pytest.mark.parametrize(("text", "expected"), [("10 ms", 0.01), ("2.5ms", 0.0025), ("500us", 5e-4), ("1 s", 1)])
def test_durations(text: str, expected: float) -> None:
    assert transport.duration_s(text) == pytest.approx(expected)


@pytest.mark.parametrize("text", ["", "ms", "10", "10 m", "-1 s", "0 s", "None"])
def test_what_is_no_duration(text: str) -> None:
    with pytest.raises(ValueError, match=r"duration|float"):
        transport.duration_s(text)


# What the station makes of them

_RECORDED = {
    "/robot1/valves/report": (
        "flotilla.ValvesReport",
        "step:UINT64 sensed_ns:INT64 navigation_ns:INT64 control_ns:INT64 mapping_ns:INT64 valves_ns:INT64 "
        "now_ns:INT64 offset_ns:INT64 valves:BOOL[] controller:UINT32 good:BOOL refused:UINT32 "
        "forged:UINT32 replayed:UINT32",
    ),
    "/robot3/control/report": (
        "flotilla.ControlReport",
        "step:UINT64 wanted:DOUBLE[] estimated:DOUBLE[] wrench:DOUBLE[] flying:BOOL done:BOOL",
    ),
}
"""Topics, schemas, and fields in the order of their numbers, as recordings and dashboards have them: to be kept."""


def test_recordings_keep_their_schemas() -> None:
    found = {}
    for stream in telemetry.streams(virtual.fleet("udp")):
        schema = Schema.of(stream)
        (file,) = descriptor_pb2.FileDescriptorSet.FromString(schema.data).file
        (message,) = file.message_type
        assert [field.number for field in message.field] == list(range(1, len(message.field) + 1))
        kinds = descriptor_pb2.FieldDescriptorProto
        fields = " ".join(
            f"{field.name}:{kinds.Type.Name(field.type).removeprefix('TYPE_')}"
            f"{'[]' if field.label == kinds.LABEL_REPEATED else ''}"
            for field in message.field
        )
        assert (file.name, schema.name) == (f"{stream.topic[1:]}.proto", f"{file.package}.{message.name}")
        found[stream.topic] = (schema.name, fields)
    assert found == _RECORDED


def test_every_type_of_signal_can_be_recorded(tasks: Path) -> None:
    """And is laid out as blocks do: without gaps."""
    signals = ", ".join(f'{kind}: {{ type: {kind}, width: 3, unit: "1" }}' for kind in CODES)
    entry = (
        f"valves-all: {{ sender: valves, receiver: stations, port: 5030, rate_hz: 100, signals: {{ {signals} }} }}\n"
    )
    with (tasks / paths.MESSAGES).open("a") as file:
        file.write(entry)
    (stream,) = [stream for stream in telemetry.streams(virtual.fleet("udp")) if stream.name == "all"]
    assert stream.length == 3 * (1 + 1 + 1 + 2 + 2 + 4 + 4 + 8 + 8 + 4 + 8)
    assert [field.offset for field in stream.fields] == [0, 3, 6, 9, 15, 21, 33, 45, 69, 93, 105]
    assert Schema.of(stream).encode(stream.unpack(bytes(stream.length)), 0)
