"""The paper's laboratory experiment (sect. VI) as a simulation: three people, walls, landmarks.

Path, speeds and the tag are those of the emulator's scenario of the same name
(:mod:`relpos.simulation.team`): 23 m x 13 m, one metre from the walls of a room of 25 m x 15 m,
0.82 to 0.88 m/s, 310 m. All walk the whole time, as 310 m in 380 s say, and begin 8 m apart (the
distance of the paper's simulation). Motions come every second, ranges every two. What is added
here is what the paper could only describe.

**The room plan** (:data:`WALLS`): the walkway surrounds a block of rooms with two partitions, so
that people on different sides see each other, if at all, through walls.

**Detection.** An attempt over distance d succeeds with the probability

    p(d) * wall_transmission^walls * body_transmission^bodies,

p(d) falling in a straight line from ``detection_near`` at 0 m to ``detection_far`` at
``max_range_m`` (30 m in clear line of sight, sect. VI-A) and 0 beyond. Walls are counted on the
line of sight. The tags are worn on the chest: a wearer who has the other one behind (more than
110 degrees off its heading) is a body in the way, and so both can be. People in a file therefore
often do not hear each other although they are close, as the paper's figure of the detection
probability shows.

**What it measures.** Every wall delays the first path by up to 0.3 m, every body by up to 0.5 m
(uniform), on top of the tag's own noise. Where anything is in the way, a fraction ``reflection`` of
the ranges are those of a reflection, whose detour in a room of this size is 2 to 6 m.

**Odometry.** Relative white noise of the step length, relative noise of the turns, white heading
noise, a constant step scale and a constant heading drift a wearer; most of the error comes from
the heading (sect. IV-B: "the heading is highly influenced by the irregular movements and the local
magnetic field"). Wearers differ by the paper's patterns. ``noise_scale`` multiplies all of them.
It is set so that the distance RMSE of dead reckoning is the paper's 3.0 m: 3.25 +- 0.07 m at 1 and
3.02 +- 0.07 m at 0.92 (200 seeds, standard errors).

What the paper does not print, the transmissions and the fraction of reflections, was chosen within
what is plausible such that few attempts succeed even among close people and that ranges are bad
enough for the paper's own result: its filter errs by 1.96 +- 0.05 m (seeds 0 to 23) and 2.21 +-
0.08 m (seeds 100 to 147) where the paper has 2.2 m.

**Landmarks.** 112 on the walls, evenly along the way; a wearer who passes presses a button, at
most every ``press_every_s`` and up to a quarter of a second wrong. What is surveyed is the spot on
the way abreast of the mark.

Everything is a pure function of the settings and the seed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from relpos.measurements import Event, Measurement, Prior, Range
from relpos.settings import parse, setting
from relpos.simulation.paper import (
    DISTANCE_NOISE,
    HEADING_PATTERN,
    Hidden,
    SimulatedRun,
    by_node,
    report_motions,
    round_rectangle,
    true_rows,
)
from relpos.simulation.team import SCENARIOS

Floats = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]

_TEAM = SCENARIOS["lab"]

LANDMARKS = 112
MARGIN_M = 1.0
"""From the walkway to the room's walls."""

_BLOCK = (2.0, 21.0, 2.0, 11.0)
"""Least and greatest x and y of the block of rooms that the walkway surrounds."""


def _walls() -> Floats:
    x0, x1, y0, y1 = _BLOCK
    third = (x1 - x0) / 3.0
    return np.array(
        [
            [x0, y0, x1, y0],
            [x1, y0, x1, y1],
            [x1, y1, x0, y1],
            [x0, y1, x0, y0],
            [x0 + third, y0, x0 + third, y1],
            [x1 - third, y0, x1 - third, y1],
        ]
    )


WALLS = _walls()
"""Inner walls (W, 4): x, y of both ends, m; the outer walls block no line of sight."""

BEHIND_RAD = math.radians(110.0)


