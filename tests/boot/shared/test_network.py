"""Who listens on the network, and what gets in."""

from __future__ import annotations

import re
from contextlib import closing
from ipaddress import IPv4Address

import pytest

from flotilla.fleet import identity, message_keys
from flotilla.fleet.model import Fleet
from flotilla.robot import ssh
from flotilla.station import services
from tests.boot.guests import call, sh
from tests.boot.shared.probes import firewall, time_server
from tests.conftest import RobotGuest


def test_only_ssh_and_time_listen(robot: RobotGuest) -> None:
    assert _listeners(robot) == {("tcp", "22", "sshd"), ("udp", "123", "chronyd")}
    sh(robot, "systemd-run --quiet --unit a-test busybox nc -l -p 2323")
    try:
        found = _listeners(robot)
        assert any(port == "2323" for _, port, _ in found), f"a further listener was not seen: {found}"
    finally:
        sh(robot, "systemctl stop a-test")


def _listeners(robot: RobotGuest) -> set[tuple[str, str, str]]:
    found = set()
    for line in sh(robot, "ss --no-header --tcp --udp --raw --packet --listening --numeric --processes").splitlines():
        kind, _, _, _, address, *_ = line.split()
        program = re.search(r'\(\("([^"]+)"', line)
        found.add((kind, address.rpartition(":")[2], program[1] if program else "?"))
    return found


def _taken(fleet: Fleet) -> list[IPv4Address]:
    return [host.address for host in identity.hosts(fleet)]


def test_firewall_admits_the_fleet_alone(robot: RobotGuest, fleet: Fleet) -> None:
    """By packets from a neighbour, a network namespace at the other end of a virtual cable."""
    inside = next(address for address in fleet.network.subnet.hosts() if address not in _taken(fleet))
    dds = 7400 + 250 * fleet.network.dds_domain + 10
    closed = call(robot, firewall, str(inside), dds, "")
    open_for_fleet = {"tcp 22", f"udp {dds}", "udp 5000", "ping"}
    assert set(closed["inside"]) == open_for_fleet, f"from {inside}: {closed['inside']}"
    assert closed["outside"] == [], f"from outside the subnet: {closed['outside']}"
    opened = call(robot, firewall, str(inside), dds, "insert rule inet flotilla input accept")
    everything = open_for_fleet | {"tcp 2323", "udp 2323"}
    assert set(opened["outside"]) == everything, f"with an open firewall only {opened} came through: a blind probe"


def test_wrong_rules_leave_the_robot_closed(robot: RobotGuest, fleet: Fleet) -> None:
    """But for SSH and echo. Seen to fail without the rules that come before: nothing was closed."""
    inside = str(next(address for address in fleet.network.subnet.hosts() if address not in _taken(fleet)))
    dds = 7400 + 250 * fleet.network.dds_domain + 10
    sh(robot, "echo 'table inet flotilla {' > /run/wrong.nft; mount --bind /run/wrong.nft /etc/nftables.conf")
    try:
        sh(robot, "! systemctl restart nftables")
        found = call(robot, firewall, inside, dds, "")
        assert [set(found[where]) for where in ("inside", "outside")] == [{"tcp 22", "ping"}] * 2
    finally:
        sh(robot, "umount /etc/nftables.conf; systemctl restart nftables")


def test_nobody_without_the_key_tells_the_time(
    robot: RobotGuest, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a neighbour with another robot's address; the station hears of it. Seen to fail for a configuration whose
    servers have no key."""
    other = next(each for each in fleet.robots.values() if each != robot.robot)
    key = message_keys.read().time(robot.robot, other)
    found = call(robot, time_server, str(other.address), str(robot.robot.address), f"{key}\n", timeout=2400)
    for kind in ("none", "wrong"):
        answers, taken = found[kind]
        assert answers >= time_server.ENOUGH
        assert taken == 0, f"{kind}: {taken} of {answers} taken"
    assert found["right"][1] >= time_server.ENOUGH
    monkeypatch.setattr(ssh, "command", lambda _: robot.shell.command)
    with closing(services.ask(robot.robot.model_copy(update={"control_tasks": ["any"]}))) as answers:
        said = [re.fullmatch(r"clock rejected (\d+) answers that .*", note) for note in next(answers).notes]
    (refused,) = filter(None, said)
    assert int(refused[1]) >= found["none"][0] + found["wrong"][0]
