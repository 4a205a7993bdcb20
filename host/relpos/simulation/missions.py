"""Missions: teams that walk about a building as nobody planned, as measurements and truth.

Everybody walks from one waypoint of a square area to the next as a unicycle at 10 Hz, with pauses.
Dead reckoning reports once a second, every node with a phase of its own. Ranges come at random
times, some ``range_rate_hz`` a second and pair within reach. What goes wrong on the way is switched
on by settings; :data:`CONDITIONS` names the usual ones. They combine: ``--scenario mission-split
--set range_late_s=0.3``.

Everything is a pure function of the settings and the seed, and no setting changes the random
numbers of another.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from relpos.errors import RelposError
from relpos.fusion.settings import parse, setting
from relpos.measurements import (
    Heading,
    Height,
    Measurement,
    Motion,
    Prior,
    Range,
    common_priors,
)
from relpos.simulation.paper import SimulatedRun, true_rows

Floats = npt.NDArray[np.float64]

PREFIX = "mission"

RATE_HZ = 10
"""Of the true walk."""

TURN_RAD_S = math.radians(120.0)
"""A unicycle turns no faster."""

REACHED_M = 0.5
"""A waypoint is reached from so near."""

ROOM_M = 10.0
"""Distance of the walls from each other, both ways, where there are walls."""

FLOOR_M = 3.0

BESIDE_M = 0.8
"""Between two who walk side by side; in a line they follow each other by ``BEHIND_S``."""
BEHIND_S = 2.5

DISTURBED = 1
"""The user whose node restarts, loses its motion or has another clock."""

EXCESS_M = (0.5, 3.0)
"""A link without line of sight is too long by so much; redrawn every ``EXCESS_HELD_S``."""
EXCESS_HELD_S = 20.0

WALL_DELAY_M = 0.3
"""A range through a wall is too long by so much; half of them are lost."""


@dataclass(frozen=True, slots=True)
class MissionSettings:
    """What ``--set`` may change; the defaults are the condition ``base``."""

    nodes: int = setting(6, "people", 2, 1000)
    seconds: float = setting(600.0, "length of the run", 10.0, 1e5)
    area_m: float = setting(30.0, "side of the square area", 2.0, 1e4)
    speed_m_s: float = setting(1.0, "walking speed", 0.1, 10.0)
    pause_s: float = setting(5.0, "mean pause at a waypoint", 0.0, 1e3)
    abreast: int = setting(0, "1: all walk side by side", 0, 1)
    in_line: int = setting(0, "1: all walk one behind the other", 0, 1)
    way_noise_m: float = setting(0.06, "noise of a way of one metre", 0.0, 10.0)
    heading_noise_deg: float = setting(1.5, "heading noise of one second", 0.0, 90.0)
    turn_noise: float = setting(0.06, "relative noise of a turn", 0.0, 1.0)
    drift_deg_min: float = setting(0.0, "heading drift, its sign drawn", 0.0, 600.0)
    step_scale: float = setting(1.0, "true length of a step over the reported one", 0.1, 10.0)
    range_rate_hz: float = setting(0.7, "ranges a second and pair", 0.0, 50.0)
    sigma_range_m: float = setting(0.1, "noise of a range", 0.0, 100.0)
    max_range_m: float = setting(30.0, "reach", 1.0, 1e5)
    walls: int = setting(0, "1: walls every 10 m lose and delay ranges", 0, 1)
    nlos_share: float = setting(0.0, "links without line of sight in one half", 0.0, 1.0)
    shadow_m: float = setting(0.0, "most that two bodies lengthen a range", 0.0, 10.0)
    range_late_s: float = setting(0.0, "ranges are dated so much late", 0.0, 10.0)
    clock_off_s: float = setting(0.0, "one node's clock is ahead by so much", -10.0, 10.0)
    gap_s: float = setting(0.0, "once a minute a node reports no motion for so long", 0.0, 50.0)
    lost_s: float = setting(0.0, "one node's motion is lost for so long at half-time", 0.0, 600.0)
    reboot_s: float = setting(0.0, "one node is off for so long at half-time", 0.0, 600.0)
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
    "gap-2": {"gap_s": 2},
    "gap-5": {"gap_s": 5},
    "gap-20": {"gap_s": 20},
    "two-abreast": {"nodes": 2, "abreast": 1},
    "line": {"in_line": 1},
    "two-hour": {"nodes": 2, "seconds": 3600},
    "drift": {"drift_deg_min": 6},
    "compass": {"compass_deg": 30},
    "scale": {"step_scale": 0.8},
    "nlos": {"nlos_share": 0.4},
    "walls": {"walls": 1, "max_range_m": 8},
    "rare": {"range_rate_hz": 0.1},
    "dense": {"range_rate_hz": 10},
    "shadow": {"shadow_m": 0.8},
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


@dataclass(frozen=True, slots=True)
class Walk:
    """True poses: times (T,), positions (N, T, 2), unwrapped headings (N, T), floors (N,)."""

    time_s: Floats
    position_m: Floats
    heading_rad: Floats
    floor_m: Floats

    def at(self, node: int, time_s: Floats) -> Floats:
        """Position and unwrapped heading of one user at times (n,) -> (n, 3)."""
        columns = (*self.position_m[node].T, self.heading_rad[node])
        return np.stack([np.interp(time_s, self.time_s, c) for c in columns], axis=-1)


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
    floor_m = np.zeros(settings.nodes)
    if settings.floors > 1:
        floor_m[1::2] = FLOOR_M
    poses = np.stack(tracks)
    return Walk(time_s, poses[:, :, :2], poses[:, :, 2], floor_m)


def _wander(
    settings: MissionSettings, time_s: Floats, away_m: Floats, rng: np.random.Generator
) -> Floats:
    """One user's poses (T, 3) from waypoint to waypoint; in the split's time by ``away_m`` off."""
    step_s = 1.0 / RATE_HZ
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
        dx, dy = goal[0] - x, goal[1] - y
        if math.hypot(dx, dy) < REACHED_M:
            goal, until_s = None, now_s + rng.exponential(settings.pause_s)
            continue
        turn = math.remainder(math.atan2(dy, dx) - heading, 2.0 * math.pi)
        heading += min(max(turn, -TURN_RAD_S * step_s), TURN_RAD_S * step_s)
        # Who faces away turns on the spot.
        way_m = settings.speed_m_s * step_s * max(math.cos(turn), 0.0)
        x, y = x + way_m * math.cos(heading), y + way_m * math.sin(heading)
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


def _motions(settings: MissionSettings, truth: Walk, rng: np.random.Generator) -> list[Motion]:
    """Every node's dead reckoning: chords of a second, each in its heading at the beginning."""
    made: list[Motion] = []
    middle_s = 0.5 * settings.seconds
    for node, one in enumerate(rng.spawn(settings.nodes)):
        phase_s, gap_phase_s = one.uniform(0.05, 1.0), one.uniform(0.0, 60.0)
        drift_rad_s = math.radians(settings.drift_deg_min) / 60.0 * one.choice([-1.0, 1.0])
        time_s = np.arange(phase_s, settings.seconds, 1.0)
        poses = truth.at(node, np.r_[0.0, time_s])
        move, turn = np.diff(poses[:, :2], axis=0), np.diff(poses[:, 2])
        c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
        forward, left = c * move[:, 0] + s * move[:, 1], c * move[:, 1] - s * move[:, 0]
        way = np.hypot(forward, left)
        normals = one.standard_normal((4, time_s.size))
        duration_s = np.diff(np.r_[0.0, time_s])
        noise_m = settings.way_noise_m * np.sqrt(way)
        x = forward / settings.step_scale + noise_m * normals[0]
        y = left / settings.step_scale + noise_m * normals[1]
        noise_rad = math.radians(settings.heading_noise_deg) * np.sqrt(duration_s)
        turned = turn + noise_rad * normals[2] * (way > 0.0)
        turned += settings.turn_noise * turn * normals[3] + drift_rad_s * duration_s
        off_s = settings.clock_off_s if node == DISTURBED else 0.0
        outage_s = max(settings.lost_s, settings.reboot_s) if node == DISTURBED else 0.0
        pending, pending_turn = 0j, 0.0
        for t, *(dx, dy, angle) in zip(time_s, x, y, turned, strict=True):
            if middle_s <= t < middle_s + outage_s:
                continue
            step = pending + complex(dx, dy) * cmath.rect(1.0, pending_turn)
            angle += pending_turn
            if t > gap_phase_s and (t - gap_phase_s) % 60.0 < settings.gap_s:
                # The next report has the sum.
                pending, pending_turn = step, float(angle)
                continue
            pending, pending_turn = 0j, 0.0
            made.append(Motion(float(t + off_s), node + 1, step.real, step.imag, float(angle)))
    return made


