"""What a fleet sends, by its description, and how many robots a cell carries by simulation and by computation.

Seen to fail by planted mistakes: frames without LLC and MAC headers, reports or beacons left out (air by hand),
triggers that nothing follows, lost steps that do not count, a standby that triggers too, no update, every size carried,
DDS without its headers, and a seed that is not used.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from flotilla.cli.main import main
from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import inventory
from flotilla.fleet.model import Fleet
from flotilla.lab.radio import capacity, command, load, model, phy, report, traffic
from flotilla.lab.radio.load import Setting

M = 1_000_000
CHAIN = "sensors → state → wrench → valves"
LIMIT_NS = 10_000_000
B = Setting(phy.B, 11 * M)


@pytest.fixture(scope="module")
def published() -> Fleet:
    return inventory.load_fleet(command.PUBLISHED)


@pytest.fixture(scope="module")
def four(published: Fleet) -> traffic.Description:
    return traffic.describe(published)


def with_network(fleet: Fleet, **values: object) -> Fleet:
    return fleet.model_copy(update={"network": fleet.network.model_copy(update=values)})


def test_the_description_says_what_is_sent(published: Fleet, four: traffic.Description) -> None:
    """Bytes of signals by messages.yml, 28 of IPv4 and UDP, and 40 of the proof of their sender; hops follow triggers,
    from task to task."""
    sent = {flow.name: flow for task in four.tasks for flow in task.flows}
    assert {name: (flow.sender, flow.receivers, flow.every) for name, flow in sent.items()} == {
        "sensors": (0, (1,), 1), "state": (1, (2,), 1), "wrench": (2, (3,), 1), "valves": (3, (0,), 1),
        "valves-report": (0, (4,), 1), "control-report": (2, (4,), 10),
    }  # fmt: skip
    assert {name: flow.packet for name, flow in sent.items()} == {
        name: published.messages[name].bytes + 28 + 40 for name in sent
    }
    assert [(chain.name, chain.period_ns) for chain in four.chains] == [(CHAIN, LIMIT_NS)]
    assert [(flow.receivers, flow.packet, period_ns) for flow, period_ns in four.positions] == [((0,), 84, LIMIT_NS)]


def test_by_dds_messages_are_longer_and_programs_announce_themselves(
    published: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_dds = traffic.describe(with_network(published, transport="dds"))
    sent = {flow.name: flow.packet for task in by_dds.tasks for flow in task.flows}
    assert sent["sensors"] == published.messages["sensors"].bytes + 28 + 80
    assert sent["valves-report"] == published.messages["valves-report"].bytes + 28 + 40, "reports go by UDP"
    assert [chain.name for chain in by_dds.chains] == [CHAIN]
    assert by_dds.dds_peers == {0: (2, 3), 1: (1, 2), 2: (1, 2), 3: (1, 2)}
    monkeypatch.setattr(load, "SPDP_NS", 10**9)
    found = load.run(by_dds, B, 1, 1)
    # 5 programs, each to every other robot's ports: robot 1 to 6, its second program too, others to 7 of 9.
    assert found.messages["DDS discovery"].sent == 2 * 6 + 3 * 7


def test_a_standby_sends_too_and_triggers_nothing(published: Fleet) -> None:
    robots = dict(published.robots)
    robots[2] = robots[2].model_copy(update={"control_tasks": ["navigation", "control"], "standby": ["control"]})
    described = traffic.describe(published.model_copy(update={"robots": robots}))
    wrenches = {flow.sender: flow for task in described.tasks for flow in task.flows if flow.name == "wrench"}
    assert sorted(wrenches) == [1, 2]
    assert wrenches[2].triggers
    assert not wrenches[1].triggers
    assert load.run(described, B, 1, 1).messages["wrench"].sent == pytest.approx(200, abs=2)


def test_where_stations_alone_listen_each_report_is_judged() -> None:
    """The wheeled robot's: ten a second of its driving, two of what it sees."""
    described = traffic.describe(inventory.load_fleet(paths.PROJECT / "flotilla/lab" / "wheeled" / "inventory"))
    periods_ns = {"drive-report": 100_000_000, "perceive-report": 500_000_000}
    assert {chain.name: chain.period_ns for chain in described.chains} == periods_ns
    chains = load.run(described, B, 1, 2).chains
    assert {name: chains[name].sent for name in periods_ns} == {"drive-report": 20, "perceive-report": 4}


