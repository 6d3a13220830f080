"""A relay board's registers as I/O ports of a guest."""

from __future__ import annotations

import select
import socket
import threading
from collections.abc import Sequence

from flotilla.lab.emulators.ir104 import Ir104
from flotilla.lab.qemu.guest import Guest

REGISTERS = 3

# The opto inputs are three registers of a network card that nobody uses, an NE2000's own address: on its second page of
# registers, they keep what was written. Here it is the host that writes, by QEMU's monitor.
_CARD = 0x303
_INPUTS = range(_CARD + 1, _CARD + 1 + REGISTERS)
_SECOND_PAGE = 0x61
INPUTS = ("-device", f"ne2k_isa,iobase={_CARD:#x},irq=7")
"""Arguments that give a guest the inputs of a board at 0x300."""


def drive_inputs(machine: Guest, board: Ir104) -> None:
    """Let a guest with `INPUTS` read what drives the board's opto inputs now."""
    for port, value in ((_CARD, _SECOND_PAGE), *((port, board.read(port)) for port in _INPUTS)):
        machine.execute("human-monitor-command", command_line=f"o /b {port:#x} {value:#x}")


class RelayPorts:
    """The relay registers' I/O ports: what the guest writes to them moves the relays of `board`.

    It reads `read_back` from them, whatever it wrote: all relays off, so that a task which ends finds them reset.
    """

    def __init__(self, board: Ir104, read_back: Sequence[int] = (0,) * REGISTERS) -> None:
        self.board = board
        self._read_back = read_back
        self._listeners = [socket.create_server(("127.0.0.1", 0)) for _ in range(REGISTERS)]
        self._wake, self._waker = socket.socketpair()
        self._thread = threading.Thread(target=self._run, daemon=True)

    @property
    def arguments(self) -> tuple[str, ...]:
        """What makes QEMU connect here: a device that hands each written byte to a socket."""
        words: list[str] = []
        for index, (listener, value) in enumerate(zip(self._listeners, self._read_back, strict=True)):
            port = listener.getsockname()[1]
            words += ["-chardev", f"socket,id=relays{index},host=127.0.0.1,port={port},reconnect=0"]
            words += [
                "-device",
                f"isa-debugcon,iobase={self.board.base + index},chardev=relays{index},readback={value}",
            ]
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
