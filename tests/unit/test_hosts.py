"""Which computers are set up, and what is installed there: this one, with another's os-release and programs."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from flotilla.common import namespace, paths
from tests.hosts.tree import SUPPORTED, Host

UBUNTU = 'PRETTY_NAME="Ubuntu 24.04.3 LTS"\nID=ubuntu\nVERSION_ID="24.04"\nVERSION_CODENAME=noble\nID_LIKE=debian\n'
NAMED = "supported hosts are Debian 12, Debian 13, Ubuntu 24.04, with x86-64 processors"


def run(
    script: str, tmp_path: Path, os_release: str, programs: dict[str, str], *arguments: Path | str, path: str = "",
    **variables: str,
) -> subprocess.CompletedProcess[str]:  # fmt: skip
    """Run a script of images/ where `os_release` is /etc/os-release; `programs` come before all others in `path`."""
    (tmp_path / "os-release").write_text(os_release)
    (tmp_path / "bin").mkdir()
    for name, text in programs.items():
        program = tmp_path / "bin" / name
        program.write_text(f"#!/bin/sh\n{text}\n")
        program.chmod(0o755)
    inside = ["sh", "-ec", 'mount --bind "$1" /etc/os-release; shift; exec env "$@"', "sh"]
    changed = [
        f"PATH={tmp_path}/bin:{path or os.environ['PATH']}",
        *(f"{key}={word}" for key, word in variables.items()),
    ]
    whole = [
        *namespace.prefix(),
        *inside,
        tmp_path / "os-release",
        *changed,
        paths.PROJECT / "images" / script,
        *arguments,
    ]
    return subprocess.run(whole, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("host", SUPPORTED)
def test_a_supported_host_is_accepted(tmp_path: Path, host: Host) -> None:
    done = run("check-host", tmp_path, f'ID={host.id}\nVERSION_ID="{host.version}"\n', {"dpkg": "echo amd64"})
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize(
    ("os_release", "programs", "any_host", "said"),
    [
        ('PRETTY_NAME="Ubuntu 22.04 LTS"\nID=ubuntu\nVERSION_ID="22.04"\n', {}, "", "Ubuntu 22.04 LTS, amd64: a host"),
        ("PRETTY_NAME=Sid\nID=debian\n", {}, "", "Sid, amd64: a host that was not tried"),
        ('PRETTY_NAME="Linux Mint 22"\nID=linuxmint\nVERSION_ID="22"\nID_LIKE="ubuntu debian"\n', {}, "1", ""),
        ("", {}, "", "an unknown system, amd64: a host that was not tried"),
        (UBUNTU, {"dpkg": "echo arm64"}, "1", "Ubuntu 24.04.3 LTS, arm64: not an x86-64 system"),
        (UBUNTU, {"dpkg": "exit 127", "uname": "echo aarch64"}, "1", "aarch64: not an x86-64 system"),
    ],
)
def test_another_host_is_refused_at_once(
    tmp_path: Path, os_release: str, programs: dict[str, str], any_host: str, said: str
) -> None:
    """Seen to fail: packages were installed by sudo first, and what failed was the build, minutes later."""
    done = run("check-host", tmp_path, os_release, {"dpkg": "echo amd64"} | programs, ANY_HOST=any_host)
    assert (done.returncode != 0, said in done.stderr) == (bool(said), True)
    if said:
        assert NAMED in done.stderr
        assert ("with ANY_HOST=1, make tries it all the same" in done.stderr) == ("a host" in said)


def test_a_host_without_apt_is_refused(tmp_path: Path) -> None:
    """As ANY_HOST=1 leaves it: nothing could be installed there."""
    programs = {name: f'exec {shutil.which(name)} "$@"' for name in ("dirname", "sed", "tr")}
    fedora = 'PRETTY_NAME="Fedora Linux 41"\nID=fedora\nVERSION_ID=41\n'
    done = run("check-host", tmp_path, fedora, {"uname": "echo x86_64"} | programs, path="/nowhere", ANY_HOST="1")
    assert done.returncode == 1
    assert "Fedora Linux 41, x86_64: no apt, which installs what building needs" in done.stderr
    assert NAMED in done.stderr
    assert "ANY_HOST" not in done.stderr


@pytest.mark.parametrize(
    ("os_release", "installed"), [(UBUNTU, "one two"), ("ID=debian\nVERSION_ID=13\n", "one three")]
)
def test_some_packages_are_for_debian_alone_or_for_other_hosts(tmp_path: Path, os_release: str, installed: str) -> None:
    (tmp_path / "list").write_text("# a list\none # reason\ntwo [!debian] # reason\nthree [debian] # reason\n")
    said = 'echo "$@"'
    programs = {"dpkg-query": "exit 1", "apt-get": said, "sudo": said}
    done = run("install-host-packages", tmp_path, os_release, programs, tmp_path / "list")
    assert done.returncode == 0, done.stderr
    assert f"install -y --no-install-recommends {installed} -q " in done.stdout.splitlines()[-1]


@pytest.mark.parametrize("page", ["README.md", "docs/tutorial.md"])
def test_pages_name_the_supported_hosts(page: str) -> None:
    text = " ".join((paths.PROJECT / page).read_text().split())
    named = set(re.findall(r"\b(Debian|Ubuntu) ([\d.]*\d)", text))
    assert named >= {(name.capitalize(), version) for name, version, _ in SUPPORTED}
