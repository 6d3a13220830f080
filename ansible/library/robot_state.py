#!/usr/bin/python3
"""What a robot is, beside what it should be: the files it has of its own, and what it runs. It changes nothing.

A robot's root is common to all; what it has of its own lies in the layer above /etc on its data partition. So drift is
what differs there from what the image brought, and nothing else needs to be looked at.

This module reads its arguments as text and does without `AnsibleModule`, whose import takes an emulated Pentium III
seconds.
"""

from __future__ import annotations

import fnmatch
import glob
import hashlib
import json
import os
import pwd
import re
import signal
import socket
import stat
import subprocess
import time

TYPE_CHECKING = False
if TYPE_CHECKING:  # without an import: it takes time
    from collections.abc import Iterable, Iterator
    from typing import Any

ARGUMENTS = r"""<<INCLUDE_ANSIBLE_MODULE_JSON_ARGS>>"""
APPS = "/data/apps"
LISTINGS = "/etc/flotilla/apps"
SYSTEM = "/etc/systemd/system"
APP_SERVICE = "/usr/lib/systemd/system/flotilla-app@.service"
SHOWN_BYTES = 65536
LOOKED_AT_S = 1.0
"""At least, for overruns to show."""
PATIENCE_S = 10.0
"""For required sensors of a task that has just started."""
UNIT_PROPERTIES = "Id,Type,ActiveState,SubState,Result,ConditionResult,RemainAfterExit,NRestarts,UnitFileState"


def output(*argv: str) -> str:
    """Standard output of a program, empty where it fails."""
    return subprocess.run(argv, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=False).stdout


def read(path: str) -> str:
    with open(path) as file:
        return file.read()


LAYER = "/data/B/etc" if "flotilla.slot=B" in read("/proc/cmdline").split() else "/data/A/etc"
"""Above /etc: of the running slot's release."""


class Root:
    """The root below the layers, seen through the mounts of a process that has it mounted once more."""

    def __init__(self) -> None:
        script = "mount --bind / /mnt && echo ready && exec sleep 60"
        argv = ["unshare", "--mount", "sh", "-c", script]
        self._process = subprocess.Popen(argv, stdout=subprocess.PIPE)
        if not self._process.stdout or self._process.stdout.readline() != b"ready\n":
            raise OSError("cannot look below the layers of /etc")

    def close(self) -> None:
        self._process.send_signal(signal.SIGKILL)
        self._process.wait()

    def path(self, path: str) -> str:
        return f"/proc/{self._process.pid}/root/mnt{path}"


class Found:
    """A file as it is."""

    def __init__(self, kind: int, mode: int, owner: tuple[int, int], content: bytes) -> None:
        self.kind, self.mode, self.owner, self.content = kind, mode, owner, content

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Found) and vars(self) == vars(other)

    __hash__ = None  # type: ignore[assignment]  # nobody asks


def described(path: str) -> Found | None:
    """What there is; None where there is nothing."""
    try:
        found = os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return None
    content = b""
    if stat.S_ISLNK(found.st_mode):
        content = os.readlink(path).encode()
    elif stat.S_ISREG(found.st_mode):
        with open(path, "rb") as file:
            content = file.read()
    return Found(stat.S_IFMT(found.st_mode), stat.S_IMODE(found.st_mode), (found.st_uid, found.st_gid), content)


def is_whiteout(path: str) -> bool:
    found = os.lstat(path)
    return stat.S_ISCHR(found.st_mode) and found.st_rdev == 0


def is_opaque(directory: str) -> bool:
    """Whether a directory was removed and made anew, which hides what the root has in it."""
    try:
        return os.getxattr(directory, "trusted.overlay.opaque") == b"y"
    except OSError:
        return False


def shown(found: Found | None) -> str:
    """A file's content as text for a person; nothing of a file that is not for everyone."""
    if found is None or found.kind == stat.S_IFDIR:
        return ""
    if found.kind == stat.S_IFREG and not found.mode & stat.S_IROTH:
        return "(private)\n"
    text = found.content[:SHOWN_BYTES].decode(errors="replace")
    return text if text.endswith("\n") or not text else text + "\n"


