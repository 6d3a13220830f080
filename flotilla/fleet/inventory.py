"""Reads `ansible/inventory/` and says everything that is wrong with it, at once, with file and line.

Ansible merges the variables (`ansible-inventory --list`), pydantic checks single values (`model.py`), the functions in
`_CHECKS` what values have to do with each other. The YAML files are read a second time, only to know where a value
stands and to see what Ansible passes over in silence: names that stand twice, misspelt names.
"""

from __future__ import annotations

import difflib
import json
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from fnmatch import fnmatch
from importlib.metadata import version
from ipaddress import IPv4Address, IPv4Network
from itertools import count
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from flotilla.common import ansible, cache, durable, paths
from flotilla.common.errors import Problem, ProblemsError, UserError
from flotilla.common.sources import find
from flotilla.common.yaml_file import SYNTAX, Entry, Loc, child, compose, did_you_mean, dotted, explained, pairs
from flotilla.fleet import apps, home, messages, privileges
from flotilla.fleet.model import Board, Fleet, Health, Host, Label, Network, Releases, Robot

Finding = tuple[Loc, str, str]
"""A place in the merged description, such as `("robots", "robot3", "address")`; what is wrong with it, what would be
right."""
Scope = tuple[str, str]
"""Whose variables, by kind and name: `("hosts", "robot3")`, `("group_vars", "all")`, `("vars", "robots")` …"""

_HOMES = {"fleet_name": "all", "network": "all", "health": "all", "releases": "all", "board": "board_*"}
"""Variables that hosts share, and the one group whose `group_vars/` sets them."""
_OF_ROBOTS = ("number", "devices", "can", "control_tasks", "standby", "apps")
_VARIABLES = {"address", *_OF_ROBOTS, *_HOMES}
"""The variables read here. Any others are Ansible's and its roles'."""


def load_fleet(directory: Path | None = None) -> Fleet:
    """The fleet of an inventory, by default that of the fleet's home; or ProblemsError with all that is wrong in it."""
    paths.check()  # for playbooks, too
    home.check()
    directory = directory or paths.INVENTORY
    if not directory.is_dir():
        remedy = "name one with robots.yml and group_vars/"
        raise UserError(f"INVENTORY={paths.shown(directory)}: there is no such directory; {remedy}")
    places = layers(directory)
    sources = Sources(*places)
    try:
        merged = _merged(places)
    except UserError:
        if sources.problems:  # they say more than Ansible does
            raise ProblemsError(sources.problems) from None
        raise
    return validate(merged, sources)


def layers(directory: Path) -> list[Path]:
    """What Ansible reads, the weakest first: a fleet's own inventory lies over the boards that come with the tool."""
    return [paths.BOARDS, directory] if paths.OWN_HOME and directory == paths.INVENTORY else [directory]


def robot(fleet: Fleet, number: int) -> Robot:
    """Robot `number` of the fleet."""
    if number not in fleet.robots:
        there = ", ".join(map(str, fleet.robots))
        where = paths.shown(paths.INVENTORY / "robots.yml")
        raise UserError(f"robot {number}: no such robot in {where}; robots are {there}")
    return fleet.robots[number]


def station(fleet: Fleet, name: str | None, where: Path) -> Host:
    """The station that was named, or the only one; `where` the inventory is."""
    names = [station.name for station in fleet.stations]
    if name is None and len(names) == 1:
        return fleet.stations[0]
    for each in fleet.stations:
        if each.name == name:
            return each
    what = f"stations: {name} is none" if name else "say which station this computer is: STATION="
    raise UserError(f"{paths.shown(where)}: {what}; there are {', '.join(names) or 'none'}")


def summary(fleet: Fleet) -> str:
    """One line about the fleet, one about each robot."""
    members = ", ".join(
        f"{len(group)} {kind}{'s' * (len(group) != 1)}"
        for kind, group in (("robot", fleet.robots), ("station", fleet.stations))
    )
    rows = [
        (
            str(number),
            robot.name,
            robot.board,
            str(robot.address),
            ", ".join(f"{name} on {device.port or device.usb}" for name, device in robot.devices.items())
            or "no devices",
        )
        for number, robot in fleet.robots.items()
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    table = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)
    return "\n".join((f"{fleet.name}: {members}, {fleet.network.subnet} over {fleet.network.link}", *table))


