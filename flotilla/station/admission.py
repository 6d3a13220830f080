"""Who may hold a connection to the station's page: whoever has the token, and others for a moment.

Connections cost files, of which a process has so many. Those that have not shown the token are few for each address and
in all, and end after PROVE_S. A new one ends the oldest, of its address or of all: so whoever holds connections holds
up itself first, and a browser's Stop all, whose connection may be new, gets in.
"""

from __future__ import annotations

import asyncio
import resource
from collections.abc import Callable

PROVE_S = 5.0
OF_AN_ADDRESS = 24
IN_ALL = 96
_FILES = 1024
"""What the limit of open files is raised to, if it is lower."""


class Admission:
    """`note`: takes an address whose connections are ended."""

    def __init__(self, note: Callable[[str], None]) -> None:
        self._note = note
        self._unproven: dict[asyncio.BaseTransport, str] = {}
        """Addresses, by connection, the oldest first."""
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        if soft != resource.RLIM_INFINITY and soft < _FILES:
            wanted = _FILES if hard == resource.RLIM_INFINITY else min(_FILES, hard)
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))

    def come(self, transport: asyncio.BaseTransport) -> None:
        address = str((transport.get_extra_info("peername") or ("?",))[0])
        self._unproven[transport] = address
        of_address = [each for each, whose in self._unproven.items() if whose == address]
        if len(of_address) > OF_AN_ADDRESS:
            self._end(of_address[0])
        elif len(self._unproven) > IN_ALL:
            self._end(next(iter(self._unproven)))
        asyncio.get_running_loop().call_later(PROVE_S, self._end, transport)

    def proven(self, transport: asyncio.BaseTransport | None) -> None:
        """It has shown the token."""
        self._unproven.pop(transport, None) if transport else None

    def gone(self, transport: asyncio.BaseTransport) -> None:
        self._unproven.pop(transport, None)

    def _end(self, transport: asyncio.BaseTransport) -> None:
        """If it has not shown the token, and is there."""
        if address := self._unproven.pop(transport, ""):
            assert isinstance(transport, asyncio.Transport)
            transport.abort()
            self._note(address)


class Door(asyncio.Protocol):
    """Before the protocol of a connection: whether it is admitted."""

    def __init__(self, inner: asyncio.Protocol, admission: Admission) -> None:
        self._inner, self._admission = inner, admission
        self.data_received = inner.data_received  # type: ignore[method-assign]
        self.eof_received = inner.eof_received  # type: ignore[method-assign]
        self.pause_writing = inner.pause_writing  # type: ignore[method-assign]
        self.resume_writing = inner.resume_writing  # type: ignore[method-assign]

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport
        self._inner.connection_made(transport)
        self._admission.come(transport)

    def connection_lost(self, error: Exception | None) -> None:
        self._admission.gone(self._transport)
        self._inner.connection_lost(error)
