"""Debian packages that a command needs on this computer: the command installs them.

In a checkout, `make setup` has installed those of the list `build` before there was a Python for commands.
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
    lists = [str(LISTS[name]) for name in command.host if paths.INSTALLED or name != "build"]
    if not lists:
        return
    scripts = [[str(_SCRIPTS / "install-host-packages"), *lists]]
    if paths.INSTALLED:
        scripts.insert(0, [str(_SCRIPTS / "check-host")])
    for script in scripts:
        done = subprocess.run(["sh", *script], stdout=2, env=os.environ | {"LC_ALL": "C.UTF-8"}, check=False)
        if done.returncode:
            raise UserError(f"flotilla {command.name} needs Debian packages that could not be installed; see above")