# What Ansible says


def _merged(places: Sequence[Path]) -> dict[str, Any]:
    """Output of `ansible-inventory --list`, kept under the hash of the inventory: Ansible takes a second to start."""
    # By what Ansible reads: a link leads to what it reads.
    contents = [
        part
        for place in places
        for file in sorted(place.rglob("*"))
        if file.is_file()
        for part in (str(file.relative_to(place)), file.read_bytes())
    ]
    kept = paths.CACHE / f"inventory-{cache.digest(version('ansible-core'), *contents)}.json"
    try:
        merged: dict[str, Any] = json.loads(kept.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):  # or cut short by a power cut
        text = _ansible_inventory(places)
        kept.parent.mkdir(parents=True, exist_ok=True)
        durable.write(kept, text)
        merged = json.loads(text)
    return merged


def _ansible_inventory(places: Sequence[Path]) -> str:
    """Ansible's answer depends on the inventory alone: no configuration of the user's, no variables."""
    program = Path(sys.executable).with_name("ansible-inventory")
    home = paths.CACHE / "ansible"
    home.mkdir(parents=True, exist_ok=True)
    empty = home / "empty.cfg"
    empty.touch()
    environment = ansible.environment() | {
        "ANSIBLE_CONFIG": str(empty),
        "ANSIBLE_HOME": str(home),
        "ANSIBLE_INVENTORY_ANY_UNPARSED_IS_FAILED": "1",
    }
    argv = [str(program), *(word for place in places for word in ("-i", str(place))), "--list"]
    try:
        done = subprocess.run(
            argv, env=environment, stdin=subprocess.DEVNULL, capture_output=True, encoding="utf-8", check=False
        )
    except FileNotFoundError:
        raise UserError(f"{program}: not installed; run `make setup`") from None
    if done.returncode:
        message = done.stderr.partition("Traceback")[0].strip()
        raise UserError(f"{paths.shown(places[-1])}: Ansible cannot read the inventory:\n{message}")
    return done.stdout


# Where things stand


