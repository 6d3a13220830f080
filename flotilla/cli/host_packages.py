"""Debian packages that a command needs on this computer.

`make` installs them before it starts a command. Where the tool was installed as a package, the command does.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from flotilla.cli.command import Command, HostList
from flotilla.common import paths
from flotilla.common.errors import UserError

LISTS: dict[HostList, Path] = {
    "build": paths.PROJECT / "images/host-packages.txt",
    "lab": paths.PACKAGE / "lab/host-packages.txt",
    "runtime": paths.PROJECT / "runtime/host-packages.txt",
}
_SCRIPTS = paths.PROJECT / "images"


def install(command: Command) -> None:
    """Install the packages that are missing, by apt. UserError where that is not possible."""
    if not paths.INSTALLED or not command.host:
        return
    lists = [str(LISTS[name]) for name in command.host]
    for script in ([_SCRIPTS / "check-host"], [_SCRIPTS / "install-host-packages", *lists]):
        done = subprocess.run(["sh", *script], stdout=2, env=os.environ | {"LC_ALL": "C.UTF-8"}, check=False)
        if done.returncode:
            raise UserError(f"flotilla {command.name} needs Debian packages that could not be installed; see above")
