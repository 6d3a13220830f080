"""Bursts of recorded messages at the UDP port of a control task, inside a guest in virtual time.

Who sends them has the sender's address and what it sent before it restarted, but no key. To refuse these costs most:
their proof is right, and only a question to the sender tells that they are not new. All share the guest's one
processor, so a flood that goes on would get less of it the more its receiver does; a burst waits in the queue.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from flotilla.debian import toolchain
from flotilla.fleet.model import Board

NAME = "flood"
SECONDS = 4
BURST = 64
"""Datagrams at once."""
INTERVAL_MS = 100
PERIOD_NS = 10_000_000
PORT = 5001
SENDER, RECEIVER = "127.0.0.2", "127.0.0.1"
_KEYS = [f"{number:064x}" for number in (1, 2)]

_SEND = """
period: 10 ms
priority: 70
blocks:
  clock: {{type: clock}}
  bytes: {{type: pack, in: {{in0: clock.time}}, parameters: {{types: [double]}}}}
  out:
    type: udp-send
    in: {{data: bytes.out}}
    parameters:
      {{address: {receiver}, port: {port}, length: 8, local_address: {sender}, keys: {directory}/sender.keys}}
"""
_RECEIVE = """
period: 10 ms
priority: 80
overruns: 0
blocks:
  in:
    type: udp-receive
    parameters: {{port: {port}, length: 8, from: {sender}, keys: {directory}/receiver.keys}}
"""
_RECORD = f"""
import pathlib, socket, sys
port = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
port.bind(("{RECEIVER}", {PORT}))
port.settimeout(20)
print("listens", flush=True)
pathlib.Path(sys.argv[1]).write_bytes(port.recv(2000))
"""
_SCRIPT = f"""
cd {{directory}}
chmod +x flood
mkfifo /run/flood.listens
python3 record.py /run/flood.recorded >/run/flood.listens & recorder=$!
read -r _ </run/flood.listens
flotilla-run --steps 3 sender.yml
wait $recorder
bursts="{BURST} {INTERVAL_MS} {SECONDS * 1000 // INTERVAL_MS}"
./flood {SENDER} {RECEIVER} {PORT} $bursts /run/flood.recorded >/run/flood.sent & flood=$!
run() {{{{
  task=$1; shift
  flotilla-run --steps {SECONDS * 90} --statistics /run/flood.$task.json "$@" $task.yml
}}}}
run sender & sender=$!
run receiver --watch in.sequence,in.dropped,in.replayed >/run/flood.rows
wait $sender
wait $flood
tr -d '\\n' </run/flood.receiver.json
echo
tail -n 1 /run/flood.rows
cat /run/flood.sent
"""


@dataclass(frozen=True)
class Flooded:
    """What came of it."""

    sent: int
    """Datagrams of the flood."""
    steps: int
    """Of the receiver."""
    overruns: int
    longest_ns: int
    """Step."""
    taken: int
    """Messages of the sender."""
    replayed: int
    """Datagrams that were refused, by the receiver's own count."""
    dropped: int
    """Lost because its queue was full."""


def command(directory: PurePosixPath) -> list[str]:
    return ["sh", "-ec", _SCRIPT.format(directory=directory)]


def files(board: Board, directory: PurePosixPath) -> dict[str, bytes]:
    """By their names in `directory`."""
    options = ["-std=gnu11", "-Wall", "-Wextra", "-Werror"]
    places = {"sender": SENDER, "receiver": RECEIVER, "port": PORT, "directory": directory}
    there, back = _KEYS
    texts = {
        "sender.yml": _SEND.format(**places),
        "receiver.yml": _RECEIVE.format(**places),
        "sender.keys": f"{RECEIVER} {there} {back}\n",
        "receiver.keys": f"{SENDER} {back} {there}\n",
        "record.py": _RECORD,
    }
    flood = toolchain.compile_static(Path(__file__).with_suffix(".c"), board, options)
    return {name: text.encode() for name, text in texts.items()} | {"flood": flood}


def read(said: str) -> Flooded:
    """What the command printed last."""
    receiver, row, sent = said.splitlines()[-3:]
    statistics, last = json.loads(receiver), json.loads(row)
    return Flooded(
        sent=int(sent),
        steps=statistics["step"]["count"],
        overruns=statistics["overruns"],
        longest_ns=statistics["step"]["max_ns"],
        taken=last["in.sequence"],
        replayed=last["in.replayed"],
        dropped=last["in.dropped"],
    )