class Sources:
    """The inventory's YAML files: where each variable stands, and the problems that only they show."""

    def __init__(self, *places: Path) -> None:
        """`places`: the weakest first."""
        self.directory = places[-1]
        self.problems: list[Problem] = []
        self._entries: dict[Scope, list[Entry]] = {}
        """In each scope later files override earlier ones, as in Ansible."""
        for place in places:
            for path in sorted(place.rglob("*")):
                if path.suffix in (".yml", ".yaml", ".json") and path.is_file():
                    self._read(place, path)
        if any(problem.key == SYNTAX for problem in self.problems):  # Ansible could not read it either
            raise ProblemsError(self.problems)
        for (kind, name), entries in self._entries.items():
            for entry in entries:
                self._check_names(kind, name, entry)

    def locate(self, scopes: Sequence[Scope], path: Loc) -> tuple[str, str]:
        """File with line and text of the variable at `path`, looked for in `scopes`, the strongest first.

        What is missing is located at what should contain it."""
        entries = [entry for scope in scopes for entry in reversed(self._entries.get(scope, []))]
        for entry in entries:
            if found := entry.locate(path):
                return found
        if entries:
            return entries[0].at(entries[0].key), "(missing)"
        kind, name = scopes[0]
        return paths.shown(self.directory / (f"{kind}/{name}.yml" if kind == "group_vars" else "")), "(missing)"

    def boards(self) -> list[str]:
        """Groups that `group_vars/` describes as boards."""
        return sorted({name for kind, name in self._entries if kind == "group_vars" and name.startswith("board_")})

    def described(self, board: str) -> Any:
        """What `group_vars/` has of a board's group: Ansible lists variables of hosts only, and it may have none."""
        for entry in reversed(self._entries.get(("group_vars", board), [])):
            if found := child(entry.node, "board"):
                return yaml.SafeLoader("").construct_document(found[1])
        return None

    def _read(self, place: Path, path: Path) -> None:
        entry = compose(path)
        if isinstance(entry, Problem):
            self.problems.append(entry)
        if not isinstance(entry, Entry):
            return
        # A host's path begins with its name, wherever its group stands.
        self.problems += entry.twice(entry.node, unnamed=("hosts", "children", "vars"))
        kind, name, *_ = (*path.relative_to(place).with_suffix("").parts, "")
        if kind in ("group_vars", "host_vars"):
            self._entries.setdefault((kind, name), []).append(entry)
        elif not child(entry.node, "plugin"):
            self._read_groups(entry, entry.node)

    def _read_groups(self, file: Entry, groups: yaml.Node) -> None:
        """Take in what the groups of an inventory file contain, whatever their depth."""
        for group, content in pairs(groups):
            for key, value in pairs(content):
                if key.value == "children":
                    self._read_groups(file, value)
                elif key.value == "vars":
                    self._add("vars", group.value, file, key, value)
                elif key.value == "hosts":
                    for host, variables in pairs(value):
                        self._add("hosts", host.value, file, host, variables)
                else:
                    message = "is no part of a group, Ansible ignores it"
                    remedy = did_you_mean(key.value, ("hosts", "children", "vars"))
                    self.problems.append(file.problem(key, (group.value, key.value), value, message, remedy))

    def _add(self, kind: str, name: str, file: Entry, key: yaml.Node, node: yaml.Node) -> None:
        self._entries.setdefault((kind, name), []).append(Entry(file.file, file.text, key, node))

    def _check_names(self, kind: str, name: str, entry: Entry) -> None:
        """Misspelt variables, and shared ones outside their home. Other names are free: roles have variables too."""
        for key, value in pairs(entry.node):
            path = (key.value,) if kind == "group_vars" else (name, key.value)
            close = difflib.get_close_matches(key.value, _VARIABLES, 1, 0.8)
            home = _HOMES.get(key.value)
            if key.value not in _VARIABLES and close:
                remedy = f"did you mean {close[0]}? If not, take a name less like it"
                self.problems.append(entry.problem(key, path, value, "is not a variable of the fleet", remedy))
            elif home and not (kind == "group_vars" and fnmatch(name, home)):
                remedy = f"move it to group_vars/{home.replace('*', 'NAME')}.yml"
                self.problems.append(
                    entry.problem(key, path, value, "is set for only a part of those who share it", remedy)
                )


# What it means


class _Description(BaseModel):
    """The merged description before contradictions are excluded: robots by host name, not by number."""

    model_config = ConfigDict(extra="forbid")
    name: Label
    network: Network
    health: Health = Health()
    releases: Releases = Releases()
    boards: dict[str, Board]
    robots: dict[str, Robot]
    stations: dict[str, Host]


def validate(merged: dict[str, Any], sources: Sources) -> Fleet:
    """The fleet in Ansible's merged variables, or ProblemsError with all that is wrong in them and in the files."""
    groups = _Groups(merged)
    raw, findings = _description(groups, sources)
    findings += _templates(raw, ())
    known = {loc for loc, _, _ in findings}
    description = None
    try:
        description = _Description.model_validate(raw)
    except ValidationError as error:
        for detail in error.errors():
            loc = tuple(step for step in detail["loc"] if step != "[key]")
            if loc not in known:
                findings.append((loc, *explained(_Description, loc, detail)))
            if loc == detail["loc"]:
                _remove(raw, loc)  # the other checks then work on what is right
    for check in _CHECKS:
        findings += check(raw)

    exchanged, problems = messages.load()
    problems += sources.problems
    for loc, message, remedy in findings:
        if loc[0] in ("robots", "stations") and loc[2:] == ("name",):
            loc = loc[:2]  # a host's name is the key itself
        scopes, path = groups.place(loc)
        file, value = sources.locate(scopes, path)
        key = dotted((*loc[1:2], *path) if loc[0] in ("robots", "stations") else path)
        problems.append(Problem(file, key, value, message, remedy))
    if problems or not description:
        raise ProblemsError(problems)
    robots = sorted(description.robots.values(), key=lambda robot: robot.number)
    return Fleet(
        name=description.name,
        network=description.network,
        health=description.health,
        releases=description.releases,
        boards=description.boards,
        robots={robot.number: robot for robot in robots},
        stations=list(description.stations.values()),
        messages=exchanged,
    )