def _ranges(settings: MissionSettings, truth: Walk, rng: np.random.Generator) -> list[Range]:
    made: list[Range] = []
    middle_s = 0.5 * settings.seconds
    pairs = [(a, b) for a in range(settings.nodes) for b in range(a + 1, settings.nodes)]
    for (a, b), one in zip(pairs, rng.spawn(len(pairs)), strict=True):
        count = one.poisson(settings.range_rate_hz * settings.seconds)
        time_s = np.sort(one.uniform(0.0, settings.seconds, count))
        lost, first = one.random(count), np.where(one.random(count) < 0.5, a, b)
        noise_m = settings.sigma_range_m * one.standard_normal(count)
        held = round(settings.seconds / EXCESS_HELD_S) + 2
        blocked = one.random(held) < settings.nlos_share
        excess_m = blocked * one.uniform(*EXCESS_M, held)
        at, of = truth.at(a, time_s), truth.at(b, time_s)
        line = of[:, :2] - at[:, :2]
        flat_m = np.hypot(*line.T)
        true_m = np.hypot(flat_m, truth.floor_m[b] - truth.floor_m[a])
        range_m = true_m + noise_m + _shadow(settings.shadow_m, at, of)
        in_half = at[:, 0] < 0.5 * settings.area_m
        range_m += in_half * excess_m[(time_s / EXCESS_HELD_S).astype(int)]
        heard = true_m < settings.max_range_m
        if settings.walls:
            crossed = np.abs(np.diff(np.floor([at[:, :2] / ROOM_M, of[:, :2] / ROOM_M]), axis=0))
            walls = crossed[0].sum(axis=1)
            range_m += WALL_DELAY_M * walls
            heard &= lost < 0.5**walls
        if settings.reboot_s > 0.0 and DISTURBED in (a, b):
            heard &= (time_s < middle_s) | (time_s >= middle_s + settings.reboot_s)
        # The clock is that of the one who ranges.
        off_s = np.where(first == DISTURBED, settings.clock_off_s, 0.0) + settings.range_late_s
        for k in np.flatnonzero(heard):
            node = int(first[k])
            peer = b if node == a else a
            made.append(
                Range(float(time_s[k] + off_s[k]), node + 1, peer + 1, abs(float(range_m[k])))
            )
    return made


