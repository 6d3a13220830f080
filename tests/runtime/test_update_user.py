"""What parses an update's bytes on a robot does so without root's privileges."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from flotilla.common import namespace, paths
from flotilla.fleet import privileges
from flotilla.updates import multicast

_SEED = paths.PROJECT / "runtime/tests/fuzz/corpus/patch/add"
_ASK = """
import subprocess, sys
program, base, seed = sys.argv[1:]
with subprocess.Popen([program, base], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as patch:
    patch.stdin.write(open(seed, "rb").read())
    patch.stdin.flush()
    assert patch.stdout.read(20) == b"abcdefghijklmnopqrst"
    print(open(f"/proc/{patch.pid}/status").read())
"""


@pytest.fixture
def base(tmp_path: Path) -> Path:
    """That root alone reads, as a slot's device."""
    (tmp_path / "base").write_bytes(bytes(4096))
    (tmp_path / "base").chmod(0o600)
    return tmp_path / "base"


def test_a_delta_is_read_without_privileges(flotilla_run: Path, base: Path) -> None:
    """Seen to fail: it was read as root, with all capabilities."""
    argv = [sys.executable, "-c", _ASK, str(flotilla_run.with_name("flotilla-patch")), str(base), str(_SEED)]
    done = subprocess.run(
        [*namespace.prefix("--mount-proc"), *argv], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    found = dict(re.findall(r"^(\w+):[ \t]*(.*?)[ \t]*$", done.stdout, re.MULTILINE))
    assert found["Uid"].split() == found["Gid"].split() == [str(privileges.UPDATE_NUMBER)] * 4
    assert found["Groups"] == ""
    assert {found[name] for name in ("CapPrm", "CapEff", "CapInh", "CapAmb")} == {"0" * 16}
    assert found["NoNewPrivs"] == "1"


def test_who_cannot_give_up_privileges_reads_nothing(flotilla_run: Path, base: Path) -> None:
    """In a user namespace that has no other user."""
    argv = ["unshare", "--user", "--map-root-user", str(flotilla_run.with_name("flotilla-patch")), str(base)]
    done = subprocess.run(argv, input=_SEED.read_bytes(), capture_output=True, check=False, timeout=60)
    assert (done.returncode, done.stdout) == (1, b"")
    assert done.stderr.startswith(b"flotilla-patch: user 903: ")


_RECEIVE = """
set -eu
tmp=$1 program=$2 python=$3
printf 'root:x:0:0::/:/bin/sh\\nupdate:x:903:903::/:/bin/sh\\n' >$tmp/passwd
printf 'root:x:0:\\nupdate:x:903:\\n' >$tmp/group
mount --bind $tmp/passwd /etc/passwd
mount --bind $tmp/group /etc/group
mount -t tmpfs none /mnt
ip link set lo up multicast on
ip address add 10.0.0.1/24 dev lo
ip address add 10.0.0.254/24 dev lo
ip route add 239.0.0.0/8 dev lo
PATH=$tmp/bin:$PATH sh $tmp/receive begin 10.0.0.254 10.0.0.1 <$tmp/order
. /mnt/update/spool/addresses
cp $program /mnt/flotilla-receive
line=$(eval echo "$(cat $tmp/argv)")
setpriv --reuid update --regid update --clear-groups --bounding-set=-all --no-new-privs $line >$tmp/said 2>&1 &
$python -m flotilla.updates.multicast --at 10.0.0.254 --key $tmp/key --rate 3000000 $tmp/content 10.0.0.1
wait $! || true
cat $tmp/said
cmp $tmp/content "$(PATH=$tmp/bin:$PATH sh $tmp/receive end)"
stat -c '%U %a' /mnt/update/spool/in/file
"""


def test_a_file_is_received_without_privileges(flotilla_run: Path, tmp_path: Path) -> None:
    """By the script, the command line and the user of the service, in another place. Seen to fail with folders that the
    user may not enter."""
    spool = "/data/update/spool"
    script = (paths.OVERLAY / "usr/lib/flotilla/receive").read_text()
    service = (paths.OVERLAY / "usr/lib/systemd/system/flotilla-receive.service").read_text()
    assert "\nUser=update\n" in service
    assert "\nCapabilityBoundingSet=\n" in service
    (argv,) = re.findall(r"^ExecStart=/usr/bin(.*)$", service, re.MULTILINE)
    content = b"a release" * 20000
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/systemctl").write_text("#!/bin/sh\n")
    (tmp_path / "bin/systemctl").chmod(0o755)
    key = bytes(range(multicast.KEY_BYTES))
    there = "/mnt/update/spool"
    for name, text in {
        "receive": script.replace(spool, there), "argv": "/mnt" + argv.replace(spool, there),
        "order": multicast.order(key, multicast.describe(content)), "key": key.hex(),
    }.items():  # fmt: skip
        (tmp_path / name).write_text(text)
    (tmp_path / "content").write_bytes(content)
    program = flotilla_run.with_name("flotilla-receive")
    done = subprocess.run(
        [*namespace.prefix("--net", "--mount-proc"), "sh", "-c", _RECEIVE, "sh", tmp_path, program, sys.executable],
        cwd=paths.PROJECT, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[1:] == ["whole", "update 600"]


def test_the_number_is_the_images() -> None:
    source = (paths.PROJECT / "runtime/programs/flotilla_patch.c").read_text()
    assert re.findall(r"\bUSER = (\d+),", source) == [str(privileges.UPDATE_NUMBER)]
    assert privileges.UPDATE_NUMBER not in privileges.USERS.values()
