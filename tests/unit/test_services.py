"""What robots say of their control tasks' services, and what becomes of it; ssh runs it in a shell here."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from contextlib import closing
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

import pytest

from flotilla.common.errors import UserError
from flotilla.fleet.model import Robot
from flotilla.robot import ssh
from flotilla.robot.health import READ_ONLY
from flotilla.station import services, watching
from flotilla.station.services import Answer, State, TaskStatus, ask

ROBOT = Robot(
    name="robot3", number=3, board="smartcoret3", address=IPv4Address("10.0.0.3"), control_tasks=["valves", "sensors"]
)
SSH = """#!/bin/sh
while [ "$1" = -o ] || [ "$1" = -F ]; do shift 2; done
PATH="{directory}:$PATH" exec sh -c "$*"
"""


def unit(task: str, active: str, sub: str, restarts: int, since_us: int) -> str:
    """As systemd 252 says it, in its own order."""
    return f"""NRestarts={restarts}
Id=flotilla-task@{task}.service
ActiveState={active}
SubState={sub}
ActiveEnterTimestampMonotonic={since_us}
"""


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A directory of the robot's programs; it says what a file `said` in it has, and has been up for 153.54 s."""
    program(tmp_path, "ssh", SSH.format(directory=tmp_path))
    program(tmp_path, "sudo", '#!/bin/sh\nexec "$@"\n')
    program(tmp_path, "cat", '#!/bin/sh\n[ "$*" = /proc/uptime ] && echo 153.54 93.80\n')
    program(tmp_path, "sleep", "#!/bin/sh\n")
    asked = "--property=Id,ActiveState,SubState,NRestarts,ActiveEnterTimestampMonotonic"
    words = f"show {asked} flotilla-task@valves.service flotilla-task@sensors.service"
    program(tmp_path, "systemctl", f'#!/bin/sh\n[ "$*" = "{words}" ] && exec /bin/cat {tmp_path}/said\n')
    monkeypatch.setattr(ssh, "command", lambda _: [str(tmp_path / "ssh")])
    return tmp_path


def test_a_robot_that_lets_in_slowly_is_awaited_as_by_every_command() -> None:
    """Seen to fail: 5 s here, so a busy robot's tasks were `no answer` for ever."""
    assert not [setting for setting in services._SETTINGS if setting.startswith("ConnectTimeout")]


def program(directory: Path, name: str, script: str) -> None:
    (directory / name).write_text(script)
    (directory / name).chmod(0o755)


def tell(robot: Path, **overruns: int | None) -> None:
    """What tasks say of themselves; a stopped one nothing."""
    for task, count in overruns.items():
        report = {"task": task, "period_s": 0.01, "overruns": count, "sensors": {"gyro": {"flag": False, "age_s": 1.5}}}
        beside = robot / f"{task}.new"  # whoever asks meanwhile reads a whole report
        beside.write_text(json.dumps(report) + "\n")
        beside.rename(robot / task) if count is not None else (robot / task).unlink()
    if not (robot / "flotilla-param").exists():  # it may be running
        program(robot, "flotilla-param", f'#!/bin/sh\n[ "$1" = --status=json ] && exec /bin/cat {robot}/"$2"\n')


def say(robot: Path, *units: str) -> None:
    beside = robot / "said.new"
    beside.write_text("\n".join(units))
    beside.rename(robot / "said")


def test_what_services_do(robot: Path) -> None:
    """Seen to fail with restarts that do no harm, and with the boot's time for the task's."""
    say(robot, unit("valves", "active", "running", 0, 148562559), unit("sensors", "active", "running", 2, 53540000))
    with closing(ask(ROBOT)) as answers:
        assert next(answers) == Answer(
            {"valves": State("running 5 s", True), "sensors": State("running 100 s, restarted 2×", False)}
        )
        say(robot, unit("valves", "inactive", "dead", 0, 0), unit("sensors", "activating", "auto-restart", 7, 0))
        changed = {"valves": State("dead", False), "sensors": State("auto-restart, restarted 7×", False)}
        assert until(answers, changed)


