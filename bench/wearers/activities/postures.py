"""Activities of other postures: standing, bending, crawling, falling; and a sensor that slips.

Ranges are given beside each activity. Where no literature or recording supports one it is wide
and uniform, and its comment says "open".
"""

from __future__ import annotations

import math

import numpy as np

from .activity import Activity
from .itinerary import HIP_OF_STATURE, Impact, Slip
from .planner import Planner, StepShape
from .walking import walk


def crawl(p: Planner, a: Activity, last: bool) -> None:
    """Crawl on hands and knees."""
    # On hands and knees: hips a thigh's length (0.245 of stature, Winter) above the floor.
    # Speed, lift and roll are open.
    rng, w = p.rng, p.wearer
    down, up = (float(rng.uniform(1.8, 3.5)) for _ in range(2))
    level = math.radians(float(rng.uniform(70.0, 95.0)))
    drop = (HIP_OF_STATURE - 0.245) * w.stature_m - float(rng.uniform(0.0, 0.06))
    begin = p.time
    p.out.pitch.to(level, begin, down)
    p.out.drop.to(drop, begin + 0.1, down)
    p.stay(down + 0.5)
    stride = float(rng.uniform(0.18, 0.45))
    cadence = float(rng.uniform(0.7, 1.6))
    lift = float(rng.uniform(0.003, 0.02))
    count = max(1, round(a.distance_m / stride))
    for _ in range(count):
        p.step(
            a.distance_m / count * math.exp(0.08 * rng.standard_normal()),
            math.exp(0.08 * rng.standard_normal()) / cadence,
            lift * math.exp(0.25 * rng.standard_normal()),
            stride * cadence / 1.2,
            shape=StepShape(
                surge=float(rng.uniform(0.1, 0.6)),
                sway=float(rng.uniform(0.4, 1.0)),
                trunk=float(rng.uniform(2.0, 4.5)),
                shock=float(rng.uniform(0.3, 1.5)),
            ),
        )
    p.stay(0.5)
    p.out.pitch.to(0.0, p.time + 0.2, up)
    p.out.drop.to(0.0, p.time, up)
    p.stay(up + 0.6)
    p.planned_path = p.path


def stand(p: Planner, a: Activity, last: bool) -> None:
    """Stand, looking about and reaching."""
    # Looking about and reaching: turns of the trunk and leans over the feet (open).
    rng = p.rng
    seconds = a.seconds or float(rng.uniform(1.5, 5.0))
    if not a.count:
        p.stay(seconds)
        return
    end = p.time + seconds
    facing = p.out.twist.final
    for _ in range(a.count):
        span = float(rng.uniform(0.5, 1.5))
        if p.time + 2 * span > end:
            break
        aside = math.radians(float(rng.normal(0.0, 25.0)))
        lean = math.radians(float(rng.normal(5.0, 10.0)))
        p.out.twist.to(facing + aside, p.time, span)
        p.out.pitch.to(lean, p.time, span)
        p.stay(span + float(rng.uniform(0.0, 1.0)))
    p.out.twist.to(facing, p.time, 0.8)
    p.out.pitch.to(0.0, p.time, 0.8)
    p.stay(max(end - p.time, 0.9))


def bend(p: Planner, a: Activity, last: bool) -> None:
    """Bend down and come up again."""
    # From a nod at a table to the floor, stooping or squatting (open).
    rng = p.rng
    for _ in range(a.count or 1):
        down, hold, up = rng.uniform((0.7, 0.2, 0.8), (2.0, 3.0, 2.2))
        begin = p.time + 0.2
        p.out.pitch.to(math.radians(float(rng.uniform(25.0, 95.0))), begin, float(down))
        p.out.drop.to(float(rng.uniform(0.02, 0.5)), begin, float(down))
        facing = p.out.twist.final
        aside = math.radians(float(rng.normal(0.0, 15.0)))
        p.out.twist.to(facing + aside, begin, float(down))
        rising = begin + float(down + hold)
        p.out.pitch.to(0.0, rising, float(up))
        p.out.drop.to(0.0, rising, float(up))
        p.out.twist.to(facing, rising, float(up))
        p.stay(0.2 + float(down + hold + up) + float(rng.uniform(0.2, 1.5)))


