"""What a script makes a wearer do over time: steps, turns, climbs and postures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from relpos.simulation.world import FloatArray

HIP_OF_STATURE = 0.53


@dataclass(slots=True)
class Changes:
    """A quantity that moves from value to value in smooth transitions."""

    begin_s: list[float] = field(default_factory=list)
    last_s: list[float] = field(default_factory=list)
    delta: list[float] = field(default_factory=list)
    final: float = 0.0

    def to(self, value: float, begin_s: float, last_s: float) -> None:
        """Go to ``value`` within ``last_s`` seconds."""
        self.begin_s.append(begin_s)
        self.last_s.append(max(last_s, 1e-3))
        self.delta.append(value - self.final)
        self.final = value

    def at(self, time_s: FloatArray) -> FloatArray:
        """Value (n,): each transition is the quintic with no velocity and force at its ends."""
        out = np.zeros_like(time_s)
        for begin, last, delta in zip(self.begin_s, self.last_s, self.delta, strict=True):
            if delta == 0.0:
                continue
            u = np.clip((time_s - begin) / last, 0.0, 1.0)
            out += delta * (u**3 * (10.0 - 15.0 * u + 6.0 * u**2))
        return out


@dataclass(frozen=True, slots=True)
class Slip:
    """The sensor turns on the body by ``angle_rad`` about ``axis`` (body) and moves."""

    begin_s: float
    last_s: float
    axis: FloatArray
    angle_rad: float
    shift_m: FloatArray


@dataclass(frozen=True, slots=True)
class Impact:
    """A blow to the torso: peak acceleration along world-fixed directions of the body."""

    time_s: float
    up_m_s2: float
    level_m_s2: float
    resonance_hz: float


STEP_FIELDS = ("excursion_m", "pace", "surge", "sway", "trunk", "length_m", "shock")
"""Per step: vertical excursion; speed over 1.2 m/s for shocks and trunk; fore-aft fluctuation;
scale of the lateral sway; scale of the trunk's rotations; length; scale of the shock."""


@dataclass(slots=True)
class Itinerary:
    """Steps, turns, climbs and postures over time. The phase is an integer in double support."""

    knot_time_s: list[float] = field(default_factory=lambda: [-1e3, 0.0])
    knot_phase: list[float] = field(default_factory=lambda: [0.0, 0.0])
    knot_path_m: list[float] = field(default_factory=lambda: [0.0, 0.0])
    knot_turn_rad: list[float] = field(default_factory=lambda: [0.0, 0.0])
    knot_ground_m: list[float] = field(default_factory=lambda: [0.0, 0.0])
    steps: list[tuple[float, ...]] = field(default_factory=list)
    """One row of `STEP_FIELDS` a step."""
    bends: list[tuple[float, float, float]] = field(default_factory=list)
    """Path length at which a bend begins, its length and its angle."""
    pitch: Changes = field(default_factory=Changes)
    roll: Changes = field(default_factory=Changes)
    drop: Changes = field(default_factory=Changes)
    """How far the hips are below their height in standing."""
    offset: Changes = field(default_factory=Changes)
    """Direction of movement from where the body faces."""
    twist: Changes = field(default_factory=Changes)
    """Turns of the body without steps."""
    slide: Changes = field(default_factory=Changes)
    """Movement without steps."""
    slips: list[Slip] = field(default_factory=list)
    impacts: list[Impact] = field(default_factory=list)
    intervals: list[tuple[float, float, str]] = field(default_factory=list)
    """Begin, end and label of each activity."""

    @property
    def end_s(self) -> float:
        """When the last activity ends."""
        return self.knot_time_s[-1]