def below(directory: str) -> Iterator[str]:
    """All paths of files and links below a directory."""
    for place, directories, names in os.walk(directory):
        for name in [*names, *(each for each in directories if os.path.islink(os.path.join(place, each)))]:
            yield os.path.join(place, name)


def drift(expected: dict[str, dict[str, Any]], keep: list[str]) -> list[dict[str, str]]:
    """Files that are not as they should be: path, what to do (`write`, `remove`, `restore`), why, and the content."""
    found: list[dict[str, str]] = []

    def add(path: str, action: str, why: str, before: Found | None) -> None:
        found.append({"path": path, "action": action, "why": why, "before": shown(before)})

    for path, wanted in sorted(expected.items()):
        there = described(path)
        if there is None:
            add(path, "write", "is missing", None)
        elif there.kind != stat.S_IFREG or hashlib.sha256(there.content).hexdigest() != wanted["sha256"]:
            add(path, "write", "has another content", there)
        elif there.mode != wanted["mode"] or there.owner != (0, 0):
            add(path, "write", f"has mode {there.mode:o} and owner {there.owner[0]}", there)
    layer = [path[len(LAYER) - len("/etc") :] for path in below(LAYER)]
    kept = {path for pattern in keep for path in fnmatch.filter(layer, pattern)}
    others = sorted(path for path in layer if path not in expected and path not in kept)
    hidden = [place[len(LAYER) - len("/etc") :] for place, _, _ in os.walk(LAYER) if is_opaque(place)]
    if not others and not hidden:
        return found
    root = Root()
    try:
        for path in others:
            below_layer, there = described(root.path(path)), described(path)
            if is_whiteout(LAYER + path[len("/etc") :]):
                add(path, "restore", "was removed", None)
            elif below_layer is None:
                add(path, "remove", "does not belong to the robot", there)
            elif there != below_layer:
                add(path, "restore", "differs from the image", there)
        for directory in hidden:
            prefix = len(root.path(""))
            for path in (each[prefix:] for each in below(root.path(directory))):
                if path not in expected and not os.path.lexists(path):
                    add(path, "restore", "was removed", None)
    finally:
        root.close()
    return found


def sysctl_drift() -> list[list[str]]:
    """Settings of the kernel that are not what /etc/sysctl.d says: name, is, should be."""
    found = []
    for name in sorted(os.listdir("/etc/sysctl.d")):
        settings = re.findall(r"^\s*([^#;\s=]+)\s*=\s*(.*?)\s*$", read(f"/etc/sysctl.d/{name}"), re.MULTILINE)
        for key, wanted in settings:
            try:
                there = " ".join(read("/proc/sys/" + key.replace(".", "/")).split())
            except OSError:
                there = "(missing)"
            if there != wanted:
                found.append([key, there, wanted])
    return found


def firewall_is_loaded() -> bool:
    """Whether the rules in force are those that the file makes in a network that has none, whatever they counted."""
    made = "nft -f /etc/nftables.conf && nft -s -t list ruleset"
    return output("nft", "-s", "-t", "list", "ruleset") == output("unshare", "--net", "sh", "-c", made)


def app_unit(name: str) -> str:
    return f"flotilla-app@{name}.service"


def leads(link: str, where: str) -> bool:
    return os.path.islink(link) and os.readlink(link) == where


def names_in(directory: str) -> list[str]:
    """What is in a directory and not hidden; nothing where there is none."""
    return [name for name in (os.listdir(directory) if os.path.isdir(directory) else ()) if not name.startswith(".")]


