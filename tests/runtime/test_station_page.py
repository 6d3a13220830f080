"""The station's page by the real program in a real browser: what it shows, who may command, and what garbage does. The
robot is a thread with real datagrams, its tasks' parameters and signals are those of a real task of the runtime on this
computer, behind a program that stands in for ssh. tests/boot/test_station_page.py has a robot's guest.

One station, one browser and one robot for all tests; each leaves the robot at rest and held by nobody.
"""

from __future__ import annotations

import functools
import json
import os
import re
import signal
import socket
import statistics
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import pytest
from websockets.exceptions import InvalidStatus

from flotilla.fleet import inventory
from flotilla.station import telemetry
from flotilla.station.authentication import TRAILER
from flotilla.station.record import Recorder
from tests.browser import Browser, Page
from tests.figures import PROPERTY
from tests.running import PATIENCE
from tests.runtime.test_param import Running
from tests.station import ADDRESS, NEIGHBOUR, decoded, on_loopback, secret_in, station
from tests.station_page import Station, WheeledRobot, connected, until

WHEELED = Path("flotilla/lab/wheeled/inventory")
SSH = """#!/bin/sh
while [ "$1" = -o ] || [ "$1" = -F ]; do shift 2; done
shift
PATH="{directory}:$PATH" exec sh -c "$*"
"""
SYSTEMCTL = """#!/bin/sh
verb="$1"; shift
echo "$verb $*" >>{directory}/asked
[ "$verb" = show ] || exit 0
shift
blank=
for unit in "$@"; do
    printf '%sId=%s\\nActiveState=active\\nSubState=running\\nNRestarts=0\\n' "$blank" "$unit"
    echo ActiveEnterTimestampMonotonic=1
    blank='
'
done
"""
PARAM = """#!/bin/sh
[ "$1" = --status=json ] || exec {real} --control {control} "$@"
{real} --control {control} "$@" |
    sed 's/"task": "[a-z]*"/"task": "'$2'"/; s/"refused": {{}}/"refused": {{"commands": {{"forged": 410}}}}/'
"""
SCOPE = '#!/bin/sh\nexec {real} --control {control} "$@"\n'
NFT = """#!/bin/sh
echo '{"nftables": [{"rule": {"expr": [{"counter": {"packets": 14, "bytes": 9}}, {"drop": null}]}}]}'
"""
TAKEN = 12
"""Key presses whose latency is measured."""
ALL_REQUESTS = 10_000
"""In a second, or as near to it as this computer comes."""


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return on_loopback(tmp_path_factory.mktemp("fleet") / "inventory", fleet=WHEELED)


@pytest.fixture(scope="module")
def robot(fleet: Path) -> Iterator[WheeledRobot]:
    robot = WheeledRobot(fleet)
    try:
        yield robot
    finally:
        robot.close()


def drain(stream: IO[str]) -> None:
    """What a task prints: it waits for whoever it prints for."""
    for _ in stream:
        pass


