"""Serial ports of the boards, and devices by their names."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from flotilla.fleet.model import Board, Fleet
from tests.boot.guests import call, sh
from tests.boot.shared.probes import exchange
from tests.conftest import RobotGuest


def test_serial_ports_of_the_board(robot: RobotGuest, board: Board) -> None:
    uarts = _uarts(robot)
    for name, port in board.ports.items():
        assert uarts[port.tty]["uart"] == "16550A", f"{name}: {port.tty} is {uarts[port.tty]}"
        trigger = sh(robot, f"cat /sys/class/tty/{port.tty}/rx_trig_bytes")
        assert trigger == "1", f"{name}: the interrupt comes after {trigger} bytes"


def _uarts(robot: RobotGuest) -> dict[str, dict[str, str]]:
    lines = sh(robot, "cat /proc/tty/driver/serial").splitlines()[1:]
    fields = [line.split() for line in lines]
    return {
        f"ttyS{line[0].rstrip(':')}": dict(word.split(":", 1) for word in line[1:] if ":" in word) for line in fields
    }


def test_devices_have_names_and_rates(pentium: RobotGuest, fleet: Fleet) -> None:
    board = pentium.board
    assert pentium.robot.devices, "the fleet of the tests has no device on this robot"
    assert set(sh(pentium, "ls /dev/robot").split()) == set(pentium.robot.devices)
    for name, device in pentium.robot.devices.items():
        tty = board.ports[device.port].tty
        assert sh(pentium, f"readlink -f /dev/robot/{name}") == f"/dev/{tty}"
        speed = pentium.shell.run(["stty", "-F", f"/dev/robot/{name}", "speed"]).stdout.strip()
        assert int(speed) == device.baud, f"{name}: {speed} bit/s"


EIGHT = [f"COM{number}" for number in range(5, 13)]


def test_eight_port_board_serves_all_ports_at_once(pentium: RobotGuest, fleet: Fleet) -> None:
    """Both ways on every port while they share interrupts, each byte to the right connector."""
    ports = {name: pentium.board.ports[name].tty for name in EIGHT}
    uarts = _uarts(pentium)
    lines = {name: uarts[tty]["irq"] for name, tty in ports.items()}
    assert len(set(lines.values())) < len(lines), f"no two ports share an interrupt: {lines}"
    ends = {name: pentium.machine.port(name) for name in EIGHT}
    try:
        with ThreadPoolExecutor() as threads:
            inside = threads.submit(call, pentium, exchange, {tty: f"to {name}\n" for name, tty in ports.items()})
            outgoing = {name: end.read_until(b"\n").decode() for name, end in ends.items()}
            for name, end in ends.items():
                end.write(f"from {name}\n".encode())
            incoming = inside.result()
    finally:
        for end in ends.values():
            end.close()
    assert outgoing == {name: f"to {name}\n" for name in EIGHT}, "what came out of the connectors"
    assert incoming == {tty: f"from {name}\n" for name, tty in ports.items()}, "what arrived at the devices"


def test_device_is_read_by_its_name(pentium: RobotGuest) -> None:
    (name, device), *_ = pentium.robot.devices.items()
    end = pentium.machine.port(device.port)
    try:
        sh(pentium, f"dd if=/dev/robot/{name} iflag=nonblock of=/dev/null", check=False)  # what lay there
        end.write(b"0123456789\r\n" * 20)
        got = pentium.shell.run(["head", "-c", "240", f"/dev/robot/{name}"]).stdout
    finally:
        end.close()
    assert got == "0123456789\r\n" * 20, f"{got!r} arrived at /dev/robot/{name}"


def test_port_stays_open_whoever_takes_it_as_a_terminal(pentium: RobotGuest) -> None:
    """Or its interrupt thread would end, and the next one start without its priority."""
    threads = "ps -e -o pid=,comm= | grep ' irq/.*-ttyS'"
    before = sh(pentium, threads)
    for name in pentium.robot.devices:
        sh(pentium, f"setsid --wait cat </dev/null >/dev/robot/{name}")
        sh(pentium, f"setsid --wait stty -F /dev/robot/{name} speed")
    assert sh(pentium, threads) == before
