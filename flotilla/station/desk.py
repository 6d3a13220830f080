"""What browsers ask of the station, done: tasks started and stopped, parameters, signals, recordings, replay.

Nothing here waits for a robot in the loop: ssh runs in threads, and answers come when they come.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import time
from collections import deque
from collections.abc import Callable, Coroutine, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.common.text import shown
from flotilla.fleet.model import Fleet, Robot
from flotilla.robot import parameters, scope
from flotilla.station import page_requests as asked
from flotilla.station import watching
from flotilla.station.driving import STOP_S, TASK, Driving
from flotilla.station.receiver import Receiver
from flotilla.station.record import Recorder
from flotilla.station.recording import Value
from flotilla.station.replay import Replay
from flotilla.station.services import State
from flotilla.station.session import Session
from flotilla.station.telemetry import Stream
from flotilla.station.view import Follower, View

ACKNOWLEDGED_S = 1.0
"""Where a robot has not acknowledged a stop by then, there is an alarm."""
MOTORS = ("left", "right", "boom_enabled")
"""Signals of a driven robot's report that are false when its motors are off."""
WATCHES = 4
"""Of a browser; a task serves four watchers, too."""
NOTES = 50
"""Kept for browsers that come later."""
_THREADS = 8
_MOST_ROBOTS = 250
_ROWS_S = 0.1


@dataclass
class _Stop:
    """Of a robot, under way."""

    robot: str
    begun_s: float = field(default_factory=time.monotonic)
    acknowledged: asyncio.Event = field(default_factory=asyncio.Event)
    follower: Follower | None = None

    @property
    def age_s(self) -> float:
        return time.monotonic() - self.begun_s


@dataclass
class _Open:
    """What a browser has under way."""

    watches: dict[int, asyncio.Task[None]] = field(default_factory=dict)
    followers: dict[int, Follower] = field(default_factory=dict)
    rows: dict[int, list[list[Any]]] = field(default_factory=dict)
    """Of streams' signals, not sent yet, by id."""


class Recording:
    """The page's own, which begins and ends while all else goes on; a sink of the receiver. `note` says what comes of
    it."""

    def __init__(self, known: list[Stream], note: Callable[[str], None]) -> None:
        self._known = known
        self._note = note
        self._recorder: Recorder | None = None
        self._file = Path()
        self._begun_s = 0.0
        self._messages = 0

    @property
    def state(self) -> dict[str, Any] | None:
        """None: nothing is recorded."""
        if not self._recorder:
            return None
        return {"file": paths.shown(self._file), "s": time.monotonic() - self._begun_s, "messages": self._messages}

    def begin(self, file: Path) -> None:
        """UserError where it cannot be made."""
        self.end()
        try:
            self._recorder = Recorder(self._known, file)
        except OSError as error:
            raise UserError(f"{paths.shown(file)}: {error.strerror}; make its directory writable") from error
        self._file, self._begun_s, self._messages = file, time.monotonic(), 0
        self._note(f"{paths.shown(file)}: recording")

    def take(self, stream: Stream, values: Mapping[str, Value], received_ns: int) -> None:
        if self._recorder:
            self._messages += 1
            self._guarded(lambda recorder: recorder.take(stream, values, received_ns))

    def refresh(self) -> None:
        if self._recorder:
            self._guarded(lambda recorder: recorder.refresh())

    def end(self) -> str:
        if self._recorder:
            self._guarded(lambda recorder: self._note(recorder.end()))
            self._recorder = None
        return ""

    def _guarded(self, do: Callable[[Recorder], None]) -> None:
        """A full disk ends the recording, and nothing else."""
        assert self._recorder
        try:
            do(self._recorder)
        except UserError as error:
            self._recorder = None
            self._note(f"the recording ended: {error}")


