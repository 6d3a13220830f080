"""The script that installs Debian packages of this computer, with other programs in the places of apt and sudo."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from flotilla.common import paths

_PROGRAMS = {
    "id": "echo 1000",
    "dpkg-query": "exit 1",
    "sudo": 'exec env -i PATH="$PATH" LOG="$LOG" "$@"',
    "apt-get": 'echo "$1 $http_proxy $https_proxy $no_proxy" >>"$LOG"',
}


def test_proxies_of_the_environment_reach_apt(tmp_path: Path) -> None:
    """sudo drops them. Seen to fail: apt had none, and waited for a firewall."""
    programs = tmp_path / "programs"
    programs.mkdir()
    for name, text in _PROGRAMS.items():
        (programs / name).write_text(f"#!/bin/sh\n{text}\n")
        (programs / name).chmod(0o755)
    (tmp_path / "packages.txt").write_text("tool # needed\n")
    environment = {
        "PATH": f"{programs}:{os.environ['PATH']}",
        "LOG": str(tmp_path / "log"),
        "http_proxy": "http://proxy:1",
        "https_proxy": "http://proxy:2",
        "no_proxy": "near,*.near",
    }
    subprocess.run(
        [paths.PROJECT / "images/install-host-packages", tmp_path / "packages.txt"], env=environment, check=True
    )
    assert (tmp_path / "log").read_text().splitlines() == [
        f"{command} http://proxy:1 http://proxy:2 near,*.near" for command in ("update", "install")
    ]
