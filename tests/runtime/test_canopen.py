"""Our side of CANopen against one that nobody here wrote: python-canopen, as slave below the block, and as master.

Both are told what a drive consists of, by a dictionary of our own: indices, types, access and defaults as in maxon's
EPOS2 Firmware Specification and CiA 301/402. The protocol, and the transitions of CiA 402, are python-canopen's.
"""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import can
import canopen
import pytest
from canopen.objectdictionary import ODArray, ODRecord, ODVariable
from canopen.profiles.p402 import State402

from flotilla.lab.emulators.can_bus import EXTENDED, REMOTE, Frame, UdpHub
from flotilla.lab.emulators.epos2 import Axis, Epos2, Epos2Server
from tests.running import PATIENCE
from tests.runtime import test_can
from tests.runtime.test_can import NODE, drive_task

pytestmark = pytest.mark.clock

hub, link, run, udp_can = test_can.hub, test_can.link, test_can.run, test_can.udp_can

I8, I16, I32, U8, U16, U32, TEXT = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x09

VARIABLES: dict[int, tuple[int, str, int | str]] = {
    0x1000: (U32, "ro", 0x00020192),
    0x1001: (U8, "ro", 0),
    0x1005: (U32, "rw", 0x80),
    0x1008: (TEXT, "const", "EPOS"),
    0x1014: (U32, "rw", 0x80 + NODE),
    0x1017: (U16, "rw", 0),
    0x2030: (I16, "rw", 0),
    0x2062: (I32, "rw", 0),
    0x2080: (U16, "rw", 500),
    0x2081: (I32, "rw", 0),
    0x206B: (I32, "rw", 0),
    0x6007: (I16, "rw", 1),
    0x6040: (U16, "rw", 0),
    0x6041: (U16, "ro", 0x0140),
    0x6060: (I8, "rw", 1),
    0x6061: (I8, "ro", 1),
    0x6064: (I32, "ro", 0),
    0x606C: (I32, "ro", 0),
    0x6078: (I16, "ro", 0),
    0x607A: (I32, "rw", 0),
    0x607C: (I32, "rw", 0),
    0x607F: (U32, "rw", 25000),
    0x6081: (U32, "rw", 1000),
    0x6083: (U32, "rw", 10000),
    0x6084: (U32, "rw", 10000),
    0x6085: (U32, "rw", 10000),
    0x6098: (I8, "rw", 7),
    0x609A: (U32, "rw", 1000),
    0x60FF: (I32, "rw", 0),
    0x6502: (U32, "ro", 0x65),
}
SECOND = {0x1600: (0, 0x60600008, 0x607A0020, 0x60FF0020), 0x1A00: (0, 0x60610008, 0x60640020, 0x606C0020)}
"""What RPDOs and TPDOs carry behind the control word, or the status word."""


def dictionary() -> canopen.ObjectDictionary:
    objects = canopen.ObjectDictionary()

    def variable(index: int, sub: int, kind: int, access: str, default: int | str) -> ODVariable:
        one = ODVariable(f"{index:04X}:{sub:02X}", index, sub)
        one.data_type, one.access_type = kind, access
        setattr(one, "default", default)  # noqa: B010 # a text, too, whatever its annotation says
        return one

    def group(whole: ODRecord | ODArray, *members: tuple[int, str, int]) -> None:
        whole.add_member(variable(whole.index, 0, U8, "ro", len(members)))
        for sub, (kind, access, default) in enumerate(members, 1):
            whole.add_member(variable(whole.index, sub, kind, access, default))
        objects.add_object(whole)

    for index, (kind, access, default) in VARIABLES.items():
        objects.add_object(variable(index, 0, kind, access, default))
    group(ODArray("consumer heartbeat time", 0x1016), (U32, "rw", 0), (U32, "rw", 0))
    group(ODRecord("identity", 0x1018), (U32, "ro", 0xFB), (U32, "ro", 0), (U32, "ro", 0), (U32, "ro", 0))
    group(
        ODRecord("motor", 0x6410),
        (U16, "rw", 2000), (U16, "rw", 4000), (U8, "rw", 1), (U32, "rw", 25000), (U16, "rw", 40),
    )  # fmt: skip
    group(ODRecord("homing speeds", 0x6099), (U32, "rw", 100), (U32, "rw", 10))
    for number in range(4):
        off = 0xC0000000 if number else 0x40000000
        identifier = 0x100 * number + NODE
        group(ODRecord(f"RPDO {number}", 0x1400 + number), (U32, "rw", 0x200 + identifier), (U8, "rw", 255))
        group(
            ODRecord(f"TPDO {number}", 0x1800 + number),
            (U32, "rw", off + 0x180 + identifier), (U8, "rw", 255), (U16, "rw", 10),
        )  # fmt: skip
        for first, word in ((0x1600, 0x60400010), (0x1A00, 0x60410010)):
            mapping = ODRecord(f"mapping {first + number:04X}", first + number)
            second = SECOND[first][number]
            group(mapping, (U32, "rw", word), (U32, "rw", second), *[(U32, "rw", 0)] * 6)
            mapping[0].access_type, mapping[0].default = "rw", 2 if second else 1
    return objects


