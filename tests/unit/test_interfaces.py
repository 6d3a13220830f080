"""CAN interfaces from the inventory to the robot's files, and tasks that name interfaces which a robot lacks."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import identity, inventory
from flotilla.fleet.model import Can, Fleet
from flotilla.images import build
from flotilla.robot import provision

_FLEET = inventory.load_fleet()
NETWORK = PurePosixPath("/etc/systemd/network")


@pytest.fixture(autouse=True)
def _keys(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paths, "KEYS", tmp_path_factory.mktemp("interfaces") / "keys")


def robot_with(can: dict[str, Can], *tasks: str) -> Fleet:
    """The fleet in which robot 3 has these."""
    fleet = _FLEET
    robot = fleet.robots[3].model_copy(update={"can": can, "control_tasks": list(tasks)})
    return fleet.model_copy(update={"robots": fleet.robots | {3: robot}})


def refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, can: dict[str, Can], block: str) -> str:
    """What is said of a task with this block, or nothing."""
    (tmp_path / "drive.yml").write_text(f"period: 10 ms\nblocks:\n  one:\n{block}")
    monkeypatch.setattr(paths, "TASKS", tmp_path)
    identity._environment.cache_clear()
    fleet = robot_with(can, "drive")
    try:
        identity.control_tasks(fleet, fleet.robots[3])
    except UserError as error:
        with pytest.raises(UserError, match=re.escape(str(error))):
            build.check_tasks(fleet, [fleet.robots[3]])  # so that no image is made either
        return str(error)
    finally:
        identity._environment.cache_clear()
    return ""


def test_a_task_for_a_processor_that_the_board_lacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    block = "    type: clock\n{}"
    assert refused(tmp_path, monkeypatch, {}, block.format("cpu: 0\n")) == ""
    said = refused(tmp_path, monkeypatch, {}, block.format("cpu: 1\n"))
    assert said.endswith(
        "drive.yml: cpu: 1: board smartcoret3 has processors 0 to 0; choose one of them, or correct `processors:` in "
        "group_vars/board_smartcoret3.yml"
    )


def test_each_interface_has_a_file_of_its_own() -> None:
    fleet = robot_with({"can0": Can(bitrate=1_000_000, restart_ms=20), "can1": Can(bitrate=125_000)})
    files = identity.render(fleet, fleet.robots[3])
    texts = {path.name: content.decode() for path, (content, _) in files.items() if path.parent == NETWORK}
    assert set(texts) == {"10-fleet.network", "20-can0.network", "20-can1.network"}
    assert "Name=can0\n" in texts["20-can0.network"]
    assert "[CAN]\nBitRate=1000000\nRestartSec=20ms\n" in texts["20-can0.network"]
    assert "[CAN]\nBitRate=125000\nRestartSec=100ms\n" in texts["20-can1.network"]
    assert {provision.role_of(str(NETWORK / name)) for name in texts} == {"network"}
    without = robot_with({})
    assert not [path for path in identity.render(without, without.robots[3]) if "can" in path.name]


@pytest.mark.parametrize("kind", ["can-send", "can-receive", "epos2"])
def test_a_block_on_an_interface_that_is_not_brought_up(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = {"can1": Can(bitrate=500_000)}
    plain = f"    type: {kind}\n"
    named = f"{plain}    parameters: {{ interface: can1 }}\n"
    assert refused(tmp_path, monkeypatch, one, named) == ""
    said = refused(tmp_path, monkeypatch, {}, named)
    assert said.endswith(
        "drive.yml: blocks.one.parameters.interface: robot3 has no CAN interface can1; add can1 with its bitrate to "
        "can: of robot3 in robots.yml"
    )
    said = refused(tmp_path, monkeypatch, one, plain)  # can0 unless it says another
    assert "robot3 has no CAN interface can0; can1, or add can0 with its bitrate" in said


@pytest.mark.parametrize("kind", ["udp-send", "udp-receive"])
def test_a_block_on_an_interface_or_address_of_somebody_else(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def said(parameters: str) -> str:
        return refused(tmp_path, monkeypatch, {}, f"    type: {kind}\n    parameters: {{ {parameters} }}\n")

    for right in ("port: 5000", "interface: eth0", "interface: lo", "local_address: 10.42.0.3", 'interface: ""'):
        assert said(right) == "", right
    assert "one.parameters.interface: robot3 has no address on wlan0; eth0, lo, or" in said("interface: wlan0")
    assert "one.parameters.local_address: 10.42.0.4 is not robot3's; 10.42.0.3, 127" in said("local_address: 10.42.0.4")
