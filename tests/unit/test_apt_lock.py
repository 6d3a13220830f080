"""images/install-host-packages, with an apt that only notes what it is asked."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from flotilla.common import paths

APT = """#!/bin/sh
echo "$*" >>{directory}/asked
[ -e {directory}/held ] || exit 0
cat {directory}/held >&2
[ -s {directory}/lasting ] || rm {directory}/held
exit 100
"""

LOCKED = "E: Could not get lock /var/lib/apt/lists/lock. It is held by process 7 (apt-get)\n"


def install(
    directory: Path, *, held: str = "", lasting: bool = False
) -> tuple[subprocess.CompletedProcess[str], list[str]]:
    """`held`: why the first run of apt fails, or all of them."""
    programs = {"apt-get": APT.format(directory=directory), "sudo": '#!/bin/sh\nexec "$@"\n', "sleep": "#!/bin/sh\n"}
    for name, text in programs.items():
        (directory / name).write_text(text)
        (directory / name).chmod(0o755)
    if held:
        (directory / "held").write_text(held)
    if lasting:
        (directory / "lasting").write_text("x")
    (directory / "list").write_text("no-such-package-anywhere # for the test\n")
    argv = [str(paths.PROJECT / "images" / "install-host-packages"), str(directory / "list")]
    environment = os.environ | {"PATH": f"{directory}:{os.environ['PATH']}"}
    done = subprocess.run(argv, env=environment, capture_output=True, text=True, timeout=60, check=False)
    return done, (directory / "asked").read_text().splitlines()


def test_packages_are_installed_when_another_apt_has_ended(tmp_path: Path) -> None:
    """Seen to fail: `Could not get lock`, and the first command of a new user ended there."""
    done, asked = install(tmp_path, held=LOCKED)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("another apt runs on this computer: waiting for it, 600 s at most") == 1
    assert [words.split()[0] for words in asked] == ["update", "update", "install"]
    assert asked[-1] == "install -y --no-install-recommends no-such-package-anywhere -q -o DPkg::Lock::Timeout=600"


def test_nobody_waits_where_no_other_apt_runs(tmp_path: Path) -> None:
    done, asked = install(tmp_path)
    assert (done.returncode, len(asked)) == (0, 2)
    assert "waiting" not in done.stderr


def test_an_apt_that_never_ends_is_not_awaited_for_ever(tmp_path: Path) -> None:
    done, asked = install(tmp_path, held=LOCKED, lasting=True)
    assert (done.returncode, len(asked)) == (1, 600)
    assert done.stderr.endswith(LOCKED)


def test_another_error_of_apt_ends_at_once(tmp_path: Path) -> None:
    done, asked = install(tmp_path, held="E: broken sources\n")
    assert (done.returncode, len(asked), done.stderr.splitlines()[-1]) == (1, 1, "E: broken sources")
