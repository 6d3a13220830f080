"""How long a frame takes, and how often it fails: 802.11b (DSSS, CCK) and 802.11g (ERP-OFDM).

Times are those of IEEE 802.11-2007, clauses 15, 17, 18 and 19. An ad hoc cell of 802.11g has the long slot of 20 µs:
the short one is for cells with an access point (19.4.4). Frames of all stations go at one rate: nobody adapts it.

Error rates are the textbook's, for white noise: DBPSK and DQPSK differentially detected (Proakis, Digital
Communications, chapter 5), CCK by the union bound over the distances of its codewords, OFDM by the union bound of
hard-decision Viterbi decoding (Proakis, chapter 8) with the first terms of the code's distance spectrum (Frenger, Orten
and Ottosson, IEEE Communications Letters 3(11), 1999). They know no fading: a room with people and metal is worse.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from flotilla.common.errors import UserError

US = 1000
"""Nanoseconds."""
ACK_BYTES = 14
"""Of an ACK and of a CTS, frame check sequence included."""
MAC_BYTES = 24 + 4
"""Of a data frame in an ad hoc cell: three addresses, no QoS, and the frame check sequence."""
LLC_BYTES = 8
"""LLC and SNAP, before an IP packet (RFC 1042)."""
DSSS_BIT_S = (1_000_000, 2_000_000, 5_500_000, 11_000_000)
OFDM_BITS = {6: 24, 9: 36, 12: 48, 18: 72, 24: 96, 36: 144, 48: 192, 54: 216}
"""Data bits of a symbol of 4 µs, by the rate in Mbit/s."""
_OFDM_BASIC_BIT_S = (6_000_000, 12_000_000, 24_000_000)
_THERMAL_DBM_HZ = -174.0


@dataclass(frozen=True)
class Phy:
    """A standard as an ad hoc cell uses it."""

    name: str
    slot_ns: int = 20 * US
    sifs_ns: int = 10 * US
    cw_min: int = 31
    """First contention window: a backoff is 0 to this many slots."""
    cw_max: int = 1023
    rates_bit_s: Sequence[int] = DSSS_BIT_S
    basic_bit_s: Sequence[int] = (1_000_000, 2_000_000)
    """Rates that every member has: those of ACKs and, the lowest, of multicast and beacons."""
    short_preamble: bool = False
    """Of DSSS frames above 1 Mbit/s."""
    protection: bool = False
    """802.11b stations are in the cell: a CTS to itself comes before each OFDM frame."""

    @property
    def difs_ns(self) -> int:
        """How long the channel is idle before who waits counts slots, or sends at once."""
        return self.sifs_ns + 2 * self.slot_ns

    @property
    def eifs_ns(self) -> int:
        """The same after a frame that could not be read: long enough for an ACK at the lowest rate."""
        return self.sifs_ns + self.frame_ns(ACK_BYTES, self.basic_bit_s[0]) + self.difs_ns

    @property
    def ack_timeout_ns(self) -> int:
        """After a frame: then no ACK has begun (9.2.8), by the delay after which a DSSS or ERP header is known."""
        return self.sifs_ns + self.slot_ns + (24 if self.basic_bit_s[0] in _OFDM_BASIC_BIT_S else 192) * US

    def frame_ns(self, size: int, rate_bit_s: int) -> int:
        """Air time of a frame of `size` bytes, MAC header and check sequence included."""
        if rate_bit_s in DSSS_BIT_S:
            # 18.3.4: the length field counts whole microseconds.
            microseconds = -(-8 * size * 1_000_000 // rate_bit_s)
            short = self.short_preamble and rate_bit_s > DSSS_BIT_S[0]
            return ((96 if short else 192) + microseconds) * US
        # 19.8.3.1: preamble and header 20 µs, service 16 and tail 6 bits, and a signal extension of 6 µs.
        symbols = -(-(16 + 8 * size + 6) // OFDM_BITS[rate_bit_s // 1_000_000])
        return (20 + 4 * symbols + 6) * US

    def ack_rate_bit_s(self, rate_bit_s: int) -> int:
        """An ACK goes at the highest basic rate that is not above the frame's, and of its kind (9.6)."""
        ofdm = rate_bit_s not in DSSS_BIT_S
        basic = _OFDM_BASIC_BIT_S if ofdm else self.basic_bit_s
        return max((rate for rate in basic if rate <= rate_bit_s and (rate in DSSS_BIT_S) != ofdm), default=basic[0])

    def ack_ns(self, rate_bit_s: int) -> int:
        """Of the ACK of a frame at that rate."""
        return self.frame_ns(ACK_BYTES, self.ack_rate_bit_s(rate_bit_s))

    def protection_ns(self, rate_bit_s: int) -> int:
        """What comes before a frame that 802.11b stations cannot read: CTS and SIFS."""
        if not self.protection or rate_bit_s in DSSS_BIT_S:
            return 0
        return self.frame_ns(ACK_BYTES, self.basic_bit_s[-1]) + self.sifs_ns

    def exchange_ns(self, size: int, rate_bit_s: int) -> int:
        """Air time of a frame and its ACK, with what is between."""
        return self.protection_ns(rate_bit_s) + self.frame_ns(size, rate_bit_s) + self.sifs_ns + self.ack_ns(rate_bit_s)