def test_a_fleet_that_sends_nothing_has_no_answer() -> None:
    with pytest.raises(UserError, match=r"list control tasks in robots\.yml"):
        traffic.describe(inventory.load_fleet())


def test_air_time_by_hand(four: traffic.Description) -> None:
    """802.11b, 11 Mbit/s, long preamble, ACK at 2 Mbit/s: frames with 36 bytes of LLC and MAC, 0.625 NTP packets, and
    beacons at 1 Mbit/s."""
    sizes = {174: 100, 185: 100, 161: 100, 173: 100, 193: 100, 120: 100, 202: 10, 132: 0.625}
    air = sum(rate * (192 + -(-8 * size // 11) + 10 + 248) for size, rate in sizes.items()) / 1e6
    air += (192 + 8 * (28 + 12 + 2 + 8 + 10 + 3 + 4)) / 102_400
    computed = model.compute(four, B, 1)
    assert computed.air == pytest.approx(air, rel=0.002)
    assert load.run(four, B, 1, 4).busy == pytest.approx(air, rel=0.05), "SIFS is not busy, beacons not exact"


def test_the_computed_cell_is_saturated_where_the_simulated_one_is(four: traffic.Description) -> None:
    """Three groups offer more than the time of 802.11b, two what a saturated cell carries."""
    offered = [model.compute(four, B, groups) for groups in (1, 2, 3)]
    assert [round(each.utilisation, 1) for each in offered] == [0.5, 1.0, 1.5]
    saturated = load.run(four, B, 3, 1)
    assert saturated.busy == pytest.approx(load.run(four, B, 4, 1).busy, rel=0.03), "more robots bring no more"
    assert saturated.chains[CHAIN].percentile_ms(50) > 10 * offered[0].chain_ms[CHAIN]


def test_the_published_four_are_on_time_and_eight_at_11_mbit_s_are_not(four: traffic.Description) -> None:
    """Published: four computers, four hops at 100 Hz, within 10 ms."""
    found = load.run(four, B, 1, 4).chains[CHAIN]
    assert found.sent == 400
    assert found.missed(LIMIT_NS) == 0
    assert found.percentile_ms(100) < 10
    assert found.percentile_ms(50) > 4 * 0.4 * 0.9 + 4 * 0.28, "four computers and four frames at least"
    assert load.run(four, B, 2, 2).chains[CHAIN].missed(LIMIT_NS) > 0.05
    assert load.run(four, Setting(phy.G, 54 * M), 2, 2).chains[CHAIN].missed(LIMIT_NS) == 0


def test_an_update_takes_its_share_of_the_air(four: traffic.Description) -> None:
    """300 kbit/s of Ethernet frames; at 1 Mbit/s with 802.11's headers and preamble 0.33 of the time."""
    quiet, updating = (load.run(four, dataclasses.replace(B, update=update), 1, 2) for update in (False, True))
    share = (192 + 8 * (548 + 36)) / (562 * 8 / 0.3)
    assert updating.busy - quiet.busy == pytest.approx(share, rel=0.05)
    assert updating.chains[CHAIN].percentile_ms(99) > quiet.chains[CHAIN].percentile_ms(99)
    computed = [model.compute(four, dataclasses.replace(B, update=update), 1).air for update in (False, True)]
    assert computed[1] - computed[0] == pytest.approx(share, rel=0.01)


def test_what_nobody_hears_is_lost_and_counts(four: traffic.Description) -> None:
    """Over 5 km members are out of range of each other: nothing arrives, all is missed, and silence is not heard."""
    far = load.run(four, dataclasses.replace(B, area_m=5_000.0), 1, 1)
    assert far.chains[CHAIN].missed(LIMIT_NS) == 1
    assert far.counts.given_up > 50
    assert far.messages["sensors"].lost() == far.messages["sensors"].sent > 90


def test_the_search_ends_where_deadlines_do(four: traffic.Description) -> None:
    told: list[int] = []
    curve = capacity.find(
        four, B, seconds=1, limit_ms=None, percent=1, done=lambda point: told.append(point.simulated.robots)
    )
    assert (curve.carries, curve.ends_at) == (4, 8)
    assert told == [point.simulated.robots for point in curve.points] == [4, 8, 12]
    for limit_ms, percent in ((1000.0, 1.0), (None, 50.0)):
        assert capacity.measure(four, B, 2, seconds=2, limit_ms=limit_ms, percent=percent).carried


def test_runs_of_one_size_are_judged_together(four: traffic.Description) -> None:
    runs = [load.run(four, dataclasses.replace(B, seed=seed), 1, 0.5) for seed in (1, 2)]
    both = load.merged(runs)
    assert both.seconds == 1
    assert both.chains[CHAIN].sent == 100
    assert both.chains[CHAIN].latencies_ns == [each for run in runs for each in run.chains[CHAIN].latencies_ns]
    assert both.counts.frames == sum(run.counts.frames for run in runs)
    assert both.busy == pytest.approx((runs[0].busy + runs[1].busy) / 2)
    assert both.silence_ms["state"] == max(run.silence_ms["state"] for run in runs)


def test_a_run_repeats_and_the_seed_counts(four: traffic.Description) -> None:
    first, again, other = (load.run(four, dataclasses.replace(B, seed=seed), 2, 0.5) for seed in (1, 1, 2))
    assert first == again
    assert first.chains != other.chains


def told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    monkeypatch.setattr("sys.argv", ["flotilla", "radio-capacity", *words])
    try:
        status = main()
    except SystemExit as ended:
        status = int(ended.code or 0)
    said = capsys.readouterr()
    return int(status or 0), said.out + said.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--standard", "n"], "STANDARD=n: is not known; take one of b, b-short, g, g-mixed"),
        (["--rate", "12M", "--standard", "b"], "RATE=12M: 802.11b has no such rate; take one of 1M, 2M, 5.5M, 11M"),
        (["--rate", "13M"], "RATE=13M: neither standard has it"),
        (["--area", "-3"], "AREA=-3: is out of range; give 1 to 100000 m"),
        (["--missed", "all"], "MISSED=all: is out of range; give 0 to 100 %"),
        (["--seconds", "nan"], "SECONDS=nan: is out of range"),
        (["--seed", "1.5"], "SEED=1.5: is no whole number"),
        (["--phases", "late"], "PHASES=late: is not known; take aligned or random"),
        (["--inventory", "/nowhere"], "INVENTORY=/nowhere: there is no such directory"),
    ],
)
def test_wrong_values_are_named_with_key_and_remedy(
    words: list[str], said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    status, text = told(monkeypatch, capsys, *words)
    assert status == 1
    assert said in text


def test_the_command_answers_and_writes_a_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(paths, "BUILD", tmp_path)
    pages = []
    for _ in range(2):
        status, text = told(monkeypatch, capsys, "--standard", "b", "--seconds", "0.5")
        assert status == 0, text
        assert "802.11b, 11 Mbit/s: carries 4 robots; with 8, " in text
        pages.append((tmp_path / "reports" / "radio-capacity.html").read_bytes())
    assert pages[0] == pages[1], "a run repeats to the byte"
    assert pages[0].count(b"<svg") == 2
    found: list[dict[str, Any]] = json.loads((tmp_path / "reports" / "radio-capacity.json").read_text())
    assert (found[0]["carries"], found[0]["ends_at"]) == (4, 8)
    assert [size["robots"] for size in found[0]["chains"][0]["sizes"]] == [4, 8, 12]


def test_rates_choose_standards() -> None:
    assert [(each.name, rate // M) for each, rate in command.chosen(None, None)] == [("b", 11), ("g", 54)]
    assert [(each.name, rate // M) for each, rate in command.chosen(None, "24M")] == [("g", 24)]
    assert [(each.name, rate) for each, rate in command.chosen("b", "5.5M")] == [("b", 5_500_000)]
    assert report.rates(phy.B) == "1M, 2M, 5.5M, 11M"
