"""The blocks with a serial port, run as on a robot, against emulated devices that behave and misbehave."""

from __future__ import annotations

import json
import math
import subprocess
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from flotilla.lab.emulators.dsp3000 import Dsp3000, Format
from flotilla.lab.emulators.micromag3 import MicroMag3
from flotilla.lab.emulators.oceanserver import Battery, OceanServer
from flotilla.lab.emulators.serial_line import Faults, SerialLine
from flotilla.lab.emulators.urg import Urg
from tests.running import PATIENCE, Row, Task, running

pytestmark = pytest.mark.clock


def watching(
    binary: Path, directory: Path, line: SerialLine, block: str, *outputs: str, **parameters: Any
) -> AbstractContextManager[Task]:
    """Run a task of one block every 10 ms, or as often as a busy machine can, and watch it."""
    written = {"device": line.path, **parameters}
    text = (
        "period: 10 ms\npriority: 0\noverrun: skip\noverruns: 0\nblocks:\n  sensor:\n"
        f"    type: {block}\n    parameters: {json.dumps(written)}\n"
    )
    watched = ",".join(f"sensor.{output}" for output in (*outputs, "flag", "age", "sequence"))
    return running([binary, "--watch", watched], directory / "task.yml", text)


# Devices and what their blocks make of them; tests/boot/test_blocks_guest.py has them, too.


def gyro(format: Format) -> Dsp3000:
    return Dsp3000(lambda seconds: 90.0, format)


GYRO = {"positive": "counterclockwise"}
WORDS = {"baud": 115200, "format": "words"}


def check_gyro(row: Row) -> None:
    assert row["rate"] == pytest.approx(-math.pi / 2, abs=0.01)


def magnetometer() -> MicroMag3:
    return MicroMag3(noise=0)


MAGNETOMETER = {"pollfreq": 16}


def check_magnetometer(row: Row) -> None:
    assert row["heading"] == pytest.approx(math.radians(194.74))
    assert row["field"] == [-106, -403, 98]


BATTERY_OUTPUTS = ("charge", "present", "charging", "voltage", "current", "temperature", "charges")


def batteries() -> OceanServer:
    measured = {1: Battery(charge=0.5), 3: Battery(voltage=15.5, current=1.25, charge=0.7)}
    return OceanServer(measured, charging=4, message="Low, charge now")


def check_batteries(row: Row) -> None:
    assert row["charge"] == pytest.approx(0.6)
    assert (row["present"], row["charging"]) == (5, 4)
    assert row["voltage"][:3] == pytest.approx([16.661, 0, 15.5])
    assert row["current"][:3] == pytest.approx([-0.02, 0, 1.25])
    assert row["temperature"][:3] == pytest.approx([296.4, 0, 296.4])
    assert row["charges"][:3] == pytest.approx([0.5, 0, 0.7])


def good_batteries(row: Row) -> bool:
    """The last record of each measurement is there, too."""
    return good(row) and row["charges"][2] > 0


def scanner() -> Urg:
    return Urg(lambda step, seconds: 7 if step == 50 else 1000 + step, old=True, noise=0)


SCAN = {"first_step": 44, "last_step": 143}


def check_scan(row: Row) -> None:
    assert len(row["ranges"]) == 100
    assert row["ranges"][6] is None  # an error code: not a number
    expected = [(1000 + step) / 1000 for step in range(44, 144)]
    assert row["ranges"][7:] == pytest.approx(expected[7:])


def good(row: Row) -> bool:
    return bool(row["flag"])


def bad(row: Row) -> bool:
    return not row["flag"]


@pytest.mark.parametrize(("format", "more"), [("text", {}), ("words", WORDS)], ids=["text", "words"])
def test_gyro_through_faults_and_unplugging(
    flotilla_run: Path, tmp_path: Path, format: Format, more: dict[str, Any]
) -> None:
    device = gyro(format)
    # The timeout is long, so that a busy machine is not taken for a fault; the flag must fall by what is wrong.
    parameters = {**GYRO, **more, "timeout": 5}
    with SerialLine(device) as line, watching(flotilla_run, tmp_path, line, "dsp3000", "rate", **parameters) as run:
        row = run.until(good)
        check_gyro(row)
        assert run.until(lambda later: later["sequence"] > row["sequence"] + 50)["age"] < 5

        device.valid = False
        check_gyro(run.until(bad))
        device.valid = True
        run.until(good)
        device.rate = lambda seconds: 380.0  # beyond full scale
        run.until(bad)
        device.rate = lambda seconds: 10.0
        assert run.until(good)["rate"] == pytest.approx(math.radians(-10), abs=0.01)

        line.unplug()
        run.until(bad)
        line.replug()
        run.until(good)

        line.faults = Faults(silence=True)
        assert run.until(bad)["age"] > 5
        line.faults = Faults()
        run.until(good)


