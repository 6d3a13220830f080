"""Keys of messages and of time: who has which, and what a revocation changes."""

from __future__ import annotations

import re
import stat
import sys
from pathlib import Path, PurePosixPath

import pytest

from flotilla.cli import main as command_line
from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import identity, keys, message_keys
from flotilla.fleet.model import Fleet, Host
from flotilla.station import clock

FILE = PurePosixPath("/etc/flotilla/message-keys")
TIME = PurePosixPath("/etc/chrony/chrony.keys")


@pytest.fixture(autouse=True)
def _keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")


def shared(fleet: Fleet, number: int) -> dict[str, tuple[str, str]]:
    """Of a robot's card: by the other's address, key to it and from it."""
    content, mode = identity.render(fleet, fleet.robots[number])[FILE]
    assert mode == 0o600
    rows = [line.split() for line in content.decode().splitlines() if not line.startswith("#")]
    assert all(re.fullmatch("[0-9a-f]{64}", key) for _, *both in rows for key in both)
    return {address: (to, come) for address, to, come in rows}


def test_each_pair_has_a_key_for_each_direction(fleet: Fleet) -> None:
    three, four = shared(fleet, 3), shared(fleet, 4)
    assert set(three) == {str(host.address) for host in identity.hosts(fleet)}
    third, fourth = (str(fleet.robots[number].address) for number in (3, 4))
    assert three[fourth] == four[third][::-1]
    everything = [key for file in (three, four) for both in file.values() for key in both]
    counts = {key: everything.count(key) for key in everything}
    assert {key for key, count in counts.items() if count > 1} == {*three[fourth], *three[third], *four[fourth]}


def test_another_fleet_has_others(fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = shared(fleet, 3)
    assert shared(fleet, 3) == one
    monkeypatch.setattr(paths, "KEYS", tmp_path / "others")
    assert not {key for both in shared(fleet, 3).values() for key in both} & {
        key for both in one.values() for key in both
    }


def test_a_revoked_robot_is_strange_to_all(fleet: Fleet) -> None:
    """Seen to fail with keys that know no revocations."""
    three, four = shared(fleet, 3), shared(fleet, 4)
    keys.revoke_host_key(fleet, fleet.robots[3])
    third = str(fleet.robots[3].address)
    now = shared(fleet, 4)
    assert {address for address in now if now[address] != four[address]} == {third}
    assert not set(three) & {address for address, both in shared(fleet, 3).items() if both == three[address]}


def test_time_has_a_key_for_each_pair(fleet: Fleet) -> None:
    def files(number: int) -> tuple[dict[str, str], set[str]]:
        """Numbers by server, and the lines of keys."""
        rendered = identity.render(fleet, fleet.robots[number])
        content, mode = rendered[TIME]
        assert mode == 0o600
        lines = {line for line in content.decode().splitlines() if not line.startswith("#")}
        assert all(re.fullmatch(r"[1-9]\d* AES128 HEX:[0-9A-F]{32}", line) for line in lines)
        asked = re.findall(r"^server (\S+) key (\d+) ", rendered[TIME.with_name("chrony.conf")][0].decode(), re.M)
        return dict(asked), lines

    (servers, three), (_, four) = files(3), files(4)
    assert set(servers) == {str(host.address) for host in identity.hosts(fleet) if host != fleet.robots[3]}
    assert set(servers.values()) == {line.split()[0] for line in three}
    (common,) = three & four
    assert servers[str(fleet.robots[4].address)] == common.split()[0]
    (station,) = fleet.stations
    assert three & set(clock.files(fleet, station)[Path("/etc/chrony/flotilla.keys")].splitlines())


def test_station_time_writes_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(paths, "BUILD", tmp_path)
    monkeypatch.setattr(sys, "argv", ["flotilla", "station-time"])
    assert command_line.main() == 0
    directory = tmp_path / "station-time" / "station"
    assert stat.S_IMODE((directory / "flotilla.keys").stat().st_mode) == 0o600
    assert "keyfile /etc/chrony/flotilla.keys" in (directory / "flotilla.conf").read_text().splitlines()
    said = capsys.readouterr().out.splitlines()
    assert f"sudo install -m 640 -g _chrony {directory / 'flotilla.keys'} /etc/chrony/flotilla.keys" in said
    monkeypatch.setattr(sys, "argv", ["flotilla", "station-time", "--station", "desk"])
    assert command_line.main() == 1
    assert "desk is none; there are station" in capsys.readouterr().err


def test_the_secret_is_made_once_and_private() -> None:
    message_keys.write_secret(bytes(range(32)))
    file = message_keys.secret_file()
    assert (file.read_text(), stat.S_IMODE(file.stat().st_mode)) == (bytes(range(32)).hex() + "\n", 0o600)
    message_keys.write_secret(bytes(32))
    assert file.read_text().startswith("000102")
    assert [each.name for each in file.parent.iterdir()] == [file.name]


@pytest.mark.parametrize("text", ["", "00" * 31, "zz" * 32])
def test_a_broken_secret_is_named(fleet: Fleet, text: str) -> None:
    """Nothing is made instead of it: robots have keys of the one that is lost."""
    message_keys.write_secret(bytes(32))
    message_keys.secret_file().write_text(text)
    with pytest.raises(UserError, match="fleet_secret: is not 64 hexadecimal digits; restore it"):
        message_keys.read().between(fleet.robots[3], Host(name="station", address=fleet.stations[0].address))