def test_what_tasks_say_of_themselves(robot: Path) -> None:
    """Overruns are new since it was asked before. Seen to fail with those of a start anew taken for a decrease."""
    say(robot, unit("valves", "active", "running", 0, 53540000), unit("sensors", "active", "running", 0, 53540000))

    def status(overruns: int, lately: int) -> TaskStatus:
        return TaskStatus(0.01, overruns, lately, {"gyro": False})

    tell(robot, valves=7, sensors=0)
    with closing(ask(ROBOT)) as answers:
        first = next(answers).tasks
        assert (first["valves"].status, first["sensors"].status) == (status(7, 0), status(0, 0))
        tell(robot, valves=9, sensors=None)
        assert any(
            (a.tasks["valves"].status, a.tasks["sensors"].status) == (status(9, 2), None)
            for a, _ in zip(answers, range(10000), strict=False)
        )
        tell(robot, valves=3)
        assert any(a.tasks["valves"].status == status(3, 3) for a, _ in zip(answers, range(10000), strict=False))


def test_what_a_task_refused(robot: Path) -> None:
    """One with an older release says nothing of it. Seen to fail without it, and where the key has to be there."""
    say(robot, unit("valves", "active", "running", 0, 53540000), unit("sensors", "active", "running", 0, 53540000))
    refused = {"wrench": {"forged": 410, "replayed": 206}}
    report = {"task": "valves", "period_s": 0.01, "overruns": 0, "sensors": {}, "refused": refused}
    tell(robot, valves=0, sensors=0)
    (robot / "valves").write_text(json.dumps(report) + "\n")
    with closing(ask(ROBOT)) as answers:
        tasks = next(answers).tasks
    assert tasks["valves"].status == TaskStatus(0.01, 0, 0, {}, refused)
    assert tasks["sensors"].status == TaskStatus(0.01, 0, 0, {"gyro": False}, {})


GOOD = {"task": "valves", "period_s": 0.01, "overruns": 0, "sensors": {}}
STATUSES = {
    "NaN as a period": GOOD | {"period_s": float("nan")},
    "an infinite period": GOOD | {"period_s": float("inf")},
    "no period": GOOD | {"period_s": 0},
    "negative overruns": GOOD | {"overruns": -1},
    "many overruns": GOOD | {"overruns": 10**400},
    "another task's": GOOD | {"task": "sensors", "overruns": 99},
    "a list": [1],
    "a number": 7,
    "text": "running",
    "escapes in a sensor's name": GOOD | {"sensors": {"\x1b[2J": {"flag": True}}},
    "markup in a block's name": GOOD | {"waiting": ["[red]x[/red]\n"]},
    "a list of sensors": GOOD | {"sensors": []},
    "many sensors": GOOD | {"sensors": {f"s{i}": {"flag": True} for i in range(1000)}},
    "refusals that are text": GOOD | {"refused": {"a": {"b": "c"}}},
}
LINES = {
    "a deep nest": "[" * 60000,
    "a deep object": '{"a":' * 10000,
    "no JSON": "hello",
    "several lines": json.dumps(GOOD) + "\n.\n.\nnull\nnull\n.",
    "a line without an end": "x" * 10_000_000,
    "escapes alone": "\x1b]0;title\x07",
    "bytes": "\ufffd\x00\x01",
    "no UTF-8": "\udcff",
}


@pytest.mark.parametrize("line", [*map(json.dumps, STATUSES.values()), *LINES.values()], ids=[*STATUSES, *LINES])
def test_a_task_that_somebody_took_over_says_nothing_of_others(robot: Path, line: str) -> None:
    """Its answer is none; that of the other one is what it was, and the connection stays.

    Seen to fail: NaN was its period, a deep nest or a byte that is no UTF-8 ended the thread that asks, nonsense
    silenced the other task.
    """
    say(robot, unit("valves", "active", "running", 0, 53540000), unit("sensors", "active", "running", 0, 53540000))
    tell(robot, valves=0, sensors=7)
    (robot / "valves").write_bytes(f"{line}\n".encode(errors="surrogateescape"))
    with closing(ask(ROBOT)) as answers:
        for answer in (next(answers), next(answers)):
            assert answer.tasks["sensors"].status == TaskStatus(0.01, 7, 0, {"gyro": False})
            assert answer.tasks["valves"] == State("running 100 s", True)
            (note,) = answer.notes
            assert note.startswith("valves does not report its status: the answer is invalid: ")
            assert note.isprintable()


