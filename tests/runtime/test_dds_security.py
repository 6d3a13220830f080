"""Messages between control tasks by DDS, with what each robot's card has to prove who it is: by the blocks and Cyclone
DDS's plug-ins, on loopback. Who has no such proof, or another's, is not listened to."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path, PurePosixPath

import pytest

from flotilla.common import paths
from flotilla.fleet import dds_security, identity, keys
from flotilla.fleet.model import Fleet
from flotilla.lab.scenarios import virtual
from tests.running import DDS_ON_LOOPBACK, Task, running
from tests.runtime import test_dds

FILE = PurePosixPath("/etc/flotilla") / dds_security.CREDENTIAL
DOMAIN = 201 + os.getpid() % 30
"""So that tests at the same time do not hear each other."""
GOOD, BAD = [0.25, -0.5, 0.125], [9.0, 9.0, 9.0]
"""What test_dds.py's sender publishes, and what an attacker does."""
LEADER, STANDBY = 3, 4
"""The robot whose task `control` sends the wrench, and one that may stand by for it."""


def parameters(robots: object) -> str:
    return f"{{type: wrench, topic: wrench, robot: {robots}, partition: robot, domain: {DOMAIN}}}"


SENT, SENT_BY_STANDBY = (test_dds.SENDER.format(parameters=parameters(robot)) for robot in (LEADER, STANDBY))
RECEIVED = test_dds.RECEIVER.format(parameters=parameters([LEADER, STANDBY]))

Start = Callable[..., AbstractContextManager[Task]]


@pytest.fixture(scope="module")
def fleet() -> Fleet:
    """The laboratory's, by DDS."""
    described = virtual.fleet("dds", dds_security=True)
    network = described.network.model_copy(update={"dds_domain": DOMAIN})
    return described.model_copy(update={"network": network})


def cards(fleet: Fleet, directory: Path) -> dict[str, str]:
    """What each robot's card has, by the task that it runs; of the fleet whose keys are in the directory."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paths, "KEYS", directory)
        return {
            task: identity.render(fleet, robot)[FILE][0].decode()
            for robot in fleet.robots.values()
            for task in robot.control_tasks
        }


@pytest.fixture
def start(flotilla_run: Path, tmp_path: Path) -> Start:
    blocks = str(flotilla_run.parent)

    def started(name: str, text: str, watched: str, security: str = "") -> AbstractContextManager[Task]:
        """A task whose DDS writes into `name.log`, with what a card has, or without."""
        said = f"<Tracing><Verbosity>warning</Verbosity><OutputFile>{tmp_path / f'{name}.log'}</OutputFile></Tracing>"
        parts = {"common": DDS_ON_LOOPBACK.replace("</Domain>", f"{said}</Domain>"), "security": security}
        files = [tmp_path / f"{name}-{part}.xml" for part, content in parts.items() if content]
        for file in files:
            file.write_text(parts[file.stem.rpartition("-")[2]])
        uri = ",".join(f"file://{file}" for file in files)
        argv: list[str | Path] = [flotilla_run, "--blocks", blocks, "--watch", watched]
        return running(argv, tmp_path / f"{name}.yml", text, {"CYCLONEDDS_URI": uri})

    return started


def exchanged(xml: str, other: str, *elements: str) -> str:
    """A card's file with elements of another one."""
    for element in elements:
        pattern = f"(?s)<{element}>.*?</{element}>"
        (own,), (found,) = re.findall(pattern, xml), re.findall(pattern, other)
        xml = xml.replace(own, found)
    return xml


@pytest.fixture
def own(fleet: Fleet, tmp_path: Path) -> dict[str, str]:
    """What the fleet's cards have."""
    return cards(fleet, tmp_path / "keys")


def no_proof(fleet: Fleet, own: dict[str, str], tmp_path: Path) -> str:
    return ""


def of_another_fleet(fleet: Fleet, own: dict[str, str], tmp_path: Path) -> str:
    return cards(fleet, tmp_path / "others")["control"]


def robot_that_allows_itself(fleet: Fleet, own: dict[str, str], tmp_path: Path) -> str:
    """Robot 2's identity is the fleet's. It signed itself that it may send what robot 3 may."""
    swapped = {2: fleet.robots[3], 3: fleet.robots[2]}
    robots = {
        number: fleet.robots[number].model_copy(update={"number": of.number, "control_tasks": of.control_tasks})
        for number, of in swapped.items()
    }
    others = fleet.model_copy(update={"robots": {**fleet.robots, **robots}})
    forged = cards(others, tmp_path / "forgery")["control"]
    return exchanged(own["navigation"], forged, "PermissionsCA", "Governance", "Permissions")