@pytest.fixture(scope="module")
def there(flotilla_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A directory of what the robot has: a task that runs, and programs that reach it."""
    directory = tmp_path_factory.mktemp("robot")
    running = Running(flotilla_run, directory)
    assert running.process.stdout
    assert running.process.stderr
    draining = threading.Thread(target=drain, args=(running.process.stdout,))
    draining.start()
    scripts = {
        "ssh": SSH.format(directory=directory),
        "sudo": '#!/bin/sh\nexec "$@"\n',
        "systemctl": SYSTEMCTL.format(directory=directory),
        "nft": NFT,
    }
    for program, script in (("flotilla-param", PARAM), ("flotilla-scope", SCOPE)):
        scripts[program] = script.format(real=flotilla_run.with_name(program), control=running.control)
    for name, script in scripts.items():
        (directory / name).write_text(script)
        (directory / name).chmod(0o755)
    for key in ("operator_ed25519", "known_hosts"):
        (directory / key).touch()
    try:
        yield directory
    finally:
        running.process.kill()
        running.process.wait(PATIENCE)
        draining.join()
        running.process.stdout.close()
        running.process.stderr.close()


@pytest.fixture(scope="module")
def environment(there: Path) -> dict[str, str]:
    return {"PATH": f"{there}:{os.environ['PATH']}", "BUILD": str(there / "build")} | secret_in(there)


@pytest.fixture(scope="module")
def served(fleet: Path, robot: WheeledRobot, environment: dict[str, str]) -> Iterator[Station]:
    with station(fleet, "station", "--port", "0", environment=environment) as process:
        yield Station(process)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser() as browser:
        yield browser


@pytest.fixture
def page(browser: Browser, served: Station, robot: WheeledRobot) -> Iterator[Page]:
    """Closed afterwards, so that nobody holds the robot."""
    page = connected(browser.page(), served.url)
    yield page
    assert page.complaints == []
    page.close()
    until(lambda: not robot.moves, "it rests")


@pytest.fixture
def driver(page: Page, robot: WheeledRobot) -> Page:
    """Holds the robot, whose motors are on."""
    page.click("#take")
    page.until("document.querySelector('#holder').textContent === 'you command'")
    page.click("#enable")
    until(lambda: robot.commands and robot.commands[-1][6], "the motors are on")
    return page


def test_the_fleet_is_shown(page: Page, served: Station, robot: WheeledRobot, artefacts: Path) -> None:
    """With a link and tasks that run, at each width, from this program alone. Seen to fail with a column of 2000 px."""
    page.until("document.querySelector('.robot .pill').textContent.startsWith('link ')")
    page.until("document.querySelector('#tasks .pill').textContent.startsWith('running')")
    assert "rover" in page.text("#fleet")
    page.picture(artefacts / "page.png")
    for width_px in (1400, 390):
        page.size(width_px, mobile=width_px < 400)
        assert page.overflow_px == 0, width_px
    page.picture(artefacts / "phone.png")
    asked = [event["params"]["request"]["url"] for event in page.events("Network.requestWillBeSent")]
    assert asked
    assert all(url.startswith((f"http://{served.host}/", f"ws://{served.host}/", "blob:", "data:")) for url in asked), (
        asked
    )
    assert page.value("location.search") == "", "the token stays in the address"


def test_what_was_refused_is_shown(page: Page) -> None:
    """By each task, and by the robot's firewall. Seen to fail without what the robot says beside its tasks."""
    for words in ("drive refused 410 forged by commands", "firewall dropped 14 packets of a flood"):
        page.until(f"document.querySelector('.robot .figures').textContent.includes('{words}')")


def test_what_others_said_in_the_robots_name_is_shown(page: Page, robot: WheeledRobot) -> None:
    """Seen to fail where the page does not name it."""
    stream = robot.streams["drive"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((robot.address, 0))
        other.sendto(bytes(stream.length + TRAILER), (ADDRESS, stream.port))
    page.until("document.querySelector('.robot .figures').textContent.includes('drive report left out 1 forged')")


def turning(robot: WheeledRobot, count: int) -> list[tuple[float, int, int, float, float, float, bool]]:
    """Its commands after so many that are to turn it."""
    return [each for each in robot.commands[count:] if each[4]]


def test_keys_drive_the_robot(
    driver: Page, robot: WheeledRobot, record_property: Callable[[str, object], None]
) -> None:
    """Ahead and to the left while keys are held, at rest when they are let go. How long a key takes to the wire is
    printed. Seen to fail with signs of the turn exchanged."""
    before = robot.pose[0]
    driver.key("ArrowUp", True)
    until(lambda: robot.pose[0] > before + 0.05, "it goes ahead")
    driver.key("ArrowLeft", True)
    until(lambda: robot.motion[1] > 0, "it turns to the left")
    driver.key("ArrowLeft", False)
    driver.key("ArrowUp", False)
    until(lambda: not robot.moves, "it rests")
    took_ms = []
    for _ in range(TAKEN):
        count, begun = len(robot.commands), time.monotonic()
        driver.key("ArrowLeft", True)
        moved = until(functools.partial(turning, robot, count), "it turns")
        took_ms.append(1000 * (moved[0][0] - begun))
        driver.key("ArrowLeft", False)
        until(lambda: not robot.moves, "it rests")
    record_property(
        PROPERTY,
        f"from a key in the browser to the command's datagram: median {statistics.median(took_ms):.0f} ms, "
        f"longest {max(took_ms):.0f} ms of {TAKEN}",
    )


def test_the_stick_drives_the_robot(driver: Page, robot: WheeledRobot, artefacts: Path) -> None:
    """And stays where it is when the page says why a robot rests, and whether the motors are on or off.

    Seen to fail with the words above the stick, and with a button whose words took a second line.
    """
    place = "document.querySelector('#stick').getBoundingClientRect().y"
    places = []
    for motors in ("Motors on", "Switch motors on", "Motors on"):
        driver.until(f"document.querySelector('#enable').textContent === '{motors}'")
        places.append(driver.value(place))
        if len(places) < 3:
            driver.click("#enable")
    words = "document.querySelector('#why').textContent = 'The robot rests. '.repeat(10)"
    places.append(driver.value(f"{words}, {place}"))
    assert len(set(places)) == 1, places
    x, y = driver.middle("#stick")
    driver.mouse("mousePressed", x, y)
    driver.mouse("mouseMoved", x + 10, y - 50)
    until(lambda: robot.motion[0] > 0.1 and robot.motion[1] < 0, "ahead, to the right")
    driver.picture(artefacts / "stick.png")
    driver.mouse("mouseReleased", x + 10, y - 50)
    until(lambda: not robot.moves, "it rests")


@pytest.mark.parametrize(
    "how", ["window.dispatchEvent(new Event('blur'))", "document.activeElement.blur(), location.reload()"]
)
def test_focus_elsewhere_ends_the_input(driver: Page, robot: WheeledRobot, how: str) -> None:
    """A key is held, and nobody says that it was let go. Seen to fail, for blur,
    without its handler."""
    driver.key("ArrowUp", True)
    until(lambda: robot.moves, "it goes")
    driver.value(how)
    until(lambda: robot.commands[-1][3] == 0 and not robot.moves, "it rests")
    count = len(robot.commands)
    driver.key("ArrowUp", False)
    assert all(each[3] == 0 for each in robot.commands[count:])


def test_a_browser_that_is_closed_lets_go(driver: Page, browser: Browser, served: Station, robot: WheeledRobot) -> None:
    """While a key is held."""
    driver.key("ArrowUp", True)
    until(lambda: robot.moves, "it goes")
    other = connected(browser.page(), served.url)
    driver.open("about:blank")
    until(lambda: not robot.moves, "it stops")
    other.until("!document.querySelector('#take').hidden")
    other.close()


def test_a_second_browser_cannot_command(
    driver: Page, browser: Browser, served: Station, robot: WheeledRobot, artefacts: Path
) -> None:
    """It sees who does, asks, and drives once the holder hands the robot over; then the first one cannot. Seen to fail
    with a station that takes any browser's commands."""
    second = connected(browser.page(), served.url)
    second.until("document.querySelector('#why').textContent.startsWith('You cannot command: browser')")
    assert second.value("document.querySelector('#take').hidden && document.querySelector('#enable').disabled")
    second.key("ArrowUp", True)
    intruder = served.client()
    intruder.send(do="drive", robot="rover", v=0.5, omega=0, boom=0, enable=True)
    assert "commands it" in intruder.until(lambda message: message["type"] == "refused")["text"]
    assert not robot.moves
    second.key("ArrowUp", False)
    second.picture(artefacts / "second.png")
    second.click("#ask")
    driver.until("document.querySelector('.offer')")
    driver.picture(artefacts / "asked.png")
    operator = robot.commands[-1][1]
    driver.click(".offer")
    second.until("!document.querySelector('#accept').hidden")
    second.click("#accept")
    second.until("document.querySelector('#holder').textContent === 'you command'")
    driver.key("ArrowUp", True)
    second.click("#enable")
    second.key("ArrowLeft", True)
    until(lambda: robot.motion[1] > 0, "the second one drives")
    assert robot.motion[0] == 0, "the first one still does"
    assert robot.commands[-1][1] != operator, "the robot cannot tell"
    second.close()
    intruder.socket.close()


def test_parameters(page: Page, artefacts: Path) -> None:
    """Listed, set, and refused with the task's reason. Seen to fail with a value that is not sent."""
    page.click("#tasks .parameters-of")
    page.until("document.querySelector('[data-name=\"a.factor\"] input')")
    for value, said in (("2.5", "2.5"), ("many", "error")):
        page.value(
            "(field => { field.value = '" + value + "'; field.dispatchEvent(new Event('change')); })"
            "(document.querySelector('[data-name=\"a.factor\"] input'))"
        )
        page.until("document.querySelector('.toast')")
        page.until("!document.querySelector('[data-name=\"a.factor\"] input').disabled")
        page.picture(artefacts / f"parameters-{said}.png")
        shown = page.text("#toasts")
        page.value("document.querySelector('#toasts').replaceChildren()")
        assert ("2.5" in shown) == (value == "2.5"), shown
    assert page.value("document.querySelector('[data-name=\"a.factor\"] input').value") == "2.5"


def plotted(page: Page, source: str, signal: str) -> None:
    """Add a plot as a person does."""
    page.click("#add-plot")
    page.until("document.querySelector('#source')")
    page.value(
        "(select => { select.value ="
        f" [...select.options].find(option => option.textContent.includes({json.dumps(source)})).value;"
        " select.dispatchEvent(new Event('change')); })(document.querySelector('#source'))"
    )
    box = f"#chooser input[value={json.dumps(signal)}]"
    page.until(f"document.querySelector({json.dumps(box)})")
    page.click(box)
    page.click("#plot")


def test_signals_are_plotted(page: Page, artefacts: Path) -> None:
    """Of a robot's report, and of a running task by its scope. Seen to fail where rows are not sent on."""
    plotted(page, "drive report", "pose[0]")
    page.until("/^([2-9]\\d|\\d{3,}) rows/.test(document.querySelector('.plot .chip').textContent)")
    plotted(page, "drive: all wires", "a.out")
    page.until("/^\\d{3,} rows/.test([...document.querySelectorAll('.plot .chip')].at(-1).textContent)")
    page.picture(artefacts / "plots.png")
    assert page.value("document.querySelectorAll('.plot canvas').length") == 2
    page.click(".plot [aria-label=close]")
    page.until("document.querySelectorAll('.plot').length === 1")


def test_a_watcher_ends_with_its_browser(served: Station, there: Path) -> None:
    """A task serves four: each that stayed would take a place. Seen to fail at the fifth, with a command that does not
    end with its stdin."""
    for _ in range(6):
        client = served.client()
        client.send(do="watch", id=7, robot="rover", task="drive", signals=["a.out"])
        assert client.until(lambda message: message["type"] == "rows")["id"] == 7
        client.socket.close()


def test_signals_that_are_none(served: Station) -> None:
    client = served.client()
    client.send(do="watch", id=1, robot="rover", task="drive", signals=["nothing.out"])
    assert "nothing" in client.until(lambda message: message["type"] == "answer")["text"]
    client.send(do="follow", id=2, topic="/rover/drive/report", signals=["pose[7]"])
    assert "pose[7]" in client.until(lambda message: message.get("id") == 2)["text"]
    client.send(do="parameters", id=3, robot="rover", task="nothing")
    assert "no such task" in client.until(lambda message: message.get("id") == 3)["text"]
    client.socket.close()


def test_stop_all(driver: Page, robot: WheeledRobot, there: Path) -> None:
    """It asks nothing, and says of each robot what came of it; who drove does no more. The robot acknowledges the
    signed command at once, by its report, and the tasks end by ssh. Seen to fail with a unit's name that is wrong."""
    driver.key("ArrowUp", True)
    until(lambda: robot.moves, "it goes")
    driver.click("#stop-all")
    driver.until("document.querySelector('#stopped')?.textContent.startsWith('rover: stopped after')")
    assert "stop flotilla-task@drive.service flotilla-task@perceive.service" in (there / "asked").read_text()
    until(lambda: not robot.moves, "it stops")
    driver.until("document.querySelector('#holder').textContent === 'nobody commands'")
    driver.until("document.querySelector('#stop-said').textContent.startsWith('stop all: 1 acknowledged after ')")
    assert robot.commands[-1][6] is False, "the motors are still on"
    driver.key("ArrowUp", False)


def test_stop_all_is_not_behind_a_burst_of_requests(served: Station, robot: WheeledRobot, there: Path) -> None:
    """Of the browser that stops. Seen to fail: it was one of those that were left out as too many."""
    client = served.client()
    you = client.until(lambda message: message["type"] == "hello")["you"]
    for _ in range(300):
        client.send(do="drive", robot="rover", v=0, omega=0, boom=0, enable=False)
    before = len((there / "asked").read_text())
    client.send(do="stop-all")
    served.until(f"browser {you}: stop all: 1 robots")
    client.until(lambda message: message["type"] == "stopped" and message["good"])
    assert "stop flotilla-task@drive.service" in (there / "asked").read_text()[before:]
    client.socket.close()


def test_a_stop_that_nobody_acknowledges_is_an_alarm_beside_the_button(
    driver: Page, served: Station, robot: WheeledRobot
) -> None:
    """The station hangs. Seen to fail: the page said nothing, and where a burst was before it the stop was lost."""
    driver.key("ArrowUp", True)
    until(lambda: robot.moves, "it goes")
    served.process.send_signal(signal.SIGSTOP)
    try:
        driver.click("#stop-all")
        driver.until("document.querySelector('#stop-said').className === 'pill alarm'")
        said = "STOP ALL NOT ACKNOWLEDGED: the station does not answer"
        assert driver.text("#stop-said") == said
        until(lambda: not robot.moves, "it stops by itself")
    finally:
        served.process.send_signal(signal.SIGCONT)
    driver.until("document.querySelector('#stop-said').textContent.startsWith('stop all: 1 acknowledged after ')")
    driver.until("document.querySelector('#stopped')?.textContent.startsWith('rover: stopped after')")
    driver.key("ArrowUp", False)


def test_a_hundred_stops_are_acknowledged(
    served: Station, robot: WheeledRobot, record_property: Callable[[str, object], None]
) -> None:
    """Each behind a burst, while the robot is driven by somebody else."""
    client, took = served.client(), []
    client.until(lambda message: message["type"] == "hello")
    for _ in range(100):
        client.send(do="take", robot="rover")
        for _ in range(3):
            client.send(do="drive", robot="rover", v=0.2, omega=0, boom=0, enable=True)
        begun = time.monotonic()
        client.send(do="stop-all")
        message = client.until(lambda message: message["type"] == "stopped" and message["acknowledged"])
        took.append(time.monotonic() - begun)
        if not message["good"]:  # its motors are off; its tasks end
            client.until(lambda message: message["type"] == "stopped" and message["good"])
    until(lambda: not robot.moves, "it stops")
    median_ms, longest_ms = 1000 * statistics.median(took), 1000 * max(took)
    said = f"stop all to its acknowledgement: median {median_ms:.0f} ms, longest {longest_ms:.0f} ms of {len(took)}"
    record_property(PROPERTY, said)
    client.socket.close()


def rested(robot: WheeledRobot) -> None:
    until(lambda: not robot.moves, "it rests")


@pytest.mark.parametrize(
    "garbage",
    [
        "nothing", "{}", '{"do":"drive"}', '{"do":"drive","robot":"rover","v":1e999,"omega":0,"boom":0,"enable":true}',
        '{"do":"drive","robot":"rover","v":NaN,"omega":0,"boom":0,"enable":true}', "[" * 4000, b"\x00\xff" * 100,
        '{"do":"set","id":1,"robot":"rover","task":"drive","parameter":"--control=/x","value":"1"}',
        '{"do":"parameters","id":1,"robot":"rover","task":"drive;reboot"}',
    ],
)  # fmt: skip
def test_garbage_is_named_and_ended(served: Station, driver: Page, robot: WheeledRobot, garbage: str | bytes) -> None:
    """Twenty times, while somebody else drives, who does not notice."""
    driver.key("ArrowUp", True)
    until(lambda: robot.moves, "it goes")
    client = served.client()
    you = client.until(lambda message: message["type"] == "hello")["you"]
    assert client.flood(garbage, 40)[1:] == (1008, "20 things that are no request")
    served.until(f"browser {you} at", "no request: ")
    driver.until(f"document.querySelector('#notes').textContent.includes('browser {you} at 127.0.0.1: 20 things')")
    assert robot.moves
    driver.key("ArrowUp", False)
    rested(robot)


def test_ten_thousand_commands_a_second(
    served: Station, browser: Browser, robot: WheeledRobot, record_property: Callable[[str, object], None]
) -> None:
    """From whoever holds the robot: its datagrams stay ten a second, the flood is named and ended, the robot stops, and
    somebody else can take it."""
    client = served.client()
    you = client.until(lambda message: message["type"] == "hello")["you"]
    client.send(do="take", robot="rover")
    count, begun = len(robot.commands), time.monotonic()
    request = json.dumps({"do": "drive", "robot": "rover", "v": 0.5, "omega": 0, "boom": 0, "enable": True})
    sent, code, _ = client.flood(request, ALL_REQUESTS)
    lasted_s = time.monotonic() - begun
    assert code in (0, 1008)  # 0: it sent on, and did not hear why
    served.until(f"browser {you} at", "requests too many")
    rested(robot)
    came = len(robot.commands) - count
    assert came <= 12 * lasted_s + 4
    record_property(PROPERTY, f"a flood of {sent} commands in {lasted_s:.2f} s: {came} datagrams, then closed")
    page = connected(browser.page(), served.url)
    page.click("#take")
    page.until("document.querySelector('#holder').textContent === 'you command'")
    page.close()


def test_too_long_a_request_ends_the_connection(served: Station) -> None:
    client = served.client()
    you = client.until(lambda message: message["type"] == "hello")["you"]
    assert client.flood("x" * 100_000, 1)[1] in (0, 1009)
    served.until(f"browser {you} at", "more than 4096 bytes")


def status(served: Station, path: str, **headers: str) -> int:
    request = urllib.request.Request(f"http://{served.host}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


def test_only_who_has_the_token_is_answered(served: Station) -> None:
    """By token, Host and Origin."""
    token, port = served.token, served.host.rpartition(":")[2]
    assert status(served, f"/?token={token}") == 200
    assert status(served, "/") == 403
    assert status(served, f"/?token={token[:-1]}") == 403
    assert status(served, "/main.js", Cookie=f"flotilla-{port}={token[::-1]}") == 403
    assert status(served, "/main.js", Cookie=f"flotilla-{port}={token}") == 200
    assert status(served, "/../web.py", Cookie=f"flotilla-{port}={token}") == 404
    assert status(served, f"/?token={token}", Host=f"attacker.example:{port}") == 403
    assert status(served, f"/?token={token}", Origin="http://attacker.example") == 403
    for headers in (
        {"Origin": "http://attacker.example"}, {"Origin": ""}, {"Cookie": ""}, {"Cookie": f"flotilla-{port}=x"},
        {"Origin": f"http://127.0.0.1:{int(port) + 1}"},
    ):  # fmt: skip
        with pytest.raises(InvalidStatus, match="403"):
            served.client(**headers)
    served.until("refused a request from 127.0.0.1")


def test_a_recording_is_made_and_replayed(
    page: Page, browser: Browser, served: Station, fleet: Path, environment: dict[str, str], artefacts: Path
) -> None:
    """By the page, with the same page: it plays, jumps and ends."""
    page.click("#record")
    page.until("/^Recording \\d+ s · [2-9]\\d/.test(document.querySelector('#record span').textContent)")
    page.click("#record")
    line = served.until("mcap: ", " messages, ")
    file = Path(environment["BUILD"]) / "recordings" / line.partition(":")[0].rpartition("/")[2]
    topics = {topic for topic, _ in decoded(file)}
    assert {"/rover/drive/report", "/rover/drive/report/pose", "/rover/perceive/report/scan"} <= topics
    with station(fleet, "station", "--port", "0", "--replay", file, environment=environment) as process:
        replayed = Station(process)
        again = connected(browser.page(), replayed.url)
        assert again.value("document.querySelector('#drive').hidden && document.querySelector('#stop-all').hidden")
        again.until("document.querySelector('#play').textContent === 'Play'")  # it came to its end
        again.value(
            "(range => { range.value = 0.5; range.dispatchEvent(new Event('change')); })"
            "(document.querySelector('#position'))"
        )
        again.until("document.querySelector('#position-s').textContent.startsWith('0.5 of')")
        again.click("#play")
        again.until("document.querySelector('#play').textContent === 'Pause'")
        again.picture(artefacts / "replay.png")
        again.until("document.querySelector('#play').textContent === 'Play'")
        assert again.complaints == []
        again.close()


def test_nothing_is_shown_as_current_while_the_station_hangs(driver: Page, served: Station) -> None:
    """Seen to fail: green, `connected`, `link 100 %` and old speeds for as long as it hung."""
    driver.until("document.querySelector('#chart').dataset.old === ''")
    served.process.send_signal(signal.SIGSTOP)
    try:
        driver.until("document.querySelector('#link').textContent.startsWith('the station has said nothing for ')")
        driver.until("document.querySelector('#chart').dataset.old === 'rover'")
        for selector, shown in (
            ("#link", "pill bad"), (".robot .pill", "pill bad"), ("#holder", "pill bad"), ("#tasks .pill", "pill bad"),
        ):  # fmt: skip
            assert driver.value(f"document.querySelector('{selector}').className") == shown
        assert re.fullmatch(r"\d+\.\d s old", driver.text(".robot .pill"))
        assert "m/s" not in driver.text("#drive")
        assert driver.value("getComputedStyle(document.querySelector('.robot .figures')).opacity") < "0.5"
        assert driver.value("document.querySelector('#enable').disabled")
    finally:
        served.process.send_signal(signal.SIGCONT)
    driver.until("document.querySelector('#link').textContent === 'connected'")
    driver.until("document.querySelector('#chart').dataset.old === ''")
    driver.until("document.querySelector('.robot .pill').textContent.startsWith('link ')")


def test_open_pages_reach_a_station_that_was_started_anew_or_say_why_not(
    browser: Browser, fleet: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    """Seen to fail: they were dead for ever, and said `not connected` and nothing else."""
    recorded, own = tmp_path / "run.mcap", environment | {"BUILD": str(tmp_path)}
    streams = telemetry.streams(inventory.load_fleet(fleet))
    recorder = Recorder(streams, recorded)
    for stream in streams:
        recorder.take(
            stream, {each.name: (0.0,) * each.width if each.width > 1 else 0 for each in stream.fields}, 10**18
        )
    recorder.end()
    with station(fleet, "station", "--port", "0", "--replay", recorded, environment=own) as process:
        first = Station(process)
        page = browser.page()
        page.open(first.url)
        page.until("document.querySelector('#link').textContent === 'connected'")
    port = first.host.rpartition(":")[2]
    page.until(
        "document.querySelector('#link').textContent === 'not connected: the station does not answer: is it running?'"
    )
    with station(fleet, "station", "--port", port, "--replay", recorded, environment=own) as process:
        assert Station(process).token == first.token
        page.until("document.querySelector('#link').textContent === 'connected'")
    (kept,) = tmp_path.glob("run/page-*.token")
    assert kept.stat().st_mode & 0o777 == 0o600
    kept.chmod(0o644)  # others may have read it
    with station(fleet, "station", "--port", port, "--replay", recorded, environment=own) as process:
        assert Station(process).token != first.token
        page.until("document.querySelector('#link').textContent.endsWith('open the address that it printed')")
    page.close()


def test_a_browser_that_does_not_read_disturbs_nobody(served: Station, page: Page) -> None:
    """It is gone after a while, and the page goes on meanwhile."""
    host, _, port = served.host.rpartition(":")
    with socket.create_connection((host, int(port)), PATIENCE) as slow:
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.sendall(
            f"GET /socket HTTP/1.1\r\nHost: {served.host}\r\nOrigin: http://{served.host}\r\n"
            f"Cookie: flotilla-{port}={served.token}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
            "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n".encode()
        )
        page.until("document.querySelector('#browsers').textContent === '2 browsers'")
        page.until("document.querySelector('#browsers').textContent === ''")
    page.until("document.querySelector('.robot .streams').textContent.includes('Hz')")


def test_the_address_and_port_have_to_be_this_computers(fleet: Path, served: Station) -> None:
    for options, said in (
        (("--page-address", "here"), "ADDRESS=here"),
        (("--port", served.host.rpartition(":")[2]), "TCP port"),
    ):
        other = on_loopback(fleet.parent / f"other{len(options[1])}", begin=NEIGHBOUR)
        with station(other, "station", *options, address="127.0.0.1") as process:
            _, complaint = process.communicate(timeout=PATIENCE)
        assert process.returncode == 1
        assert said in complaint
        assert "Traceback" not in complaint
