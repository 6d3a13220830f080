"""What tests of the station's page need: the program, a client that is no browser, and a robot that is driven without a
guest."""

from __future__ import annotations

import json
import math
import re
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from flotilla.common.signals import CODES
from flotilla.fleet import inventory
from flotilla.station import telemetry
from flotilla.station.driving import COMMAND
from tests.browser import Page
from tests.running import PATIENCE
from tests.station import ProvenWay


class Station:
    """The program that serves the page; what it says on stderr is kept."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.said: list[str] = []
        self._changed = threading.Condition()
        threading.Thread(target=self._read, daemon=True).start()
        self.until("the station's page: ")
        self.url = re.findall(r"http\S+", "".join(self.said))[0]
        parts = urlsplit(self.url)
        self.host, self.token = parts.netloc, parse_qs(parts.query)["token"][0]

    def until(self, *words: str) -> str:
        """A line that has all of these; the first one."""
        end = time.monotonic() + PATIENCE
        with self._changed:
            while not (found := [line for line in self.said if all(word in line for word in words)]):
                assert time.monotonic() < end, (words, self.said)
                assert self.process.poll() is None, self.said
                self._changed.wait(1)
        return found[0]

    def client(self, **headers: str) -> Client:
        return Client(self.host, self.token, headers)

    def _read(self) -> None:
        assert self.process.stderr
        for line in self.process.stderr:
            with self._changed:
                self.said.append(line)
                self._changed.notify_all()


class Client:
    """Speaks to the station's WebSocket and is no browser. `headers`: in place of the usual ones."""

    def __init__(self, host: str, token: str, headers: Mapping[str, str]) -> None:
        sent = {"Origin": f"http://{host}", "Cookie": f"flotilla-{host.rpartition(':')[2]}={token}"} | dict(headers)
        self.socket: ClientConnection = connect(
            f"ws://{host}/socket", additional_headers={name: value for name, value in sent.items() if value},
            max_size=None, compression=None, ping_interval=None, legacy=True,
        )  # fmt: skip

    def send(self, **request: object) -> None:
        self.socket.send(json.dumps(request))

    def flood(self, request: str | bytes, count: int) -> tuple[int, int, str]:
        """Send it so often, or until the station closes the connection: how often it was, then the close's code and
        reason."""
        sent = 0
        try:
            while sent < count:
                self.socket.send(request)
                sent += 1
            while True:
                self.socket.recv(PATIENCE)
        except ConnectionClosed as closed:
            return sent, closed.rcvd.code if closed.rcvd else 0, closed.rcvd.reason if closed.rcvd else ""

    def until(self, what: Callable[[dict[str, Any]], Any]) -> Any:
        """The first message that it is true of."""
        end = time.monotonic() + PATIENCE
        while True:
            message = json.loads(self.socket.recv(end - time.monotonic()))
            if found := what(message):
                return found if found is not True else message


class WheeledRobot:
    """Stands in for `drive` and `perceive` of a wheeled robot: takes commands and reports, by real datagrams. No wheel
    slips, and a room has two walls. All datagrams that came are kept."""

    PERIOD_S = 0.02
    DEAD_MAN_S = 0.3

    def __init__(self, fleet: Path) -> None:
        described = inventory.load_fleet(fleet)
        self.streams = {stream.task: stream for stream in telemetry.streams(described)}
        self.address = self.streams["drive"].address
        self.commands: list[tuple[float, int, int, float, float, float, bool]] = []
        """When it came, operator, sequence, v, omega, boom, enable."""
        self.pose = [0.0, 0.0, 0.0]
        self.motion = (0.0, 0.0)
        self._end = threading.Event()
        self._command = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._command.bind((self.address, 5030))
        self._reports = {task: ProvenWay(stream, described) for task, stream in self.streams.items()}
        self._threads = [threading.Thread(target=each) for each in (self._listen, self._drive)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        self._end.set()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as waker:
            waker.sendto(b"", (self.address, 5030))
        for thread in self._threads:
            thread.join()
        self._command.close()
        for report in self._reports.values():
            report.close()

    @property
    def moves(self) -> bool:
        return self.motion != (0.0, 0.0)

    def _listen(self) -> None:
        while not self._end.is_set():
            datagram = self._command.recv(100)
            if len(datagram) > COMMAND.size:  # a proof follows, which tests/runtime/test_two_stations.py judges
                self.commands.append((time.monotonic(), *COMMAND.unpack(datagram[: COMMAND.size])))

    def _drive(self) -> None:
        step = 0
        while not self._end.wait(self.PERIOD_S):
            came_s, operator, sequence, v, omega, boom, enable = (
                self.commands[-1] if self.commands else (-math.inf, 0, 0, 0.0, 0.0, 0.0, False)
            )
            alive = enable and time.monotonic() - came_s < self.DEAD_MAN_S
            self.motion = (v, omega) if alive else (0.0, 0.0)
            x, y, heading = self.pose
            self.pose = [
                x + self.motion[0] * math.cos(heading) * self.PERIOD_S,
                y + self.motion[0] * math.sin(heading) * self.PERIOD_S,
                heading + self.motion[1] * self.PERIOD_S,
            ]
            step += 2
            if step % 10 == 0:
                self._say(
                    "drive", step=step, command=sequence, pose=tuple(self.pose), motion=self.motion, wanted=self.motion,
                    boom=boom, free=1.5, alive=alive, seeing=True, left=enable, right=enable, boom_enabled=enable,
                    operator=operator,
                )  # fmt: skip
            if step % 50 == 0:
                self._say("perceive", step=step // 10, age=0.05, ranges=self._scan(), good=True)

    def _scan(self) -> tuple[float, ...]:
        x, y, heading = self.pose
        found = []
        for number in range(171):
            angle = heading - 2.077 + number * 0.02454369
            reach = [
                (wall - at) / along
                for wall, at, along in ((3.0, x, math.cos(angle)), (1.5, y, math.sin(angle)))
                if along > 1e-6
            ]
            found.append(min([each for each in reach if each < 5.6], default=math.nan))
        return tuple(found)

    def _say(self, task: str, **values: Any) -> None:
        stream = self.streams[task]
        data = b""
        for each in stream.fields:
            value = values.get(each.name, 0)
            data += struct.pack(f"<{each.width}{CODES[each.type]}", *(value if isinstance(value, tuple) else (value,)))
        self._reports[task].send(data)


def until(what: Callable[[], Any], why: str, timeout_s: float = PATIENCE) -> Any:
    """Look again and again; what is true then."""
    end = time.monotonic() + timeout_s
    while not (found := what()):
        assert time.monotonic() < end, why
        time.sleep(0.01)  # nothing tells it
    return found


def connected(page: Page, url: str) -> Page:
    """Open it, until it shows the fleet."""
    page.open(url)
    page.until("document.querySelector('#link').textContent === 'connected'")
    page.until("document.querySelector('.robot .streams')?.textContent.includes('Hz')")
    return page
