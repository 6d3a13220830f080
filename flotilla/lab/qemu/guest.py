"""A guest in QEMU that runs a card image: implements `protocols.Power`, and has a console, serial ports and a cable."""

from __future__ import annotations

import contextlib
import shlex
import shutil
import socket
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import serial

from flotilla.fleet.model import Board
from flotilla.lab.qemu import qemu
from flotilla.lab.qemu.console import SerialConsole
from flotilla.lab.qemu.process import Emulator, Exited
from flotilla.lab.qemu.timing import Deadline, Expired, LabError, Steps

_SAVED_MACHINE, _SAVED_CARD = "machine", "card.qcow2"
_STATE_SECONDS = 600
"""Limit for what takes less than one on an idle host: the memory of a guest to a file, and back."""
_STATE_BYTES_S = 10**11
"""QEMU would save a guest as slowly as it moves one over a network."""


class Guest:
    """A computer with a card in it. Make it, `on()`, use it, `close()` it; or use it as a context manager.

    What the card takes up stays in an overlay until `close()`, through any number of power cuts. In `directory` lie
    `console.log`, `qmp.log`, `qemu.command`, `qemu.stderr`, `steps.log` and, when asked for, `wire.pcap`.
    """

    def __init__(
        self,
        board: Board,
        image: Path,
        directory: Path,
        options: qemu.Options | None = None,
        *,
        card_bytes: int = qemu.CARD_BYTES,
        capture: bool = False,
    ) -> None:
        """`options`: link, MAC address, watchdog and the like; the lab itself fills in channels and ports."""
        self.board = board
        self.image = image
        self.options = options or qemu.Options()
        self._card_bytes = card_bytes
        self._emulator: Emulator | None = None
        self._last_words = "it has not been powered on"
        self._powered_on: float | None = None
        self.restored = False
        """Whether it goes on from a saved state, not from a boot."""
        directory.mkdir(parents=True, exist_ok=True)
        self.directory = directory
        if capture:
            self.options = replace(self.options, capture=directory / "wire.pcap")
        self._overlay = directory / "card.qcow2"
        self._steps = Steps(directory / "steps.log")
        self.console = SerialConsole(directory / "console.log", self._explain)

    def __enter__(self) -> Guest:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def name(self) -> str:
        return self.options.name

    @property
    def processor_s(self) -> float:
        """Seconds of a processor of the host that the running guest has taken so far."""
        return self._running().processor_s

    # Power

    def prepare(self) -> None:
        """Start QEMU but let no instruction run: the moment to open `port()`s whose first byte matters."""
        if self._emulator and self._emulator.running:
            return
        if not self._overlay.exists():
            qemu.make_overlay(self.image, self._overlay, self._card_bytes)
        self._start()

    def _start(self, *more: str) -> None:
        """Start QEMU, with `more` arguments."""
        self._forget()
        ours, theirs = socket.socketpair()
        ports = dict.fromkeys(qemu.port_ids(self.board), qemu.tcp_socket())
        options = replace(
            self.options,
            console=qemu.inherited_socket(theirs.fileno()),
            ports={**ports, **self.options.ports},
            paused=True,
            extra=(*self.options.extra, *more),
        )
        with contextlib.ExitStack() as on_failure:
            on_failure.callback(ours.close)
            with theirs:
                self._emulator = Emulator(
                    lambda qmp: qemu.command_line(self.board, self._overlay, replace(options, qmp=qmp)),
                    self.directory,
                    inherited=[theirs.fileno()],
                )
            on_failure.pop_all()
        self.console.attach(ours)

    def on(self) -> None:
        if self._powered_on is not None and self.running:
            raise LabError(f"{self.name} is on already")
        self.prepare()
        self._steps.note("power on")
        # Before `cont`, so that no console text can be older.
        self._powered_on = time.monotonic()
        self.execute("cont")

    def off(self, timeout: float = 600) -> None:
        self._steps.note("power button")
        self.execute("system_powerdown")
        self.wait_off(timeout)

    def cut(self) -> None:
        self._steps.note("power cut")
        self._forget()
        self._last_words = "its power was cut"

    def wait_off(self, timeout: float) -> None:
        """Wait until the guest has switched itself off, or ended for a reboot where `reboot=False`."""
        emulator = self._running()
        status = emulator.wait(timeout)
        self._steps.note(f"QEMU ended with status {status}")
        if status:
            raise Exited(emulator.explain())
        self._forget()
        self._last_words = "it was switched off"

    def reset(self) -> None:
        """Press the reset button."""
        self._steps.note("reset")
        self.execute("system_reset")

    def close(self) -> None:
        """Power off for good and throw the card's overlay away; may be repeated."""
        self._forget()
        self.console.close()
        self._overlay.unlink(missing_ok=True)

    @property
    def running(self) -> bool:
        return self._emulator is not None and self._emulator.running

    def seconds_to(self, pattern: str) -> float:
        """How long after power on the console had said this; it must have, but nobody needs to have waited for it."""
        if self._powered_on is None:
            raise LabError(f"{self.name} has not been powered on")
        return self.console.arrival(pattern) - self._powered_on

    # What only an emulator can do

    def save(self, directory: Path) -> None:
        """Put the running machine with its card into files, from which `restore` makes others; this one goes on."""
        self._steps.note("saved")
        self.execute("stop")
        self.execute("migrate-set-parameters", max_bandwidth=_STATE_BYTES_S)
        self._migrate("migrate", f"exec:cat >{shlex.quote(str(directory / _SAVED_MACHINE))}")
        shutil.copyfile(self._overlay, directory / _SAVED_CARD)  # which nobody writes to before it goes on
        deadline = Deadline(_STATE_SECONDS)
        while self.execute("query-status")["status"] == "finish-migrate":  # no event tells when that is over
            if deadline.expired:
                raise Expired(f"{self.name}: saved, but not within {deadline.seconds:g} s")
        self.execute("cont")

    def restore(self, directory: Path) -> None:
        """Go on from where a machine of the same options and card was saved. It was never switched on, so its console
        has said nothing; afterwards it is a guest like any other."""
        self._overlay.unlink(missing_ok=True)
        qemu.make_overlay(directory / _SAVED_CARD, self._overlay, below="qcow2")
        self._start("-incoming", "defer")
        self._migrate("migrate-incoming", f"exec:cat {shlex.quote(str(directory / _SAVED_MACHINE))}")
        self._steps.note("restored")
        self._powered_on = time.monotonic()
        self.restored = True
        self.execute("cont")

    def _migrate(self, command: str, uri: str) -> None:
        self.execute("migrate-set-capabilities", capabilities=[{"capability": "events", "state": True}])
        self.execute(command, uri=uri)
        while (status := self.wait_event("MIGRATION", _STATE_SECONDS)["data"]["status"]) != "completed":
            if status == "failed":
                raise LabError(f"{self.name}: {command}: {self.execute('query-migrate').get('error-desc', status)}")

    def execute(self, command: str, **arguments: object) -> Any:
        """A QMP command."""
        return self._running().execute(command, **arguments)

    def wait_event(self, name: str, timeout: float) -> dict[str, Any]:
        """A QMP event, such as WATCHDOG."""
        return self._running().wait_event(name, timeout)

    # What is plugged in

    def cable(self, *, plugged: bool) -> None:
        """Pull the network cable, or put it back."""
        self._steps.note(f"cable {'plugged in' if plugged else 'pulled'}")
        self.execute("set_link", name="nic", up=plugged)

    def port_url(self, name: str) -> str:
        """Where the other end of a serial connector is, for pyserial; one client at a time. Changes at power on."""
        identifier = qemu.port_ids(self.board)[name]
        return f"socket://127.0.0.1:{self._running().sockets()[identifier]}"

    def port(self, name: str, timeout: float = 600) -> serial.SerialBase:
        """The other end of a serial connector as an open pyserial port; `timeout` is that of its reads and writes."""
        return serial.serial_for_url(self.port_url(name), timeout=timeout, write_timeout=timeout)

    def ssh_port(self) -> int:
        """The loopback port that leads to the guest's SSH; only with a `UserLink`."""
        link = self.options.link
        if not isinstance(link, qemu.UserLink):
            raise LabError(f"{self.name} is not on a network of its own: ask its segment for the port")
        return self._running().forwards()[str(link.guest)]

    def _running(self) -> Emulator:
        if self._emulator is None:
            raise LabError(f"{self.name} is off: {self._last_words}")
        return self._emulator

    def _explain(self) -> str:
        return self._emulator.explain() if self._emulator else self._last_words

    def _forget(self) -> None:
        """End QEMU if it is there, and take in the last words of its console."""
        self.restored = False
        self._powered_on = None if self._emulator is None else self._powered_on
        if self._emulator:
            self._emulator.kill()
            self.console.detach()
            self._emulator = None
