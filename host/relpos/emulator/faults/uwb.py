"""Faults of the ultra-wideband air between the tags; those of one tag are in ``chips.py``."""

from __future__ import annotations

from collections import deque

from relpos.emulator.air import EXCHANGE_US
from relpos.emulator.pozyx import Pozyx

from .hooks import Hooks, Rng
from .spec import FaultSpec


def uwb(hooks: Hooks, spec: FaultSpec, rng: Rng) -> None:
    """Install a fault of the air between the tags."""
    air = hooks.team.uwb
    before = air.spoil
    foreign: deque[int] = deque()
    next_us = [float(spec.from_us)]
    rate = spec.number("rate")

    def collisions(measured_m: float | None, end_us: int) -> tuple[float | None, bool]:
        """Exchanges of foreign tags begin at random times; whether one overlaps."""
        begin_us = hooks.clock.now_us
        while next_us[0] < end_us and rate > 0.0:
            foreign.append(round(next_us[0]))
            next_us[0] += 1e6 * float(rng.exponential(1.0 / rate))
        while foreign and foreign[0] + EXCHANGE_US <= begin_us:
            foreign.popleft()
        return measured_m, bool(foreign) and foreign[0] < end_us

    def loss(measured_m: float | None, _end_us: int) -> tuple[float | None, bool]:
        return None if rng.random() < rate else measured_m, False

    def wrong(measured_m: float | None, _end_us: int) -> tuple[float | None, bool]:
        if rng.random() < rate and measured_m is not None:
            measured_m += float(rng.uniform(0.0, spec.number("value")))
        return measured_m, False

    damage = {"collisions": collisions, "loss": loss, "wrong": wrong}[spec.fault.behaviour]

    def spoil(initiator: Pozyx, measured_m: float | None, end_us: int) -> tuple[float | None, bool]:
        measured_m, collided = before(initiator, measured_m, end_us)
        if not spec.active(hooks.clock.now_us):
            return measured_m, collided
        measured_m, met = damage(measured_m, end_us)
        return measured_m, met or collided

    air.spoil = spoil
