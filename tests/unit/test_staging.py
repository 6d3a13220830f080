"""What goes to several robots at once: who lacks the same of a release, and the file that has it."""

from __future__ import annotations

import hashlib
import random
import struct
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet.model import Fleet, Host
from flotilla.robot import release
from flotilla.updates import staging
from flotilla.updates.staging import Lack
from tests.runtime.test_update import CHUNK, header_of, manifest_of, pack

BLOB = random.Random(5).randbytes(8 * CHUNK - 512)


@pytest.fixture
def bundle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(paths, "BUNDLES", tmp_path / "bundles")
    return pack(tmp_path / "board.bundle", manifest_of(BLOB, header_of(BLOB)), [], BLOB)


def lack(bundle: Path, *missing: int, base: str = "old", **more: Any) -> Lack:
    told = {"base": base, "running": False, "staged": False, "missing": list(missing)}
    return Lack(bundle, told | more)


def delta(base: str, size: int) -> Path:
    """A delta from a release; its content does not matter here."""
    file = release.delta_of(base, hashlib.sha256(BLOB).hexdigest())
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(bytes(size))
    return file


def test_robots_that_lack_the_same_share(bundle: Path) -> None:
    """By the release that they run: those for which there is a delta get it, all others what any of them lacks. Seen to
    fail where the chunks are those that the first one lacks."""
    file = delta("previous", 1000)
    lacks = {
        "robot1": lack(bundle, 1, 2),
        "robot2": lack(bundle, 2, 7),
        "robot3": lack(bundle, 0, 1, base="previous"),
        "robot4": lack(bundle, 3, 4, base="previous"),
        "robot5": lack(bundle, running=True),
        "robot6": lack(bundle, 1, staged=True),
        "robot7": lack(bundle),
    }
    first, second = staging.shipments(lacks, "")
    assert (first.command, first.file, first.robots) == ("delta", file, ("robot3", "robot4"))
    assert (second.command, second.robots) == ("write", ("robot1", "robot2"))
    framed = b""
    for number in (1, 2, 7):
        chunk = BLOB[number * CHUNK : (number + 1) * CHUNK]
        framed += struct.pack("<II", number, len(chunk)) + chunk
    assert second.file.read_bytes() == framed
    assert staging.shipments(lacks, "")[1].file == second.file, "a station that starts again goes on with another file"


def test_one_robot_alone_gets_its_own_copy(bundle: Path) -> None:
    """Unless multicast is asked for. Seen to fail with a least number of 1."""
    lacks = {"robot1": lack(bundle, 1), "robot2": lack(bundle, 1, base="previous")}
    delta("previous", 1000)
    assert staging.shipments(lacks, "") == []
    assert [each.robots for each in staging.shipments(lacks, "multicast")] == [("robot2",), ("robot1",)]
    both = {"robot1": lack(bundle, 1), "robot2": lack(bundle, 1)}
    assert [each.robots for each in staging.shipments(both, "")] == [("robot1", "robot2")]
    assert staging.shipments(both, "ssh") == []


def test_a_delta_that_is_more_than_what_is_missing_stays(bundle: Path) -> None:
    """Seen to fail where a delta is taken whenever there is one."""
    delta("previous", CHUNK)
    (found,) = staging.shipments({name: lack(bundle, 1, base="previous") for name in ("robot1", "robot2")}, "")
    assert found.command == "write"
    (found,) = staging.shipments({name: lack(bundle, 1, 2, base="previous") for name in ("robot1", "robot2")}, "")
    assert found.command == "delta"


def test_another_way_is_refused(bundle: Path) -> None:
    with pytest.raises(UserError, match="by=broadcast: give ssh or multicast"):
        staging.shipments({"robot1": lack(bundle, 1)}, "broadcast")


def test_the_station_is_known_by_its_address(fleet: Fleet) -> None:
    """Seen to fail where the first station of the inventory is taken for this computer."""
    elsewhere, here = Host(name="other", address=IPv4Address("192.0.2.1")), IPv4Address("127.0.0.1")
    stations = [elsewhere, Host(name="here", address=here)]
    assert staging.station(fleet.model_copy(update={"stations": stations})) == here
    assert staging.station(fleet.model_copy(update={"stations": [elsewhere]})) is None


@pytest.mark.parametrize("missing", [[99], [-1], [1, 1], [1 << 62]])
def test_a_robot_that_asks_for_what_there_is_not_holds_up_no_other(bundle: Path, missing: list[int]) -> None:
    """Seen to fail: ValueError for all, by a number that the bundle does not have."""
    lacks = {"robot1": lack(bundle, 1, 2), "robot2": lack(bundle, 2, 7), "robot3": lack(bundle, *missing)}
    (shared,) = staging.shipments(lacks, "")
    assert shared.robots == ("robot1", "robot2")
