"""Serving what robots tell the station: by the real program, to a client that knows the protocol and nothing else."""

from __future__ import annotations

import base64
import json
import signal
import socket
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from flotilla.common import paths
from tests.running import PATIENCE
from tests.station import Robots, contiguous, message_class, on_loopback, station

TOPIC = "/robot3/control/report"
DATAGRAM = struct.Struct("<Q2d6d3d2?")
"""Of `control`: step, wanted, estimated, wrench, flying, done."""
WINDOW = 50
"""Datagrams under way at once: far fewer than any socket holds."""
MANY = 40000
"""Messages of 111 B: more than the 4 MiB that Linux keeps for one who does not read, and the library's 1024."""


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    return on_loopback(tmp_path / "inventory")


def port_of(process: subprocess.Popen[str]) -> int:
    """Where it serves, which it says first."""
    assert process.stderr
    line = process.stderr.readline()
    assert line.startswith("serving at ws://127.0.0.1:"), line
    return int(line.partition(";")[0].rpartition(":")[2])


class Viewer:
    """A client, as the protocol's description has it; it asks for all that `topic` brings."""

    def __init__(self, port: int, topic: str = TOPIC, receive_buffer: int | None = None) -> None:
        self.socket = socket.socket()
        if receive_buffer:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        self.socket.connect(("127.0.0.1", port))
        self.connection: ClientConnection = connect(
            f"ws://127.0.0.1:{port}",
            sock=self.socket,
            subprotocols=[Subprotocol("foxglove.sdk.v1")],
            legacy=True,
            close_timeout=1,
        )
        self.info = self.said("serverInfo")
        self.channels = {channel["topic"]: channel for channel in self.said("advertise")["channels"]}
        channel = self.channels[topic]
        self.message = message_class(channel["schemaName"], base64.b64decode(channel["schema"]))
        self.tell("subscribe", subscriptions=[{"id": 7, "channelId": channel["id"]}])

    def said(self, what: str) -> dict[str, Any]:
        said: dict[str, Any] = json.loads(self.connection.recv(PATIENCE))
        assert said["op"] == what
        return said

    def tell(self, what: str, **more: object) -> None:
        self.connection.send(json.dumps({"op": what, **more}))

    def next(self, patience: float = PATIENCE) -> Any:
        """The next message, decoded by the schema that was advertised."""
        data = self.connection.recv(patience)
        assert isinstance(data, bytes)
        kind, subscription, _ = struct.unpack_from("<BIQ", data)
        assert (kind, subscription) == (1, 7)
        return self.message.FromString(data[13:])

    def shown(self, wanted: Callable[[], None]) -> int:
        """Do what is wanted until a message comes of it; its step. Nobody says when a subscription has begun."""
        for _ in range(PATIENCE * 10):
            wanted()
            try:
                return int(self.next(0.1).step)
            except TimeoutError:
                continue
        raise AssertionError("nothing came")

    def vanish(self) -> None:
        """Without a word: the connection is reset."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.socket.close()


def send(robots: Robots) -> None:
    """One of `control`'s datagrams, all of whose values tell its number."""
    step = robots.sent["control"]
    values = [step + part / 16 for part in range(11)]
    robots.send("control", DATAGRAM.pack(step, *values, step % 2 == 1, True))
    robots.sent["control"] += 1


def watched(robots: Robots, viewer: Viewer, count: int, begun: int) -> list[Any]:
    """Send `count` more; all that the viewer is shown from the step after `begun` on."""
    shown: list[Any] = []
    end = robots.sent["control"] + count
    while len(shown) < end - begun - 1:
        while robots.sent["control"] < min(end, begun + 1 + len(shown) + WINDOW):
            send(robots)
        shown.append(viewer.next())
    return shown


def check(shown: list[Any], begun: int) -> None:
    """It is what was sent, all of it, once."""
    for step, message in enumerate(shown, begun + 1):
        values = [*message.wanted, *message.estimated, *message.wrench]
        assert values == [step + part / 16 for part in range(11)]
        assert (message.step, message.flying, message.done) == (step, step % 2 == 1, True)


