"""What a test may ask of a robot, whether that is a guest in QEMU or a PC/104 stack on the bench.

Tests name these, never QEMU, unless they need something that only an emulator can do.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from subprocess import CompletedProcess
from typing import Protocol


class Power(Protocol):
    """The supply. On the bench a switched outlet."""

    def on(self) -> None:
        """Apply power; returns at once, not when the system is up."""

    def off(self, timeout: float = 600) -> None:
        """Press the power button and wait until the system has shut itself down."""

    def cut(self) -> None:
        """Take the power away, whatever is being written."""


class Console(Protocol):
    """The serial console. On the bench a null modem cable."""

    @property
    def text(self) -> str:
        """All that was ever said."""

    def expect(self, pattern: str, timeout: float) -> re.Match[str]:
        """Wait for a regular expression (`re.MULTILINE`) in what was said since the last match."""

    def send(self, text: str) -> None:
        """Type; a line ends with a carriage return, `\\r`."""


class Command(Protocol):
    """A shell of user `robot`. Over SSH in both worlds."""

    def run(
        self, argv: Sequence[str], *, timeout: float = 600, check: bool = True, stdin: str = ""
    ) -> CompletedProcess[str]:
        """Run a command there, arguments kept apart; with `check` a status other than 0 raises LabError."""


class FileTransfer(Protocol):
    def read(self, path: str) -> bytes:
        """Contents of a file there."""

    def write(self, path: str, contents: bytes) -> None:
        """Replace the contents of a file there."""