B = Phy("b")
B_SHORT = Phy("b, short preamble", short_preamble=True)
G = Phy("g", cw_min=15, rates_bit_s=tuple(rate * 1_000_000 for rate in OFDM_BITS), basic_bit_s=_OFDM_BASIC_BIT_S)
G_MIXED = Phy(
    "g with b stations", cw_min=15, rates_bit_s=(*DSSS_BIT_S, *G.rates_bit_s),
    basic_bit_s=(1_000_000, 2_000_000), protection=True,
)  # fmt: skip
"""ERP-OFDM beside 802.11b stations: basic rates are theirs, and a CTS to itself precedes each OFDM frame."""
STANDARDS: Mapping[str, Phy] = {"b": B, "b-short": B_SHORT, "g": G, "g-mixed": G_MIXED}


def rate_bit_s(text: str, phy: Phy) -> int:
    """`11M` as bits a second; UserError for what the standard has not."""
    there = ", ".join(f"{rate / 1e6:g}M" for rate in phy.rates_bit_s)
    try:
        found = round(float(text.removesuffix("M")) * 1e6)
    except (ValueError, OverflowError):
        found = 0
    if found not in phy.rates_bit_s:
        raise UserError(f"RATE={text}: 802.11{phy.name} has no such rate; take one of {there}")
    return found


# What noise does


@dataclass(frozen=True)
class Air:
    """The room: log-distance path loss, and what receivers need."""

    transmit_dbm: float = 15.0
    """Of each radio, antennas included."""
    loss_1m_db: float = 40.0
    """Path loss at 1 m: free space at 2.4 GHz."""
    exponent: float = 3.0
    """Path loss grows by ten times this for each decade of distance: 2 in free space, 3 to 4 indoors (Rappaport,
    Wireless Communications, 4.9)."""
    noise_figure_db: float = 7.0
    sense_dbm: float = -85.0
    """A station takes the channel for busy from this power on."""
    capture_db: float = 10.0
    """A frame survives others that are weaker by so much together."""

    def received_dbm(self, distance_m: float) -> float:
        """At a distance; nearer than 1 m is 1 m."""
        return self.transmit_dbm - self.loss_1m_db - 10 * self.exponent * math.log10(max(distance_m, 1.0))

    def noise_dbm(self, rate_bit_s: int) -> float:
        """In the receiver's bandwidth."""
        return _THERMAL_DBM_HZ + 10 * math.log10(bandwidth_hz(rate_bit_s)) + self.noise_figure_db


def bandwidth_hz(rate_bit_s: int) -> float:
    return 22e6 if rate_bit_s in DSSS_BIT_S else 20e6