class Desk:
    """Of all browsers. `states` and `notes`: of tasks and of robots, as Services keeps them; `replay`: instead of
    robots."""

    def __init__(
        self,
        fleet: Fleet,
        receiver: Receiver,
        view: View,
        states: Mapping[tuple[str, str], State],
        notes: Mapping[str, Sequence[str]],
        way: Callable[[Robot], Sequence[str]],
        replay: Replay | None,
        driving: Driving,
    ) -> None:
        self._driving = driving
        self._vehicles = {} if replay else {each.robot: each for each in driving.vehicles}
        self._asking: dict[str, dict[int, str]] = {robot: {} for robot in self._vehicles}
        """Browsers that ask for a robot, by number."""
        self._fleet = fleet
        self._robots = {robot.name: robot for robot in fleet.robots.values()}
        self._receiver = receiver
        self._view = view
        self._states = states
        self._said = notes
        self._replay = replay
        self._way = way
        self.recording = Recording(list(receiver.known.values()), self.note)
        self._open: dict[Session, _Open] = {}
        self._notes: deque[dict[str, Any]] = deque(maxlen=NOTES)
        self._threads = ThreadPoolExecutor(_THREADS, "asks")
        self._stopping = ThreadPoolExecutor(_MOST_ROBOTS, "stops")  # never behind anything else
        self._running: set[asyncio.Task[None]] = set()
        self._stops: dict[str, list[_Stop]] = {}
        """By robots whose tasks are being stopped: who waits for it."""

    # What goes to browsers

    def note(self, text: str) -> None:
        """On the terminal and on the page, control characters of others shown as such."""
        text = shown(text)
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()
        note = {"type": "note", "at": time.time(), "text": text}
        self._notes.append(note)
        self._tell_all(note)

    def enter(self, session: Session) -> None:
        """A browser is there."""
        self._open[session] = _Open()
        session.tell(
            {
                "type": "hello",
                "you": session.number,
                "fleet": self._fleet.name,
                "robots": [
                    {"name": robot.name, "number": robot.number, "address": str(robot.address),
                     "tasks": robot.control_tasks}
                    for robot in self._robots.values()
                ],
                "vehicles": {robot: dict(vehicle.limits) for robot, vehicle in self._vehicles.items()},
                "streams": self._view.described(),
                "paths": self._view.paths(),
                "replay": self._replay and {"file": self._replay.name,
                                            "s": (self._replay.end_ns - self._replay.begin_ns) / 1e9},
                "notes": list(self._notes),
            }
        )  # fmt: skip

    def leave(self, session: Session) -> None:
        """It is gone, in whatever way."""
        left = self._open.pop(session)
        for robot in self._vehicles:
            self._asking[robot].pop(session.number, None)
            holder = self._driving.state(robot).holder
            if holder and holder.id == session.operator.id:
                self._driving.release(robot, session.operator.id)
                self.note(f"{robot}: {session.operator.name} is gone: released")
        for watch in left.watches.values():
            watch.cancel()
        for follower in left.followers.values():
            self._view.leave(follower)

    def show(self) -> None:
        """The present state, to all browsers."""
        if not self._open:
            self._view.scans()
            return
        state = self._view.state() | {
            "type": "state",
            "tasks": {f"{robot} {task}": _task(state) for (robot, task), state in self._states.items()},
            "said": {robot: list(notes) for robot, notes in self._said.items()},
            "driving": {robot: self._held(robot) for robot in self._vehicles},
            "recording": self.recording.state,
            "browsers": len(self._open),
        }
        if self._replay:
            state["replay"] = {
                "s": (self._replay.position_ns - self._replay.begin_ns) / 1e9,
                "playing": self._replay.playing,
                "speed": self._replay.speed,
            }
        text = json.dumps(state, separators=(",", ":"), allow_nan=False)
        scans = self._view.scans()
        for session, own in self._open.items():
            session.show(text)
            if scans:
                session.tell({"type": "scans", "scans": scans})
            for number, rows in own.rows.items():
                if rows:
                    session.tell({"type": "rows", "id": number, "rows": rows})
                    own.rows[number] = []

    def _tell_all(self, message: dict[str, Any]) -> None:
        for session in self._open:
            session.tell(message)

    # What browsers ask

    def do(self, session: Session, request: asked.Request) -> None:
        """At once, or begun: what takes longer answers later."""
        match request:
            case asked.StopAll():
                self.stop_all(f"browser {session.number}")
            case asked.Unwatch():
                self._unwatch(session, request.id)
            case asked.Play():
                self._play(request)
            case asked.Follow():
                self._follow(session, request)
            case asked.Record():
                self._record(session, request)
            case asked.Watch():
                self._watch(session, request)
            case asked.Parameters():
                self._ask(session, request, lambda robot: parameters.param(robot, request.task))
            case asked.Signals():
                self._ask(session, request, lambda robot: scope.signals(robot, request.task))
            case asked.SetParameter():
                self._set(session, request)
            case asked.Service():
                self._service(session, request)
            case asked.Drive():
                self._drive(session, request)
            case asked.Driving():
                self._hold(session, request)

    def _drive(self, session: Session, request: asked.Drive) -> None:
        try:
            self._driving.drive(
                request.robot, session.operator.id, request.v, request.omega, request.boom, request.enable
            )  # fmt: skip
        except UserError as error:
            session.tell({"type": "refused", "robot": request.robot, "text": f"{error}"})

    def _hold(self, session: Session, request: asked.Driving) -> None:
        """Whom a robot obeys changes here only."""
        robot, own = request.robot, session.operator
        try:
            if robot not in self._vehicles:
                raise UserError(f"{robot}: is no robot that can be driven")
            asking = self._asking[robot]
            match request.do:
                case "take":
                    self._driving.take(robot, own)
                    asking.pop(session.number, None)
                    self.note(f"{robot}: {own.name} commands it")
                case "ask":
                    asking[session.number] = own.name
                    self.note(f"{robot}: {own.name} asks for it")
                case "offer":
                    to = next((each.operator for each in self._open if each.number == request.to), None)
                    if request.to is not None and not to:
                        raise UserError(f"{robot}: browser {request.to} is gone")
                    self._driving.offer(robot, own.id, to)
                    self.note(f"{robot}: {own.name} offers it to {to.name if to else 'nobody any more'}")
                case "accept":
                    self._driving.accept(robot, own.id)
                    asking.pop(session.number, None)
                    self.note(f"{robot}: {own.name} commands it")
                case "release":
                    self._driving.release(robot, own.id)
                    self.note(f"{robot}: {own.name} released it")
        except (UserError, OSError) as error:
            session.tell({"type": "refused", "robot": robot, "text": f"{error}"})

    def _held(self, robot: str) -> dict[str, Any]:
        """Who commands it, for the page."""
        state = self._driving.state(robot)
        numbers = {each.operator.id: each.number for each in self._open}
        return {
            "holder": state.holder and state.holder.name,
            "by": numbers.get(state.holder.id) if state.holder else None,
            "offered": numbers.get(state.offered.id) if state.offered else None,
            "asking": self._asking[robot],
            "operator": state.number,
            "sequence": state.sequence,
            "sending": state.sending
            and [state.sending.v, state.sending.omega, state.sending.boom, state.sending.enable],
            "note": state.note,
            "error": state.error,
        }

    def _robot(
        self, request: asked.Parameters | asked.SetParameter | asked.Signals | asked.Watch | asked.Service
    ) -> Robot:
        if self._replay:
            raise UserError("this is a recording: robots are not asked")
        robot = self._robots.get(request.robot)
        if not robot or request.task not in robot.control_tasks:
            raise UserError(f"{request.robot} {request.task}: the inventory has no such task")
        return robot

    def _ask(
        self,
        session: Session,
        request: asked.Parameters | asked.SetParameter | asked.Signals | asked.Service,
        action: Callable[[Robot], str],
        told: str = "",
    ) -> None:
        """By a thread. `told`: what all browsers get to know of it."""

        async def answer() -> None:
            try:
                robot = self._robot(request)
                text = await asyncio.get_running_loop().run_in_executor(self._threads, action, robot)
                session.tell({"type": "answer", "id": request.id, "good": True, "text": text})
                if told:
                    self.note(f"{told}{': ' if text else ''}{text}")
            except (UserError, OSError, ValueError) as error:
                session.tell({"type": "answer", "id": request.id, "good": False, "text": f"{error}"})
                if told:
                    self.note(f"{told}: {error}")

        self._begin(answer())

    def _set(self, session: Session, request: asked.SetParameter) -> None:
        told = f"browser {session.number}: {request.robot} {request.task} {request.parameter}"
        self._ask(
            session,
            request,
            lambda robot: parameters.param(robot, request.task, request.parameter, request.value, request.confirm),
            told,
        )

    def _service(self, session: Session, request: asked.Service) -> None:
        told = f"browser {session.number}: {request.action} {request.robot} {request.task}"
        self._ask(
            session, request, lambda robot: parameters.service(robot, [request.task], request.action) or "done", told
        )  # fmt: skip

    def stop_all(self, who: str) -> list[str]:
        """Stop all robots at once: those that are driven by a signed command, which they acknowledge by their reports,
        and the tasks of all by ssh. The names of the robots; what they say comes to all browsers."""
        robots = [] if self._replay else [robot for robot in self._robots.values() if robot.control_tasks]
        self.note(f"{who}: stop all: {len(robots)} robots")
        for robot in robots:
            stop = _Stop(robot.name)
            if robot.name in self._vehicles:
                self._command_stop(robot.name, stop)
            under_way = self._stops.setdefault(robot.name, [])
            under_way.append(stop)
            if len(under_way) == 1:
                self._begin(self._stop_tasks(robot, stop))
            self._begin(self._watch_stop(stop))
        return [robot.name for robot in robots]

    def _tell_stop(self, stop: _Stop, *, good: bool | None, text: str) -> None:
        self._tell_all(
            {"type": "stopped", "robot": stop.robot, "good": good, "acknowledged": stop.acknowledged.is_set(),
             "text": text}
        )  # fmt: skip

    def _command_stop(self, robot: str, stop: _Stop) -> None:
        """By datagrams, which robots acknowledge by reports that their motors are off."""
        begun_ns = time.time_ns()
        stream = self._view.task_stream(robot, TASK, MOTORS)

        def take(row: list[Any]) -> None:
            if not stop.acknowledged.is_set() and 1e9 * row[0] >= begun_ns and not any(row[1:]):
                stop.acknowledged.set()
                self._tell_stop(stop, good=None, text=f"motors off after {stop.age_s:.1f} s")

        if stream:
            stop.follower = self._view.follow(stream.topic, MOTORS, take)
        try:
            self._driving.stop(robot)
        except (UserError, OSError) as error:
            self.note(f"stop all: {robot}: {error}")

    async def _stop_tasks(self, robot: Robot, stop: _Stop) -> None:
        """By ssh, over the connection that is there; if that does not do it, by a new one."""
        self._tell_stop(stop, good=None, text="stopping")
        run = asyncio.get_running_loop().run_in_executor
        try:
            try:
                await run(self._stopping, parameters.service, robot, robot.control_tasks, "stop", self._way(robot))
            except UserError:
                await run(self._stopping, parameters.service, robot, robot.control_tasks, "stop")
            good, text = True, f"stopped after {stop.age_s:.1f} s"
            for each in self._stops[robot.name]:
                each.acknowledged.set()
        except (UserError, OSError, ValueError) as error:
            good, text = False, f"{error}"
        finally:
            del self._stops[robot.name]
        self._tell_stop(stop, good=good, text=text)
        self.note(f"stop all: {robot.name}: {text}")

    async def _watch_stop(self, stop: _Stop) -> None:
        """An alarm where nothing has come back by then."""
        try:
            await asyncio.wait_for(stop.acknowledged.wait(), ACKNOWLEDGED_S)
        except TimeoutError:
            text = f"NOT acknowledged within {ACKNOWLEDGED_S:g} s"
            self._tell_stop(stop, good=None, text=text)
            self.note(f"stop all: {stop.robot}: {text}")
        if stop.follower:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.acknowledged.wait(), STOP_S)
            self._view.leave(stop.follower)

    def _record(self, session: Session, request: asked.Record) -> None:
        try:
            if self._replay:
                raise UserError("this is a recording already")
            if request.on:
                self.recording.begin(paths.BUILD / "recordings" / time.strftime("%Y-%m-%dT%H-%M-%S.mcap"))
            else:
                self.recording.end()
            session.tell({"type": "answer", "id": request.id, "good": True, "text": ""})
        except UserError as error:
            session.tell({"type": "answer", "id": request.id, "good": False, "text": f"{error}"})

    def _play(self, request: asked.Play) -> None:
        if not self._replay:
            return
        if request.speed is not None:
            self._replay.speed = request.speed
        if request.at_s is not None:
            self._view.begin()
            self._replay.seek(request.at_s, self._receiver)
            self._tell_all({"type": "begin", "paths": self._view.paths()})
        if request.on is not None:
            self._replay.play(request.on)

    # Rows of signals

    def _follow(self, session: Session, request: asked.Follow) -> None:
        self._unwatch(session, request.id)
        own = self._open[session]
        try:
            if len(own.followers) + len(own.watches) >= WATCHES:
                raise UserError(f"{WATCHES} plots are the most; close one")
            own.rows[request.id] = []
            own.followers[request.id] = self._view.follow(
                request.topic, request.signals, lambda row: self._row(session, request.id, row)
            )
            text, good = "", True
        except UserError as error:
            text, good = f"{error}", False
        except KeyError as error:
            text, good = f"{request.topic}: there is no {error}", False
        session.tell({"type": "answer", "id": request.id, "good": good, "text": text})

    def _row(self, session: Session, number: int, row: list[Any]) -> None:
        if session in self._open:
            self._open[session].rows.setdefault(number, []).append(row)

    def _watch(self, session: Session, request: asked.Watch) -> None:
        self._unwatch(session, request.id)
        own = self._open[session]

        async def watch() -> None:
            good, text = True, "ended"
            try:
                robot = self._robot(request)
                state = self._states.get((request.robot, request.task))
                command = watching.words(
                    request.task, request.signals, period_s=state.status.period_s if state and state.status else None,
                    at_least=request.every, trigger=request.trigger, before=request.before, count=request.rows,
                )  # fmt: skip
                async for batch in watching.rows(robot, command, request.signals):
                    rows = [[time_s, *values] for time_s, _, *values in batch]
                    lost = sum(row[1] for row in batch)
                    session.tell({"type": "rows", "id": request.id, "rows": rows, "lost": lost})
            except (UserError, OSError, ValueError) as error:
                good, text = False, shown(f"{error}")
            own.watches.pop(request.id, None)
            session.tell({"type": "answer", "id": request.id, "good": good, "text": text})

        if len(own.followers) + len(own.watches) >= WATCHES:
            text = f"{WATCHES} plots are the most; close one"
            session.tell({"type": "answer", "id": request.id, "good": False, "text": text})
            return
        own.watches[request.id] = self._begin(watch())

    def _unwatch(self, session: Session, number: int) -> None:
        own = self._open[session]
        own.rows.pop(number, None)
        if watch := own.watches.pop(number, None):
            watch.cancel()
        if follower := own.followers.pop(number, None):
            self._view.leave(follower)

    def _begin(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.create_task(work)
        self._running.add(task)
        task.add_done_callback(self._running.discard)
        return task

    async def end(self) -> None:
        """Recording complete, nothing under way."""
        self.recording.end()
        for task in list(self._running):
            task.cancel()
        await asyncio.gather(*self._running, return_exceptions=True)
        for threads in (self._threads, self._stopping):
            threads.shutdown(wait=False, cancel_futures=True)


def _task(state: State) -> dict[str, Any]:
    status = state.status
    return {
        "words": state.words,
        "good": state.good,
        "overruns": status and status.overruns,
        "lately": status and status.lately,
        "sensors": status.flags if status else {},
        "refusals": status.refusals if status else "",
        "waiting": ", ".join(status.waiting) if status else "",
        "lost": status.lost if status else "",
        "period_ms": status and 1000 * status.period_s,
    }
