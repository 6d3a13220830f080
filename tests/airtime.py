"""A station that brings releases to robots in a cell by `ansible-playbook update.yml`; what went through the air."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from flotilla.common import paths
from flotilla.lab.qemu.radio import Radio
from flotilla.lab.qemu.timing import Deadline
from flotilla.updates import multicast

_SYMBOL_BYTES = multicast.HEADERS + multicast.OVERHEAD + multicast.SYMBOL
"""Of a frame that has a symbol, which no other frame of a station has."""


@dataclass
class Station:
    """A station, in the cell of its robots."""

    directory: Path
    """With the inventory, and `reach.yml`: how Ansible reaches its robots."""
    radio: Radio
    station: str
    """Its address."""
    environment: dict[str, str]
    """Of its plays; `ANSIBLE_HOME` is nobody else's."""

    kbit_s: int
    """Of multicasts."""
    seconds: int
    """For a play, on a computer that has other things to do."""

    def start(self, bundle: Path, *more: str) -> subprocess.Popen[str]:
        """The play that brings a release to the robots."""
        program = Path(sys.executable).with_name("ansible-playbook")
        argv = [str(program), "-i", str(self.directory / "inventory"), "-i", str(self.directory / "reach.yml")]
        argv += ["update.yml", "--tags", "stage", "-e", f"bundle={bundle}", "-e", f"kbit_s={self.kbit_s}", *more]
        return self.radio.nodes[self.station].run(*argv, cwd=paths.PROJECT / "ansible", more=self.environment)

    def said(self, play: subprocess.Popen[str], status: int = 0) -> str:
        """What a play said that ended as expected."""
        out, err = play.communicate(timeout=self.seconds)
        (self.directory / "ansible.log").write_text(out + err)
        assert play.returncode == status, out + err
        print(out)
        return out

    def kill(self, play: subprocess.Popen[str]) -> None:
        """End the station without a word of warning; then nothing of it sends any more."""
        play.kill()
        deadline = Deadline(self.seconds)
        while left := [*self._of_plays()]:
            assert not deadline.expired, left
            time.sleep(0.1)  # a process that is not ours tells nobody when it ends
        play.communicate()

    def _of_plays(self) -> Iterator[str]:
        """Ansible's processes of this station."""
        home = f"ANSIBLE_HOME={self.environment['ANSIBLE_HOME']}".encode()
        for process in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):  # it has just ended
                words = (process / "cmdline").read_bytes().split(b"\0")
                if b"update.yml" in words and home in (process / "environ").read_bytes().split(b"\0"):
                    yield process.name

    def symbols(self) -> int:
        """Sent by now."""
        return self.radio.sent[self.station].count(_SYMBOL_BYTES)

    def wait_for_symbols(self, count: int) -> None:
        """Until the station has sent so many, from now on."""
        with self.radio.on_frame:
            wanted = self.symbols() + count
            assert self.radio.on_frame.wait_for(lambda: self.symbols() >= wanted, self.seconds)