@pytest.mark.parametrize(
    ("faults", "wrong"),
    [
        (Faults(garbage=0.3), 0.05),  # of random words of the right length, parity lets some pass
        (Faults(half=0.3), 0),
        (Faults(corrupt=0.3), 0),
        (Faults(burst=50), 0),
    ],
    ids=["garbage", "half", "corrupt", "burst"],
)
def test_gyros_words_survive_faults(flotilla_run: Path, tmp_path: Path, faults: Faults, wrong: float) -> None:
    """A third of the words is spoilt, and what comes is what was measured."""
    gyro = Dsp3000(lambda seconds: 90.0, "words", noise=0)
    parameters = {**WORDS, "timeout": 5}
    with (
        SerialLine(gyro, faults=faults, seed=7) as line,
        watching(flotilla_run, tmp_path, line, "dsp3000", "rate", **parameters) as run,
    ):
        rates: dict[int, float] = {}  # by sequence: a step may see the same measurement again
        while len(rates) < 100:
            row = run.until(good)
            rates[row["sequence"]] = row["rate"]
    assert sum(rate != pytest.approx(math.pi / 2, abs=1e-5) for rate in rates.values()) <= wrong * len(rates)


def test_gyro_counts_increments_although_its_rate_beats_against_the_tasks(flotilla_run: Path, tmp_path: Path) -> None:
    gyro = Dsp3000(lambda seconds: 90.0, noise=0)
    with (
        SerialLine(gyro) as line,
        watching(flotilla_run, tmp_path, line, "dsp3000", "increment", mode="incremental", timeout=5) as run,
    ):
        first = run.until(good)
        turned = 0.0
        for row in run.rows():
            assert row["flag"]
            turned += row["increment"]
            if row["sequence"] >= first["sequence"] + 100:
                expected = (row["sequence"] - first["sequence"]) * math.radians(90) * 0.0102
                assert turned == pytest.approx(expected, rel=1e-3)
                break


def test_wrong_baud_is_never_good(flotilla_run: Path, tmp_path: Path) -> None:
    with SerialLine(Dsp3000(lambda seconds: 90.0)) as line:
        with watching(flotilla_run, tmp_path, line, "dsp3000", "rate", baud=57600, timeout=5) as run:
            sent = line.sent
            for row in run.rows():
                assert not row["flag"]
                if line.sent > sent + 100:
                    break
        with watching(flotilla_run, tmp_path, line, "dsp3000", "rate", baud=38400, timeout=5) as run:
            run.until(good)


def test_magnetometer(flotilla_run: Path, tmp_path: Path) -> None:
    compass = magnetometer()
    parameters = {**MAGNETOMETER, "timeout": 3}
    with (
        SerialLine(compass) as line,
        watching(flotilla_run, tmp_path, line, "micromag3", "heading", "field", "error", **parameters) as run,
    ):
        check_magnetometer(run.until(good))
        assert compass.pollfreq == 16
        compass.error = 0x200
        assert run.until(bad)["error"] == 0x200
        compass.error = 0
        run.until(good)
        compass.sums = "unknown"  # wrong checksums: the value grows stale
        assert run.until(bad)["age"] > 3
        compass.sums = "xor"
        run.until(good)
        line.unplug()
        run.until(bad)
        line.replug()
        run.until(good)


@pytest.mark.parametrize("mode", ["stream", "poll", "raw"])
def test_magnetometer_whatever_was_stored_in_it(flotilla_run: Path, tmp_path: Path, mode: str) -> None:
    """Mils, true north, NMEA, axes switched off."""
    compass = magnetometer()
    compass.settings = {"uc": "m", "sn": "t", "sdo": "n", "ec": "d", "ex": "d", "ey": "d", "ez": "d"}
    with (
        SerialLine(compass) as line,
        watching(flotilla_run, tmp_path, line, "micromag3", "heading", "field", mode=mode, timeout=5) as run,
    ):
        row = run.until(good)
        assert row["field"] == [-106, -403, 98]
        assert row["heading"] == pytest.approx(0 if mode == "raw" else math.radians(194.74))
        assert compass.settings["sn"] == "m"


def test_magnetometer_with_unknown_checksums(flotilla_run: Path, tmp_path: Path) -> None:
    parameters = {"mode": "poll", "checksum": "none", "timeout": 5}
    with (
        SerialLine(MicroMag3(noise=0, sums="unknown")) as line,
        watching(flotilla_run, tmp_path, line, "micromag3", "heading", **parameters) as run,
    ):
        first = run.until(good)["sequence"]
        run.until(lambda row: row["sequence"] > first + 3)