def apps(wanted: dict[str, Any], services: dict[str, dict[str, str]]) -> dict[str, dict[str, Any]]:
    """By name, the apps that a robot has or should have.

    Of each: `version` that is there, empty where none is; `listed`, the version that the inventory gave; whether it
    starts with the robot (`kept`), its service has its `drop_in`, and it is `up`; `files`: what is wrong with those of
    an app that the robot should have.
    """
    found = {}
    for name in sorted({*wanted, *names_in(APPS), *names_in(LISTINGS)}):
        place = os.path.join(APPS, name)
        there = described(place)
        is_link = there is not None and there.kind == stat.S_IFLNK and os.path.isdir(place)
        listing = described(os.path.join(LISTINGS, name))
        first = listing.content.decode(errors="replace").split("\n")[0].split() if listing else []
        unit = services.get(app_unit(name))
        found[name] = {
            "version": os.readlink(place).partition("@")[2] if is_link else "",
            "listed": first[1] if first[:1] == ["version"] and len(first) == 2 else "",
            "kept": leads(os.path.join(SYSTEM, "multi-user.target.wants", app_unit(name)), APP_SERVICE),
            "drop_in": leads(os.path.join(SYSTEM, f"{app_unit(name)}.d"), os.path.join(place, "unit.d")),
            "up": unit is not None and is_up(unit),
            "files": app_files(place, wanted[name]["files"]) if name in wanted and is_link else [],
        }
    return found


def app_files(place: str, wanted: dict[str, dict[str, Any]]) -> list[str]:
    """What is wrong with the files of an app."""
    top = os.path.realpath(place)
    found = []
    for path in sorted({*wanted, *(os.path.relpath(each, top) for each in below(top))}):
        there = described(os.path.join(top, path))
        if path not in wanted:
            found.append(f"{path} does not belong to it")
        elif there is None:
            found.append(f"{path} is missing")
        elif there.kind != stat.S_IFREG or hashlib.sha256(there.content).hexdigest() != wanted[path]["sha256"]:
            found.append(f"{path} has another content")
        elif there.mode != wanted[path]["mode"] or there.owner != (0, 0):
            found.append(f"{path} has mode {there.mode:o} and owner {there.owner[0]}")
    return found


def units(tasks: list[str], apps: Iterable[str] = ()) -> dict[str, dict[str, str]]:
    """Services that start with the robot, by name. Of tasks and apps, those that are named, and tasks that run."""
    # What `systemctl list-unit-files` would say, which takes an old processor twenty seconds.
    wanted = glob.glob("/etc/systemd/system/*.wants/*.service")
    names = sorted({os.path.basename(path) for path in wanted if os.path.exists(path)})
    names = [name for name in names if "@." not in name and not name.startswith("flotilla-app@")]
    names += [*(f"flotilla-task@{task}.service" for task in tasks), *map(app_unit, apps)]
    instances = "flotilla-task@*.service", "flotilla-ibss@*.service", "flotilla-cell@*.service"
    running = output("systemctl", "list-units", "--plain", "--no-legend", "--all", *instances)
    names += [line.split()[0] for line in running.splitlines() if line.split()[0] not in names]
    blocks = output("systemctl", "show", "--property", UNIT_PROPERTIES, *names).strip().split("\n\n")
    shown = (dict(line.split("=", 1) for line in block.splitlines()) for block in blocks)
    return {unit["Id"]: unit for unit in shown if "Id" in unit}


def is_up(unit: dict[str, str]) -> bool:
    """Whether a service does what it is there for."""
    if unit["ActiveState"] in ("active", "reloading"):
        return True
    if unit["ActiveState"] == "activating":  # a robot may have just booted; one that fails again and again is waiting
        return not unit["SubState"].startswith("auto-restart")
    done = unit["Type"] == "oneshot" and unit["RemainAfterExit"] == "no" and unit["Result"] == "success"
    return unit["ActiveState"] == "inactive" and (unit["ConditionResult"] == "no" or done)


def clock() -> dict[str, Any]:
    """What chrony says: offset from its source in s, and whether it follows one."""
    fields = output("chronyc", "-c", "tracking").strip().split(",")
    if len(fields) < 14:
        return {"synchronised": False, "offset_s": None}
    return {"synchronised": fields[13] != "Not synchronised", "offset_s": float(fields[4])}


def status(task: str) -> dict[str, Any]:
    """How a running task does, as it says itself (runtime/executive/status.h), or the `problem` with that."""
    argv = ["flotilla-param", "--status=json", task]
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    if done.returncode:
        return {"problem": done.stderr.strip() or f"flotilla-param ended with status {done.returncode}"}
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


