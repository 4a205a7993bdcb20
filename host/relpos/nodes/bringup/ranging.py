"""The Pozyx: its own self-test, its pressure sensor, how long it holds the clock, and ranging."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from statistics import median

from relpos.nodes.bringup.bus import POZYX_ADDRESS as ADDRESS
from relpos.nodes.bringup.bus import BusFindings
from relpos.nodes.bringup.bus_access import BusAccess
from relpos.nodes.bringup.finding import POZYX, PRESSURE, RANGING, Finding

FIRMWARE, HARDWARE, SELF_TEST, ERROR_CODE, INT_STATUS = 0x01, 0x02, 0x03, 0x04, 0x05
UWB_SETTINGS, PRESSURE_MPA = 0x1C, 0x50
DO_RANGING, RANGE_INFO = 0xB5, 0xC7
ERROR_FLAG, DONE_FLAG = 0x01, 0x10
TESTED = 0x3F
"""Its sensors, its processor, its pressure sensor and UWB (register ST_RESULT)."""
PLAUSIBLE_PA = (60_000.0, 110_000.0)
"""From 4,000 m to below the sea."""
EXCHANGES = 10
"""As many again where fewer than half of the first succeed, but some: an eighth fails in the
emulated air, too."""
GIVE_UP_S = 1.5
LATE_S = 0.06
"""An exchange takes 20 to 30 ms."""
SLOW_ANSWER_S = 0.5
"""An exchange whose timing a repeated command spoils does not count."""
UPTIME_TOLERANCE_S = 3.0
TOO_LONG_US = 5_000
DISTANCE_TOLERANCE_M = 1.0
"""Antenna delays before calibration, and walls."""

GOOD, SLOW, STALE, INVERTED, FAILED, REFUSED, SILENT = (
    "good", "slow", "stale", "inverted", "failed", "refused", "silent",
)  # fmt: skip


@dataclass(frozen=True)
class Exchange:
    """One ranging exchange carried out from here; ``late_s``: how long no end was to be seen."""

    outcome: str
    late_s: float = 0.0
    code: int = 0
    stretch_us: float = 0.0
    distance_m: float = 0.0
    rss_dbm: int = 0
    on_since_s: float = -math.inf
    """When the Pozyx was switched on, by its own clock."""


def pozyx_findings(bus: BusAccess, figures: dict[str, object]) -> Iterator[Finding]:
    """What it says of itself and of the air's pressure."""
    tested = bus.byte(ADDRESS, SELF_TEST)
    settings = [bus.byte(ADDRESS, UWB_SETTINGS + k) for k in range(4)]
    versions = [bus.byte(ADDRESS, register) for register in (FIRMWARE, HARDWARE)]
    figures |= {"pozyx_versions": versions, "pozyx_self_test": tested, "uwb_settings": settings}
    yield Finding(
        POZYX,
        tested == TESTED,
        f"its own self-test gives 0x{tested or 0:02X}, firmware 0x{versions[0] or 0:02X}",
        f"0x{TESTED:02X} is right: update its firmware with Pozyx's tools, then it is defective",
    )
    words = [bus.transfer(ADDRESS, PRESSURE_MPA, read=n).data for n in (2, 4)]
    pressure_pa = int.from_bytes(b"".join(words), "little") * 1e-3
    figures["pressure_pa"] = pressure_pa
    yield Finding(
        PRESSURE,
        PLAUSIBLE_PA[0] <= pressure_pa <= PLAUSIBLE_PA[1],
        f"{pressure_pa / 100.0:.0f} hPa",
        "600 to 1100 hPa are plausible: the sensor on the Pozyx is defective",
    )


def ranging_findings(
    bus: BusAccess,
    found: BusFindings,
    peer: int,
    distance_m: float | None,
    on_since_s: float,
    figures: dict[str, object],
) -> Iterator[Finding]:
    """Range to ``peer`` and judge what most exchanges do. ``on_since_s``: the node."""
    exchanges: list[Exchange] = []
    good: list[Exchange] = []
    for _ in range(2):
        exchanges += [exchange for _ in range(EXCHANGES) if (exchange := _range(bus, found, peer))]
        good = [exchange for exchange in exchanges if exchange.outcome == GOOD]
        if not good or 2 * len(good) >= len(exchanges):
            break
    counts = Counter(exchange.outcome for exchange in exchanges)
    stretches = [e.stretch_us for e in exchanges if e.outcome != SILENT]
    figures["exchanges"] = dict(counts)
    if found.byte_us and stretches:
        figures["pozyx_stretch_us"] = [min(stretches), max(stretches)]
        yield Finding(
            POZYX,
            max(stretches) < TOO_LONG_US,
            f"holds the clock for {median(stretches):.0f} us a ranging call, at most "
            f"{max(stretches):.0f} us",
            "5000 us are allowed: send this report in",
        )
    later_s = max((exchange.on_since_s for exchange in good), default=-math.inf) - on_since_s
    if later_s > UPTIME_TOLERANCE_S:
        yield Finding(
            POZYX,
            False,
            f"has restarted {later_s:.0f} s after the node was switched on",
            "its supply dips: 5 V at its pins, contacts",
        )
    if 2 * len(good) >= max(len(exchanges), 1):
        yield _distance(good, len(exchanges), peer, distance_m, figures)
        return
    yield Finding(RANGING, False, *_why(counts, exchanges, peer))


