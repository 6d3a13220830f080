"""An 802.11 cell in real time: guests with USB adapters, and cables that lead into it, on one channel.

A guest's adapter is an emulated one (`rt73usb.py`) that QEMU plugs in, so driver, firmware and 802.11 stack are the
robot's own. A cable's other end is a computer whose adapter is taken for granted: its Ethernet frames go into the cell
and come out of it as a driver would do it.

The channel carries one frame at a time, each for its air time and the pauses around it (`phy.py`), in the order in
which they came; collisions are what `dcf.py` simulates. A frame to one member is repeated until that acknowledges it,
as often as its adapter was told; one to all is sent once.
"""

from __future__ import annotations

import heapq
import itertools
import random
import selectors
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

from flotilla.fleet.model import Ibss
from flotilla.lab.emulators.rt73usb import Frame, Rt73Usb
from flotilla.lab.emulators.usb_redirection import Plug
from flotilla.lab.qemu.qemu import Wire
from flotilla.lab.radio import phy

NEAR_DBM = -50.0
"""What members of a laboratory receive each other by."""
QUEUE_NS = 200_000_000
"""What waits longer for the channel than that is dropped, as a driver's full queue does."""
_SNAP = bytes.fromhex("aaaa03000000")
_STATION_100KBIT_S = 110
_GROUP_100KBIT_S = 10
_ATTEMPTS = 7
_SLOT = "0x13"
"""Of the USB controller: its interrupt is not that of the serial ports, with which our kernel loses it now and then and
asks the controller ten times a second instead."""
_PHY = phy.Phy("802.11g", rates_bit_s=(*phy.DSSS_BIT_S, *(rate * 1_000_000 for rate in phy.OFDM_BITS)))


@dataclass
class Adapter:
    """A guest's, in its USB socket. QEMU connects when it starts, and again after each power cut."""

    name: str
    device: Rt73Usb
    listener: socket.socket
    plug: Plug | None = None
    connection: socket.socket | None = None
    plugged: bool = True

    @property
    def arguments(self) -> tuple[str, ...]:
        """Of QEMU."""
        port = self.listener.getsockname()[1]
        return (
            "-device", f"usb-ehci,id=radio-host,addr={_SLOT}",
            "-chardev", f"socket,id=radio,host=127.0.0.1,port={port},nodelay=on",
            "-device", "usb-redir,chardev=radio,bus=radio-host.0",
        )  # fmt: skip

    def hear(self, frame: Frame, dbm: float) -> None:
        if self.plug and self.plugged:
            self.device.hear(frame, dbm)


@dataclass
class Cable:
    """A cable whose other end is a computer in the cell."""

    name: str
    wire: Wire
    """Our end."""
    cell: Ibss
    transmit: Callable[[Frame], None]
    socket: socket.socket = field(init=False)
    _sequence: int = 0
    _addresses: set[bytes] = field(default_factory=set)
    """Of the computer behind it: one, as a rule."""

    def __post_init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self.socket.bind(("127.0.0.1", self.wire.here))
        self.socket.connect(("127.0.0.1", self.wire.there))
        self.socket.setblocking(False)

    def take(self, ethernet: bytes) -> None:
        """A frame of the computer's: into the cell."""
        receiver, sender = ethernet[:6], ethernet[6:12]
        self._addresses.add(sender)
        self._sequence = (self._sequence + 0x10) & 0xFFFF
        header = b"\x08\x00\x00\x00" + receiver + sender + bytes.fromhex(self.cell.bssid.replace(":", ""))
        content = header + self._sequence.to_bytes(2, "little") + _SNAP + ethernet[12:]
        to_group = receiver[0] & 1
        rate = _GROUP_100KBIT_S if to_group else _STATION_100KBIT_S
        self.transmit(Frame(content, rate, self.cell.frequency_mhz, 1 if to_group else _ATTEMPTS))

    def hear(self, frame: Frame, dbm: float) -> None:
        """A frame of the cell's: to the computer, if it is data for it."""
        content = frame.content
        is_data, is_qos = content[0] & 0x0C == 0x08, bool(content[0] & 0x80)
        body = 24 + 2 * is_qos
        own_cell = content[16:22].hex(":") == self.cell.bssid
        if not (is_data and own_cell and frame.frequency_mhz == self.cell.frequency_mhz):
            return
        if content[body : body + 6] != _SNAP:  # such as a null frame
            return
        receiver = frame.receiver
        if receiver[0] & 1 or receiver in self._addresses:
            with suppress(OSError):  # the computer is off, or slow
                self.socket.send(receiver + content[10:16] + content[body + 6 :])


