"""What keys do on the screen of `make top`: choose a task, start or stop it, read and set its parameters.

A task is started and stopped as by the playbook `tasks.yml`, and its parameters are read and set as by `make param`: by
ssh, in a thread of its own, so that neither reception nor screen waits for a robot.
"""

from __future__ import annotations

import codecs
import contextlib
import os
import re
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator, Mapping, Sequence

from flotilla.common.errors import UserError
from flotilla.fleet.model import Robot
from flotilla.robot import parameters

TaskOf = tuple[str, str]
"""Names of robot and task."""
HELP = "↑ ↓ choose   s start   x stop   p parameters   Ctrl-C end"
_LONGEST = 200
"""Characters of what may be typed at once."""
_MOVES = {"\x1b[A": -1, "\x1bOA": -1, "k": -1, "\x1b[B": 1, "\x1bOB": 1, "j": 1}
_SERVICE = {"s": "start", "x": "stop"}
_ENTER, _ERASE, _ESCAPE = ("\r", "\n"), ("\x7f", "\b"), "\x1b"
_KEY = re.compile(r"\x1b(?:\[[0-9;]*[@-~]|O[A-Z])|.", re.DOTALL)
"""One key: what a terminal sends for an arrow or the like (ECMA-48), or a character."""


class Dialog:
    """What is asked and answered. `robots`: by name."""

    def __init__(self, robots: Mapping[str, Robot]) -> None:
        self._robots = robots
        self._row = 0
        self._asked: TaskOf | None = None
        """Whom the question on the screen is about."""
        self._do = ""
        """What is asked: `start`, `stop`, or `parameters`."""
        self._typed = ""
        self._answer = ""

    @property
    def lines(self) -> list[str]:
        """The question, or the keys that there are, and what came of the last action."""
        if not self._asked:
            return [HELP, *self._answer.splitlines()]
        name = " ".join(self._asked)
        if self._do in _SERVICE.values():
            return [f"{self._do} {name}? y: yes, any other key: no"]
        return [f"{name}: BLOCK.PARAMETER [VALUE], nothing: list them, Esc: leave > {self._typed}▏"]

    def chosen(self, tasks: Sequence[TaskOf]) -> int | None:
        """The line that keys act upon; None: there is none."""
        return min(self._row, len(tasks) - 1) if tasks else None

    def press(self, typed: str, tasks: Sequence[TaskOf]) -> None:
        """Keys as the terminal sends them; `tasks`: of each line."""
        for key in _KEY.findall(typed):
            if not self._asked:
                self._command(key, tasks)
            elif self._do in _SERVICE.values():
                self._confirm(key)
            else:
                self._edit(key)

    def _command(self, key: str, tasks: Sequence[TaskOf]) -> None:
        row = self.chosen(tasks)
        if row is None:
            self._answer = "there is no task to choose"
        elif key in _MOVES:
            self._row = (row + _MOVES[key]) % len(tasks)
        elif key in _SERVICE or key == "p":
            self._asked, self._do, self._typed = tasks[row], _SERVICE.get(key, "parameters"), ""
        else:
            self._answer = f"{key if key.isprintable() else 'that key'} does nothing"

    def _confirm(self, key: str) -> None:
        (robot, task), do = self._leave(), self._do
        what = f"{do} {robot} {task}"
        if key == "y":
            self._act(what, robot, lambda there: parameters.service(there, [task], do) or "done")
        else:
            self._answer = f"{what}: left as it is"

    def _edit(self, key: str) -> None:
        if key == _ESCAPE:
            self._leave()
            self._answer = ""
        elif key in _ENTER:
            words = self._typed.split(maxsplit=1)
            robot, task = self._leave()
            self._act(" ".join([robot, task, *words]), robot, lambda there: parameters.param(there, task, *words))
        elif key in _ERASE:
            self._typed = self._typed[:-1]
        elif key.isprintable() and len(self._typed) < _LONGEST:
            self._typed += key

    def _leave(self) -> TaskOf:
        """The question is answered; whom it was about."""
        assert self._asked
        asked, self._asked = self._asked, None
        return asked

    def _act(self, what: str, robot: str, action: Callable[[Robot], str]) -> None:
        """What comes of it is on the next screen after it came."""
        self._answer = f"{what} …"

        def act() -> None:
            try:
                self._answer = f"{what}:\n{action(self._robots[robot])}"
            except (UserError, OSError, ValueError) as error:
                self._answer = f"{what}: {error}"

        threading.Thread(target=act, daemon=True).start()


@contextlib.contextmanager
def keyboard(press: Callable[[str], None]) -> Iterator[dict[int, Callable[[], bool]]]:
    """For `receive`: hands over what is typed on this terminal, without echo or end of line, until it is gone. Nothing
    where there is no terminal."""
    if not sys.stdin.isatty():
        yield {}
        return
    fd = sys.stdin.fileno()
    decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")

    def read() -> bool:
        try:
            typed = os.read(fd, 1024)
        except OSError:  # nobody is at the other end any more
            return False
        press(decoder.decode(typed))
        return bool(typed)

    before = termios.tcgetattr(fd)
    tty.setcbreak(fd)
    try:
        yield {fd: read}
    finally:
        with contextlib.suppress(termios.error):
            termios.tcsetattr(fd, termios.TCSADRAIN, before)
