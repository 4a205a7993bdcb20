"""What air pressure does in a building, and the height that a barometer makes of it.

All in pascals over what the standard atmosphere has at that height: common weather, stack effect
(NFPA 92: 10 Pa over 12 m at 20 K), fans (25 Pa), doors (10 Pa), hot air (6 in place of 11.8 Pa/m
at 300 degrees).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
import numpy.typing as npt

from relpos.settings import setting
from relpos.simulation.sensing import RATE_HZ, SensingSettings
from relpos.simulation.storeys import STAIRWELLS, TAG_M, Place

Floats = npt.NDArray[np.float64]
Places = npt.NDArray[np.int64]

PA_PER_M = 12.01
"""Of air at 15 degrees, which the node takes for granted."""
COOL_K = 288.15

WEATHER_S = 3600.0
"""How long the weather keeps its trend."""
DOOR_EVERY_S, DOOR_SHUT_S = 60.0, (5.0, 40.0)
"""Mean time between doors that shut somebody off, and how long they are shut (assumed)."""
LEAK = 0.1
"""Share of the stairwell's pressure that reaches the storeys (assumed)."""
GUSTS = 0.05
"""Share of a fan's pressure that flutters (assumed)."""
HOT_X_M = 10.0
"""The fire's rooms reach so far from the west wall."""
NEUTRAL_M = 1.75
"""Height over the floor at which a hot room has the pressure of its surroundings."""

SMOOTHED_S = 0.4
"""A node's height follows so much late (docs/building.md)."""


@dataclass(frozen=True, slots=True)
class AirSettings(SensingSettings):
    """What ``--set`` may change of air and barometers.

    A phone's pressure over returns to the same point after a minute differs by 0.30 m (RMS, 264
    returns in the logs of IPIN 2023); ``bias_m`` and ``drift_m`` give 0.27 m with ``noise_m``.
    """

    weather_pa_h: float = setting(20.0, "trend of the weather in an hour", 0.0, 1e4)
    stack_pa: float = setting(0.0, "stack effect over 12 m of a stairwell", -100.0, 100.0)
    fan_pa: float = setting(0.0, "overpressure of a fan", 0.0, 1e3)
    fan_whole: int = setting(0, "1: it reaches the whole building; 0: a stairwell", 0, 1)
    fan_s: float = setting(600.0, "the fan starts", 0.0, 1e5)
    fan_rise_s: float = setting(10.0, "and reaches its pressure after so long", 0.1, 1e3)
    fan_off_s: float = setting(900.0, "the fan stops", 0.0, 1e5)
    door_pa: float = setting(0.0, "pressure behind a door that shuts", 0.0, 1e3)
    heat_k: float = setting(0.0, "hot rooms on the floor above the start's: by so much", 0.0, 1e3)
    heat_s: float = setting(120.0, "they begin to burn", 0.0, 1e5)
    warm_k: float = setting(5.0, "air is so much warmer than 15 degrees", -50.0, 50.0)
    noise_m: float = setting(0.06, "noise of a reported height", 0.0, 10.0)
    bias_m: float = setting(0.15, "wandering of a barometer, keeping for bias_s", 0.0, 10.0)
    bias_s: float = setting(90.0, "how long it keeps", 1.0, 1e5)
    drift_m: float = setting(0.005, "drift of a barometer in a second's root", 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Where one node is over time (T,): feet and tag over the start's, place, x."""

    feet_m: Floats
    tag_m: Floats
    place: Places
    x_m: Floats


def weather_pa(settings: AirSettings, time_s: Floats, rng: np.random.Generator) -> Floats:
    """Pressure (T,) that is common to all: a trend that wanders within an hour."""
    step_s = 1.0 / RATE_HZ
    rate = settings.weather_pa_h / 3600.0
    trend = _wander(time_s.size, WEATHER_S, rng, start=float(rng.choice([-1.0, 1.0])))
    return np.asarray(np.cumsum(rate * trend * step_s))


def fan_pa(settings: AirSettings, time_s: Floats, rng: np.random.Generator) -> Floats:
    """Overpressure (T,) where the fan blows."""
    rises = np.clip((time_s - settings.fan_s) / settings.fan_rise_s, 0.0, 1.0)
    falls = np.clip((time_s - settings.fan_off_s) / settings.fan_rise_s, 0.0, 1.0)
    gusts = 1.0 + GUSTS * _wander(time_s.size, 2.0, rng)
    return np.asarray(settings.fan_pa * (rises - falls) * gusts)


def field_pa(
    settings: AirSettings, at: Surroundings, time_s: Floats, fan: Floats, hot_m: float
) -> Floats:
    """Return what one node's place adds to the weather (T,); ``hot_m`` is the hot floor."""
    shaft = np.isin(at.place, STAIRWELLS)
    inside = at.place != Place.OUTSIDE
    west = at.place == Place.WEST
    share = np.where(west, 1.0, LEAK) if not settings.fan_whole else np.ones(time_s.size)
    field = fan * share * inside
    # In a shaft warm air stands from bottom to top; on a storey half of it leaks away.
    field += settings.stack_pa / 12.0 * at.feet_m * np.where(shaft, 1.0, 0.5) * inside
    warm = settings.heat_k * np.clip((time_s - settings.heat_s) / 60.0, 0.0, 1.0)
    lighter = PA_PER_M * warm / (COOL_K + warm)
    over_m = at.tag_m + TAG_M - hot_m
    in_heat = (at.place == Place.STOREY) & (np.abs(at.feet_m - hot_m) < 1.0) & (at.x_m < HOT_X_M)
    field += lighter * (over_m - NEUTRAL_M) * in_heat
    return np.asarray(field)


def doors_pa(settings: AirSettings, time_s: Floats, rng: np.random.Generator) -> Floats:
    """Pressure (T,) behind doors that shut one node off for a while."""
    field = np.zeros(time_s.size)
    count = int(rng.poisson(time_s[-1] / DOOR_EVERY_S))
    begins_s = rng.uniform(0.0, time_s[-1], count)
    for begin_s, shut_s, sign in zip(
        begins_s, rng.uniform(*DOOR_SHUT_S, count), rng.choice([-1.0, 1.0], count), strict=True
    ):
        field[(time_s >= begin_s) & (time_s < begin_s + shut_s)] = sign * settings.door_pa
    return field


def reported_m(
    settings: AirSettings, tag_m: Floats, over_pa: Floats, time_s: Floats, rng: np.random.Generator
) -> Floats:
    """Height (T,) that a barometer makes of the true one (T,) and the field (T,), without noise.

    It counts from the first sample, as a node counts from where it was switched on.
    """
    scale = COOL_K / (COOL_K + settings.warm_k)
    wander = settings.bias_m * _wander(time_s.size, settings.bias_s, rng)
    drift = settings.drift_m / math.sqrt(RATE_HZ) * np.cumsum(rng.standard_normal(time_s.size))
    height = scale * tag_m - over_pa / PA_PER_M + wander + drift
    return np.asarray(np.interp(time_s - SMOOTHED_S, time_s, height))


def _wander(
    count: int, keeps_s: float, rng: np.random.Generator, start: float | None = None
) -> Floats:
    """Return an Ornstein-Uhlenbeck process (count,) of variance 1."""
    kept = math.exp(-1.0 / (RATE_HZ * keeps_s))
    first = float(rng.standard_normal()) if start is None else start
    shocks = math.sqrt(1.0 - kept**2) * rng.standard_normal(count)
    shocks[0] = first
    return np.array(list(accumulate(shocks.tolist(), lambda last, shock: kept * last + shock)))