class _Groups:
    """Who is in which group, all the way down."""

    def __init__(self, merged: dict[str, Any]) -> None:
        self.variables: dict[str, dict[str, Any]] = merged.get("_meta", {}).get("hostvars", {})
        self.members: dict[str, list[str]] = {}
        self._depth: dict[str, int] = {}
        self._merged = merged
        self.hosts = self._visit("all", 0)

    def _visit(self, name: str, depth: int) -> list[str]:
        group = self._merged.get(name, {})
        self._depth[name] = max(depth, self._depth.get(name, 0))
        below = [host for child in group.get("children", []) for host in self._visit(child, depth + 1)]
        self.members[name] = list(dict.fromkeys([*group.get("hosts", []), *below]))
        return self.members[name]

    def of(self, host: str) -> list[str]:
        """Groups of a host, in Ansible's precedence: the innermost first."""
        groups = (name for name, members in self.members.items() if host in members)
        return sorted(groups, key=lambda name: (self._depth[name], name), reverse=True)

    def place(self, loc: Loc) -> tuple[list[Scope], Loc]:
        """Who may have set the value at `loc`, the strongest first, and its path among their variables."""
        match loc:
            case ("robots" | "stations", host, *rest):
                groups = self.of(str(host))
                own = [("host_vars", str(host)), ("hosts", str(host))]
                shared = [(kind, group) for kind in ("group_vars", "vars") for group in groups]
                return own + shared, tuple(rest)
            case ("boards", board, *rest):
                return [("group_vars", f"board_{board}")], ("board", *rest)
            case ("name",):
                return [("group_vars", "all")], ("fleet_name",)
            case ("network" | "health" | "releases", *_):
                return [("group_vars", "all")], loc
        return [("hosts", "")], loc


def _description(groups: _Groups, sources: Sources) -> tuple[dict[str, Any], list[Finding]]:
    """The merged variables in the form of `_Description`, and what is wrong with who is in which group."""
    findings: list[Finding] = []
    raw: dict[str, Any] = {"boards": {}, "robots": {}, "stations": {}}
    boards = sorted({*(name for name in groups.members if name.startswith("board_")), *sources.boards()})
    for host in groups.hosts:
        variables = groups.variables.get(host, {})
        for key, name in (
            ("fleet_name", "name"),
            ("network", "network"),
            ("health", "health"),
            ("releases", "releases"),
        ):
            if key in variables:
                raw.setdefault(name, variables[key])
        of = groups.of(host)
        own = [group for group in of if group.startswith("board_")]
        kind = "robots" if own or "robots" in of else "stations"
        inside = ", ".join(own)
        faults = (
            ("robots" in of and not own, "stands in no board group", f"move it to one of {', '.join(boards)}"),
            (len(own) > 1, f"stands in several board groups: {inside}", "leave it in one of them"),
            (
                own and "robots" not in of,
                f"stands in {inside}, which is not below robots",
                "list the board in robots' children",
            ),
            (kind == "robots" and "stations" in of, "is robot and station", "leave it in one of the groups"),
            (
                kind == "stations" and "stations" not in of,
                "is neither robot nor station",
                "move it to the hosts of a board or of stations",
            ),
        )
        findings += [((kind, host), message, remedy) for wrong, message, remedy in faults if wrong]
        member = {"name": host} | {key: variables[key] for key in ("address",) if key in variables}
        if kind == "robots":
            member |= {key: variables[key] for key in _OF_ROBOTS if key in variables}
            member["board"] = own[0].removeprefix("board_") if own else ""
        raw[kind][host] = member
        if len(own) == 1:  # a host in several board groups has one merged `board`
            raw["boards"].setdefault(member["board"], variables.get("board"))
    for group in sources.boards():
        raw["boards"].setdefault(group.removeprefix("board_"), sources.described(group))
    for name, board in raw["boards"].items():
        if board is None:
            findings.append((("boards", name), "is not described", "copy another board's file to this one"))
        elif isinstance(board, dict):
            if "name" in board:
                findings.append((("boards", name, "name"), "is not known", f"remove it: the group {name} defines it"))
            raw["boards"][name] = board | {"name": name}
    if not raw["robots"]:
        findings.append((("robots",), "there are no robots", "add one to the group robots in robots.yml"))
    return raw, findings