class HubBus(can.BusABC):
    """python-can on the bus of UDP sockets."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.send(b"")
        super().__init__(channel=port)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        flags = EXTENDED * msg.is_extended_id | REMOTE * msg.is_remote_frame
        self._socket.send(Frame(msg.arbitration_id | flags, bytes(msg.data)).pack())

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not select.select([self._socket], [], [], timeout)[0]:
            return None, False
        frame = Frame.unpack(self._socket.recv(64))
        message = can.Message(
            timestamp=time.monotonic(),
            arbitration_id=frame.id & ~(EXTENDED | REMOTE),
            is_extended_id=bool(frame.id & EXTENDED),
            is_remote_frame=bool(frame.id & REMOTE),
            data=frame.data,
        )
        return message, False

    def shutdown(self) -> None:
        super().shutdown()
        self._socket.close()


@pytest.fixture
def network(hub: UdpHub) -> Iterator[canopen.Network]:
    with canopen.Network(HubBus(hub.port)) as network:
        network.connect()
        yield network


def await_that(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.01)


# --- our block, and a slave of python-canopen ---


class Slave:
    """A LocalNode that has an axis: the state machine is the table of python-canopen's own profile."""

    def __init__(self, network: canopen.Network) -> None:
        self.network = network
        self.state = "SWITCH ON DISABLED"
        self.seen: list[str] = []
        self.node = network.create_node(NODE, dictionary())
        self.node.add_write_callback(self.written)
        network.subscribe(0x000, self.commanded)
        network.subscribe(0x080, self.synchronise)
        self.boot()

    def boot(self) -> None:
        self.node.nmt.stop_heartbeat()
        application = {index: subs for index, subs in self.node.data_store.items() if index >= 0x2000}
        self.node.data_store = application
        self.node.nmt.state = "INITIALISING"  # sends the boot-up message
        self.node.nmt.state = "PRE-OPERATIONAL"

    def commanded(self, identifier: int, data: bytearray, timestamp: float) -> None:
        command, node = data
        if node not in (0, NODE):
            return
        if command in (0x81, 0x82):
            self.become("SWITCH ON DISABLED")
            self.boot()
        elif command == 0x01:
            for pdo in self.node.rpdo.values():
                pdo.read()
                pdo.callbacks = [self.received]
            self.node.tpdo.read()

    def received(self, pdo: Any) -> None:
        for variable in reversed(list(pdo)):  # the target before the word
            self.node.set_data(variable.index, variable.subindex, bytes(variable.data))

    def written(self, index: int, subindex: int, od: Any, data: bytes) -> None:
        if index == 0x6060:
            self.node.set_data(0x6061, 0, data)
        elif index == 0x6040:
            word = int.from_bytes(data, "little")
            for (before, after), code in State402.TRANSITIONTABLE.items():
                if before == self.state and code == word & 0x8F:
                    self.become(after)
                    return

    def become(self, state: str) -> None:
        self.state = state
        self.seen.append(state)
        self.node.set_data(0x6041, 0, State402.SW_MASK[state][1].to_bytes(2, "little"))

    def synchronise(self, identifier: int, data: bytearray, timestamp: float) -> None:
        if self.node.nmt.state != "OPERATIONAL":
            return
        enabled = self.state == "OPERATION ENABLED"
        self.node.set_data(0x606C, 0, self.node.get_data(0x206B, 0) if enabled else bytes(4))
        for pdo in self.node.tpdo.values():
            if pdo.enabled and pdo.trans_type == 1:
                for variable in pdo:
                    variable.data = self.node.get_data(variable.index, variable.subindex)
                pdo.transmit()