def revoked_robot(fleet: Fleet, own: dict[str, str], tmp_path: Path) -> str:
    """The fleet's cards know so, and its own does not."""
    former = own["control"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paths, "KEYS", tmp_path / "keys")
        keys.revoke_host_key(fleet, fleet.robot_with("control"))
    own.update(cards(fleet, tmp_path / "keys"))
    return former


@pytest.mark.parametrize(
    ("attacker", "refusal"),
    [
        (no_proof, ""),
        (of_another_fleet, "certificate signature failure"),
        (robot_that_allows_itself, "permissions from plugin: Failed"),
        (revoked_robot, "certificate revoked"),
    ],
)
def test_nobody_else_is_listened_to(
    attacker: Callable[[Fleet, dict[str, str], Path], str],
    refusal: str,
    fleet: Fleet,
    own: dict[str, str],
    start: Start,
    tmp_path: Path,
) -> None:
    """While the one who may send does, at the same time and as the same robot. Seen to fail with what robot 3 has."""
    has = attacker(fleet, own, tmp_path)
    forged = SENT.replace(str(GOOD), str(BAD))
    assert forged != SENT
    with contextlib.ExitStack() as tasks:
        hearing = tasks.enter_context(start("mapping", RECEIVED, "in.wrench,in.flag", own["thruster-mapping"]))
        attacking = tasks.enter_context(start("attacker", forged, "out.written", has))
        attacking.until(lambda row: row["step"] >= 100)
        tasks.enter_context(start("control", SENT, "out.written", own["control"]))
        rows = [hearing.until(lambda row: row["flag"])]
        rows += [row for row, _ in zip(hearing.rows(), range(200), strict=False)]
    assert {tuple(row["wrench"]) for row in rows if row["flag"]} == {tuple(GOOD)}
    said = "".join((tmp_path / f"{name}.log").read_text() for name in ("mapping", "attacker"))
    assert refusal in said


def test_a_hot_standby_sends_as_itself_alone(fleet: Fleet, own: dict[str, str], start: Start, tmp_path: Path) -> None:
    """It may send the topic, but not as its leader. Seen to fail with permissions for all partitions."""
    tasks = {"control_tasks": [*fleet.robots[STANDBY].control_tasks, "control"], "standby": ["control"]}
    robot = fleet.robots[STANDBY].model_copy(update=tasks)
    standing_by = fleet.model_copy(update={"robots": {**fleet.robots, STANDBY: robot}})
    security = cards(standing_by, tmp_path / "keys")["thruster-mapping"]
    with (
        start("mapping", RECEIVED, "in.wrench,in.flag,in.sender", own["thruster-mapping"]) as hearing,
        start("as-leader", SENT.replace(str(GOOD), str(BAD)), "out.written", security) as attacking,
    ):
        attacking.until(lambda row: row["step"] >= 100)
        with start("as-itself", SENT_BY_STANDBY, "out.written", security):
            rows = [hearing.until(lambda row: row["flag"])]
            rows += [row for row, _ in zip(hearing.rows(), range(200), strict=False)]
    assert {(tuple(row["wrench"]), row["sender"]) for row in rows if row["flag"]} == {(tuple(GOOD), 1)}


def test_nobody_else_listens(start: Start, own: dict[str, str]) -> None:
    """Neither who has no proof nor a robot whose tasks do not receive it. Seen to fail with one whose task does."""
    with contextlib.ExitStack() as tasks:
        spies = [
            tasks.enter_context(start(f"spy-{name}", RECEIVED, "in.peers,in.flag", security))
            for name, security in {"stranger": "", "valves": own["valves"]}.items()
        ]
        hearing = tasks.enter_context(start("mapping", RECEIVED, "in.flag", own["thruster-mapping"]))
        tasks.enter_context(start("control", SENT, "out.written", own["control"]))
        hearing.until(lambda row: row["flag"])
        for spy in spies:
            seen = spy.until(lambda row: row["step"] >= 200)
            assert (seen["peers"], seen["flag"]) == (0, 0)


@pytest.mark.parametrize("secured", ["sender", "receiver"])
def test_messages_of_ros_are_for_everybody(start: Start, own: dict[str, str], secured: str) -> None:
    """A computer that runs ROS has no proof. Seen to fail with governance that allows no such participants."""
    security = own["control"]
    sent, received = (task.format(domain=DOMAIN) for task in (test_dds.ROS_SENDER, test_dds.ROS_RECEIVER))
    with (
        start("receiver", received, "in.linear,in.flag", security * (secured == "receiver")) as hearing,
        start("sender", sent, "out.written", security * (secured == "sender")),
    ):
        assert hearing.until(lambda row: row["flag"])["linear"] == [0.25, 0, 0]
