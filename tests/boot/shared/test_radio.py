"""The ad hoc radio, with simulated ones."""

from __future__ import annotations

from pathlib import PurePosixPath

from flotilla.fleet import identity
from flotilla.fleet.model import Fleet
from tests.boot.guests import sh
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
            sh(pentium, "timeout 30 sh -c 'until systemctl -q is-active flotilla-ibss@wlan0; do sleep 0.2; done'")
            link = sh(pentium, "iw dev wlan0 link")
            assert cell in link, f"{plugged}: {link}"
            assert f"SSID: {fleet.network.ibss.ssid}" in link, f"{plugged}: {link}"
            assert f"freq: {fleet.network.ibss.frequency_mhz}" in link, f"{plugged}: {link}"
            assert "type IBSS" in sh(pentium, "iw dev wlan0 info")
            assert "type managed" in sh(pentium, "iw dev wlan1 info"), (
                "the radio that no unit was started for joined too"
            )
            sh(pentium, "modprobe -r mac80211_hwsim")
            sh(pentium, "timeout 30 sh -c 'while systemctl -q is-active flotilla-ibss@wlan0; do sleep 0.2; done'")
    finally:
        sh(pentium, "rm -f /etc/flotilla/ibss.conf /run/udev/rules.d/71-a-test.rules; udevadm control --reload")
        sh(pentium, "modprobe -r mac80211_hwsim cfg80211; systemctl reset-failed", check=False)
    assert sh(pentium, "ls /sys/class/ieee80211", check=False) == ""