def _templates(value: Any, loc: Loc) -> Iterator[Finding]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _templates(inner, (*loc, key))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from _templates(inner, (*loc, index))
    elif isinstance(value, str) and re.search(r"{{|{%", value):
        yield loc, "is a template", "write the value itself: the image builder reads the inventory as it stands"


def _remove(raw: Any, loc: Loc) -> None:
    """Take the value at `loc` out of nested mappings."""
    for step in loc[:-1]:
        raw = raw.get(step) if isinstance(raw, dict) else None
    if isinstance(raw, dict):
        raw.pop(loc[-1], None)


# Checks of values against each other, on what is left when wrong values are taken out. Anything may be missing.


def _again(items: Iterable[tuple[Loc, Any]]) -> Iterator[tuple[Loc, Any, Loc]]:
    """The items whose value an earlier item has, with the earlier one's place."""
    first: dict[Any, Loc] = {}
    for loc, value in items:
        if first.setdefault(value, loc) != loc:
            yield loc, value, first[value]


def _numbers(raw: dict[str, Any]) -> Iterator[Finding]:
    numbers = {
        ("robots", name, "number"): robot["number"] for name, robot in raw["robots"].items() if "number" in robot
    }
    free = next(number for number in count(1) if number not in numbers.values())
    for loc, _, other in _again(numbers.items()):
        yield loc, f"is {other[1]}'s number", f"each number once; the next free one is {free}"


def _addresses(raw: dict[str, Any]) -> Iterator[Finding]:
    addresses = {
        (kind, name, "address"): IPv4Address(host["address"])
        for kind in ("robots", "stations")
        for name, host in raw[kind].items()
        if "address" in host
    }
    subnet = raw.get("network", {}).get("subnet")
    hosts = IPv4Network(subnet).hosts() if subnet else iter(())
    free = next((f"; the next free one is {host}" for host in hosts if host not in addresses.values()), "")
    for loc, _, other in _again(addresses.items()):
        yield loc, f"is {other[1]}'s address", f"each address once{free}"
    for loc, address in addresses.items() if subnet else ():
        net = IPv4Network(subnet)
        if address not in net:
            yield loc, f"lies outside the fleet's network {net}", f"{net[1]} to {net[-2]}{free}"
        elif address in (net[0], net[-1]):
            yield (
                loc,
                f"is the {'network' if address == net[0] else 'broadcast'} address",
                f"{net[1]} to {net[-2]}{free}",
            )


def _devices(raw: dict[str, Any]) -> Iterator[Finding]:
    for name, robot in raw["robots"].items():
        board = raw["boards"].get(robot["board"], {})
        ports, console = board.get("ports"), (board.get("console") or {}).get("tty")
        used = {
            ("robots", name, "devices", device, "port"): plug["port"]
            for device, plug in robot.get("devices", {}).items()
            if "port" in plug
        }
        for loc, port, other in _again(used.items()):
            yield loc, f"{other[3]} is plugged into {port} already", _free(ports, used.values(), console)
        for loc, port in used.items() if ports else ():
            if port not in ports:
                yield loc, f"the board {robot['board']} has no such port", _free(ports, used.values(), console)
            elif console and ports[port].get("tty") == console:
                yield loc, f"is the console's port ({console})", _free(ports, used.values(), console)
        yield from _plugged(name, robot.get("devices", {}))