@pytest.mark.parametrize("written", ["x" * 10_000_000, "\n".join(["x"] * 100_000), "\x1b[2J"])
def test_a_robot_that_says_nonsense_ends_its_connection_alone(robot: Path, written: str) -> None:
    (robot / "nonsense").write_text(written)
    program(robot, "cat", f"#!/bin/sh\n/bin/cat {robot}/nonsense; while :; do echo .; done\n")
    say(robot, unit("valves", "active", "running", 0, 53540000), unit("sensors", "active", "running", 0, 53540000))
    tell(robot, valves=7, sensors=0)
    with closing(ask(ROBOT)) as answers, pytest.raises(UserError, match="robot3: ") as refused:
        next(answers)
    assert str(refused.value).isprintable()


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ("in the cell", ()),
        (LOST := "in the cell; joined again 2 times, last because it had left it", (f"radio {LOST}",)),
    ],
)
def test_what_a_robot_says_of_the_cell(robot: Path, written: str, said: tuple[str, ...]) -> None:
    """Seen to fail with the line taken for a task's, too."""
    say(robot, unit("valves", "active", "running", 0, 53540000), unit("sensors", "active", "running", 0, 53540000))
    tell(robot, valves=7, sensors=0)
    program(robot, "cat", f'#!/bin/sh\n[ "$*" = /proc/uptime ] && echo 153.54 93.80 || echo "{written}"\n')
    with closing(ask(ROBOT)) as answers:
        first = next(answers)
    assert (first.notes, sorted(first.tasks)) == (said, ["sensors", "valves"])
    assert first.tasks["valves"].status


CHAIN = """{"nftables": [
{"metainfo": {"version": "1.0.6", "release_name": "Lester Gooch #5", "json_schema_version": 1}},
{"chain": {"family": "inet", "table": "flotilla", "name": "flood", "handle": 1, "type": "filter", "hook": "prerouting",
"prio": -450, "policy": "accept"}},
{"rule": {"family": "inet", "table": "flotilla", "chain": "flood", "handle": 6, "expr": [
{"match": {"op": "==", "left": {"meta": {"key": "iif"}}, "right": "lo"}}, {"accept": null}]}},
{"rule": {"family": "inet", "table": "flotilla", "chain": "flood", "handle": 7, "expr": [
{"match": {"op": "!=", "left": {"meta": {"key": "l4proto"}}, "right": 6}},
{"counter": {"packets": PACKETS, "bytes": 9}}, {"drop": null}]}},
{"rule": {"family": "inet", "table": "flotilla", "chain": "flood", "handle": 8, "expr": [
{"match": {"op": "==", "left": {"meta": {"key": "l4proto"}}, "right": 6}},
{"limit": {"rate": 4000, "burst": 800, "per": "second", "inv": true}},
{"counter": {"packets": PACKETS, "bytes": 9}}, {"drop": null}]}}]}"""


@pytest.mark.parametrize(("packets", "said"), [(70, ("firewall dropped 140 packets of a flood",)), (0, ())])
def test_what_the_firewall_dropped(robot: Path, packets: int, said: tuple[str, ...]) -> None:
    """As nft 1.0.6 says it. Seen to fail without the chain in what is asked."""
    say(robot, unit("valves", "active", "running", 0, 53540000), unit("sensors", "active", "running", 0, 53540000))
    tell(robot, valves=7, sensors=0)
    chain = CHAIN.replace("PACKETS", str(packets)).replace("\n", " ")
    program(robot, "nft", f"""#!/bin/sh\n[ "$*" = "--json list chain inet flotilla flood" ] && echo '{chain}'\n""")
    with closing(ask(ROBOT)) as answers:
        first = next(answers)
    assert (first.notes, sorted(first.tasks)) == (said, ["sensors", "valves"])


