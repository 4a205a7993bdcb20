"""A node's health in three colours, from its own reports and its link.

Red: its data are unusable, or it is about to fall silent. Yellow: it works with reduced quality.
Green: everything else. The limits stand below, each with its reason.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

from relpos.said import Said

SILENT_S = 5.0
"""A node reports its motion every second; five in a row are lost once in 10^8 at 2 % loss."""
LOSS_YELLOW = 0.10
"""Running totals replace lost motion, lost ranges are gone: five times the usual 2 %."""
LOSS_RED = 0.50
RANGING_YELLOW = 0.20
MIN_EXCHANGES = 15
"""An unreachable peer counts as a failure, so a team spread over a floor is at 30 to 50 % and well.
 Of fifteen exchanges at 40 % under a fifth succeed three times in a hundred by chance; more
often the tag is covered, or all others are out of reach, which users should know. Two nodes make
fifteen in half a minute."""
BATTERY_YELLOW_V = 4.5
"""Below the guaranteed supply of the Uno's 3.3 V regulator and its boards (5 V - 10 %). The AVR's
reference is 1.0 to 1.2 V, so a single board may report 9 % too little or too much."""
BATTERY_RED_V = 4.2
"""At 16 MHz an ATmega328P is specified down to 3.78 V; a transmission pulls a weak cell further."""
RSSI_YELLOW_DBM = -86
"""An XBee Series 1 hears down to -92 dBm (data sheet, from memory: check); a body that turns takes
more than the 6 dB that are left."""
STARTING_S = 8.0
"""Sensors answer within a second of power-on, a beacon comes soon after; the first status of a node
comes before they do, and the next one 10 s later."""
STARTING = "starting"
FRESH_START_S = 60.0
"""How long an unwanted restart is reported."""
MIN_STACK_BYTES = 48
"""An interrupt with its registers takes 40."""


class Health(IntEnum):
    """The colour; a higher number is worse."""

    GREEN = 0
    YELLOW = 1
    RED = 2


@dataclass(frozen=True)
class HealthInputs:
    """The inputs of :func:`assess` for one node; None where unknown.

    ``status`` says whether a status report has arrived. ``frame_loss`` and ``ranging`` are
    fractions over the last half minute, ``exchanges`` the number of exchanges in ``ranging``.
    ``missed_ticks``, ``refused_frames``, ``damaged_bytes`` and ``lost_bytes`` are counts within
    that time.
    """

    silent_s: float
    status: bool = True
    frame_loss: float | None = None
    rssi_dbm: float | None = None
    battery_v: float | None = None
    ranging: float | None = None
    exchanges: int = 0
    neighbours: int | None = None
    team: int | None = None
    imu: bool | None = None
    magnetometer: bool | None = None
    pozyx: bool | None = None
    pressure: bool | None = None
    beacon: bool | None = None
    uptime_s: float | None = None
    unwanted_start: str | None = None
    missed_ticks: int = 0
    refused_frames: int = 0
    damaged_bytes: int = 0
    lost_bytes: int = 0
    free_stack_bytes: int | None = None


def assess(inputs: HealthInputs) -> tuple[Health, list[str]]:
    """Return the colour and its reasons, the worst first; a green node has none."""
    reasons = sorted(_reasons(inputs), key=lambda reason: -reason[0])
    worst = max((colour for colour, _ in reasons), default=Health.GREEN)
    return worst, [words for _, words in reasons]


def _reasons(f: HealthInputs) -> Iterator[tuple[Health, str]]:
    red, yellow = Health.RED, Health.YELLOW
    if f.silent_s > SILENT_S:
        yield red, Said("silent", "silent for {seconds:.0f} s", seconds=f.silent_s)
    elif not f.status:
        yield yellow, Said("no-status", "no status heard yet")
    parts = (f.magnetometer, "magnetometer"), (f.pozyx, "Pozyx"), (f.pressure, "pressure sensor")
    missing = [what for there, what in parts if there is False]
    if f.uptime_s is not None and f.uptime_s < STARTING_S:
        if missing or f.imu is False or f.beacon is False:
            yield yellow, Said("starting", STARTING)
    else:
        if f.imu is False:
            yield red, Said("no-imu", "inertial sensor missing")
        for what in missing:
            yield yellow, Said("missing", "{part} missing", part=what)
        if f.beacon is False:
            yield yellow, Said("no-beacon", "receives no beacon")
    if f.frame_loss is not None and f.frame_loss > LOSS_YELLOW:
        colour = red if f.frame_loss > LOSS_RED else yellow
        yield colour, Said("loss", "{percent:.0f} % of frames lost", percent=100 * f.frame_loss)
    # 0: this board does not measure it.
    if f.battery_v and f.battery_v < BATTERY_YELLOW_V:
        colour = red if f.battery_v < BATTERY_RED_V else yellow
        yield colour, Said("supply", "supply {volts:.2f} V", volts=f.battery_v)
    if f.unwanted_start is not None and (f.uptime_s or 0.0) < FRESH_START_S:
        yield yellow, Said("restarted", "restarted ({cause})", cause=f.unwanted_start)
    if (
        f.ranging is not None
        and f.exchanges >= MIN_EXCHANGES
        and f.ranging < RANGING_YELLOW
        and f.pozyx is not False
    ):
        yield (
            yellow,
            Said("ranging", "{percent:.0f} % of rangings succeed", percent=100 * f.ranging),
        )
    if f.neighbours == 0 and (f.team or 0) > 1:
        yield yellow, Said("no-peer", "no peer in range")
    if f.rssi_dbm is not None and f.rssi_dbm < RSSI_YELLOW_DBM:
        yield yellow, Said("radio", "weak radio ({dbm:.0f} dBm)", dbm=f.rssi_dbm)
    if f.missed_ticks > 0:
        yield yellow, f"{f.missed_ticks} ticks missed"
    if f.refused_frames > 0:
        yield yellow, f"{f.refused_frames} forged or repeated frames rejected"
    if f.damaged_bytes > 0:
        yield yellow, f"{f.damaged_bytes} bytes damaged on the way from the XBee"
    if f.lost_bytes > 0:
        yield yellow, f"{f.lost_bytes} received bytes lost"
    if f.free_stack_bytes is not None and f.free_stack_bytes < MIN_STACK_BYTES:
        yield yellow, f"{f.free_stack_bytes} bytes of stack left"