def _plugged(robot: str, devices: dict[str, Any]) -> Iterator[Finding]:
    """Each device is at a port or on USB, and USB tells each from the others."""
    identities: dict[Loc, str] = {}
    for device, plug in devices.items():
        loc: Loc = ("robots", robot, "devices", device)
        if bool(plug.get("port")) == bool(plug.get("usb")):
            wrong = "is both at a port and on USB" if plug.get("port") else "is plugged into nothing: port is missing"
            yield loc, wrong, "either port, such as COM5, or usb, such as '15d1:0000'"
        elif plug.get("usb"):
            identities[(*loc, "usb")] = plug["usb"]
    for loc, identity in identities.items():
        for other, another in identities.items():
            if loc != other and identity.startswith(another) and (len(identity) > len(another) or other < loc):
                yield loc, f"is also {other[3]}'s", "the serial number of each behind it, such as '0403:6001/A9XYZ'"


def _named(raw: dict[str, Any], robot: str, key: str) -> dict[Loc, str]:
    """Names in a robot's list of tasks or apps."""
    tasks = raw["robots"][robot].get(key)
    return {
        ("robots", robot, key, index): task
        for index, task in enumerate(tasks if isinstance(tasks, list) else ())
        if isinstance(task, str)
    }


def _tasks(raw: dict[str, Any]) -> Iterator[Finding]:
    there = messages.task_names()
    for name in raw["robots"]:
        named = _named(raw, name, "control_tasks")
        for loc, task, _ in _again(named.items()):
            yield loc, f"{task} is listed already", "each task once"
        if len(named) > privileges.MOST_TASKS:
            yield ("robots", name, "control_tasks"), f"has {len(named)} tasks", f"{privileges.MOST_TASKS} at most"
        for loc, task in named.items():
            if task not in there:
                yield loc, f"there is no file {paths.shown(paths.TASKS)}/{task}.yml", f"one of {', '.join(there)}"


def _apps(raw: dict[str, Any]) -> Iterator[Finding]:
    there = apps.names()
    for name, robot in raw["robots"].items():
        named = _named(raw, name, "apps")
        for loc, app, _ in _again(named.items()):
            yield loc, f"{app} is listed already", "each app once"
        for loc, app in named.items():
            file = paths.shown(paths.APPS / app / apps.FILE)
            if app not in there:
                others = f"one of {', '.join(there)}, or " if there else ""
                yield loc, f"there is no {file}", f"{others}`make new-app KIND=block NAME={app}` makes a working start"
            elif (board := apps.board(app)) not in (None, robot["board"]):
                remedy = f"give it to robots of that board, or change {file}"
                yield loc, f"{app} is for the board {board}, and {name} is a {robot['board']}", remedy
            elif app in _named(raw, name, "control_tasks").values():
                yield loc, f"{app} is one of {name}'s control tasks, too", f"rename {paths.shown(paths.APPS / app)}"


def _standby(raw: dict[str, Any]) -> Iterator[Finding]:
    tasks = {name: set(_named(raw, name, "control_tasks").values()) for name in raw["robots"]}
    named = {name: _named(raw, name, "standby") for name in raw["robots"]}
    first = {task for name in raw["robots"] for task in tasks[name] - set(named[name].values())}
    for name in raw["robots"]:
        for loc, task, _ in _again(named[name].items()):
            yield loc, f"{task} is listed already", "each task once"
        for loc, task in named[name].items():
            if task not in tasks[name]:
                yield loc, f"{task} is none of {name}'s control tasks", "list it in control_tasks too, or remove it"
            elif task not in first:
                yield loc, f"no robot has {task} first", "remove it from one robot's standby: that one is listened to"


def _required_sensors(raw: dict[str, Any]) -> Iterator[Finding]:
    health = raw.get("health")
    required = health.get("required_sensors") if isinstance(health, dict) else None
    tasks = {task for name in raw["robots"] for task in _named(raw, name, "control_tasks").values()}
    named = {
        ("health", "required_sensors", index): sensor
        for index, sensor in enumerate(required if isinstance(required, list) else ())
        if isinstance(sensor, str)
    }
    for loc, sensor in named.items():
        if (task := sensor.partition(".")[0]) not in tasks:
            remedy = f"a sensor of {', '.join(sorted(tasks))}" if tasks else "remove it"
            yield loc, f"no robot has a control task {task}", remedy


