"""Activities on the feet: walking in any direction, turning, stairs.

Ranges are given beside each activity. Where no literature or recording supports one it is wide
and uniform, and its comment says "open".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .activity import Activity
from .planner import Planner, StepShape


@dataclass(frozen=True, slots=True)
class _Style:
    """Factors on the wearer's usual walk: on the walk ratio, the excursion, and `StepShape`."""

    ratio: float = 1.0
    excursion: float = 1.0
    trunk: float = 1.0
    shock: float = 1.0
    surge: float = 1.0


def _forward(
    p: Planner,
    distance: float,
    turn: float,
    speed: float,
    last: bool,
    style: _Style = _Style(),
) -> None:
    """Walk ``distance`` turning evenly by ``turn``; ``last`` shortens the last step."""
    rng, w = p.rng, p.wearer
    begin = p.planned_path
    end = begin + distance
    p.planned_path = end
    if turn != 0.0:
        p.out.bends.append((begin, distance, turn))
    bend = abs(turn) / max(distance, 0.1)
    slow = 0.3 * min(bend * 0.6, 1.0)
    while True:
        p.wander = 0.9 * p.wander + 0.04 * math.sqrt(1 - 0.9**2) * rng.standard_normal()
        pace_m_s = speed * (1.0 - slow) * math.exp(p.wander)
        cadence = math.sqrt(pace_m_s / (p.walk_ratio * style.ratio))
        side = p.foot
        uneven = w.asymmetry + w.limp
        vary = p.variation(pace_m_s)
        length = pace_m_s / cadence * math.exp(vary * rng.standard_normal())
        length *= 1.0 + side * uneven
        duration = math.exp(0.8 * vary * rng.standard_normal()) / cadence
        duration *= 1.0 - side * 0.6 * uneven
        left = end - p.path
        if left < 0.5 * length:
            break
        final = last and left < 1.5 * length
        if final:
            length = left
        if p.since_stand == 0:
            length *= 0.65
            duration *= 1.1
        excursion = p.excursion(max(length, 0.05), cadence) * style.excursion
        p.step(
            length,
            duration,
            excursion * (1.0 + side * 1.2 * uneven),
            pace_m_s / 1.2,
            shape=StepShape(
                surge=style.surge * min(w.surge * math.sqrt(1.2 / pace_m_s), 0.5),
                trunk=style.trunk * (1.0 + w.limp),
                shock=style.shock * (1.0 + side * uneven),
            ),
        )
        if final:
            break


def walk(p: Planner, a: Activity, last: bool) -> None:
    """Walk forward."""
    speed = a.speed_m_s if a.speed_m_s is not None else p.wearer.speed_m_s
    _forward(p, a.distance_m, a.turn_rad, speed, last)


def carry(p: Planner, a: Activity, last: bool) -> None:
    """Walk with a load in the arms."""
    # Open but for the direction: loads damp the trunk's motion (LaFiandra 2003).
    rng = p.rng
    speed = a.speed_m_s if a.speed_m_s is not None else p.wearer.speed_m_s
    p.out.pitch.to(math.radians(float(rng.uniform(-8.0, 12.0))), p.time, 0.8)
    _forward(
        p,
        a.distance_m,
        a.turn_rad,
        speed * float(rng.uniform(0.75, 1.0)),
        last,
        _Style(
            ratio=float(rng.uniform(0.8, 1.0)),
            excursion=float(rng.uniform(0.45, 0.9)),
            trunk=float(rng.uniform(0.2, 0.6)),
            shock=float(rng.uniform(0.6, 1.1)),
            surge=float(rng.uniform(0.6, 1.2)),
        ),
    )
    p.out.pitch.to(0.0, p.time, 0.8)


def shuffle(p: Planner, a: Activity, last: bool) -> None:
    """Walk in short steps that hardly lift the feet."""
    # Short steps whose lift has little to do with their length. The slow bouts of
    # walk_daily_lowerback (one person) have steps of 0.2 to 0.4 m in 0.3 to 2.9 s that lift
    # the back by 17 to 29 mm with 0.8 to 1.5 m/s2 rms; feet that slide lift it less (open).
    rng, w = p.rng, p.wearer
    stride = float(rng.uniform(0.08, 0.42))
    cadence = float(rng.uniform(0.9, 2.2))
    lift = float(rng.uniform(0.004, 0.036))
    trunk = float(rng.uniform(0.3, 3.0))
    surge = float(rng.uniform(0.2, 0.9))
    hesitate = float(rng.uniform(0.0, 0.2))
    uneven = float(rng.uniform(0.1, 0.4))
    swerve = float(rng.uniform(0.0, 0.2))
    shock = float(rng.uniform(0.5, 2.5))
    begin = p.planned_path
    end = begin + a.distance_m
    p.planned_path = end
    if a.turn_rad:
        p.out.bends.append((begin, a.distance_m, a.turn_rad))
    while (left := end - p.path) > 0.5 * stride:
        if rng.random() < hesitate:
            p.stay(float(rng.uniform(0.2, 1.5)))
        length = stride * math.exp(uneven * rng.standard_normal())
        length = min(length, left) if last else length
        p.step(
            length,
            math.exp(0.12 * w.irregularity * rng.standard_normal()) / cadence,
            lift * math.exp(0.25 * rng.standard_normal()),
            length * cadence / 1.2,
            turn=swerve * float(rng.standard_normal()),
            shape=StepShape(
                shock=shock,
                surge=surge,
                sway=float(rng.uniform(0.6, 1.4)),
                trunk=trunk,
            ),
        )