@dataclass(frozen=True, slots=True)
class LabSettings:
    """What ``--set`` may change."""

    nodes: int = setting(3, "people", 2, 20)
    seconds: float = setting(380.0, "length of the run", 1.0, 1e5)
    spacing_m: float = setting(8.0, "path length between two at the start", 0.0, 1e3)
    noise_scale: float = setting(0.92, "factor on all errors of the odometry", 0.0, 100.0)
    distance_noise: float = setting(0.15, "factor on the step length's white noise", 0.0, 100.0)
    turn_noise: float = setting(0.035, "mean relative error of a turn", 0.0, 10.0)
    heading_noise_deg: float = setting(
        0.17, "mean white heading noise a second of walking", 0.0, 90.0
    )
    scale_error: float = setting(0.01, "spread of the hidden step scale", 0.0, 1.0)
    heading_drift_deg_s: float = setting(0.05, "spread of the hidden heading drift", 0.0, 90.0)
    sigma_range_m: float = setting(
        _TEAM.world.uwb.noise_sigma_m, "standard deviation of a range", 0.0, 100.0
    )
    max_range_m: float = setting(30.0, "reading range in clear line of sight", 0.1, 1e4)
    detection_near: float = setting(
        _TEAM.world.uwb.detection_near, "detection in line of sight at 0 m", 0.0, 1.0
    )
    detection_far: float = setting(
        _TEAM.world.uwb.detection_far, "detection in line of sight at the reading range", 0.0, 1.0
    )
    wall_transmission: float = setting(0.5, "factor on detection for every wall", 0.0, 1.0)
    body_transmission: float = setting(0.5, "factor on detection for every body", 0.0, 1.0)
    wall_delay_min_m: float = setting(0.0, "least delay of a wall", 0.0, 100.0)
    wall_delay_max_m: float = setting(0.3, "greatest delay of a wall", 0.0, 100.0)
    body_delay_min_m: float = setting(0.0, "least delay of a body", 0.0, 100.0)
    body_delay_max_m: float = setting(0.5, "greatest delay of a body", 0.0, 100.0)
    reflection: float = setting(
        0.35, "fraction of ranges with anything in the way that are a reflection's", 0.0, 1.0
    )
    reflection_min_m: float = setting(2.0, "least detour of a reflection", 0.0, 100.0)
    reflection_max_m: float = setting(6.0, "greatest detour of a reflection", 0.0, 100.0)
    press_every_s: float = setting(2.0, "least time between presses of a landmark", 0.1, 1e4)
    range_period_s: float = setting(2.0, "time between ranges of a pair", 0.1, 60.0)


def walls_between(first_m: Floats, second_m: Floats) -> Counts:
    """How many inner walls the lines of sight between points (P, 2), (P, 2) cross: (P,)."""
    a, b = WALLS[None, :, :2], WALLS[None, :, 2:]
    p, q = first_m[:, None, :], second_m[:, None, :]

    def side(of: Floats, to: Floats, point: Floats) -> Floats:
        along, off = to - of, point - of
        result: Floats = along[..., 0] * off[..., 1] - along[..., 1] * off[..., 0]
        return result

    crosses = (side(a, b, p) * side(a, b, q) < 0.0) & (side(p, q, a) * side(p, q, b) < 0.0)
    count: Counts = crosses.sum(axis=1)
    return count


def bodies_between(
    first_m: Floats, second_m: Floats, first_rad: Floats, second_rad: Floats
) -> Counts:
    """How many of both wearers, (P, 2), (P, 2), headings (P,), have the other one behind: (P,)."""
    bearing = np.arctan2(*(second_m - first_m).T[::-1])
    count = np.zeros(len(bearing), dtype=np.int64)
    for off in (bearing - first_rad, bearing + math.pi - second_rad):
        count += np.abs(np.angle(np.exp(1j * off))) > BEHIND_RAD
    return count


