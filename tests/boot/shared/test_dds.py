"""DDS as the image configures it: each option has the effect it is there for."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest

from flotilla.fleet.model import Fleet
from tests.boot.guests import call, sh
from tests.boot.shared.probes import observe_dds
from tests.conftest import RobotGuest


def test_dds_configuration_reaches_everyone(robot: RobotGuest) -> None:
    expected = "file:///etc/flotilla/cyclonedds.xml"
    assert robot.shell.run(["sh", "-c", "echo $CYCLONEDDS_URI"]).stdout.strip() == expected
    try:
        sh(robot, "systemd-run --quiet --unit a-test -p Type=oneshot sh -c 'env >/run/a-test'")  # returns at its end
        service = sh(robot, "sed -n 's/^CYCLONEDDS_URI=//p' /run/a-test")
    finally:
        sh(robot, "rm -f /run/a-test")
    assert service == expected, f"a service sees {service!r}"
    assert sh(robot, "sysctl -n net.core.rmem_max") == "2097152"


@pytest.fixture(scope="module")
def dds(pentium: RobotGuest, fleet: Fleet) -> dict[str, Any]:
    """What DDS does with the configuration as shipped, and with others."""
    shipped = pentium.shell.read("/etc/flotilla/cyclonedds.xml").decode()
    changed = _edited(
        shipped,
        (r"<AllowMulticast>.*?<", "<AllowMulticast>true<"),
        (r"<MaxMessageSize>.*?<", "<MaxMessageSize>3000B<"),
        (r"<FragmentSize>.*?<", "<FragmentSize>500B<"),
        (r"<MaxAutoParticipantIndex>.*?<", "<MaxAutoParticipantIndex>3<"),
        (r"(?s)<Peers>.*?</Peers>", f'<Peers><Peer Address="{pentium.robot.address}"/></Peers>'),
        (r"<MultipleReceiveThreads>.*?<", "<MultipleReceiveThreads>true<"),
        (r"(?s)<Threads>.*?</Threads>", ""),
    )
    alone = _edited(
        shipped,
        (r'<NetworkInterface name=".*?"', '<NetworkInterface name="lo"'),
        (r"<ParticipantIndex>.*?<", "<ParticipantIndex>none<"),
    )
    greedy = _edited(shipped, (r'<SocketReceiveBufferSize min=".*?"', '<SocketReceiveBufferSize min="8MB"'))
    runs = {"shipped": (shipped, 2), "changed": (changed, 2), "alone": (alone, 1), "greedy": (greedy, 1)}
    domain = fleet.network.dds_domain
    return {
        name: call(pentium, observe_dds, text, domain, count, 3, timeout=2 * observe_dds.FOUND_S)
        for name, (text, count) in runs.items()
    }


def _edited(text: str, *changes: tuple[str, str]) -> str:
    for pattern, replacement in changes:
        text, count = re.subn(pattern, replacement, text)
        assert count == 1, f"{pattern} is {count} times in cyclonedds.xml"
    return text


_DDS_HOUSEKEEPING = ("tev", "gc", "dq.builtins")
"""Cyclone's threads that need not be in time."""


def _dds_case(option: str, read: Callable[[dict[str, Any]], object], expected: object, other: str = "changed") -> Any:
    return pytest.param(read, expected, other, id=option)


def _asked(run: dict[str, Any], *, own: bool) -> list[tuple[str, int]]:
    """Where on its own computer, or on others, an announcement went: addresses, and ports of participants."""
    asked = [(peer, port) for peer, port in run["sent"] if port >= 10 and port % 2 == 0]
    return [(peer, port) for peer, port in asked if (peer in run["advertised"]) == own]


@pytest.mark.parametrize(
    ("read", "expected", "other"),
    [
        _dds_case("NetworkInterface", lambda run: run["advertised"], ["own"], "alone"),
        _dds_case("AllowMulticast", lambda run: "239.255.0.1" in run["groups"], False),
        _dds_case("AllowMulticast-sent", lambda run: any(peer.startswith("239.") for peer, _ in run["sent"]), False),
        _dds_case("MaxMessageSize", lambda run: 1000 < run["largest"] <= 1400, True),
        _dds_case("FragmentSize", lambda run: run["fragments"], [1300]),
        _dds_case("ParticipantIndex", lambda run: {0, 1, 2, 3} <= set(run["bound"]), True, "alone"),
        _dds_case("MaxAutoParticipantIndex", lambda run: len(_asked(run, own=True)), 6),
        _dds_case("Peers", lambda run: _asked(run, own=False), "everyone"),
        _dds_case("MultipleReceiveThreads", lambda run: sorted(set(run["threads"]) & {"recvMC", "recvUC"}), []),
        _dds_case("Scheduling", lambda run: run["real_time"], dict.fromkeys(_DDS_HOUSEKEEPING, 40)),
        _dds_case("StackSize", lambda run: run["stacks"] >= 5, True),
        _dds_case("SocketReceiveBufferSize", lambda run: run["ended"], [None, None], "greedy"),
    ],
)
def test_dds_obeys(
    dds: dict[str, Any],
    pentium: RobotGuest,
    fleet: Fleet,
    read: Callable[[dict[str, Any]], object],
    expected: object,
    other: str,
) -> None:
    """Each option of cyclonedds.xml has the effect it is there for, and another value has another."""
    if expected == ["own"]:
        expected = [str(pentium.robot.address)]
    if expected == "everyone":
        others = [robot for robot in fleet.robots.values() if robot.number != pentium.robot.number]
        expected = sorted(
            (str(robot.address), 10 + 2 * program)
            for robot in others
            for program in range(len(robot.control_tasks) + 1)
        )
    assert read(dds["shipped"]) == expected, f"as shipped: {dds['shipped']}"
    assert read(dds[other]) != expected, f"with another value, the same: {dds[other]}"


def test_dds_delivers(dds: dict[str, Any]) -> None:
    assert re.search(r"size 8000 total \d+ lost 0 ", dds["shipped"]["said"][0]), dds["shipped"]["said"]