class Air:
    """The cell. Members are made before it is entered; they may be switched on and off."""

    def __init__(self, *, loss: float = 0.0, seed: int = 1) -> None:
        """`loss`: of each attempt of a frame, 0 to 1, for each receiver by itself, from `seed`."""
        self.loss = loss
        self._seed = seed
        self._chances: dict[tuple[str, str], random.Random] = {}
        self._members: dict[str, Adapter | Cable] = {}
        self.apart: set[frozenset[str]] = set()
        """Pairs of members that are out of each other's range."""
        self.sent = self.lost = self.dropped = 0
        """Frames: on the air, lost on the way to a receiver, given up before."""
        self.air_ns = 0
        """For which the channel was taken."""
        self._free_ns = 0
        self._pending: list[tuple[int, int, str, Frame]] = []
        self._order = itertools.count()
        self._lock = threading.RLock()
        self._wake, self._waker = socket.socketpair()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._fault: BaseException | None = None

    def adapter(self, name: str, mac: str, seed: int = 1) -> Adapter:
        """For a guest, with the `arguments` of its QEMU."""
        device = Rt73Usb(bytes.fromhex(mac.replace(":", "")), lambda frame: self._transmit(name, frame), seed)
        made = Adapter(name, device, socket.create_server(("127.0.0.1", 0)))
        self._members[name] = made
        return made

    def cable(self, name: str, wire: Wire, cell: Ibss) -> Cable:
        """For a computer at the other end of `wire`, which is in the cell."""
        made = Cable(name, wire, cell, lambda frame: self._transmit(name, frame))
        self._members[name] = made
        return made

    def plug(self, name: str, *, plugged: bool) -> None:
        """Pull a guest's adapter out of its socket, or put it back."""
        member = self._members[name]
        assert isinstance(member, Adapter)
        with self._lock:
            member.plugged = plugged
            if member.plug is None:
                return
            if plugged:
                member.device.power_on()
                member.plug.plug()
            else:
                member.plug.unplug()

    def reach(self, name: str, *, reached: bool) -> None:
        """Whether a member is in the range of all others, or of none."""
        pairs = {frozenset((name, other)) for other in self._members if other != name}
        with self._lock:
            self.apart = self.apart - pairs if reached else self.apart | pairs

    def __enter__(self) -> Air:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the cell, whether or not it was entered; raise what ended it before."""
        self._waker.close()
        if self._thread.ident:
            self._thread.join()
        self._wake.close()
        for member in self._members.values():
            for end in [member.socket] if isinstance(member, Cable) else [member.listener, member.connection]:
                if end:
                    end.close()
        if self._fault:
            raise self._fault

    def _transmit(self, name: str, frame: Frame) -> None:
        """Queue it for the channel, with its attempts one behind the other."""
        now_ns = time.monotonic_ns()
        begin_ns = max(self._free_ns, now_ns)
        if begin_ns - now_ns > QUEUE_NS:
            self.dropped += 1
            return
        # On the average, who waits counts half a contention window down.
        pause_ns = _PHY.difs_ns + _PHY.cw_min * _PHY.slot_ns // 2
        taken_ns = pause_ns + _PHY.frame_ns(len(frame.content) + 4, frame.rate_100kbit_s * 100_000)
        if frame.attempts > 1:
            taken_ns += _PHY.sifs_ns + _PHY.frame_ns(phy.ACK_BYTES, _PHY.basic_bit_s[0])
        self._free_ns = begin_ns + taken_ns
        self.air_ns += taken_ns
        self.sent += 1
        heapq.heappush(self._pending, (self._free_ns, next(self._order), name, frame))

    def _arrive(self, sender: str, frame: Frame) -> None:
        for name, member in self._members.items():
            if name == sender or frozenset((sender, name)) in self.apart:
                continue
            chance = self._chances.setdefault((sender, name), random.Random(f"{self._seed} {sender} {name}"))
            if all(chance.random() < self.loss for _ in range(frame.attempts)):
                self.lost += 1
            else:
                member.hear(frame, NEAR_DBM)

    def _run(self) -> None:
        try:
            self._carry()
        except BaseException as error:
            self._fault = error

    def _carry(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._wake, selectors.EVENT_READ)
            for member in self._members.values():
                end = member.socket if isinstance(member, Cable) else member.listener
                selector.register(end, selectors.EVENT_READ, member)
            while True:
                for key, _ in selector.select(self._pause_s()):
                    if key.fileobj is self._wake:
                        return
                    with self._lock:
                        self._serve(selector, key)
                with self._lock:
                    self._tick()

    def _pause_s(self) -> float | None:
        due = [self._pending[0][0]] if self._pending else []
        for member in self._members.values():
            if isinstance(member, Adapter) and (at := member.device.next_tick_ns()) is not None:
                due.append(at)
        return max(0.0, (min(due) - time.monotonic_ns()) / 1e9) if due else None

    def _tick(self) -> None:
        now_ns = time.monotonic_ns()
        while self._pending and self._pending[0][0] <= now_ns:
            _, _, sender, frame = heapq.heappop(self._pending)
            self._arrive(sender, frame)
        for member in self._members.values():
            if isinstance(member, Adapter):
                member.device.tick(now_ns)

    def _serve(self, selector: selectors.BaseSelector, key: selectors.SelectorKey) -> None:
        member = key.data
        if isinstance(member, Cable):
            with suppress(OSError):  # an error of a computer that is off
                member.take(member.socket.recv(65536))
        elif key.fileobj is member.listener:
            self._connect(selector, member)
        else:
            self._read(selector, member)

    def _connect(self, selector: selectors.BaseSelector, member: Adapter) -> None:
        if member.connection:
            self._disconnect(selector, member)
        connection, _ = member.listener.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        member.connection = connection
        member.device.power_on()

        def send(data: bytes) -> None:
            with suppress(OSError):  # QEMU has ended: its connection says so, too
                connection.sendall(data)

        member.plug = Plug(member.device, send)
        member.device.say = member.plug.say
        selector.register(connection, selectors.EVENT_READ, member)

    def _read(self, selector: selectors.BaseSelector, member: Adapter) -> None:
        assert member.connection
        assert member.plug
        try:
            data = member.connection.recv(65536)
        except OSError:
            data = b""
        if data:
            member.plug.feed(data)
        else:
            self._disconnect(selector, member)

    def _disconnect(self, selector: selectors.BaseSelector, member: Adapter) -> None:
        assert member.connection
        selector.unregister(member.connection)
        member.connection.close()
        member.connection = member.plug = None
        member.device.power_on()
