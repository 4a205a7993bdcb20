"""Whole scripts by name, drawn at random."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from wearers.wearer import Wearer

from .activity import ACTIVITIES, Activity

_RIGHT_ANGLE = math.pi / 2


def _laps(
    rng: np.random.Generator, wearer: Wearer, sides_m: tuple[float, float], total_m: float
) -> list[Activity]:
    """Counter-clockwise laps of a rectangle whose corners are rounded, ``total_m`` of way."""
    bend = wearer.turn_length_m
    # A corner of raised-cosine curvature takes this much off each side that it joins.
    u = np.linspace(0.0, 1.0, 1001)
    profile = u - np.sin(2 * np.pi * u) / (2 * np.pi)
    chord = abs(np.trapezoid(np.exp(1j * _RIGHT_ANGLE * profile), u)) * bend
    tangent = float(chord) / math.sqrt(2.0)
    out, left, side = [], total_m, 0
    while left > 0.5:
        straight = min(sides_m[side % 2] - 2 * tangent, left)
        out.append(Activity("walk", straight))
        left -= straight
        if left > bend:
            out.append(Activity("walk", bend, _RIGHT_ANGLE))
            left -= bend
        side += 1
    return out


def _stand(rng: np.random.Generator) -> Activity:
    return Activity("stand", seconds=float(rng.uniform(4.0, 8.0)))


def _paper310(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    return [Activity("stand", seconds=5.0), *_laps(rng, wearer, (23.0, 13.0), 310.0)]


def _paper310_open(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    """310 m that do not close: corridors of 8 to 40 m, turns left and right."""
    out, left = [Activity("stand", seconds=5.0)], 310.0
    while left > 0.0:
        straight = float(rng.uniform(8.0, 40.0))
        if left - straight < wearer.turn_length_m + 2.0:
            straight = left
        out.append(Activity("walk", straight))
        left -= straight
        if left > 0.0:
            angle = math.radians(float(rng.choice((90.0, 90.0, 45.0, 30.0))) * rng.choice((-1, 1)))
            out.append(Activity("walk", wearer.turn_length_m, float(angle)))
            left -= wearer.turn_length_m
    return out


def _speeds(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    """Straights of 12 m at 0.3 to 1.8 m/s, a turn on the spot between."""
    out = [_stand(rng)]
    for speed in rng.permutation(np.linspace(0.3, 1.8, 7)):
        out.append(Activity("walk", 12.0, speed_m_s=float(speed)))
        out.append(Activity("turn", turn_rad=float(rng.choice((-np.pi, np.pi)))))
    return out


def _bout(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    """A few metres at home: slow, curved, ended by standing or a turn on the spot."""
    length = float(rng.uniform(1.2, 6.0))
    kind = str(rng.choice(("walk", "shuffle", "shuffle")))
    turn = float(rng.normal(0.0, 0.9))
    speed = float(rng.uniform(0.3, 1.0))
    return [Activity(kind, length, turn, speed_m_s=speed)]


def _daily(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    """Some three minutes of slow indoor activity: bouts, turns, side steps, bending, standing."""
    out = [_stand(rng)]
    for _ in range(14):
        kind = str(
            rng.choice(("bout", "turn", "side", "bend", "stand"), p=(0.4, 0.2, 0.1, 0.1, 0.2))
        )
        if kind == "bout":
            out += _bout(rng, wearer)
        elif kind == "turn":
            out.append(Activity("turn", turn_rad=float(rng.uniform(-np.pi, np.pi))))
        elif kind == "side":
            out.append(Activity("side", float(rng.uniform(0.4, 1.5) * rng.choice((-1, 1)))))
        elif kind == "bend":
            out.append(Activity("bend", count=1))
        else:
            seconds, looks = float(rng.uniform(1.0, 12.0)), int(rng.integers(0, 5))
            out.append(Activity("stand", seconds=seconds, count=looks))
    return out


def _mixed(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    """Every activity once, in any order, 8 to 20 m of walking between."""
    out = [_stand(rng)]
    kinds = [k for k in ACTIVITIES if k not in ("stand", "walk")]
    for kind in rng.permutation(kinds):
        out.append(Activity("walk", float(rng.uniform(8.0, 20.0)), float(rng.normal(0.0, 0.5))))
        out += _one(str(kind), rng)
    out.append(Activity("walk", 10.0))
    return out


def _one(kind: str, rng: np.random.Generator) -> list[Activity]:
    """One stretch of an activity, of a usual size."""
    if kind == "turn":
        return [Activity("turn", turn_rad=float(rng.uniform(1.0, 2 * np.pi) * rng.choice((-1, 1))))]
    if kind == "side":
        return [Activity("side", float(rng.uniform(1.5, 4.0) * rng.choice((-1, 1))))]
    if kind in ("stairs_up", "stairs_down"):
        return [Activity(kind, count=int(rng.integers(8, 20)))]
    if kind == "bend":
        return [Activity("bend", count=int(rng.integers(1, 4)))]
    if kind in ("fall", "remount", "stand"):
        return [Activity(kind)]
    return [Activity(kind, float(rng.uniform(3.0, 10.0)))]


def _only(kind: str, repeats: int) -> Callable[[np.random.Generator, Wearer], list[Activity]]:
    """Build a script: stand, walk 15 m, then the activity ``repeats`` times."""

    def script(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
        out = [_stand(rng), Activity("walk", 15.0)]
        for _ in range(repeats):
            out += [*_one(kind, rng), Activity("stand", seconds=float(rng.uniform(1.0, 3.0)))]
        return out

    return script


def _pauses(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    out = [_stand(rng)]
    for _ in range(12):
        out.append(Activity("walk", float(rng.uniform(2.0, 15.0)), float(rng.normal(0.0, 0.4))))
        out.append(Activity("stand", seconds=float(rng.uniform(0.5, 6.0))))
    return out


def _slip(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    """The sensor slips while walking, twice."""
    one = [Activity("walk", 20.0), Activity("remount", 20.0)]
    return [_stand(rng), *one, *one, Activity("walk", 20.0)]


SCRIPTS: Mapping[str, Callable[[np.random.Generator, Wearer], list[Activity]]] = {
    "paper310": _paper310,
    "paper310_open": _paper310_open,
    "straight": lambda rng, wearer: [_stand(rng), Activity("walk", 60.0)],
    "speeds": _speeds,
    "daily": _daily,
    "mixed": _mixed,
    "pauses": _pauses,
    "standing": lambda rng, wearer: [Activity("stand", seconds=60.0)],
    "turning": _only("turn", 6),
    "side": _only("side", 5),
    "backward": _only("backward", 4),
    "shuffle": _only("shuffle", 5),
    "carry": _only("carry", 4),
    "stairs_up": _only("stairs_up", 3),
    "stairs_down": _only("stairs_down", 3),
    "crawl": _only("crawl", 3),
    "bend": _only("bend", 4),
    "fall": lambda rng, wearer: [
        _stand(rng),
        Activity("walk", 15.0),
        Activity("fall"),
        Activity("walk", 20.0),
    ],
    "remount": lambda rng, wearer: [
        _stand(rng),
        Activity("walk", 15.0),
        Activity("remount"),
        Activity("walk", 30.0),
    ],
    "slip": _slip,
}
"""Scripts by name; each call draws another one."""