def detection(settings: LabSettings, distance_m: Floats, walls: Counts, bodies: Counts) -> Floats:
    """Probability that an attempt succeeds."""
    fall = settings.detection_near - settings.detection_far
    clear = settings.detection_near - fall * distance_m / settings.max_range_m
    clear = np.where(distance_m < settings.max_range_m, clear, 0.0)
    result: Floats = clear * settings.wall_transmission**walls * settings.body_transmission**bodies
    return result


@dataclass(frozen=True)
class Walk:
    """True poses on a common grid (T,): path lengths, positions (N, T, 2), headings (N, T)."""

    time_s: Floats
    path_m: Floats
    position_m: Floats
    heading_rad: Floats


def walk(settings: LabSettings, rng: np.random.Generator) -> Walk:
    """Let all walk round, one after the other, until 310 m are done."""
    times = np.arange(math.floor(settings.seconds) + 1, dtype=np.float64)
    speed = rng.uniform(*_TEAM.speed_m_s, settings.nodes)
    walked = speed[:, None] * np.maximum(times[None, :] - _TEAM.still_s, 0.0)
    if _TEAM.distance_limit_m is not None:
        walked = np.minimum(walked, _TEAM.distance_limit_m)
    path = walked + settings.spacing_m * np.arange(settings.nodes)[::-1, None]
    return Walk(times, path, *round_rectangle(path, *_TEAM.path_m))


def odometry(settings: LabSettings, rng: np.random.Generator) -> Hidden:
    """Draw the hidden constants of each wearer's odometry."""
    count, factor = settings.nodes, settings.noise_scale
    pattern = np.resize(np.array(HEADING_PATTERN), count)
    pattern /= pattern.mean()
    drift_rad_s = math.radians(settings.heading_drift_deg_s)
    return Hidden(
        by_node(np.exp(factor * settings.scale_error * rng.standard_normal(count))),
        by_node(factor * drift_rad_s * rng.standard_normal(count)),
        by_node(factor * settings.distance_noise * np.resize(np.array(DISTANCE_NOISE), count)),
        by_node(factor * settings.turn_noise * pattern),
        by_node(factor * math.radians(settings.heading_noise_deg) * pattern),
    )


@dataclass(frozen=True)
class Attempts:
    """All attempts at ranging, (A,) each: who, when, how far, what was in the way, the outcome."""

    time_s: Floats
    first: Counts
    second: Counts
    distance_m: Floats
    walls: Counts
    bodies: Counts
    heard: npt.NDArray[np.bool_]
    range_m: Floats


def attempt(settings: LabSettings, truth: Walk, rng: np.random.Generator) -> Attempts:
    """Let every pair range every ``range_period_s``."""
    instants = np.arange(settings.range_period_s, truth.time_s[-1] + 1e-9, settings.range_period_s)
    path = np.stack([np.interp(instants, truth.time_s, row) for row in truth.path_m])
    position, heading = round_rectangle(path, *_TEAM.path_m)
    one, other = np.triu_indices(settings.nodes, 1)
    first, second = np.repeat(one, instants.size), np.repeat(other, instants.size)
    at = [position[who].reshape(-1, 2) for who in (one, other)]
    facing = [heading[who].reshape(-1) for who in (one, other)]
    distance = np.hypot(*(at[0] - at[1]).T)
    walls, bodies = walls_between(*at), bodies_between(*at, *facing)
    size = distance.size
    heard = rng.random(size) < detection(settings, distance, walls, bodies)
    measured = distance + settings.sigma_range_m * rng.standard_normal(size)
    # Each obstacle has a delay of its own; two bodies and a few walls are the most there can be.
    for count, low, high in (
        (walls, settings.wall_delay_min_m, settings.wall_delay_max_m),
        (bodies, settings.body_delay_min_m, settings.body_delay_max_m),
    ):
        delays = rng.uniform(low, max(high, low), (_MOST_OBSTACLES, size))
        measured += (delays * (np.arange(_MOST_OBSTACLES)[:, None] < count)).sum(axis=0)
    reflected = (rng.random(size) < settings.reflection) & (walls + bodies > 0)
    low, high = settings.reflection_min_m, settings.reflection_max_m
    measured += reflected * rng.uniform(low, max(high, low), size)
    return Attempts(
        np.tile(instants, one.size), first, second, distance, walls, bodies, heard, np.abs(measured)
    )


