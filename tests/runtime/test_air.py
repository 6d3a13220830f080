"""The air of flights in virtual time takes for a frame what the simulated cell takes, whose times the standard judges.

Seen to fail with one microsecond less of preamble, and with symbols that are not rounded up.
"""

from __future__ import annotations

import ctypes
import errno
import subprocess
from pathlib import Path

import pytest

from flotilla.lab.air import HERE, ONE_GUEST
from flotilla.lab.radio.phy import ACK_BYTES, DSSS_BIT_S, B, G

RATES_MBIT_S = (1, 2, 5.5, 11, 6, 9, 12, 18, 24, 36, 48, 54)
"""In the order in which Linux's drivers of 2.4 GHz have them."""


@pytest.fixture(scope="module")
def air(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    library = tmp_path_factory.mktemp("air") / "air.so"
    sources = [HERE / name for name in ONE_GUEST]
    options = ["-std=gnu11", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-fvisibility=hidden"]
    subprocess.run(["cc", *options, "-o", library, *sources], check=True)
    loaded = ctypes.CDLL(str(library))
    loaded.air_ns.restype = ctypes.c_int64
    return loaded


@pytest.mark.parametrize(("number", "mbit_s"), list(enumerate(RATES_MBIT_S)))
def test_a_frame_takes_its_time(air: ctypes.CDLL, number: int, mbit_s: float) -> None:
    rate_bit_s = round(mbit_s * 1e6)
    standard = B if rate_bit_s in DSSS_BIT_S else G
    for size in range(ACK_BYTES, 2347):
        assert air.air_ns(size, number) == standard.frame_ns(size, rate_bit_s), size


def test_who_is_no_radio_is_refused(air: ctypes.CDLL, tmp_path: Path) -> None:
    """Before anything is asked of a driver, which this computer lacks. Seen to fail without the check: ENODEV."""
    air.carry.argtypes = [ctypes.c_int, ctypes.c_double, ctypes.c_int]
    with (tmp_path / "ready").open("w") as ready:
        assert air.carry(0, 0.0, ready.fileno()) == errno.EINVAL
        assert air.carry(65, 0.0, ready.fileno()) == errno.EINVAL
    assert (tmp_path / "ready").read_text() == ""