def turn(p: Planner, a: Activity, last: bool) -> None:
    """Turn on the spot."""
    # Open but for the size of the turns: 25 to 70 degrees a step.
    rng = p.rng
    count = max(2, round(abs(a.turn_rad) / math.radians(float(rng.uniform(25.0, 70.0)))))
    cadence = float(rng.uniform(0.9, 2.2))
    lift = float(rng.uniform(0.003, 0.022))
    creep = float(rng.uniform(0.0, 0.06))
    p.face(float(rng.uniform(-math.pi, math.pi)) if creep > 0.02 else 0.0)
    fraction = np.exp(0.3 * rng.standard_normal(count))
    fraction /= fraction.sum()
    for k in range(count):
        p.step(
            creep * float(rng.uniform(0.0, 1.0)),
            math.exp(0.15 * rng.standard_normal()) / cadence,
            lift * math.exp(0.3 * rng.standard_normal()),
            float(rng.uniform(0.1, 0.35)),
            turn=a.turn_rad * float(fraction[k]),
            shape=StepShape(
                surge=0.3,
                sway=float(rng.uniform(0.5, 1.3)),
                trunk=float(rng.uniform(0.5, 2.0)),
            ),
        )
    p.face(0.0)
    p.planned_path = p.path


def side(p: Planner, a: Activity, last: bool) -> None:
    """Step sideways."""
    # Open: one foot steps, the other closes; the trunk moves by fits and starts.
    rng = p.rng
    p.face(math.copysign(math.pi / 2, a.distance_m))
    pair = float(rng.uniform(0.25, 0.6))
    lift = float(rng.uniform(0.004, 0.03))
    cadence = float(rng.uniform(1.0, 2.2))
    lead = float(rng.uniform(0.5, 0.75))
    surge = float(rng.uniform(0.3, 0.9))
    count = max(1, round(abs(a.distance_m) / pair))
    for k in range(2 * count):
        fraction = lead if k % 2 == 0 else 1.0 - lead
        p.step(
            abs(a.distance_m) / count * fraction,
            math.exp(0.08 * rng.standard_normal()) / cadence,
            lift * math.exp(0.2 * rng.standard_normal()),
            pair * cadence / 2.4,
            shape=StepShape(
                surge=surge,
                sway=float(rng.uniform(0.2, 0.6)),
                trunk=float(rng.uniform(0.4, 1.5)),
            ),
        )
    p.face(0.0)
    p.planned_path = p.path


def backward(p: Planner, a: Activity, last: bool) -> None:
    """Walk backward."""
    # Shorter steps at a higher cadence (Winter 1989); how much lift is open.
    rng = p.rng
    p.face(math.pi)
    speed = float(rng.uniform(0.3, 0.9)) if a.speed_m_s is None else a.speed_m_s
    p.planned_path = p.path
    _forward(
        p,
        a.distance_m,
        0.0,
        speed,
        True,
        _Style(
            ratio=float(rng.uniform(0.6, 0.9)),
            excursion=float(rng.uniform(0.6, 1.2)),
            shock=float(rng.uniform(0.4, 0.9)),
            surge=float(rng.uniform(0.8, 2.0)),
        ),
    )
    p.face(0.0)
    p.planned_path = p.path


def stairs(p: Planner, a: Activity, last: bool) -> None:
    """Climb stairs, or descend them."""
    # Riser and tread as built (0.17 m and 0.29 m usual), cadence as Riener, Rabuffetti and
    # Frigo 2002 (0.4 to 0.6 m/s along the tread); the bounce beside the climb is open.
    rng = p.rng
    up = a.kind == "stairs_up"
    count = a.count or int(rng.integers(8, 22))
    riser = float(rng.uniform(0.15, 0.20))
    tread = float(rng.uniform(0.25, 0.32))
    cadence = float(rng.uniform(1.1, 1.9) if up else rng.uniform(1.2, 2.1))
    bounce = float(rng.uniform(0.008, 0.045))
    shock = float(rng.uniform(0.4, 0.9) if up else rng.uniform(0.9, 1.8))
    surge = float(rng.uniform(0.1, 0.5))
    lean = rng.uniform(4.0, 16.0) if up else rng.uniform(-3.0, 8.0)
    p.out.pitch.to(math.radians(float(lean)), p.time, 0.8)
    vary = 0.03 * p.wearer.irregularity
    for _ in range(count):
        p.step(
            tread,
            math.exp(vary * rng.standard_normal()) / cadence,
            bounce * math.exp(0.12 * rng.standard_normal()),
            tread * cadence / 1.2 * (1.0 if up else 1.3),
            climb=riser if up else -riser,
            shape=StepShape(
                surge=surge,
                shock=shock,
                trunk=1.3,
            ),
        )
    p.out.pitch.to(0.0, p.time, 0.8)
    p.planned_path = p.path
