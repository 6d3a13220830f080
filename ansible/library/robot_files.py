#!/usr/bin/python3
"""Bring files of a robot to what they should be, and let them take effect.

Each is written beside and renamed, so that power may go at any time. What was begun is finished though the station
goes: files that never took effect would look right in the next run.

`robot_state` says why this does without `AnsibleModule`, and what `restore` means: back to what the root below has.
"""

from __future__ import annotations

import base64
import json
import os
import signal
import subprocess

TYPE_CHECKING = False
if TYPE_CHECKING:  # without an import: it takes time
    from typing import Any

ARGUMENTS = r"""<<INCLUDE_ANSIBLE_MODULE_JSON_ARGS>>"""
RESTORE = """
mount --bind / /mnt || exit
for path; do
    mkdir -p "${path%/*}" && rm -rf "$path.flotilla-new" && cp -a "/mnt$path" "$path.flotilla-new" &&
        mv -fT "$path.flotilla-new" "$path" || exit
done
"""


def write(path: str, content: bytes, mode: int) -> None:
    directory = os.path.dirname(path)
    os.makedirs(directory, mode=0o755, exist_ok=True)
    beside = f"{path}.flotilla-new"
    with open(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
        os.fchmod(file.fileno(), mode)
        os.fchown(file.fileno(), 0, 0)
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.rename(beside, path)


def remove(path: str) -> None:
    """Remove a file and the directories that this leaves empty on the way up."""
    os.unlink(path)
    try:
        os.removedirs(os.path.dirname(path))
    except OSError:
        return  # something is left in it


class RefusedError(Exception):
    """A command that comes before the files has failed."""


def run_first(command: dict[str, Any]) -> None:
    """Run one of the commands that come before the files."""
    stdin = base64.b64decode(command["stdin"])
    done = subprocess.run(command["argv"], input=stdin, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, check=False)
    if done.returncode:
        message = done.stderr.decode(errors="replace").strip()
        raise RefusedError(f"{command['name']}: {message or f'status {done.returncode}'}")


def main() -> None:
    arguments = json.loads(ARGUMENTS)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    for command in arguments["before"]:
        run_first(command)
    for path, file in arguments["write"].items():
        write(path, base64.b64decode(file["content"]), file["mode"])
    for path in arguments["remove"]:
        remove(path)
    if arguments["restore"]:
        argv = ["unshare", "--mount", "sh", "-c", RESTORE, "sh", *arguments["restore"]]
        subprocess.run(argv, check=True, capture_output=True)
    os.sync()
    subprocess.run(["sh", "-c", arguments["then"]], check=True, capture_output=True)
    print(json.dumps({"changed": True}))


if __name__ == "__main__":
    try:
        main()
    except (OSError, ValueError, KeyError) as error:
        print(json.dumps({"failed": True, "msg": f"{type(error).__name__}: {error}"}))
    except RefusedError as error:
        print(json.dumps({"failed": True, "msg": str(error)}))
    except subprocess.CalledProcessError as error:
        print(json.dumps({"failed": True, "msg": f"{error.cmd[2]}: {error.stderr.decode(errors='replace').strip()}"}))