def test_the_block_drives_a_slave(run: Any, hub: UdpHub, network: canopen.Network) -> None:
    with Epos2Server(hub).running():
        slave = Slave(network)
        with run(drive_task("velocity", 5, test_can.RESTLESS)) as task:
            row = task.until(lambda row: row["enabled"] and row["velocity"] > 0)
            assert row["velocity"] == pytest.approx(5, abs=0.01)
            assert (row["flag"], row["abort"], row["error"]) == (1, 0, 0)
            assert slave.state == "OPERATION ENABLED"
            assert slave.seen[-3:] == ["READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"]
            assert slave.node.nmt.state == "OPERATIONAL"
            assert slave.node.get_data(0x1400, 1) == (0x200 + NODE).to_bytes(4, "little")
            assert slave.node.get_data(0x1016, 1) == (127 << 16 | 1000).to_bytes(4, "little")
            slave.node.emcy.send(0x2310, 0x02)
            slave.become("FAULT")
            row = task.until(lambda row: row["error"] == 0x2310)
            task.until(lambda row: row["enabled"] and not row["error"])  # it resets the fault, as it is asked to
            assert task.end() == 0
        await_that(lambda: slave.node.nmt.state == "PRE-OPERATIONAL")
        assert slave.state == "SWITCH ON DISABLED"


def test_a_slave_refuses_an_object(run: Any, hub: UdpHub, network: canopen.Network) -> None:
    with Epos2Server(hub).running():
        slave = Slave(network)
        del slave.node.object_dictionary[0x206B]
        slave.node.add_write_callback(refuse_mapping)
        with run(drive_task("velocity", 5)) as task:
            assert task.until(lambda row: row["abort"])["abort"] == 0x06020000
        assert "OPERATION ENABLED" not in slave.seen


def refuse_mapping(index: int, subindex: int, od: Any, data: bytes) -> None:
    """As a device does: an object that it does not have cannot be mapped."""
    if index == 0x1603 and data[2:] == b"\x6b\x20":
        raise canopen.SdoAbortedError(0x06020000)


# --- a master of python-canopen, and our emulator ---


@pytest.fixture
def drive() -> Epos2:
    return Epos2(NODE)


@pytest.fixture
def server(hub: UdpHub, drive: Epos2) -> Iterator[Epos2Server]:
    server = Epos2Server(hub, drive)
    with server.running():
        yield server


@pytest.fixture
def master(server: Epos2Server, network: canopen.Network) -> canopen.BaseNode402:
    node = canopen.BaseNode402(NODE, dictionary())
    network.add_node(node)
    node.sdo.RESPONSE_TIMEOUT = PATIENCE  # s: the host may be busy; likewise below
    for name in ("SWITCH_OP_MODE", "SWITCH_STATE_FINAL", "SWITCH_STATE_SINGLE", "CHECK_TPDO"):
        setattr(node, f"TIMEOUT_{name}", PATIENCE)
    node.sdo.upload(0x1000, 0)  # an answer shows that the bus knows the master: what comes before it gets lost
    return node


def test_a_master_reads_and_writes_objects(master: canopen.BaseNode402) -> None:
    for index, (_, access, default) in VARIABLES.items():
        if access != "rw" or index in (0x6040, 0x6060):
            assert master.sdo[index].raw == default, f"{index:04X}"
    for index in (0x1018, 0x6099, 0x6410):
        assert master.sdo[index][0].raw == len(list(master.sdo[index].values()))
    for number in range(4):
        for index in (0x1400, 0x1600, 0x1800, 0x1A00):
            for sub, entry in master.sdo[index + number].items():
                assert entry.raw == entry.od.default, f"{index + number:04X}:{sub:02X}"
    master.sdo[0x6081].raw = 1234
    assert master.sdo[0x6081].raw == 1234
    master.sdo[0x6060].raw = -2
    assert master.sdo[0x6061].raw == -2
    for code, index, sub, data in (
        (0x06010002, 0x6041, 0, bytes(2)),
        (0x06020000, 0x5FFF, 0, bytes(2)),
        (0x06090011, 0x1018, 9, bytes(4)),
        (0x06070010, 0x6081, 0, bytes(2)),
        (0x06090030, 0x607F, 0, (25001).to_bytes(4, "little")),
    ):
        with pytest.raises(canopen.SdoAbortedError) as refused:
            master.sdo.download(index, sub, data)
        assert refused.value.code == code


def test_a_master_commands_by_nmt(master: canopen.BaseNode402) -> None:
    states: list[int] = []

    def beats(state: str) -> bool:
        return bool(master.nmt.wait_for_heartbeat(PATIENCE) == state)

    def booted(times: int) -> bool:
        return states.count(0) == times

    master.sdo[0x1017].raw = 20
    master.nmt.wait_for_heartbeat(PATIENCE)
    assert master.nmt.state == "PRE-OPERATIONAL"
    for wanted in ("OPERATIONAL", "STOPPED", "PRE-OPERATIONAL"):
        master.nmt.state = wanted
        await_that(partial(beats, wanted))
    master.nmt.add_heartbeat_callback(states.append)
    for boots, command in enumerate((0x81, 0x82), 1):
        master.sdo[0x6081].raw = 77
        master.nmt.send_command(command)
        await_that(partial(booted, boots))
        assert master.sdo[0x1017].raw == 0
        assert master.sdo[0x6081].raw == (1000 if command == 0x81 else 77), "the node, or its communication alone"


