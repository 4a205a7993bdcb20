"""Walks through a building, second by second, as a vertical filter sees them.

Written apart from the simulated building: a wearer's life is a list of parts, each so many seconds
of steps, rise and pressure (in metres of height); the pressure's noise and bias are added here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from relpos.fusion.estimator import Vertical
from relpos.fusion.timeline import Advance
from relpos.fusion.vertical.filter import VerticalFilter
from relpos.fusion.vertical.track import HEIGHT_LATE_S
from relpos.measurements import Height


class Part(NamedTuple):
    """What somebody does for some seconds; rates in a second."""

    seconds: int
    steps: float = 0.0
    way_m: float = 0.0
    """Horizontal way, truly."""
    rise_m: float = 0.0
    pressure_m: float = 0.0
    """What the pressure does beside, as a height."""
    claims: float = 1.0
    """Way by dead reckoning over the true one."""


def stand(seconds: int) -> Part:
    return Part(seconds)


def walk(seconds: int) -> Part:
    return Part(seconds, 1.8, 1.3)


def stairs(rise_m: float, riser_m: float = 0.175, tread_m: float = 0.28) -> Part:
    """Some 1.6 steps a second; a step is claimed to be 0.56 m long."""
    seconds = round(abs(rise_m) / riser_m / 1.6)
    steps = abs(rise_m) / riser_m / seconds
    return Part(seconds, steps, tread_m * steps, rise_m / seconds, claims=0.56 / tread_m)


def lift(rise_m: float) -> Part:
    seconds = round(abs(rise_m))
    return Part(seconds, rise_m=rise_m / seconds)


def blown(life: Sequence[Part], from_s: int) -> list[Part]:
    """Return a life second by second, with a fan that reaches its pressure in ten of them."""
    seconds = [part._replace(seconds=1) for part in life for _ in range(part.seconds)]
    fan = range(from_s, from_s + 10)
    return [p._replace(pressure_m=-0.21) if k in fan else p for k, p in enumerate(seconds)]


FAN_ON = Part(10, pressure_m=-0.21)
FALL = Part(2, rise_m=-0.85)


@dataclass(frozen=True)
class Outcome:
    """What came of it, second by second: (T,) of each node."""

    told: dict[int, list[Vertical]]
    z_m: dict[int, np.ndarray]
    claimed_m: dict[int, float]
    """Length of the way after correction."""
    true_m: dict[int, float]
    filter: VerticalFilter


def follow(
    lives: Mapping[int, Sequence[Part]],
    *,
    seed: int = 0,
    noise_m: float = 0.06,
    bias_m: float = 0.1,
    weather_m_s: float = 0.0,
    begins_s: Mapping[int, float] | None = None,
    silent: Mapping[int, tuple[float, float]] | None = None,
    stuck_s: Mapping[int, float] | None = None,
    away_s: tuple[float, float] = (math.inf, math.inf),
    with_steps: bool = True,
) -> Outcome:
    """Let a team live; the shorter lives end standing. Heights come to the centimetre.

    From ``stuck_s`` on a node repeats its last height; during ``away_s`` nobody is heard at all.
    """
    rng = np.random.default_rng(seed)
    vertical = VerticalFilter()
    seconds = max(sum(part.seconds for part in life) for life in lives.values())
    each = {
        node: [p for part in life for p in [part] * part.seconds] for node, life in lives.items()
    }
    told: dict[int, list[Vertical]] = {node: [] for node in lives}
    z = {node: np.zeros(seconds) for node in lives}
    bias, now, pressure, shown = (dict.fromkeys(lives, 0.0) for _ in range(4))
    claimed, true = dict.fromkeys(lives, 0j), dict.fromkeys(lives, 0.0)
    for k in range(seconds):
        time_s = float(k + 1)
        for node, life in each.items():
            part = life[k] if k < len(life) else Part(1)
            late_m = HEIGHT_LATE_S * (part.rise_m + part.pressure_m)
            now[node] += part.rise_m
            pressure[node] += part.pressure_m
            z[node][k] = now[node]
            true[node] += part.way_m
            way_m = part.way_m * part.claims
            steps = part.steps if with_steps else None
            made = vertical.move(Advance(time_s, node, 1.0, way_m, 0.0, 0.0, steps=steps))
            claimed[node] += complex(made.dx_m, made.dy_m)
            kept = math.exp(-1.0 / 90.0)
            bias[node] = kept * bias[node] + bias_m * math.sqrt(1 - kept**2) * rng.standard_normal()
            start_s = (begins_s or {}).get(node, 0.0)
            from_s, to_s = (silent or {}).get(node, (math.inf, math.inf))
            noise = noise_m * rng.standard_normal()
            away = away_s[0] <= time_s < away_s[1]
            if time_s > start_s and not away and not from_s <= time_s < to_s:
                h = now[node] - late_m + pressure[node] + bias[node] + noise + weather_m_s * time_s
                if start_s:
                    h -= z[node][int(start_s)] + weather_m_s * start_s
                if time_s < (stuck_s or {}).get(node, math.inf):
                    shown[node] = round(h, 2)
                vertical.measure(Height(time_s, node, shown[node]), time_s)
        for back in () if away else vertical.close(time_s):
            claimed[back.node] += complex(back.dx_m, back.dy_m)
        for node in lives:
            told[node].append(vertical.of(node, time_s))
    return Outcome(told, z, {n: abs(c) for n, c in claimed.items()}, true, vertical)