def test_batteries(flotilla_run: Path, tmp_path: Path) -> None:
    with (
        SerialLine(batteries()) as line,
        watching(flotilla_run, tmp_path, line, "oceanserver", *BATTERY_OUTPUTS, timeout=4) as run,
    ):
        check_batteries(run.until(good_batteries))
        line.unplug()
        run.until(bad)
        line.replug()
        run.until(good)
        line.faults = Faults(corrupt=1)
        assert run.until(bad)["age"] > 4


@pytest.mark.parametrize("mode", ["stream", "poll"])
def test_laser_scanner(flotilla_run: Path, tmp_path: Path, mode: str) -> None:
    device = scanner()
    parameters = {**SCAN, "mode": mode, "timeout": 5}
    with SerialLine(device) as line:
        with watching(flotilla_run, tmp_path, line, "urg", "ranges", "timestamp", **parameters) as run:
            row = run.until(good)
            check_scan(row)
            run.until(lambda later: later["timestamp"] > row["timestamp"])
            line.faults = Faults(corrupt=1)
            assert run.until(bad)["age"] > 5
            line.faults = Faults()
            run.until(good)
            line.unplug()
            run.until(bad)
            line.replug()
            run.until(good)
            assert device.laser
        end = time.monotonic() + PATIENCE
        while device.laser:  # the task has ended, and said so
            assert time.monotonic() < end
            time.sleep(0.01)


@pytest.mark.parametrize(
    ("state", "baud", "parameters"),
    [
        (lambda scanner: scanner.received(b"TM0\n"), 115200, {}),
        (lambda scanner: scanner.received(b"MD0044072501000\nSS057600\n"), 19200, {}),
        (lambda scanner: None, 115200, {"skip": 9, "cluster": 2, "first_step": 44, "last_step": 243}),
        (lambda scanner: scanner.received(b"MD00440"), 19200, {"characters": 2}),
    ],
    ids=["adjusting the time", "streaming at another rate", "with long pauses", "half a command"],
)
def test_laser_scanner_as_it_was_left(
    flotilla_run: Path, tmp_path: Path, state: Callable[[Urg], object], baud: int, parameters: dict[str, Any]
) -> None:
    device = Urg(lambda step, seconds: 7 if step == 50 else 1000 + step, baud=baud, noise=0)
    with SerialLine(device) as line:
        state(device)
        given = {**SCAN, **parameters, "timeout": 30}
        with watching(flotilla_run, tmp_path, line, "urg", "ranges", **given) as run:
            row = run.until(lambda row: row["sequence"] > 2)
            if "cluster" in parameters:
                expected = [51 if step == 50 else step for step in range(44, 244, 2)]  # the error code is no distance
                assert row["ranges"] == pytest.approx([(1000 + step) / 1000 for step in expected])
            else:
                check_scan(row)
            assert device.baud == 115200


LOSING = """
#include <linux/serial.h>
#include <stdarg.h>
#include <sys/ioctl.h>
#include <sys/syscall.h>
#include <unistd.h>
int ioctl(int fd, unsigned long request, ...)
{
    static int asked;
    va_list arguments;
    va_start(arguments, request);
    void *argument = va_arg(arguments, void *);
    va_end(arguments);
    if (request != TIOCGICOUNT)
        return (int)syscall(SYS_ioctl, fd, request, argument);
    *(struct serial_icounter_struct *)argument = (struct serial_icounter_struct){.overrun = 7 * ++asked};
    return 0;
}
"""
"""Emulates a UART that loses seven bytes before each look at its counts: neither a pty nor QEMU's UART loses any."""


def test_bytes_that_a_port_loses_are_named(flotilla_run: Path, tmp_path: Path) -> None:
    """Seen to fail: nothing asked for the counts, so the status said nothing, and a gyro with gaps looked broken."""
    (tmp_path / "losing.c").write_text(LOSING)
    shim = tmp_path / "losing.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", shim, tmp_path / "losing.c"], check=True)
    text = "period: 10 ms\npriority: 0\nblocks:\n  gyro: {type: dsp3000, parameters: "
    control = ["--control", str(tmp_path / "control")]
    with SerialLine(gyro("text")) as line:
        text += json.dumps({"device": line.path, **GYRO}) + "}\n"
        argv: list[str | Path] = [flotilla_run, *control, "--watch", "gyro.flag,gyro.sequence"]
        with running(argv, tmp_path / "losing.yml", text, {"LD_PRELOAD": str(shim)}) as run:
            run.until(good)
            asking: list[str | Path] = [flotilla_run.with_name("flotilla-param"), *control, "--status=json", "losing"]

            def lost(_: Row) -> int:  # the port is asked once a second
                said = subprocess.run(asking, capture_output=True, text=True, timeout=PATIENCE, check=True).stdout
                return int(json.loads(said)["serial_overruns"].get("gyro", 0))

            assert lost(run.until(lost)) % 7 == 0
