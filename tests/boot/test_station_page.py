"""The station's page drives the wheeled robot's shipped image: a real browser, the real program, real tasks in a guest
in real time. How fast that goes depends on the host, so only what comes of it is judged; what a key takes is printed.

One robot, one station and one browser for all tests; each leaves the robot at rest and held by nobody. Signals,
parameters and stop all are not tried on a guest. What needs no guest is in tests/runtime/test_station_page.py.
"""

from __future__ import annotations

import functools
import json
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from flotilla.lab.wheeled import live
from flotilla.lab.wheeled.live import Live
from flotilla.robot import ssh
from tests.browser import Browser, Page
from tests.figures import PROPERTY
from tests.station import station
from tests.station_page import Station, connected

PATIENCE_S = 300
"""Until something comes of what a browser does; only finite."""
PRESSED = 8
"""Keys whose latency is measured."""


@pytest.fixture(scope="module")
def directory(session_artefacts: Path) -> Path:
    return session_artefacts / "station-page"


@pytest.fixture(scope="module")
def there(directory: Path) -> Iterator[Live]:
    with live.robots(1, "corner", directory) as there:
        yield there


@pytest.fixture(scope="module")
def served(there: Live, directory: Path) -> Iterator[Station]:
    """It reaches the guest's SSH as that of `make wheeled`."""
    patch = pytest.MonkeyPatch()
    patch.setattr(ssh, "RUN", directory / "build" / "run")
    environment = {"KEYS": str(directory / "keys"), "BUILD": str(directory / "build")}
    one = there.robots[0]
    try:
        with (
            ssh.announced(one.robot, one.ssh_port),
            station(
                there.inventory, "station", "--port", "0", environment=environment, address=there.station_address
            ) as process,
        ):
            yield Station(process)
    finally:
        patch.undo()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser() as browser:
        yield browser


@pytest.fixture
def page(browser: Browser, served: Station, there: Live) -> Iterator[Page]:
    page = connected(browser.page(height_px=1000), served.url)
    yield page
    assert page.complaints == []
    page.close()
    rests(there)


@pytest.fixture
def driver(page: Page, there: Live) -> Page:
    """Holds the robot, whose motors are on."""
    page.click("#take")
    page.until("document.querySelector('#holder').textContent === 'you command'")
    page.click("#enable")
    there.until(lambda: there.report()["left"] and there.report()["right"], PATIENCE_S, "the motors are on")
    return page


def rests(there: Live) -> None:
    """Its wheels do."""
    there.until(lambda: max(map(abs, there.report()["motion"])) < 0.01, PATIENCE_S, "it is at rest")


def turns(there: Live, left: int) -> bool:
    """Whether its wheels are to: 1 to the left, −1 to the right."""
    return bool(there.report()["wanted"][1] * left > 0)


def test_keys_move_the_real_tasks(
    driver: Page, there: Live, artefacts: Path, record_property: Callable[[str, object], None]
) -> None:
    """Ahead while a key is held, at rest once it is let go; the page shows where it is."""
    before = there.truth()["pose"][0]
    driver.key("KeyW", True)
    there.until(lambda: there.truth()["pose"][0] > before + 0.2, PATIENCE_S, "it goes ahead")
    driver.picture(artefacts / "driving.png")
    driver.key("KeyW", False)
    rests(there)
    assert there.report()["alive"], "the station went silent"
    x = there.report()["pose"][0]
    driver.until(f"Math.abs(parseFloat(document.querySelector('.figures b').textContent) - {x}) < 0.05")
    took_ms = []
    for number in range(PRESSED):
        left = 1 if number % 2 == 0 else -1
        begun = time.monotonic()
        driver.key("ArrowLeft" if left > 0 else "ArrowRight", True)
        there.until(functools.partial(turns, there, left), PATIENCE_S, "it turns")
        took_ms.append(1000 * (time.monotonic() - begun))
        driver.key("ArrowLeft" if left > 0 else "ArrowRight", False)
        there.until(lambda: there.report()["wanted"][1] == 0, PATIENCE_S, "it is to rest")
    rests(there)
    record_property(
        PROPERTY,
        f"from a key in the browser to the robot's report that its wheels are to turn, one each 100 ms of the guest: "
        f"median {statistics.median(took_ms):.0f} ms, longest {max(took_ms):.0f} ms of {PRESSED}",
    )


def test_a_handover_changes_whom_the_robot_obeys(driver: Page, browser: Browser, served: Station, there: Live) -> None:
    """The second browser sees why it cannot command, asks, and drives once the first one hands over."""
    second = connected(browser.page(), served.url)
    second.until("document.querySelector('#why').textContent.startsWith('You cannot command: browser')")
    second.click("#ask")
    driver.until("document.querySelector('.offer')")
    driver.click(".offer")
    second.until("!document.querySelector('#accept').hidden")
    second.click("#accept")
    second.until("document.querySelector('#holder').textContent === 'you command'")
    second.click("#enable")
    there.until(lambda: there.report()["left"] and there.report()["alive"], PATIENCE_S, "it obeys the second one")
    second.key("ArrowLeft", True)
    there.until(lambda: there.truth()["motion"][1] > 0.1, PATIENCE_S, "it turns to the left")
    driver.until("document.querySelector('#why').textContent.startsWith('You cannot command: browser')")
    second.close()  # with the key held
    rests(there)


def test_a_browser_that_is_closed_stops_the_robot(driver: Page, served: Station, there: Live) -> None:
    """While a key is held: the robot rests, and nobody holds it."""
    driver.key("ArrowRight", True)
    there.until(lambda: there.truth()["motion"][1] < -0.1, PATIENCE_S, "it turns")
    driver.open("about:blank")
    rests(there)
    served.until("is gone: released")


def test_ten_thousand_commands_a_second_leave_it_safe(
    served: Station, browser: Browser, there: Live, record_property: Callable[[str, object], None]
) -> None:
    """From whoever holds the robot: named, ended, the robot at rest, and then it can be taken."""
    client = served.client()
    you = client.until(lambda message: message["type"] == "hello")["you"]
    client.send(do="take", robot="rover")
    command = {"do": "drive", "robot": "rover", "v": 0.0, "omega": 0.6, "boom": 0.0, "enable": True}
    sent, code, _ = client.flood(json.dumps(command), 10_000)
    assert code in (0, 1008)
    served.until(f"browser {you} at", "requests too many")
    rests(there)
    record_property(PROPERTY, f"the robot's guest rests after a flood that was ended at command {sent} of 10000")
    page = connected(browser.page(), served.url)
    page.click("#take")
    page.until("document.querySelector('#holder').textContent === 'you command'")
    page.close()
