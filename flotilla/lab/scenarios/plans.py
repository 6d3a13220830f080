"""The flights: the published experiment's three tests, and what it did not try."""

from __future__ import annotations

from dataclasses import replace

from flotilla.lab.scenarios.virtual import Event, Plan, square

SIDE_M = 1.0
"""Of the published square, flown at 1 cm/s."""
TESTED_SIDE_M = 0.03
"""Of the square that every test run flies."""
CUT_S = 2.5
_CUT = (Event.on(CUT_S, "robot1", "iw", "dev", "wlan0", "ibss", "leave"),)
_LOSS = tuple(
    Event.on(0, f"robot{number}", "tc", "qdisc", "add", "dev", "wlan0", "root", "netem", "loss", "10%")
    for number in range(1, 5)
)
_DISORDER = tuple(
    Event.on(
        0, f"robot{number}", "tc", "qdisc", "add", "dev", "wlan0", "root", "netem",
        "delay", "2ms", "1ms", "distribution", "normal", "reorder", "20%", "duplicate", "5%",
    )
    for number in range(1, 5)
)  # fmt: skip
_GAPS = (
    Event(6, "power-off", ["robot4"]),
    Event(7, "power-on", ["robot4"]),
    Event.on(10, "robot3", "iw", "dev", "wlan0", "ibss", "leave"),
    Event.on(10.5, "robot3", "/usr/lib/flotilla/ibss", "wlan0"),
)
_CONTROL_LOST = (Event(6, "power-off", ["robot3"]), Event(10.5, "power-on", ["robot3"]))
"""Over two sides of the square."""
_FIRST_ALONE = Event(13.5, "lose", ["control-standby"])
_STANDBY = {"robot2": "control"}
_DDS_LATER_S = 4
"""Tasks that use DDS take that much longer to start, as long as all share one processor."""
_SECURED_LATER_S = 34
"""With certificates: five programs prove who they are to each other first."""
_ANNOUNCED_S = 36
"""By then each DDS program has announced itself to all others once more, as it does every 28 s."""
STATION_GONE_S = 4
"""Before the flight's end."""
_SPIN = {"initial_velocity": [0, 0, 1]}
"""With 1 rad/s the thrusters have to turn for four seconds: they do when the link is cut."""


def plans(side_m: float = SIDE_M) -> tuple[Plan, ...]:
    by_dds = square("dds", "the square, by DDS", side_m, transport="dds")
    return (
        square("udp", "the square, by UDP", side_m),
        square("air", "the square, over the air of 802.11b", side_m, air_loss=0),
        replace(by_dds, seconds=max(by_dds.seconds, _ANNOUNCED_S)),
        square("loss", "the square, each radio losing a tenth", side_m, events=_LOSS),
        _strangers(side_m),
        Plan("cut-open", "the link cut, valves open", 8, events=_CUT, plant=_SPIN),
        Plan(
            "cut-open-no-timeout", "the link cut, valves open, without a time-out", 8, events=_CUT, plant=_SPIN,
            changes={"valves.relays.timeout": 60},
        ),
    )  # fmt: skip


def disturbed(side_m: float) -> tuple[Plan, ...]:
    """Further disturbances of the network, by UDP; apart from the others for their time."""
    return (
        square("disorder", "the square, packets late, out of order and twice", side_m, events=_DISORDER),
        square("gaps", "the square, one computer without power for a second, then one alone", side_m, events=_GAPS),
        Plan("cut-closed", "the link cut, valves closed", 8, events=_CUT, plant={"initial_velocity": [0.01, 0, 0]}),
    )


def standby(side_m: float) -> tuple[Plan, ...]:
    """The controller's computer loses power, with and without another that stands by; by UDP it returns.

    By DDS it does not: a task that starts to use DDS keeps the one processor, which is all computers, from control for
    more than a second. Apart from the others, because tests fly these in a guest of their own.
    """
    lost, _ = _CONTROL_LOST
    return (
        square(
            "standby", "the square, another computer takes over control and hands back", side_m,
            events=(*_CONTROL_LOST, _FIRST_ALONE), standby=_STANDBY,
        ),
        square(
            "standby-dds", "the square, another computer takes over control, by DDS", side_m, transport="dds",
            events=(replace(lost, at_s=lost.at_s + _DDS_LATER_S),), standby=_STANDBY,
            seconds=4 * side_m / 0.01 + 6 + _DDS_LATER_S,
        ),
        square("no-standby", "the same without another", side_m, events=_CONTROL_LOST, seconds=12),
    )  # fmt: skip


def over_the_air(side_m: float) -> tuple[Plan, ...]:
    """The air of 802.11b that loses frames, that is cut, and that DDS uses; apart from the others for their time."""
    by_dds = square("air-dds", "the square, by DDS, over the air of 802.11b", side_m, transport="dds", air_loss=0)
    title = "the link cut, valves open, over the air of 802.11b that loses a tenth"
    return (
        *(
            square(f"air-{percent}", f"the square, over the air that loses {percent} %", side_m, air_loss=percent / 100)
            for percent in (1, 5, 10)
        ),
        replace(by_dds, seconds=max(by_dds.seconds, _ANNOUNCED_S)),
        # Longer than without air: in lock-step the robot's own service looks for the cell, at any time within 5 s.
        Plan("air-cut-open", title, 12, events=_CUT, plant=_SPIN, air_loss=0.1),
    )


def _strangers(side_m: float) -> Plan:
    title = "the square, a stranger and a second station in the cell, the clock set, at last not the first station"
    plan = square("strangers", title, side_m, stranger=True, second_station=True)
    seconds = plan.seconds + STATION_GONE_S
    events = (Event(5, "run", ["date", "--set", "+1 hour"]), Event(plan.seconds, "lose", ["station"]))
    return replace(plan, seconds=seconds, events=events)


def secured(side_m: float) -> tuple[Plan, ...]:
    """By DDS with certificates, by guests in lock-step: to prove who is who takes more than the one processor that all
    computers of other flights share."""
    title = "the square, by DDS, with certificates, over the air of 802.11b"
    by_dds = square("air-dds-secured", title, side_m, transport="dds", dds_security=True, air_loss=0)
    return (replace(by_dds, seconds=by_dds.seconds + _SECURED_LATER_S),)
