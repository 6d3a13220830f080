"""This computer's adapter joins the cell, or says what it lacks, and everything is put back.

The programs are played by `Computer`, which answers as iw 5.19, iproute2 6.1 and NetworkManager 1.42 do. With the real
iw, kernel and simulated radios: tests/boot/shared/test_radio.py.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.station import adapter, cell

CELL = adapter.Cell("robots", 2412, "02:ca:ff:ee:10:42", "10.42.0.254/24")
PHY_INFO = """Wiphy phy0
\tmax # scan SSIDs: 4
\tSupported interface modes:
\t\t * IBSS
\t\t * managed
\t\t * monitor
\tBand 1:
\t\tFrequencies:
\t\t\t* 2412 MHz [1] (20.0 dBm)
\t\t\t* 2467 MHz [12] (20.0 dBm) (no IR)
\t\t\t* 2484 MHz [14] (disabled)
\tsoftware interface modes (can always be added):
"""


_ASKS = ("info", "get", "link")


class Computer:
    """With an adapter wlan0, which NetworkManager and a wpa_supplicant configure."""

    def __init__(self, root: Path) -> None:
        self.calls: list[str] = []
        self.info = PHY_INFO
        self.joins: str | None = CELL.bssid
        """The BSSID of which cell the driver becomes a member."""
        self.others: list[dict[str, object]] = []
        self.fails = ""
        """The beginning of a command that fails."""
        phy = root / "class" / "ieee80211" / "phy0"
        (phy / "rfkill3").mkdir(parents=True)
        for name, state in (("soft", "1"), ("hard", "0")):
            (phy / "rfkill3" / name).write_text(state)
        net = root / "class" / "net" / "wlan0"
        net.mkdir(parents=True)
        (net / "phy80211").symlink_to(phy)
        (root / "class" / "net" / "eth0").mkdir()
        self.rfkill = phy / "rfkill3" / "soft"
        self.hard = phy / "rfkill3" / "hard"

    def run(self, *argv: str) -> str:
        line = " ".join(argv)
        self.calls.append(line)
        if self.fails and line.startswith(self.fails):
            raise adapter.RefusalError(f"{line}: command failed: Operation not supported (-95)")
        wlan0 = {
            "ifname": "wlan0", "flags": ["BROADCAST", "UP"], "addr_info": [{"local": "192.168.7.9", "prefixlen": 24}],
        }  # fmt: skip
        answers: dict[str, object] = {
            "iw phy phy0 info": self.info,
            "iw dev wlan0 info": "Interface wlan0\n\tifindex 3\n\ttype managed\n",
            "iw dev wlan0 get power_save": "Power save: on\n",
            "iw dev wlan0 link": f"Joined IBSS {self.joins} (on wlan0)\n" if self.joins else "Not connected.\n",
            "ip -json -4 address show": [wlan0, *self.others],
            "ip -json -4 address show dev wlan0": [wlan0],
            "nmcli --terse --fields DEVICE,STATE device": "eth0:connected\nwlan0:connected\n",
        }
        if line.startswith("systemctl is-active") and "wpa_supplicant@wlan0" not in line:
            raise adapter.RefusalError(line)
        answer = answers.get(line, "")
        return answer if isinstance(answer, str) else json.dumps(answer)

    def changes(self) -> list[str]:
        """Commands that change something."""
        asks = ("iw phy", "ip -json", "systemctl is-active", "nmcli --terse", *(f"iw dev wlan0 {do}" for do in _ASKS))
        return [each for each in self.calls if not each.startswith(asks)]


@pytest.fixture
def computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Computer:
    made = Computer(tmp_path / "sys")
    monkeypatch.setattr(adapter, "SYS", tmp_path / "sys")
    monkeypatch.setattr(adapter, "STATE", tmp_path / "run")
    monkeypatch.setattr(adapter, "JOIN_S", 0)
    monkeypatch.setattr(adapter, "run", made.run)
    monkeypatch.setattr("shutil.which", lambda name: f"/usr/bin/{name}")
    return made


ENTERED = [
    "nmcli device set wlan0 managed no",
    "systemctl stop wpa_supplicant@wlan0.service",
    "ip link set wlan0 down",
    "ip -4 address flush dev wlan0",
    "iw dev wlan0 set type ibss",
    "iw dev wlan0 set power_save off",
    "ip link set wlan0 up",
    "iw dev wlan0 ibss join robots 2412 fixed-freq 02:ca:ff:ee:10:42",
]
LEFT = [
    "iw dev wlan0 ibss leave",
    "ip -4 address flush dev wlan0",
    "ip link set wlan0 down",
    "iw dev wlan0 set type managed",
    "iw dev wlan0 set power_save on",
    "ip link set wlan0 up",
    "ip address add 192.168.7.9/24 dev wlan0",
    "nmcli device set wlan0 managed yes",
    "systemctl start wpa_supplicant@wlan0.service",
]


def test_it_joins_and_everything_is_put_back(computer: Computer) -> None:
    """Seen to fail with each line of `put_back` left out."""
    assert adapter.join(None, CELL) == "wlan0"
    assert computer.changes() == [*ENTERED, "ip address add 10.42.0.254/24 dev wlan0"]
    assert computer.rfkill.read_text() == "0"
    computer.calls.clear()
    assert adapter.leave(None) == "wlan0"
    assert computer.changes() == LEFT
    assert computer.rfkill.read_text() == "1"
    with pytest.raises(adapter.RefusalError, match="is in no cell"):
        adapter.leave(None)


def test_who_joins_again_still_gets_back_what_was_first(computer: Computer) -> None:
    """Seen to fail when the second one kept its own state: power saving and the first address were gone."""
    adapter.join("wlan0", CELL)
    kept = adapter.file_of("wlan0").read_text()
    computer.rfkill.write_text("0")
    adapter.join("wlan0", CELL)
    assert adapter.file_of("wlan0").read_text() == kept


@pytest.mark.parametrize("fails", ["iw dev wlan0 ibss join", "iw dev wlan0 set type ibss", "ip address add 10.42"])
def test_what_fails_halfway_is_put_back(computer: Computer, fails: str) -> None:
    computer.fails = fails
    with pytest.raises(adapter.RefusalError, match="Operation not supported"):
        adapter.join("wlan0", CELL)
    assert computer.changes()[-len(LEFT) :] == LEFT
    assert not adapter.file_of("wlan0").exists()


def test_an_adapter_that_was_unplugged_leaves(computer: Computer, tmp_path: Path) -> None:
    adapter.join("wlan0", CELL)
    computer.calls.clear()
    (tmp_path / "sys" / "class" / "net" / "wlan0" / "phy80211").unlink()
    (tmp_path / "sys" / "class" / "net" / "wlan0").rmdir()
    adapter.leave("wlan0")
    assert computer.changes() == ["systemctl start wpa_supplicant@wlan0.service"]


def test_what_cannot_be_put_back_is_named_and_the_rest_is(computer: Computer) -> None:
    adapter.join("wlan0", CELL)
    computer.calls.clear()
    computer.fails = "ip link set wlan0 down"
    with pytest.raises(adapter.RefusalError, match="not all is as before: ip link set wlan0 down"):
        adapter.leave("wlan0")
    assert computer.changes() == LEFT


def without_ibss(computer: Computer) -> None:
    computer.info = PHY_INFO.replace("\t\t * IBSS\n", "").replace("software", "\t * IBSS\n\tsoftware")


def hard_switch(computer: Computer) -> None:
    computer.hard.write_text("1")


def other_bssid(computer: Computer) -> None:
    computer.joins = "5e:11:22:33:44:55"


def no_cell(computer: Computer) -> None:
    computer.joins = None


def same_subnet(computer: Computer) -> None:
    computer.others = [{"ifname": "eth0", "addr_info": [{"local": "10.42.0.9", "prefixlen": 24}]}]


@pytest.mark.parametrize(
    ("what", "frequency_mhz", "reason", "changed"),
    [
        (without_ibss, 2412, r"wlan0: its driver has no ad hoc mode \(IBSS\); adapters with", False),
        (lambda _: None, 5180, "has no channel of 5180 MHz; take another", False),
        (lambda _: None, 2484, "2484 MHz is marked 'disabled' .*iw reg set", False),
        (lambda _: None, 2467, "2467 MHz is marked 'no IR'", False),
        (hard_switch, 2412, "a switch of the computer turns radio off", False),
        (same_subnet, 2412, r"eth0: has 10\.42\.0\.9, .* ip address del 10\.42\.0\.9/24 dev eth0", False),
        (other_bssid, 2412, "is in the cell 5e:11:22:33:44:55 and not in 02:ca.*does not take a fixed BSSID", True),
        (no_cell, 2412, "is in the cell none", True),
    ],
)
def test_what_the_driver_lacks_is_explained(
    computer: Computer, what: Callable[[Computer], None], frequency_mhz: int, reason: str, changed: bool
) -> None:
    """Without a change, or with everything put back."""
    what(computer)
    wanted = adapter.Cell(CELL.ssid, frequency_mhz, CELL.bssid, CELL.address)
    with pytest.raises(adapter.RefusalError, match=reason):
        adapter.join(None, wanted)
    assert computer.changes() == ([*ENTERED, *LEFT] if changed else [])
    assert not adapter.file_of("wlan0").exists()


def test_an_adapter_has_to_be_there(computer: Computer) -> None:
    with pytest.raises(adapter.RefusalError, match=r"eth0: is no 802\.11 adapter of this computer; there is wlan0"):
        adapter.join("eth0", CELL)


def arguments(station: str | None) -> argparse.Namespace:
    return argparse.Namespace(adapter=None, station=station, inventory=paths.INVENTORY)


def test_the_cell_is_the_inventorys(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    asked: list[dict[str, object]] = []

    def as_root(do: str, words: str) -> str:
        asked.append({"do": do, **json.loads(words)})
        return "wlan0"

    monkeypatch.setattr(cell, "_as_root", as_root)
    cell.join(arguments(None))
    assert asked == [
        {
            "do": "join", "interface": None, "ssid": "flotilla", "frequency_mhz": 2412, "bssid": "02:ca:ff:ee:10:42",
            "address": "10.42.0.254/24",
        }
    ]  # fmt: skip
    assert "in the cell flotilla as station, 10.42.0.254" in capsys.readouterr().out


def test_a_station_has_to_be_of_the_fleet() -> None:
    with pytest.raises(UserError, match=r"inventory: stations: desk is none; there are station"):
        cell.join(arguments("desk"))
