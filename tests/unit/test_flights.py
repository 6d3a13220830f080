"""What a flight's figures may not show, and how the report marks it. No QEMU."""

from __future__ import annotations

from pathlib import Path

import pytest

from flotilla.lab.scenarios import report
from flotilla.lab.scenarios.flight import Flight, Record

PERIOD_NS = 10_000_000


def flight(*four_hops_us: int, last_hop_us: int = 100) -> Flight:
    """A step for each latency; only what the hops' figures need."""

    def step(number: int, latency_us: int) -> Record:
        sensed_ns = number * PERIOD_NS
        valves_ns = sensed_ns + latency_us * 1000
        mapping_ns = valves_ns - last_hop_us * 1000
        return {
            "sequence": number, "number": number, "sensed_ns": sensed_ns, "navigation_ns": sensed_ns + 100_000,
            "control_ns": sensed_ns + 200_000, "mapping_ns": mapping_ns, "valves_ns": valves_ns,
            "now_ns": valves_ns, "offset_ns": 0, "time_ns": valves_ns,
        }  # fmt: skip

    still = {"pose": (0, 0, 0), "velocity": (0, 0, 0), "on_time": [0] * 8, "switches": [0] * 8}
    return Flight(
        [still | {"time_ns": end * PERIOD_NS} for end in range(2)],
        [step(number, us) for number, us in enumerate(four_hops_us, 1)],
        [],
    )


def test_a_flight_within_the_limit_has_no_faults() -> None:
    assert flight(2000, 9999).faults(disturbed=False) == []


def test_what_takes_a_period_is_late() -> None:
    found = flight(2000, 10_000, 10_970)
    assert found.late() == 2
    assert found.faults(disturbed=False) == ["four hops: 2 of 3 steps took 10000 µs or more, 10970 µs at most"]
    assert found.faults(disturbed=True) == [], "it was delayed on purpose"


@pytest.mark.parametrize("disturbed", [True, False])
def test_a_message_cannot_arrive_before_it_was_sent(disturbed: bool) -> None:
    assert flight(2000, 3000, last_hop_us=-21).faults(disturbed=disturbed) == [
        "thruster mapping → valves: 2 of 2 messages arrived before they were sent, -21 µs"
    ]


def test_steps_count_from_when_the_path_is_flown() -> None:
    """Seen to fail with all steps that arrived."""
    found = flight(12_000, 2000, 3000)
    found.controls = [{"number": 2, "flying": True, "done": False}]
    assert found.late() == 0
    assert found.latency().samples == 2
    assert found.start_up_us == 12_000


@pytest.mark.parametrize(("at_ns", "overruns"), [(999, 0), (1000, 3), (None, 3)])
def test_overruns_count_from_when_the_path_is_flown(at_ns: int | None, overruns: int) -> None:
    """Guests in lock-step say no time: they count from there. Seen to fail with all overruns."""
    found = flight(2000)
    found.controls = [{"number": 1, "time_ns": 1000, "flying": True, "done": False}]
    found.statistics = {"valves": {"overruns": 3} | ({"last_overrun": {"at_ns": at_ns}} if at_ns else {})}
    assert found.overruns("valves") == overruns


def test_clocks_of_several_computers_are_not_compared() -> None:
    found = flight(12_000, last_hop_us=-21)
    found.one_clock = False
    assert found.faults(disturbed=False) == []


def test_tasks_that_measure_no_jitter_have_overruns_all_the_same() -> None:
    """As those of guests in lock-step. Seen to fail: such a flight had no page."""
    found = flight(2000)
    found.statistics = {"plant": {"overruns": 1, "jitter": {"max_ns": 7000}}}
    assert report.summary(found)["jitter_max_us"] == 7
    found.statistics["valves"] = {"overruns": 2}
    assert report.summary(found)["overruns"] == 3
    assert "jitter_max_us" not in report.summary(found)


def test_the_page_marks_what_is_late_and_what_cannot_be(tmp_path: Path) -> None:
    def marks(found: Flight) -> int:
        return report.write({"square": found}, tmp_path).read_text().count('class="missed"')

    assert marks(flight(2000)) == 0
    assert marks(flight(12_000)) == 2
    assert marks(flight(2000, last_hop_us=-21)) == 1


def test_the_trajectory_is_a_file_of_its_own(tmp_path: Path) -> None:
    """The README shows one. Seen to fail: that picture had to be cut out of the page."""
    report.write({"no path": flight(2000)}, tmp_path)
    assert not (tmp_path / "scenarios.svg").exists()
    found = flight(2000)
    found.controls = [
        {"number": number, "time_ns": number * PERIOD_NS // 2, "flying": True, "done": number == 2, "wanted": (0.1, 0)}
        for number in range(3)
    ]
    report.write({"no path": flight(2000), "square": found}, tmp_path)
    assert "Trajectory" in (tmp_path / "scenarios.svg").read_text()
