"""A relay board's registers as I/O ports of a guest."""

from __future__ import annotations

import select
import socket
import threading

from tests.emulators.ir104 import Ir104

REGISTERS = 3


class RelayPorts:
    """The relay registers' I/O ports: what the guest writes to them moves the relays of `board`."""

    def __init__(self, board: Ir104) -> None:
        self.board = board
        self._listeners = [socket.create_server(("127.0.0.1", 0)) for _ in range(REGISTERS)]
        self._wake, self._waker = socket.socketpair()
        self._thread = threading.Thread(target=self._run, daemon=True)

    @property
    def arguments(self) -> tuple[str, ...]:
        """What makes QEMU connect here: a device that hands each written byte to a socket."""
        words: list[str] = []
        for index, listener in enumerate(self._listeners):
            port = listener.getsockname()[1]
            words += ["-chardev", f"socket,id=relays{index},host=127.0.0.1,port={port},reconnect=0"]
            words += ["-device", f"isa-debugcon,iobase={self.board.base + index},chardev=relays{index}"]
        return tuple(words)

    def __enter__(self) -> RelayPorts:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._waker.close()
        self._thread.join()
        self._wake.close()
        for listener in self._listeners:
            listener.close()

    def _run(self) -> None:
        registers: dict[socket.socket, int] = {}
        while True:
            ready, _, _ = select.select([self._wake, *self._listeners, *registers], [], [])
            if self._wake in ready:
                break
            for each in ready:
                if each in self._listeners:
                    registers[each.accept()[0]] = self._listeners.index(each)
                elif data := each.recv(4096):
                    self.board.feed(registers[each], data)
                else:
                    del registers[each]
                    each.close()
        for each in registers:
            each.close()