def test_a_master_hears_of_faults(master: canopen.BaseNode402, server: Epos2Server, drive: Epos2) -> None:
    heard: list[canopen.emcy.EmcyError] = []
    master.emcy.add_callback(heard.append)
    with server.paused():
        drive.fault(0x2310, 0x02)
        drive.fault(0x8611, 0x20)
    await_that(lambda: len(heard) == 2)
    assert [(error.code, error.register) for error in heard] == [(0x2310, 0x02), (0x8611, 0x22)]
    history = [int.from_bytes(master.sdo.upload(0x1003, sub), "little") for sub in range(3)]
    assert history == [2, 0x8611, 0x2310]
    master.sdo.download(0x1003, 0, bytes(1))
    assert master.sdo.upload(0x1003, 0) == bytes(1)


def test_a_master_exchanges_pdos(master: canopen.BaseNode402, network: canopen.Network) -> None:
    master.tpdo.read()
    motion = master.tpdo[4]
    motion.clear()
    for index in (0x6041, 0x606C, 0x6078):
        motion.add_variable(index)
    motion.trans_type, motion.enabled = 1, True
    motion.save()
    master.nmt.state = "OPERATIONAL"
    deadline = time.monotonic() + PATIENCE
    while not motion.is_received:
        assert time.monotonic() < deadline
        network.sync.transmit()
        motion.wait_for_reception(0.1)
    assert motion[0].raw & 0x6F == 0x40
    assert len(motion.data) == 8


def test_a_master_moves_the_motor(
    master: canopen.BaseNode402, network: canopen.Network, server: Epos2Server, drive: Epos2
) -> None:
    master.nmt.state = "PRE-OPERATIONAL"
    master.tpdo.read()
    master.tpdo[1].trans_type = 1
    master.tpdo[1].save()
    network.sync.start(0.01)
    master.setup_402_state_machine()
    master.nmt.state = "OPERATIONAL"
    master.op_mode = "PROFILED VELOCITY"
    master.state = "OPERATION ENABLED"
    with server.paused():
        assert drive.axis is Axis.OPERATION_ENABLED
    master.sdo[0x60FF].raw = 300
    await_that(lambda: abs(master.sdo[0x606C].raw - 300) < 10)
    with server.paused():
        drive.fault(0x2310)
    await_that(lambda: master.state == "FAULT")
    master.reset_from_fault()
    assert master.state == "OPERATION ENABLED"
    master.state = "READY TO SWITCH ON"
    master.controlword = 0x000F  # switch on and enable operation at once
    await_that(lambda: master.state == "OPERATION ENABLED")
    master.controlword = 0x0000
    await_that(lambda: master.state == "SWITCH ON DISABLED")
    network.sync.stop()


@pytest.mark.parametrize(("method", "fails", "home"), [(-4, False, -2.0), (18, False, 1.5), (-4, True, None)])
def test_a_master_sends_it_home(
    master: canopen.BaseNode402, network: canopen.Network, server: Epos2Server, drive: Epos2,
    method: int, fails: bool, home: float | None,
) -> None:  # fmt: skip
    """By python-canopen's own homing, which reads the status word as the standard has it."""
    drive.motor.stops, drive.motor.switches = (-2.0, 3.0), (-1.5, 1.5)
    drive.wrong.homing_error = fails
    master.nmt.state = "PRE-OPERATIONAL"
    master.tpdo.read()
    master.tpdo[1].trans_type = 1
    master.tpdo[1].save()
    network.sync.start(0.01)
    master.setup_402_state_machine()
    for index, value in ((0x6098, method), (0x609A, 5000), (0x607C, 100), (0x2081, 7)):
        master.sdo[index].raw = value
    master.sdo[0x6099][1].raw = 200
    master.nmt.state = "OPERATIONAL"
    assert master.homing(PATIENCE) is not fails
    assert bool(master.sdo[0x6041].raw & 0x8000) is not fails
    if home is not None:
        assert abs(master.sdo[0x6064].raw - 7) < 10
        with server.paused():
            assert drive.motor.turns == pytest.approx(home + 100 / 2000, abs=0.1)
    network.sync.stop()