def _free(ports: dict[str, Any] | None, used: Iterable[str], console: str | None) -> str:
    """The ports of a board that one more device could take."""
    names = [name for name, port in (ports or {}).items() if name not in used and port.get("tty") != console]
    names.sort(key=lambda name: (len(name), name))
    return f"free are {', '.join(names)}" if names else "no port is free"


def _boards(raw: dict[str, Any]) -> Iterator[Finding]:
    for name, board in raw["boards"].items():
        ports = board.get("ports", {})
        ttys = {("boards", name, "ports", port, "tty"): facts["tty"] for port, facts in ports.items() if "tty" in facts}
        bases = {
            ("boards", name, "ports", port, "isa", "io"): facts["isa"]["io"]
            for port, facts in ports.items()
            if facts.get("isa") and "io" in facts["isa"]
        }
        for loc, _, other in _again([*ttys.items(), *bases.items()]):
            yield loc, f"belongs to port {other[3]} already", "each port has its own"

        # 8250.nr_uarts: Debian's kernels make 4 ports unless told so (SERIAL_8250_RUNTIME_UARTS) and 32 at most.
        arguments = " ".join(map(str, board.get("kernel_arguments", ())))
        limit = re.search(r"8250\.nr_uarts=(\d+)", arguments)
        uarts = int(limit[1]) if limit else 4
        needed = 1 + max((int(tty[4:]) for tty in ttys.values() if tty.startswith("ttyS")), default=-1)
        if needed > uarts and "kernel_arguments" in board:
            loc = ("boards", name, "kernel_arguments")
            yield loc, f"the kernel makes only ttyS0 to ttyS{uarts - 1}", f"add 8250.nr_uarts={max(16, needed)}"

        count = board.get("processors", 1)
        for at, processor in enumerate(board.get("isolated_processors", ())):
            if isinstance(count, int) and isinstance(processor, int) and processor >= count:
                loc = ("boards", name, "isolated_processors", at)
                yield loc, f"the board has processors 0 to {count - 1}", "write `processors:`, or remove it"
        if board.get("architecture") == "i386":
            if board.get("suite") == "trixie":
                yield ("boards", name, "suite"), "Debian 13 has no kernel for i386", "bookworm"
            if board.get("firmware") == "uefi":
                yield ("boards", name, "firmware"), "the boot loader for UEFI is for amd64", "bios"
        if board.get("architecture") == "amd64" and board.get("qemu", {}).get("system") == "i386":
            yield ("boards", name, "qemu", "system"), "cannot run amd64", "x86_64"


def _files_of_boards(raw: dict[str, Any]) -> Iterator[Finding]:
    """A board's further files, which have its name."""
    for name, board in raw["boards"].items():
        packages, kernel = find(paths.PACKAGES, f"{name}.list"), find(paths.KERNELS, f"{name}.yml")
        if not packages.is_file():
            remedy = "copy another board's and name the board's kernel package in it"
            yield ("boards", name), f"has no package list {paths.shown(packages)}", remedy
        if board.get("kernel") == "lean" and not kernel.is_file():
            remedy = "write that file as another board has it, or take debian"
            yield ("boards", name, "kernel"), f"there is no {paths.shown(kernel)}", remedy


def _radio(raw: dict[str, Any]) -> Iterator[Finding]:
    network = raw.get("network", {})
    if network.get("link") == "ibss" and not network.get("ibss"):
        yield ("network", "ibss"), "is missing, and the link is ibss", "give ssid, frequency_mhz and bssid"


_CHECKS = (
    _numbers,
    _addresses,
    _devices,
    _tasks,
    _apps,
    _standby,
    _required_sensors,
    _boards,
    _files_of_boards,
    _radio,
)