@pytest.mark.parametrize(
    ("valid", "said"), [(7, ("clock rejected 2 answers that were not a time server's",)), (9, ())], ids=["liar", "none"]
)
def test_what_told_a_wrong_time(robot: Path, valid: int, said: tuple[str, ...]) -> None:
    """As chronyc 4.3 says it of two servers. Seen to fail with the first one's counts alone."""
    say(robot, unit("valves", "active", "running", 0, 53540000), unit("sensors", "active", "running", 0, 53540000))
    tell(robot, valves=7, sensors=0)
    server = "RX timestamping : Kernel\nTotal TX        : 12\nTotal RX        : {}\nTotal valid RX  : {}\n"
    counts = server.format(40, 40) + "\n" + server.format(9, valid)
    program(robot, "chronyc", f"""#!/bin/sh\n[ "$*" = "-n ntpdata" ] && echo '{counts}'\n""")
    with closing(ask(ROBOT)) as answers:
        first = next(answers)
    assert (first.notes, sorted(first.tasks)) == (said, ["sensors", "valves"])


@pytest.mark.parametrize(
    ("options", "said"),
    [("rw,relatime rw", ()), ("rw,relatime ro,errors=remount-ro", (READ_ONLY,)), ("ro,relatime rw", (READ_ONLY,))],
)
def test_a_read_only_data_partition_is_named(robot: Path, options: str, said: tuple[str, ...]) -> None:
    """As findmnt 2.38 reports it. Seen to fail: nothing was named, on the page and in `make top`."""
    say(robot, unit("valves", "active", "running", 0, 53540000), unit("sensors", "active", "running", 0, 53540000))
    tell(robot, valves=7, sensors=0)
    program(robot, "findmnt", f"""#!/bin/sh\n[ "$*" = "-rno VFS-OPTIONS,FS-OPTIONS /data" ] && echo {options}\n""")
    with closing(ask(ROBOT)) as answers:
        first = next(answers)
    assert (first.notes, sorted(first.tasks)) == (said, ["sensors", "valves"])


def until(answers: Iterator[Answer], wanted: dict[str, State]) -> bool:
    """One of the next answers is that: some were given before the change."""
    return any(answer.tasks == wanted for answer, _ in zip(answers, range(10000), strict=False))


def test_one_that_does_not_answer(robot: Path) -> None:
    program(robot, "ssh", "#!/bin/sh\necho 'ssh: connect to host: No route' >&2; exit 255\n")
    with pytest.raises(UserError, match=r"^robot3 did not answer: ssh: connect to host: No route; is it on"):
        next(ask(ROBOT))


@pytest.mark.parametrize("said", ["Failed to connect\n", "without an end "])
def test_one_that_talks_nonsense(robot: Path, said: str) -> None:
    """Seen to hang without a limit to what is read."""
    say(robot, said)
    with pytest.raises(UserError, match=r"^robot3: its report of its tasks is invalid"):
        next(ask(ROBOT))


ROW = {"release_ns": 1_000_000_000, "lost": 0, "a": 1.5}
NO_ROWS = {
    "a list": [1],
    "NaN as a time": ROW | {"release_ns": float("nan")},
    "a huge time": ROW | {"release_ns": 10**400},
    "text as a signal": ROW | {"a": "\x1b[2J"},
    "a nest as a signal": ROW | {"a": [[1]]},
    "lost that is none": ROW | {"lost": []},
}


@pytest.mark.parametrize("line", [*map(json.dumps, NO_ROWS.values()), "[" * 60000], ids=[*NO_ROWS, "a deep nest"])
def test_rows_of_signals_are_numbers(line: str) -> None:
    """What is none ends them. Seen to fail: text and nests went on to browsers, a huge time ended the plot's task."""

    async def read(*lines: str) -> list[list[Any] | None]:
        stream, batch = asyncio.StreamReader(), asyncio.Queue[list[Any] | None]()
        stream.feed_data("".join(f"{each}\n" for each in lines).encode())
        stream.feed_eof()
        await watching._read(stream, ["a"], batch)
        return [batch.get_nowait() for _ in range(batch.qsize())]

    good, nan = json.dumps(ROW), json.dumps(ROW | {"a": float("nan")})
    assert asyncio.run(read(good, nan, line, good)) == [[1.0, 0, 1.5], [1.0, 0, None], None]