def fall(p: Planner, a: Activity, last: bool) -> None:
    """Fall, lie, and get up over hands and knees."""
    # From standing height the trunk is down in 0.6 to 1.1 s (free fall of the hip: 0.45 s);
    # blows of 3 to 10 g at the waist (Kangas 2008), most of them past the chip's range.
    rng, w, out = p.rng, p.wearer, p.out
    side = str(rng.choice(("front", "back", "left", "right")))
    down_s = float(rng.uniform(0.6, 1.1))
    level = math.radians(float(rng.uniform(70.0, 95.0)))
    # The hips lie as high as the body is deep, or half as wide.
    lying = float(rng.uniform(0.13, 0.22) if side in ("front", "back") else rng.uniform(0.2, 0.28))
    hip = HIP_OF_STATURE * w.stature_m - lying
    direction = {"front": 0.0, "back": math.pi, "left": math.pi / 2, "right": -math.pi / 2}
    if out.offset.final != direction[side]:
        out.offset.to(direction[side], p.time, 0.4)
    p.stay(0.6)
    begin = p.time
    if side in ("front", "back"):
        out.pitch.to(level if side == "front" else -level, begin, down_s)
    else:
        # A roll to the right side lifts the left: positive about the forward axis.
        out.roll.to(level if side == "right" else -level, begin, down_s)
    out.drop.to(hip, begin, down_s)
    out.slide.to(out.slide.final + float(rng.uniform(0.2, 0.8)), begin, down_s)
    out.impacts.append(
        Impact(
            begin + 0.85 * down_s,
            float(rng.uniform(25.0, 100.0)),
            float(rng.uniform(-30.0, 30.0)),
            float(rng.uniform(4.0, 9.0)),
        )
    )
    p.stay(down_s + (a.seconds or float(rng.uniform(2.0, 12.0))))
    # Up over hands and knees.
    first, second = (float(rng.uniform(1.2, 3.0)) for _ in range(2))
    out.pitch.to(math.radians(float(rng.uniform(40.0, 80.0))), p.time, first)
    out.roll.to(0.0, p.time, first)
    out.drop.to(0.24 * w.stature_m, p.time, first)
    turn = math.radians(float(rng.normal(0.0, 40.0)))
    out.twist.to(out.twist.final + turn, p.time, first)
    p.stay(first + float(rng.uniform(0.1, 1.5)))
    out.pitch.to(0.0, p.time, second)
    out.drop.to(0.0, p.time, second)
    p.stay(second + float(rng.uniform(0.6, 2.0)))
    p.face(0.0)


def _slip(p: Planner, begin: float, last: float, angle_deg: tuple[float, float]) -> None:
    axis = p.rng.standard_normal(3)
    p.out.slips.append(
        Slip(
            begin,
            last,
            axis / np.linalg.norm(axis),
            math.radians(float(p.rng.uniform(*angle_deg))),
            p.rng.normal(0.0, 0.03, 3),
        )
    )


def remount(p: Planner, a: Activity, last: bool) -> None:
    """Let the sensor be turned on the body, standing or while walking."""
    rng = p.rng
    if a.distance_m > 0.0:
        _slip(p, p.time + 3.0, float(rng.uniform(0.2, 0.8)), (10.0, 70.0))
        walk(p, a, last)
        return
    p.stay(1.0)
    span = float(rng.uniform(0.6, 2.5))
    _slip(p, p.time, span, (20.0, 180.0))
    p.stay(span + (a.seconds or float(rng.uniform(1.0, 5.0))))
