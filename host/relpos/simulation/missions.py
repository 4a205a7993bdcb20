"""Missions: teams that walk about a building as nobody planned, as measurements and truth.

Everybody walks from one waypoint of a square area to the next as a unicycle at 10 Hz, with pauses;
:mod:`relpos.simulation.sensing` measures. What goes wrong on the way is switched on by settings;
:data:`CONDITIONS` names the usual ones. They combine: ``--scenario mission-split --set
range_late_s=0.3``.

Everything is a pure function of the settings and the seed, and no setting changes the random
numbers of another.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from relpos.errors import RelposError
from relpos.measurements import (
    Heading,
    Height,
    Measurement,
    common_priors,
)
from relpos.settings import parse, setting
from relpos.simulation.paper import SimulatedRun
from relpos.simulation.sensing import (
    RATE_HZ,
    SensingSettings,
    Walk,
    motions,
    ranges,
    unicycle,
)

Floats = npt.NDArray[np.float64]

PREFIX = "mission"

TURN_RAD_S = math.radians(120.0)
"""A unicycle turns no faster."""

REACHED_M = 0.5
"""A waypoint is reached from so near."""

FLOOR_M = 3.0

BESIDE_M = 0.8
"""Between two who walk side by side; in a line they follow each other by ``BEHIND_S``."""
BEHIND_S = 2.5


@dataclass(frozen=True, slots=True)
class MissionSettings(SensingSettings):
    """What ``--set`` may change; the defaults are the condition ``base``."""

    abreast: int = setting(0, "1: all walk side by side", 0, 1)
    in_line: int = setting(0, "1: all walk one behind the other", 0, 1)
    split_s: float = setting(0.0, "half of the team is away for so long", 0.0, 1e4)
    split_m: float = setting(80.0, "how far away", 0.0, 1e5)
    floors: int = setting(1, "2: every other one is on the upper floor", 1, 2)
    heights: int = setting(0, "1: heights are reported", 0, 1)
    start_m: float = setting(0.0, "the start is said to be common; spread of positions", 0.0, 100.0)
    start_deg: float = setting(0.0, "and of headings", 0.0, 180.0)
    compass_deg: float = setting(-1.0, "spread of compass errors; below 0: no compass", -1.0, 180.0)


CONDITIONS: Mapping[str, Mapping[str, float]] = {
    "base": {},
    "hour": {"nodes": 8, "seconds": 3600},
    "common": {"start_m": 0.5, "start_deg": 10},
    "split": {"seconds": 1500, "split_s": 600, "split_m": 80},
    "split-hard": {
        "seconds": 1500, "split_s": 600, "split_m": 150, "drift_deg_min": 6, "pause_s": 20,
        "heading_noise_deg": 3,
    },
    "reboot": {"reboot_s": 8},
    "lost": {"lost_s": 20},
    "carried": {"carried_s": 30},
    "gap-2": {"gap_s": 2},
    "gap-5": {"gap_s": 5},
    "gap-20": {"gap_s": 20},
    "two-abreast": {"nodes": 2, "abreast": 1},
    "line": {"in_line": 1},
    "two-hour": {"nodes": 2, "seconds": 3600},
    "drift": {"drift_deg_min": 6},
    "compass": {"compass_deg": 30},
    "scale": {"step_scale": 0.8},
    "crawl": {"scale_change": 0.74},
    "nlos": {"nlos_share": 0.4},
    "walls": {"walls": 1, "max_range_m": 8},
    "office": {"walls": 1},
    "rare": {"range_rate_hz": 0.1},
    "dense": {"range_rate_hz": 10},
    "shadow": {"shadow_m": 0.8},
    "delays": {"delay_m": 0.2},
    "late-0.3": {"range_late_s": 0.3},
    "late-1": {"range_late_s": 1},
    "clock": {"clock_off_s": 1},
    "floors": {"floors": 2, "heights": 1},
    "floors-no-heights": {"floors": 2},
    "fourteen": {"nodes": 14},
    "twenty": {"nodes": 20},
    "thirty": {"nodes": 30, "drift_deg_min": 6, "step_scale": 0.85, "seconds": 300},
    "thirty-one": {"nodes": 31, "drift_deg_min": 6, "step_scale": 0.85, "seconds": 300},
}  # fmt: skip
"""Condition -> how it differs from ``base``."""

NAMES = tuple(f"{PREFIX}-{condition}" for condition in CONDITIONS)


def settings_of(
    scenario: str, overrides: Mapping[str, str | float] | None = None
) -> MissionSettings:
    """Return a mission's settings, changed by ``overrides`` (the values of ``--set``)."""
    condition = scenario.removeprefix(f"{PREFIX}-")
    if scenario not in NAMES:
        raise RelposError(f"unknown scenario '{scenario}': one of {', '.join(NAMES)}")
    return parse(MissionSettings, {**CONDITIONS[condition], **(overrides or {})}, scenario)


def walk(settings: MissionSettings, rng: np.random.Generator) -> Walk:
    """Let everybody walk."""
    count = round(settings.seconds * RATE_HZ) + 1
    time_s = np.arange(count) / RATE_HZ
    together = bool(settings.abreast or settings.in_line)
    tracks = []
    for node, one in enumerate(rng.spawn(settings.nodes)):
        if together and node:
            continue
        away = np.zeros(2)
        if settings.split_s > 0.0 and node >= settings.nodes // 2:
            away[0] = settings.split_m
        tracks.append(_wander(settings, time_s, away, one))
    if together:
        tracks = [_follow(settings, time_s, tracks[0], node) for node in range(settings.nodes)]
    height_m = np.zeros((settings.nodes, count))
    if settings.floors > 1:
        height_m[1::2] = FLOOR_M
    poses = np.stack(tracks)
    return Walk(time_s, poses[:, :, :2], poses[:, :, 2], height_m)


