"""Faults of the laptop at the coordinator's serial port."""

from __future__ import annotations

from .hooks import Hooks, Rng
from .spec import FaultSpec


def host(hooks: Hooks, spec: FaultSpec, rng: Rng) -> None:
    """Install a fault of the laptop."""
    before = hooks.team.host_fault
    wakes_us = {"gone": None, "delayed": spec.to_us}[spec.fault.behaviour]

    def due_us(time_us: int) -> int | None:
        at_us = before(time_us)
        return at_us if at_us is None or not spec.active(at_us) else wakes_us

    hooks.team.host_fault = due_us