def _shadow(most_m: float, at: Floats, of: Floats) -> Floats:
    """How much two bodies lengthen a range: each half of ``most_m`` when it faces away (n,)."""
    line = np.arctan2(of[:, 1] - at[:, 1], of[:, 0] - at[:, 0])
    away_from_of = np.maximum(-np.cos(line - at[:, 2]), 0.0)
    away_from_at = np.maximum(np.cos(line - of[:, 2]), 0.0)
    shadow: Floats = 0.5 * most_m * (away_from_of + away_from_at)
    return shadow


def _sensed(
    settings: MissionSettings, truth: Walk, rng: np.random.Generator
) -> list[Height | Heading]:
    made: list[Height | Heading] = []
    for node, one in enumerate(rng.spawn(settings.nodes)):
        time_s = np.arange(one.uniform(0.0, 1.0), settings.seconds, 1.0)
        heading = truth.at(node, time_s)[:, 2]
        wrong_rad = math.radians(max(settings.compass_deg, 0.0)) * one.standard_normal()
        noise = one.standard_normal((2, time_s.size))
        for k, t in enumerate(time_s):
            if settings.heights:
                height_m = float(truth.floor_m[node] + 0.1 * noise[0, k])
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
    return Walk(truth.time_s, positions, headings, truth.floor_m)


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
        *_motions(settings, truth, motion_rng),
        *_ranges(settings, truth, range_rng),
        *_sensed(settings, truth, sensed_rng),
    ]
    priors = tuple(
        Prior(k + 1, *map(float, pose))
        for k, pose in enumerate(np.column_stack([truth.position_m[:, 0], truth.heading_rad[:, 0]]))
    )
    if common:
        priors = common_priors(p.node for p in priors)
    whole = slice(None, None, RATE_HZ)
    rows = true_rows(
        truth.time_s[whole], truth.position_m[:, whole], truth.heading_rad[:, whole], truth.floor_m
    )
    return SimulatedRun(scenario, tuple(sorted(measurements, key=lambda m: m.time_s)), priors, rows)
