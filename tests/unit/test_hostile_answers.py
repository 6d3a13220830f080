"""Answers, archives and recordings of others that take what the station has: memory, an agent, a session."""

from __future__ import annotations

import http.client
import re
import shlex
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import pytest
import zstandard
from lz4 import frame
from mcap.opcode import Opcode

from flotilla.apps import imported
from flotilla.common import paths, processes
from flotilla.common.errors import UserError
from flotilla.debian import runtime
from flotilla.debian.lock import HOST
from flotilla.fleet.model import Fleet
from flotilla.robot import fetch, ssh
from flotilla.station import mcap_reader
from tests.unit.test_station_admission import page

__all__ = ["page"]


@pytest.fixture
def way(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """A shell's command in place of ssh."""
    return lambda command: monkeypatch.setattr(ssh, "command", lambda *_, **__: ["sh", "-c", command])


def test_an_answer_without_an_end_is_none(
    fleet: Fleet, way: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "ANSWER_BYTES", 1 << 20)
    for command in ("exec yes", "exec yes >&2"):
        way(command)
        with pytest.raises(UserError, match=r"robot1: an answer of more than 1 MiB"):
            ssh.output(fleet.robots[1], ["true"])
        with pytest.raises(UserError, match=r"robot1: an answer of more than 1 MiB"):
            fetch._listed(fleet.robots[1], "drive")


def test_a_file_is_no_longer_than_the_robot_says(fleet: Fleet, way: Callable[[str], None]) -> None:
    """Seen to fail: all was written that came."""
    way("exec yes")
    written: list[bytes] = []
    remote = fetch._Remote("log-000001.rec", 100_000, "")
    with pytest.raises(UserError, match=r"robot1: log-000001\.rec: sends more than it has"):
        fetch._append(fleet.robots[1], "drive", remote, 0, written.append, lambda _: None)
    assert sum(map(len, written)) <= remote.size


def test_an_answer_is_fit_for_a_terminal(fleet: Fleet, way: Callable[[str], None]) -> None:
    way("printf '\\033]0;x\\007\\n\\tgood\\n'")
    assert ssh.output(fleet.robots[1], ["true"]) == "\\x1b]0;x\\x07\n\tgood"
    way("printf '\\033[2J' >&2; exit 3")
    with pytest.raises(UserError, match=re.escape(r"robot1: \x1b[2J")):
        ssh.output(fleet.robots[1], ["true"])


WANTED = {"-F none", "ForwardAgent no", "ForwardX11 no", "ClearAllForwardings yes"}


def asked(argv: list[str]) -> set[str]:
    """The settings of a command line of ssh, each `name value`."""
    pairs = pairwise(argv)
    return {f"-F {value}" if flag == "-F" else value.replace('"', "").replace("=", " ") for flag, value in pairs}


def test_ssh_lends_nothing_to_a_robot_and_goes_by_no_configuration_of_the_user(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paths, "KEYS", tmp_path)
    for name in ("operator_ed25519", "known_hosts"):
        (tmp_path / name).touch()
    assert asked(ssh.command(fleet.robots[1])) >= WANTED
    variables = (paths.PROJECT / "ansible/inventory/group_vars/robots.yml").read_text()
    common = variables.partition("ansible_ssh_common_args: >-\n")[2].partition("{{")[0]
    assert asked(shlex.split(common)) >= WANTED


def test_a_member_without_a_name_is_refused(tmp_path: Path) -> None:
    """Seen to fail: IndexError."""
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr(".", b"")
    with pytest.raises(UserError, match=r"a\.zip: \.: is no file inside the archive"):
        imported._unpack(tmp_path / "a.zip", tmp_path / "out")


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def recording(compression: str, packed: bytes, said: int) -> bytes:
    """A file of one chunk."""
    content = struct.pack("<QQQI", 0, 0, said, 0) + text(compression) + struct.pack("<Q", len(packed)) + packed
    return mcap_reader._MAGIC + struct.pack("<BQ", Opcode.CHUNK, len(content)) + content + mcap_reader._MAGIC


@pytest.mark.parametrize("said", [0, 1 << 20, 300 << 20, 1 << 62])
@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_a_small_recording_takes_little_memory(tmp_path: Path, compression: str, said: int) -> None:
    """Of 100 MiB of zeros, whatever it says of its length."""
    zeros = bytes(100 << 20)
    packed = frame.compress(zeros) if compression == "lz4" else zstandard.ZstdCompressor().compress(zeros)
    del zeros
    file = tmp_path / "small.mcap"
    file.write_bytes(recording(compression, packed, said))
    damage = mcap_reader.Damage()
    tracemalloc.start()
    try:
        with pytest.raises(UserError, match="damaged"):
            mcap_reader.read(file, damage)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(damage.bytes) == 1
    assert most < 32 << 20


def test_the_address_gives_no_other_cookie_than_the_token(page: tuple[int, str]) -> None:
    """Seen to fail: the cookie became the address's token."""
    port, token = page
    with closing(http.client.HTTPConnection("127.0.0.1", port, 30)) as connection:
        for given, cookie in ((token, f"flotilla-{port}={token}; Path=/; HttpOnly; SameSite=Strict"), ("x", None)):
            connection.request("GET", f"/?token={given}", headers={"Cookie": f"flotilla-{port}={token}"})
            answer = connection.getresponse()
            answer.read()
            assert (answer.status, answer.getheader("Set-Cookie")) == (200, cookie)


def test_a_plugin_of_holes_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen to fail: it was read into memory. The sandbox lets a compiler write files of 4 GiB."""

    def make(work: Path, *_: object) -> None:
        with (work / "plugin.so").open("wb") as made:
            made.truncate(runtime.MOST_BYTES + 1)

    monkeypatch.setattr(runtime, "command", make)
    monkeypatch.setattr(paths, "BUILD", tmp_path)
    (tmp_path / "a.c").write_text("int a;\n")
    with pytest.raises(UserError, match=rf"plugin\.so: has {runtime.MOST_BYTES + 1} bytes, a plug-in has at most"):
        runtime.compile_shared(tmp_path / "a.c", ["a.c"], HOST, [])