def _distance(
    good: list[Exchange],
    tried: int,
    peer: int,
    distance_m: float | None,
    figures: dict[str, object],
) -> Finding:
    measured_m = median(exchange.distance_m for exchange in good)
    figures |= {
        "range_m": measured_m,
        "rss_dbm": median(exchange.rss_dbm for exchange in good),
        "exchange_under_s": max(exchange.late_s for exchange in good),
    }
    right = distance_m is None or abs(measured_m - distance_m) < DISTANCE_TOLERANCE_M
    asked = "" if distance_m is None else f" (laid out: {distance_m:g} m)"
    return Finding(
        RANGING,
        right,
        f"{measured_m:.2f} m to node {peer}{asked}, {len(good)} of {tried} exchanges, "
        f"{figures['rss_dbm']:.0f} dBm",
        "nothing between the two? Then relpos node calibrate antenna; over a metre off, the Pozyx "
        "is defective",
    )


def _why(counts: Counter[str], exchanges: list[Exchange], peer: int) -> tuple[str, str]:
    """Return what most of the bad exchanges show, and what to do."""
    counts = Counter({outcome: n for outcome, n in counts.items() if outcome != GOOD})
    worst = counts.most_common(1)[0][0] if counts else SILENT
    late_ms = 1e3 * max((exchange.late_s for exchange in exchanges), default=0.0)
    codes = ", ".join(f"0x{c:02X}" for c in sorted({e.code for e in exchanges if e.code}))
    defective = "the Pozyx or its firmware is defective: update it with Pozyx's tools"
    return {
        SLOW: (f"an exchange takes over {late_ms:.0f} ms", f"30 ms are usual: {defective}"),
        STALE: ("reports the end of exchanges, but no new distance", defective),
        INVERTED: ("reports success as failure and failure as success", defective),
        FAILED: (
            f"node {peer} does not answer (error {codes})",
            f"is node {peer}'s Pozyx on, in reach, uncovered? Have both the same UWB settings?",
        ),
        REFUSED: (f"the Pozyx refuses to range (error {codes})", defective),
        SILENT: ("the Pozyx does not answer the call", "a loose contact, or it holds the clock"),
    }[worst]


def _range(bus: BusAccess, found: BusFindings, peer: int) -> Exchange | None:
    """Carry out one exchange; None where its timing does not count."""

    def row(count: int) -> int:
        data = bus.transfer(ADDRESS, RANGE_INFO, peer, written=3, read=count).data
        return int.from_bytes(data, "little")

    before = row(3)
    bus.transfer(ADDRESS, INT_STATUS, read=1)  # clears what came before
    call = bus.transfer(ADDRESS, DO_RANGING, peer, written=3, read=1)
    if not call.answered:
        return Exchange(SILENT)
    stretch_us = max(0.0, call.took_us - found.start_us - 6.0 * found.byte_us)
    if call.data[1] != 1:
        return Exchange(REFUSED, code=bus.byte(ADDRESS, ERROR_CODE) or 0, stretch_us=stretch_us)
    late_s, slowest_s, flags = 0.0, call.apart_s, 0
    while not flags & (ERROR_FLAG | DONE_FLAG) and late_s < GIVE_UP_S:
        look = bus.transfer(ADDRESS, INT_STATUS, read=1)
        slowest_s = max(slowest_s, look.apart_s)
        if look.answered:
            flags = look.data[1]
        if not flags & (ERROR_FLAG | DONE_FLAG):
            late_s = look.at_s - call.at_s
    if slowest_s > SLOW_ANSWER_S:
        return None
    after = row(3)
    code = bus.byte(ADDRESS, ERROR_CODE) or 0
    done = bool(flags & DONE_FLAG) and not flags & ERROR_FLAG
    outcome = GOOD if done else FAILED
    if done and after == before:
        outcome = STALE
    elif not done and flags and after != before:
        outcome = INVERTED
    elif late_s > LATE_S:
        outcome = SLOW
    on_since_s = call.at_s - (after | row(5) << 16) * 1e-3
    distance_m = (row(7) | row(9) << 16) * 1e-3
    rss = int.from_bytes(row(11).to_bytes(2, "little"), "little", signed=True)
    if outcome == GOOD and row(3) != after:
        return None  # the peer has ranged meanwhile: what was read is not one exchange's
    return Exchange(outcome, late_s, code, stretch_us, distance_m, rss, on_since_s)
