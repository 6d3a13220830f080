"""Pages that the project writes, opened in a browser: they need nothing from elsewhere, and show all they have.

The pictures of each page go to `build/reports/`, to be looked at.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.fleet.model import Fleet
from flotilla.lab.latency import gate, report, results
from flotilla.lab.scenarios import report as flights_report
from flotilla.lab.scenarios import virtual
from flotilla.lab.scenarios.flight import Flight
from flotilla.lab.scenarios.plans import TESTED_SIDE_M, plans
from flotilla.station import report as station_report
from tests.browser import Browser
from tests.runtime import test_recorded_drive

command = test_recorded_drive.command
files = test_recorded_drive.files

pytestmark = pytest.mark.nightly

WIDTHS_PX = (1400, 800)
PICTURES = paths.BUILD / "reports"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser() as browser:
        yield browser


def looked_at(browser: Browser, page: Path) -> str:
    """The page's text, after what holds for every page."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    for width_px in WIDTHS_PX:
        look = browser.look(page, PICTURES / f"{page.stem}-{width_px}.png", width_px=width_px)
        assert look.requests == []
        assert look.complaints == []
        assert look.pictures > 0
        assert look.empty_pictures == 0
        assert look.overflow_px <= 0, f"{width_px} px: wider than the window by {look.overflow_px} px"
        assert not {"nan", "None", "undefined"} & set(look.text.split())
    return look.text


def test_a_browser_sees_what_is_wrong(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text('<img src="absent.png"><div style="width: 3000px">None</div><script>absent()</script>')
    look = browser.look(page, tmp_path / "page.png", width_px=800)
    assert look.requests == [(tmp_path / "absent.png").as_uri()]
    assert any("ERR_FILE_NOT_FOUND" in complaint for complaint in look.complaints)
    assert any("Uncaught" in complaint for complaint in look.complaints)
    assert look.pictures == 1
    assert look.overflow_px > 2000
    assert look.text == "None"


def test_latency(browser: Browser, artefacts: Path) -> None:
    runs = [results.read(file) for file in sorted(gate.BASELINES.glob("*.json"))]
    text = looked_at(browser, report.write(runs, artefacts))
    assert all(report.label(run) in text for run in runs)


def test_flights(browser: Browser, fleet: Fleet, artefacts: Path) -> None:
    board = fleet.board().model_copy(update={"kernel": "lean"})
    chosen = [plan for plan in plans(TESTED_SIDE_M) if plan.name in ("udp", "cut-open-no-timeout")]
    flown = virtual.fly(chosen, board, artefacts / "flights")
    flights = {plan.title: Flight.read(flown[plan.name]) for plan in chosen}
    text = looked_at(browser, flights_report.write(flights, artefacts))
    assert all(title in text for title in flights)
    recorded = sorted(flown["udp"].glob("*/*.rec"))
    text = looked_at(browser, station_report.write(recorded, artefacts / "recorded-flight.html"))
    assert all(f"/{name}" in text for name in ("flown", "steps", "controls"))
    assert "distance from commanded" in text


def test_a_recorded_drive(browser: Browser, files: list[Path], artefacts: Path) -> None:
    text = looked_at(browser, station_report.write(files, artefacts / "recorded-drive.html"))
    assert "speeds, commanded and driven" in text
    assert "limited" in text