CCK_8 = {4: 24, 6: 16, 8: 174, 10: 16, 12: 24, 16: 1}
"""Codewords of 11 Mbit/s by their squared distance from one, in units of two chips' energy."""
CCK_4 = {8: 14, 16: 1}
"""The same of 5.5 Mbit/s."""
_SPECTRA: Mapping[str, tuple[int, int, Sequence[int]]] = {
    "1/2": (10, 1, (36, 0, 211, 0, 1404, 0, 11633)),
    "2/3": (6, 2, (3, 70, 285, 1276, 6160, 27128)),
    "3/4": (5, 3, (42, 201, 1492, 10469, 62935)),
}
"""By code rate: free distance, bits a branch, and bit errors of all paths at that distance, the next, …"""
_OFDM: Mapping[int, tuple[int, str]] = {
    6: (1, "1/2"), 9: (1, "3/4"), 12: (2, "1/2"), 18: (2, "3/4"),
    24: (4, "1/2"), 36: (4, "3/4"), 48: (6, "2/3"), 54: (6, "3/4"),
}  # fmt: skip
"""By the rate in Mbit/s: coded bits of a subcarrier, code rate."""


def _q(x: float) -> float:
    return 0.5 * math.erfc(x / math.sqrt(2))


def _dqpsk(snr_bit: float) -> float:
    """Bit error rate, differentially detected and Gray coded: half the rate of symbols whose phase is off by more than
    45°, by the integral of Pawula, Rice and Roberts (IEEE Transactions on Communications 30(8), 1982)."""
    steps, total = 64, 0.0
    cosine = math.cos(math.pi / 4)
    for step in range(steps):
        inner = 1 - cosine * math.cos(-math.pi / 2 + (step + 0.5) * math.pi / steps)
        total += math.exp(-2 * snr_bit * inner) / inner
    return math.sin(math.pi / 4) / (2 * math.pi) * total * math.pi / steps / 2


def _uncoded(bits: int, snr: float) -> float:
    """Bit error rate of Gray-coded BPSK, QPSK and square QAM; `snr` of a subcarrier's symbol."""
    if bits == 1:
        return _q(math.sqrt(2 * snr))
    if bits == 2:
        return _q(math.sqrt(snr))
    levels: int = 1 << bits // 2
    return min(0.5, 4 / bits * (1 - 1 / levels) * _q(math.sqrt(3 * snr / (levels**2 - 1))))


def _decoded(error: float, code: str) -> float:
    """Bit error rate after hard-decision Viterbi decoding, by the union of Bhattacharyya's bounds."""
    distance, bits, weights = _SPECTRA[code]
    base = math.sqrt(4 * error * (1 - error))
    errors: float = sum(weight * math.pow(base, distance + n) for n, weight in enumerate(weights))
    return min(0.5, errors / (2 * bits))


def frame_error(rate_bit_s: int, size: int, snr_db: float) -> float:
    """Share of frames of `size` bytes that fail at a ratio of signal to noise in the receiver's bandwidth."""
    return _frame_error(rate_bit_s, size, round(snr_db, 2))


@lru_cache(1 << 14)
def _frame_error(rate_bit_s: int, size: int, snr_db: float) -> float:
    snr = 10 ** (snr_db / 10)
    bits = 8 * size
    if rate_bit_s in (5_500_000, 11_000_000):
        # 22 MHz of noise, 11 million chips a second: a chip has twice that ratio.
        chip = 2 * snr
        distances = CCK_8 if rate_bit_s == 11_000_000 else CCK_4
        symbol = min(1.0, sum(count * _q(math.sqrt(distance * chip)) for distance, count in distances.items()))
        unit, units = symbol, bits / (8 if rate_bit_s == 11_000_000 else 4)
    elif rate_bit_s in DSSS_BIT_S:
        snr_bit = snr * bandwidth_hz(rate_bit_s) / rate_bit_s
        unit = 0.5 * math.exp(-snr_bit) if rate_bit_s == 1_000_000 else _dqpsk(snr_bit)
        units = bits
    else:
        carried, code = _OFDM[rate_bit_s // 1_000_000]
        unit, units = _decoded(_uncoded(carried, snr), code), bits
    return 1.0 if unit >= 1 else -math.expm1(units * math.log1p(-unit))
