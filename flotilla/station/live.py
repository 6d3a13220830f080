"""Serves what robots tell the station while they tell it, by Foxglove's WebSocket protocol (subprotocol
foxglove.sdk.v1, github.com/foxglove/ws-protocol): Foxglove shows it, and any other client.

Threads of the library send. A client that reads too slowly loses its oldest messages, and disturbs nobody else.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping

import foxglove
from foxglove.websocket import ChannelView, Client, ServerListener

from flotilla.common.errors import UserError
from flotilla.fleet.drawings import Drawing
from flotilla.station import schema
from flotilla.station.origins import FOXGLOVE, Relay, hidden_address
from flotilla.station.recording import Value
from flotilla.station.telemetry import Stream

PORT = 8765
"""Where Foxglove looks first."""


class _Listener(ServerListener):
    """Called by the library's threads."""

    def __init__(self) -> None:
        self.clients: set[int] = set()
        """Those that ever subscribed."""

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self.clients.add(client.id)


class Server:
    """Serves the messages of `known` at an address of this computer; a sink of the receiver. `port` 0: any.

    `origins`: web pages that may connect besides Foxglove's.
    """

    def __init__(self, known: Iterable[Stream], address: str, port: int, origins: Iterable[str] = ()) -> None:
        if not 0 <= port < 1 << 16:
            raise UserError(f"TCP port {port}: there is none; give one from 1 to 65535: PORT=")
        self._context = foxglove.Context()  # which channels and server do not hold on to
        self._listener = _Listener()
        self._served = 0
        self._channels: dict[str, list[tuple[foxglove.Channel, schema.Schema | Drawing]]] = {}
        """By stream."""
        for stream in known:
            channels = self._channels[stream.topic] = []
            for topic, own in schema.topics(stream).items():
                described = foxglove.Schema(name=own.name, encoding=schema.ENCODING, data=own.data)
                channel = foxglove.Channel(
                    topic, schema=described, message_encoding=schema.ENCODING, context=self._context
                )
                channels.append((channel, own))
        self._relay = Relay(address, port, {*FOXGLOVE, *origins})
        hidden = hidden_address()
        self._server = foxglove.start_server(
            name="flotilla", host=hidden, port=0, server_listener=self._listener, context=self._context
        )
        self._relay.begin((hidden, self._server.port))
        self._url = f"ws://{address}:{self._relay.port}"
        sys.stderr.write(f"serving at {self._url}; in Foxglove: Open connection, Foxglove WebSocket\n")
        sys.stderr.flush()

    def take(self, stream: Stream, values: Mapping[str, Value], received_ns: int) -> None:
        for channel, own in self._channels[stream.topic]:
            if channel.has_sinks():
                channel.log(own.encode(values, received_ns), log_time=received_ns)
                self._served += 1

    def refresh(self) -> None:
        """Nothing to do: every message leaves at once."""

    def end(self) -> str:
        self._relay.end()
        self._server.stop()
        rejected = (
            f", {self._relay.rejected} connections of web pages rejected (ORIGIN=)" if self._relay.rejected else ""
        )
        return f"{self._url}: {self._served} messages served, {len(self._listener.clients)} clients{rejected}"
