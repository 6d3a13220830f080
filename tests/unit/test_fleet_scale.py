"""How provisioning grows: descriptions of fleets, lines through samples, refusals. Without any robots."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import inventory
from flotilla.lab.containers import container, scale
from flotilla.lab.qemu.timing import LabError

UP = {"outcome": "up to date", "repaired": [], "messages": []}


def sample(robots: int, wall_s: float) -> scale.Sample:
    return scale.Sample(robots, wall_s, station_cpu_s=robots / 4, robots_cpu_s=1, boot_s=2, memory_mib=20)


@pytest.mark.parametrize("board", ["smartcoret3", "x86_64"])
def test_a_described_fleet_is_valid_and_the_projects_in_all_else(board: str, tmp_path: Path) -> None:
    project = inventory.load_fleet()
    fleet = inventory.load_fleet(scale.describe(250, board, tmp_path / "inventory"))
    assert list(fleet.robots) == list(range(1, 251))
    assert {robot.board for robot in fleet.robots.values()} == {board}
    assert fleet.boards == {board: project.boards[board]}
    assert (fleet.network, fleet.stations) == (project.network, project.stations)


@pytest.mark.parametrize("count", [0, 251])
def test_a_fleet_of_no_or_too_many_robots_is_refused(count: int, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=f"N={count}: give 1 to 250 robots"):
        scale.describe(count, "smartcoret3", tmp_path / "inventory")


def test_a_board_without_an_image_is_refused_with_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = inventory.load_fleet()
    with pytest.raises(UserError, match=r"board pc: no robot has it, so there is no image; put one in its group"):
        scale.image_for(fleet, "pc")
    monkeypatch.setattr(scale, "image_of", lambda robot: tmp_path / robot.name)
    with pytest.raises(UserError, match="make image ROBOT=2"):
        scale.image_for(fleet, "x86_64")
    (tmp_path / "robot2").touch()
    assert scale.image_for(fleet, "x86_64") == tmp_path / "robot2"


def test_the_line_is_that_of_the_samples() -> None:
    result = scale.summary([sample(1, 3.5), sample(2, 4.0), sample(4, 5.0)], (4, 60.0))
    assert result["lines"]["wall_s"] == {"per_robot": 0.5, "of_no_robot": 3.0}
    assert result["lines"]["station_cpu_s"] == {"per_robot": 0.25, "of_no_robot": 0.0}
    assert result["forks"] == 8 * result["processors"]
    said = scale.table(result)
    assert said.splitlines()[3].split()[:5] == ["4", "5.0", "s", "0.50", "s"]
    assert "fleet.yml takes 3.0 s and 0.5 s for each robot" in said
    assert "4 guests of the virtual fleet, which ran meanwhile: 60.0 s" in said
    alone = scale.summary([sample(1, 3.5)])
    assert alone["lines"] == {}
    assert "for each robot" not in scale.table(alone)


@pytest.mark.parametrize(
    ("status", "robots", "words"),
    [
        (0, {"robot1": UP | {"outcome": "changed", "repaired": ["/etc/hosts is missing"]}}, "robot1: .*/etc/hosts"),
        (2, {"robot1": UP | {"outcome": "failed", "messages": ["is full"]}}, "status 2.*\nrobot1: .*is full"),
        (0, {}, "robot1: was not reached"),
        (4, {"robot1": UP}, "status 4"),
    ],
)
def test_robots_that_were_not_up_to_date_are_named(
    status: int, robots: dict[str, dict[str, object]], words: str
) -> None:
    with pytest.raises(LabError, match=words):
        scale.Play(status, 1.0, "said", robots).check_unchanged(["robot1"])


def test_robots_that_were_up_to_date_pass() -> None:
    scale.Play(0, 1.0, "said", {"robot1": UP}).check_unchanged(["robot1"])


def test_who_is_not_root_is_told_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(UserError, match=r"robots in containers need root: .*sudo"):
        container.check()


def test_a_computer_that_refuses_something_is_named_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever runs this: the probe is no matter of namespaces."""
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(container, "inside", list)
    monkeypatch.setattr(container, "NEEDED", {"wheels": "echo there are none >&2; exit 1"})
    with pytest.raises(
        UserError, match="robots in containers need wheels, which this computer does not permit: there are none"
    ):
        container.check()


def test_robots_are_booted_in_namespaces_alone(tmp_path: Path) -> None:
    """Anywhere else their mounts would be this computer's."""
    fleet = inventory.load_fleet()
    with pytest.raises(ValueError, match="inside"):
        container.boot(fleet, [], tmp_path / "no.img", tmp_path)


def test_a_robot_sees_its_boards_ports_and_sets_files(tmp_path: Path) -> None:
    """In place of settings that the kernel has once: those of the image, none of them in a comment."""
    root = tmp_path / "root"
    (root / "etc/sysctl.d").mkdir(parents=True)
    (root / "etc/sysctl.d/50.conf").write_text((paths.OVERLAY / "etc/sysctl.d/50-flotilla.conf").read_text())
    (root / "etc/sysctl.d/99.conf").write_text("# kernel.sysrq = 1\n-kernel.printk=3\n")
    files = container.own_files(root, inventory.load_fleet().boards["smartcoret3"])
    assert files["proc/sys/kernel/panic_on_oops"] == Path("/proc/sys/kernel/panic_on_oops").read_text()
    assert "proc/sys/kernel/printk" in files
    assert "proc/sys/kernel/sysrq" not in files
    assert files["proc/tty/driver/serial"].splitlines()[-1].startswith("11: uart:16550A ")
    assert (
        files["proc/sys/kernel/random/boot_id"]
        != container.own_files(root, inventory.load_fleet().boards["x86_64"])["proc/sys/kernel/random/boot_id"]
    )