def _wander(
    settings: MissionSettings, time_s: Floats, away_m: Floats, rng: np.random.Generator
) -> Floats:
    """One user's poses (T, 3) from waypoint to waypoint; in the split's time by ``away_m`` off."""
    split = 0.25 * settings.seconds, 0.25 * settings.seconds + settings.split_s
    x, y = rng.uniform(0.0, settings.area_m, 2)
    heading = rng.uniform(-math.pi, math.pi)
    goal, until_s, was_away = None, 0.0, False
    poses = np.empty((time_s.size, 3))
    for k, now_s in enumerate(time_s):
        poses[k] = x, y, heading
        is_away = split[0] <= now_s < split[1] and away_m[0] > 0.0
        if goal is None or is_away != was_away:
            goal = rng.uniform(0.0, settings.area_m, 2) + (away_m if is_away else 0.0)
            was_away = is_away
        if now_s < until_s:
            continue
        if math.hypot(goal[0] - x, goal[1] - y) < REACHED_M:
            goal, until_s = None, now_s + rng.exponential(settings.pause_s)
            continue
        x, y, heading = unicycle((x, y, heading), goal, settings.speed_m_s, TURN_RAD_S)
    return poses


def _follow(settings: MissionSettings, time_s: Floats, leader: Floats, place: int) -> Floats:
    """Poses (T, 3) of the one at ``place`` beside or behind the leader."""
    if settings.in_line:
        then_s = np.maximum(time_s - BEHIND_S * place, 0.0)
        # Before the leader's way begins they stand in a line behind it.
        poses = np.stack([np.interp(then_s, time_s, column) for column in leader.T], axis=-1)
        waiting_m = settings.speed_m_s * np.maximum(BEHIND_S * place - time_s, 0.0)
        _, _, heading = leader[0]
        poses[:, 0] -= waiting_m * math.cos(heading)
        poses[:, 1] -= waiting_m * math.sin(heading)
        return poses
    left = np.stack([-np.sin(leader[:, 2]), np.cos(leader[:, 2])], axis=-1)
    return np.column_stack([leader[:, :2] + BESIDE_M * place * left, leader[:, 2]])


def _sensed(
    settings: MissionSettings, truth: Walk, rng: np.random.Generator
) -> list[Height | Heading]:
    made: list[Height | Heading] = []
    for node, one in enumerate(rng.spawn(settings.nodes)):
        time_s = np.arange(one.uniform(0.0, 1.0), settings.seconds, 1.0)
        heading, above_m = truth.at(node, time_s)[:, 2], truth.height_at(node, time_s)
        wrong_rad = math.radians(max(settings.compass_deg, 0.0)) * one.standard_normal()
        noise = one.standard_normal((2, time_s.size))
        for k, t in enumerate(time_s):
            if settings.heights:
                height_m = float(above_m[k] + 0.1 * noise[0, k])
                made.append(Height(float(t), node + 1, height_m, 0.1))
            if settings.compass_deg >= 0.0:
                seen = heading[k] + wrong_rad + math.radians(5.0) * noise[1, k]
                made.append(Heading(float(t), node + 1, math.remainder(seen, 2.0 * math.pi)))
    return made


def _common_start(settings: MissionSettings, truth: Walk, rng: np.random.Generator) -> Walk:
    """Move and turn everybody's walk such that all begin near one pose."""
    positions, headings = truth.position_m.copy(), truth.heading_rad.copy()
    for node in range(settings.nodes):
        x, y, heading = (
            *(settings.start_m / math.sqrt(2.0) * rng.standard_normal(2)),
            math.radians(settings.start_deg) * rng.standard_normal(),
        )
        turn = heading - headings[node, 0]
        c, s = math.cos(turn), math.sin(turn)
        moved = (positions[node] - positions[node, 0]) @ np.array([[c, s], [-s, c]])
        positions[node], headings[node] = moved + np.array([x, y]), headings[node] + turn
    return replace(truth, position_m=positions, heading_rad=headings)


def simulate_mission(
    scenario: str, seed: int = 0, overrides: Mapping[str, str | float] | None = None
) -> SimulatedRun:
    """Measurements, priors and truth of one mission; the same arguments, the same run."""
    settings = settings_of(scenario, overrides)
    walk_rng, motion_rng, range_rng, sensed_rng, start_rng = (
        np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(5)
    )
    truth = walk(settings, walk_rng)
    common = settings.start_m > 0.0 or settings.start_deg > 0.0
    if common:
        truth = _common_start(settings, truth, start_rng)
    measurements: list[Measurement] = [
        *motions(settings, truth, motion_rng),
        *ranges(settings, truth, range_rng),
        *_sensed(settings, truth, sensed_rng),
    ]
    priors = truth.priors()
    return SimulatedRun(
        scenario,
        tuple(sorted(measurements, key=lambda m: m.time_s)),
        common_priors(p.node for p in priors) if common else priors,
        truth.rows(),
    )