_MOST_OBSTACLES = 4


def _streams(seed: int) -> list[np.random.Generator]:
    """Random streams: walk, the odometry's constants, its noise, ranges, presses."""
    return [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(5)]


def attempts_of(settings: LabSettings, seed: int) -> Attempts:
    """Give the attempts at ranging of the run of this seed."""
    walk_rng, _, _, range_rng, _ = _streams(seed)
    return attempt(settings, walk(settings, walk_rng), range_rng)


def simulate_lab(seed: int = 0, overrides: Mapping[str, str | float] | None = None) -> SimulatedRun:
    """Measurements, priors, truth and presses of one run; the same arguments, the same run."""
    settings = parse(LabSettings, overrides or {}, "scenario lab")
    walk_rng, hidden_rng, motion_rng, range_rng, press_rng = _streams(seed)
    truth = walk(settings, walk_rng)
    hidden = odometry(settings, hidden_rng)
    attempts = attempt(settings, truth, range_rng)
    motions = report_motions(hidden, truth.time_s, truth.position_m, truth.heading_rad, motion_rng)
    ranges, late = [], set()
    for k in np.flatnonzero(attempts.heard):
        key = (
            float(attempts.time_s[k]), int(attempts.first[k]) + 1, int(attempts.second[k]) + 1
        )  # fmt: skip
        ranges.append(Range(*key, float(attempts.range_m[k])))
        if attempts.walls[k] or attempts.bodies[k]:
            late.add(key)
    measurements: list[Measurement] = sorted([*motions, *ranges], key=lambda m: m.time_s)
    priors = tuple(
        Prior(i + 1, float(x), float(y), float(truth.heading_rad[i, 0]))
        for i, (x, y) in enumerate(truth.position_m[:, 0])
    )
    hidden = replace(hidden, late_ranges=frozenset(late))
    places = landmarks()
    return SimulatedRun(
        "lab", tuple(measurements), priors,
        true_rows(truth.time_s, truth.position_m, truth.heading_rad), hidden,
        tuple(presses(settings, truth, press_rng)), places,
    )  # fmt: skip


def landmarks() -> dict[str, tuple[float, float]]:
    """Surveyed places of the landmarks by id, evenly along one lap."""
    lap_m = 2.0 * sum(_TEAM.path_m)
    places, _ = round_rectangle(np.arange(LANDMARKS) * lap_m / LANDMARKS, *_TEAM.path_m)
    return {f"L{k + 1:03}": (float(x), float(y)) for k, (x, y) in enumerate(places)}


_PRESS_ERROR_S = 0.25


def presses(settings: LabSettings, truth: Walk, rng: np.random.Generator) -> list[Event]:
    """Press the button at landmarks passed, in the order of time."""
    spacing_m = 2.0 * sum(_TEAM.path_m) / LANDMARKS
    events = []
    for row, path in enumerate(truth.path_m):
        moving = np.diff(path) > 0.0
        walking = np.append(moving, False) | np.append(False, moving)
        if not walking.any():
            continue
        time_s, way_m = truth.time_s[walking], path[walking]
        passed = np.arange(math.floor(way_m[0] / spacing_m) + 1, way_m[-1] // spacing_m + 1)
        last_s = -math.inf
        for mark, at_s in zip(passed, np.interp(passed * spacing_m, way_m, time_s), strict=True):
            wrong_s = rng.uniform(-_PRESS_ERROR_S, _PRESS_ERROR_S)
            if at_s - last_s >= settings.press_every_s:
                last_s = float(at_s)
                name = f"L{int(mark) % LANDMARKS + 1:03}"
                events.append(Event(round(last_s + wrong_s, 3), row + 1, "landmark", name))
    return sorted(events, key=lambda e: e.time_s)