def test_a_client_gets_what_was_sent(fleet: Path) -> None:
    """Seen to fail with each hundredth message left out, and with two fields' numbers exchanged in the schema."""
    with Robots(fleet) as robots, station(fleet, "live", "0") as process:
        viewer = Viewer(port_of(process))
        assert viewer.channels.keys() == {stream.topic for stream in robots.streams.values()} | {f"{TOPIC}/pose"}
        begun = viewer.shown(lambda: send(robots))
        shown = watched(robots, viewer, 200, begun)
        check(shown, begun)
        process.send_signal(signal.SIGINT)
        said, complaints = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, complaints
    assert f": {len(shown) + 1} messages served, 1 clients" in said
    taken = f"{robots.sent['control'] - 1} received, 0 of a wrong length, 0 forged and 1 replayed left out"
    assert f"{TOPIC}: {taken}" in said, "the first one is answered by a challenge"


def opens(port: int, *origins: str) -> bool:
    """Whether a client connects that sends these Origins, as a browser does."""
    headers = [("Origin", origin) for origin in origins]
    protocols = [Subprotocol("foxglove.sdk.v1")]
    try:
        with connect(f"ws://127.0.0.1:{port}", subprotocols=protocols, additional_headers=headers):
            return True
    except InvalidStatus as error:
        return error.response.status_code != 403


def test_a_foreign_web_page_reads_nothing(fleet: Path) -> None:
    """Foxglove's pages connect, programs, and a page that is named. Seen to fail: every page connected."""
    own = "http://localhost:8080"
    with station(fleet, "live", "0", "--origin", own) as process:
        port = port_of(process)
        assert opens(port)
        for origin in ("https://app.foxglove.dev", "file://", own):
            assert opens(port, origin), origin
        foreign = ["https://evil.example", "null", "", "http://localhost:8081", f"http://127.0.0.1:{port}",
                   "https://app.foxglove.dev.evil.example", "http://app.foxglove.dev"]  # fmt: skip
        for origin in foreign:
            assert not opens(port, origin), origin
        assert not opens(port, "https://app.foxglove.dev", "https://evil.example")
        for request in (b"GET / HTTP/1.1\r\n\r\n", b"GET / HTTP/1.1\r\nUpgrade: h2c\r\n\r\n"):
            with socket.create_connection(("127.0.0.1", port)) as page:
                page.sendall(request)
                assert page.recv(100).startswith(b"HTTP/1.1 426 ")
        process.send_signal(signal.SIGINT)
        output, complaints = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, complaints
    assert f", {len(foreign) + 1} connections of web pages rejected" in output


@pytest.mark.nightly  # what other programs must not be disturbed by; the page's own clients are tried each time
def test_slow_and_vanished_clients_disturb_nobody(fleet: Path, tmp_path: Path) -> None:
    """Neither the recording of the same messages, nor another client. Seen to fail with one sink served, not both."""
    out = tmp_path / "a.mcap"
    with Robots(fleet) as robots, station(fleet, "live", "0", "--record", out) as process:
        port = port_of(process)
        slow, vanishing, viewer = Viewer(port, receive_buffer=2048), Viewer(port), Viewer(port)
        slow.shown(lambda: send(robots))
        vanishing.shown(lambda: send(robots))
        begun = viewer.shown(lambda: send(robots))
        vanishing.vanish()
        check(watched(robots, viewer, MANY, begun), begun)
        slow_shown = [slow.next().step]
        while slow_shown[-1] < robots.sent["control"] - 1:
            slow_shown.append(slow.next().step)
        assert not contiguous(slow_shown), "it was not slow"
        process.send_signal(signal.SIGINT)
        said, complaints = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, complaints
    assert "3 clients" in said
    with out.open("rb") as file:
        recorded = [
            message.sequence for _, channel, message in make_reader(file).iter_messages() if channel.topic == TOPIC
        ]
    assert recorded == list(range(robots.sent["control"] - 1)), "but for the first, which is answered by a challenge"
    assert f"a.mcap: {2 * len(recorded)} messages" in said, "each with a pose"


def test_what_cannot_be_served_is_said(fleet: Path) -> None:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        one.listen()
        port = one.getsockname()[1]
        with station(fleet, "live", str(port)) as process:
            complaints = process.communicate(timeout=PATIENCE)[1]
        assert f"TCP port {port} of 127.0.0.1: Address already in use" in complaints
        assert process.returncode == 1
    with station(fleet, "live", "0", "--live-address", "192.0.2.1") as process:  # RFC 5737: nobody's
        assert "TCP port 0 of 192.0.2.1: Cannot assign" in process.communicate(timeout=PATIENCE)[1]
    with station(fleet, "live", "70000") as process:
        assert "TCP port 70000: there is none" in process.communicate(timeout=PATIENCE)[1]
    with station(paths.INVENTORY, "live", "0") as process:
        assert "no control task sends to a station" in process.communicate(timeout=PATIENCE)[1]
