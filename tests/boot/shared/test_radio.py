"""The ad hoc radio, with simulated ones."""

from __future__ import annotations

import json
from pathlib import Path, PurePosixPath

from flotilla.fleet import identity
from flotilla.fleet.model import Fleet
from flotilla.station import adapter
from tests.boot.guests import SECONDS, sh, until
from tests.conftest import RobotGuest


def test_radio_joins_the_cell_whenever_it_is_plugged_in(pentium: RobotGuest, fleet: Fleet) -> None:
    """With simulated radios, and the files that a fleet with `link: ibss` would have."""
    assert fleet.network.ibss
    radio = fleet.network.model_copy(update={"link": "ibss"})
    rendered = identity.render(fleet.model_copy(update={"network": radio}), pentium.robot)
    rules = rendered[PurePosixPath("/etc/udev/rules.d/70-robot.rules")][0]
    cell = f"Joined IBSS {fleet.network.ibss.bssid} (on wlan0)"
    try:
        sh(pentium, "mkdir -p /run/udev/rules.d")
        for path, content in (
            ("/etc/flotilla/ibss.conf", rendered[PurePosixPath("/etc/flotilla/ibss.conf")][0]),
            ("/run/udev/rules.d/71-a-test.rules", rules),
        ):
            pentium.shell.run(["sudo", "tee", path], stdin=content.decode())
        sh(pentium, "udevadm control --reload")
        for plugged in ("plugged in", "plugged in again"):
            sh(pentium, "modprobe mac80211_hwsim radios=2")
            until(pentium, "systemctl -q is-active flotilla-ibss@wlan0")
            link = sh(pentium, "iw dev wlan0 link")
            assert cell in link, f"{plugged}: {link}"
            assert f"SSID: {fleet.network.ibss.ssid}" in link, f"{plugged}: {link}"
            assert f"freq: {fleet.network.ibss.frequency_mhz}" in link, f"{plugged}: {link}"
            assert "type IBSS" in sh(pentium, "iw dev wlan0 info")
            assert "type managed" in sh(pentium, "iw dev wlan1 info"), (
                "the radio that no unit was started for joined too"
            )
            sh(pentium, "modprobe -r mac80211_hwsim")
            until(pentium, "! systemctl -q is-active flotilla-ibss@wlan0")
    finally:
        sh(pentium, "rm -f /etc/flotilla/ibss.conf /run/udev/rules.d/71-a-test.rules; udevadm control --reload")
        sh(pentium, "modprobe -r mac80211_hwsim cfg80211; systemctl reset-failed", check=False)
    assert sh(pentium, "ls /sys/class/ieee80211", check=False) == ""


def test_a_station_joins_the_cell_and_leaves_it(pentium: RobotGuest, fleet: Fleet) -> None:
    """The program of `make station-join` with a real iw and kernel; the guest stands in for a desktop computer.

    A robot's radio is in the cell already. `nmcli` is a script that notes what it is asked. Seen to fail
    where `leave` did not set the adapter's type back.
    """
    assert fleet.network.ibss
    ibss = fleet.network.ibss
    wanted = {
        "interface": "wlan1", "ssid": ibss.ssid, "frequency_mhz": ibss.frequency_mhz, "bssid": ibss.bssid,
        "address": "192.0.2.254/24",
    }  # fmt: skip
    nmcli = """#!/bin/sh
echo "$@" >>/run/desk/asked
case "$*" in *DEVICE,STATE*) echo wlan1:disconnected ;; esac
"""

    def program(*words: str) -> str:
        line = " ".join(f"'{word}'" for word in words)
        return sh(pentium, f"PATH=/run/desk:$PATH python3 -I /run/desk/adapter.py {line} 2>&1", check=False)

    def state() -> str:
        return sh(pentium, "ip -4 -o address show dev wlan1; iw dev wlan1 info; ip -o link show wlan1 | cut -d' ' -f3")

    try:
        sh(pentium, "mkdir -p /run/desk; modprobe mac80211_hwsim radios=2")
        for name, content in (("adapter.py", Path(adapter.__file__).read_text()), ("nmcli", nmcli)):
            pentium.shell.run(["sudo", "tee", f"/run/desk/{name}"], stdin=content)
        sh(pentium, "chmod +x /run/desk/nmcli; ip link set wlan1 up; ip address add 198.51.100.7/24 dev wlan1")
        sh(pentium, "ip netns add robot; iw phy phy0 set netns name robot")
        robot = "ip netns exec robot"
        sh(pentium, f"{robot} iw dev wlan0 set type ibss; {robot} ip link set wlan0 up")
        sh(pentium, f"{robot} ip address add 192.0.2.1/24 dev wlan0")
        sh(pentium, f"{robot} iw dev wlan0 ibss join {ibss.ssid} {ibss.frequency_mhz} fixed-freq {ibss.bssid}")
        before = state()
        assert program("join", json.dumps(wanted)) == "wlan1"
        assert f"Joined IBSS {ibss.bssid}" in sh(pentium, "iw dev wlan1 link")
        assert "1 received" in sh(pentium, f"ping -c 1 -w {SECONDS} 192.0.2.1")
        assert "device set wlan1 managed no" in sh(pentium, "cat /run/desk/asked")
        assert program("leave") == "wlan1"
        assert state() == before
        assert sh(pentium, "tail -n 1 /run/desk/asked") == "device set wlan1 managed yes"
        refused = program("join", json.dumps(wanted | {"frequency_mhz": 2484}))
        assert "2484 MHz" in refused
        assert state() == before
    finally:
        sh(pentium, "ip netns delete robot; rm -rf /run/desk /run/flotilla/wlan1.json", check=False)
        sh(pentium, "modprobe -r mac80211_hwsim cfg80211; systemctl reset-failed", check=False)
    assert sh(pentium, "ls /sys/class/ieee80211", check=False) == ""