class Watch:
    """Control tasks, from now on until `end`."""

    def __init__(self, tasks: list[str]) -> None:
        self._begun = time.monotonic()
        self._before = {task: status(task) for task in tasks}

    def end(self, required: list[str]) -> dict[str, dict[str, Any]]:
        """How each does, and `lately`, meanwhile. It waits for `required` sensors (TASK.BLOCK) that are not good."""
        if not self._before:
            return {}
        time.sleep(max(0.0, self._begun + LOOKED_AT_S - time.monotonic()))
        while True:
            now = {task: status(task) for task in self._before}
            good = [f"{task}.{name}" for task in now for name, it in now[task].get("sensors", {}).items() if it["flag"]]
            waiting = [name for name in required if name.split(".")[0] in now and name not in good]
            if not waiting or time.monotonic() > self._begun + PATIENCE_S:
                break
            time.sleep(0.5)
        return {task: lately(self._before[task], found) for task, found in now.items()}


def lately(before: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """What a task says, and of it what is new; all is where it started anew meanwhile."""
    if "problem" in now:
        return now
    same = before.get("steps", now["steps"] + 1) <= now["steps"]
    return {**now, "lately": {key: now[key] - (before[key] if same else 0) for key in ("steps", "overruns")}}


def main() -> None:
    arguments = json.loads(ARGUMENTS)
    services = units(arguments["control_tasks"], arguments["apps"])
    names = {name: re.findall("flotilla-task@(.+)[.]service$", name) for name in services}
    tasks = {name: task for name, found in names.items() for task in found}
    watch = Watch([task for name, task in tasks.items() if services[name]["ActiveState"] == "active"])
    interface = json.loads(output("ip", "-json", "-4", "address", "show", "dev", arguments["interface"]) or "[]")
    addresses = [f"{each['local']}/{each['prefixlen']}" for link in interface for each in link.get("addr_info", [])]
    uarts = re.findall(r"^(\d+): uart:(?!unknown)", read("/proc/tty/driver/serial"), re.MULTILINE)
    data = os.statvfs("/data")
    wanted = {name for name, task in tasks.items() if task in arguments["control_tasks"]}
    failed = output("systemctl", "list-units", "--state=failed", "--plain", "--no-legend")
    state: dict[str, Any] = {
        "drift": drift(arguments["expected"], arguments["keep"]),
        "hostname": socket.gethostname(),
        "machine": os.uname().machine,
        "uarts": [f"ttyS{number}" for number in uarts],
        "users": [each.pw_name for each in pwd.getpwall()],
        "addresses": addresses,
        "firewall_is_loaded": firewall_is_loaded(),
        "sysctl": sysctl_drift(),
        "apps": apps(arguments["apps"], services),
        "down": sorted(
            name
            for name, unit in services.items()
            if not is_up(unit) and (name not in tasks or name in wanted) and not name.startswith("flotilla-app@")
        ),
        "superfluous_tasks": sorted(
            name for name in tasks.keys() - wanted if services[name]["ActiveState"] not in ("inactive", "failed")
        ),
        "failed": [line.split()[0] for line in failed.splitlines()],
        "tasks": {
            name: {key: services[name][key] for key in ("ActiveState", "SubState", "NRestarts")} for name in tasks
        },
        "clock": clock(),
        "release": json.loads(output("flotilla-slot", "show") or "null"),
        "data_is_writable": not data.f_flag & os.ST_RDONLY,
        "data_free_bytes": data.f_bavail * data.f_frsize,
        "boot_id": read("/proc/sys/kernel/random/boot_id").strip(),
    }
    statuses = watch.end(arguments["required_sensors"])
    for name, task in tasks.items():
        state["tasks"][name]["status"] = statuses.get(task)
    print(json.dumps({"changed": False, "state": state}))


if __name__ == "__main__":
    try:
        main()
    except (OSError, ValueError, KeyError) as error:
        print(json.dumps({"failed": True, "msg": f"{type(error).__name__}: {error}"}))
