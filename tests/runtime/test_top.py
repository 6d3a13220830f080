"""How what robots tell the station comes, shown by the real program."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys
import time
from pathlib import Path

from flotilla.common import paths
from tests.running import PATIENCE
from tests.station import ADDRESS, Robots, on_loopback, secret_in, station


def test_one_table_where_there_is_no_terminal(tmp_path: Path) -> None:
    """A tenth of the steps is left out. Seen to fail where all are sent, and where only a signal ends it."""
    fleet = on_loopback(tmp_path / "inventory")

    def ended() -> bool:
        robots.sent["valves"] += robots.sent["valves"] % 10 == 9
        return process.poll() is not None

    with Robots(fleet) as robots, station(fleet, "top") as process:
        robots.until(ended)
        said, complaints = process.communicate(timeout=PATIENCE)
    assert (process.returncode, complaints) == (0, "")
    title, valves, control = (line.split() for line in said.splitlines())
    assert title[:9] == ["robot", "task", "ms", "stream", "Hz", "of", "came", "refused", "lost"]
    came, refused, lost = (int(valves[title.index(what)]) for what in ("came", "refused", "lost"))
    assert [*valves[:4], valves[5]] == ["robot1", "valves", "10", "report", "100"]
    assert (came > 0, refused, abs(9 * lost - came) <= 9) == (True, 0, True)
    assert valves[-2:] == ["not", "good"]
    assert [*control[:4], control[5]] == ["robot3", "control", "10", "report", "10"]
    assert control[-4:] == ["not", "flying,", "not", "done"]


def test_keys_on_a_terminal(tmp_path: Path) -> None:
    """A question, its answer, a key that is none, and Ctrl-C: keys are heard as soon as the screen names them. Seen to
    fail with a keyboard that listens 1.5 s after the screen is up."""
    fleet = on_loopback(tmp_path / "inventory")
    terminal, theirs = pty.openpty()
    argv = [sys.executable, "-m", "flotilla", "top", "--inventory", str(fleet), "--address", ADDRESS]
    with subprocess.Popen(
        argv, cwd=paths.PROJECT, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
        preexec_fn=lambda: os.close(os.open(os.ttyname(0), os.O_RDWR)),
        env=os.environ | {"TERM": "xterm"} | secret_in(tmp_path / "keys"),
    ) as process:  # fmt: skip
        os.close(theirs)
        try:
            said = ""
            for key, answer in (
                ("", "Ctrl-C end"),
                ("x", "stop robot"),
                ("n", "left as it is"),
                ("\x02", "does nothing"),
            ):
                os.write(terminal, key.encode())
                said = ""
                end = time.monotonic() + PATIENCE
                while answer not in said:
                    assert select.select([terminal], [], [], end - time.monotonic())[0], said
                    try:
                        said += os.read(terminal, 65536).decode(errors="replace")
                    except OSError as error:  # the program has ended
                        raise AssertionError(f"after {key!r}: {said}") from error
            os.write(terminal, b"\x03")
            assert process.wait(PATIENCE) == 0
        finally:
            process.kill()
            os.close(terminal)
    assert "Traceback" not in said
