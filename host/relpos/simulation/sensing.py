"""What nodes measure on a walk: dead reckoning once a second, ranges at random times, and faults.

Shared by the missions and the building, which differ in how people walk. Every node reports with a
phase of its own; ranges come ``range_rate_hz`` a second and pair within reach. What goes wrong is
switched on by settings, and no setting changes the random numbers of another.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from relpos.measurements import Motion, Prior, Range, Truth
from relpos.settings import setting
from relpos.simulation.paper import true_rows
from relpos.simulation.storeys import SLAB_EXCESS_M

Floats = npt.NDArray[np.float64]

RATE_HZ = 10
"""Of the true walk."""

ROOM_M = 10.0
"""Distance of the walls from each other, both ways, where there are walls."""

DISTURBED = 1
"""The user whose node restarts, loses its motion or has another clock, or who is carried."""

EXCESS_M = (0.5, 3.0)
"""A link without line of sight is too long by so much; redrawn every ``EXCESS_HELD_S``."""
EXCESS_HELD_S = 20.0

WALL_DELAY_M = 0.3
"""A range through a wall is too long by so much; half of them are lost."""

FADING_DB = 2.0
"""Of a link's budget, where obstacles are counted in decibels (assumed)."""


@dataclass(frozen=True, slots=True)
class SensingSettings:
    """What ``--set`` may change in every scenario of walkers with waypoints."""

    nodes: int = setting(6, "people", 2, 1000)
    seconds: float = setting(600.0, "length of the run", 10.0, 1e5)
    area_m: float = setting(30.0, "side of the square area", 2.0, 1e4)
    speed_m_s: float = setting(1.0, "walking speed", 0.1, 10.0)
    pause_s: float = setting(5.0, "mean pause at a waypoint", 0.0, 1e3)
    way_noise_m: float = setting(0.06, "noise of a way of one metre", 0.0, 10.0)
    heading_noise_deg: float = setting(1.5, "heading noise of one second", 0.0, 90.0)
    turn_noise: float = setting(0.06, "relative noise of a turn", 0.0, 1.0)
    drift_deg_min: float = setting(0.0, "heading drift, its sign drawn", 0.0, 600.0)
    step_scale: float = setting(1.0, "true length of a step over the reported one", 0.1, 10.0)
    scale_change: float = setting(1.0, "factor of step_scale in the second half", 0.1, 10.0)
    range_rate_hz: float = setting(0.7, "ranges a second and pair", 0.0, 50.0)
    sigma_range_m: float = setting(0.1, "noise of a range", 0.0, 100.0)
    max_range_m: float = setting(30.0, "reach", 1.0, 1e5)
    walls: int = setting(0, "1: walls every 10 m lose and delay ranges", 0, 1)
    nlos_share: float = setting(0.0, "links without line of sight in one half", 0.0, 1.0)
    shadow_m: float = setting(0.0, "most that two bodies lengthen a range", 0.0, 10.0)
    delay_m: float = setting(0.0, "spread of the tags' antenna delays", 0.0, 10.0)
    range_late_s: float = setting(0.0, "ranges are dated so much late", 0.0, 10.0)
    clock_off_s: float = setting(0.0, "one node's clock is ahead by so much", -10.0, 10.0)
    gap_s: float = setting(0.0, "once a minute a node reports no motion for so long", 0.0, 50.0)
    lost_s: float = setting(0.0, "one node's motion is lost for so long at half-time", 0.0, 600.0)
    reboot_s: float = setting(0.0, "one node is off for so long at half-time", 0.0, 600.0)
    carried_s: float = setting(0.0, "one is carried for so long at half-time", 0.0, 600.0)


@dataclass(frozen=True, slots=True)
class Walk:
    """True poses: times (T,), positions (N, T, 2), unwrapped headings (N, T), heights (N, T).

    ``claimed_m`` (N, T, 2) is where dead reckoning without noise would lead, in world axes, where
    that is elsewhere; ``steps`` (N, T) counts steps since the start.
    """

    time_s: Floats
    position_m: Floats
    heading_rad: Floats
    height_m: Floats
    claimed_m: Floats | None = None
    steps: Floats | None = None

    def at(self, node: int, time_s: Floats, *, claimed: bool = False) -> Floats:
        """Position (or the claimed one) and unwrapped heading of one user at times (n,): (n, 3)."""
        place = self.claimed_m if claimed and self.claimed_m is not None else self.position_m
        columns = (*place[node].T, self.heading_rad[node])
        return np.stack([np.interp(time_s, self.time_s, c) for c in columns], axis=-1)

    def height_at(self, node: int, time_s: Floats) -> Floats:
        """Height of one user's tag over the start's at times (n,): (n,)."""
        return np.asarray(np.interp(time_s, self.time_s, self.height_m[node]))

    def steps_at(self, node: int, time_s: Floats) -> Floats | None:
        """Whole steps of one user until times (n,)."""
        if self.steps is None:
            return None
        return np.asarray(np.floor(np.interp(time_s, self.time_s, self.steps[node])))

    def priors(self) -> tuple[Prior, ...]:
        """Everybody's true pose at the start."""
        starts = np.column_stack([self.position_m[:, 0], self.heading_rad[:, 0]])
        return tuple(Prior(k + 1, *map(float, pose)) for k, pose in enumerate(starts))

    def rows(self) -> tuple[Truth, ...]:
        """Rows of ``truth.csv`` at whole seconds."""
        whole = slice(None, None, RATE_HZ)
        poses = self.position_m[:, whole], self.heading_rad[:, whole], self.height_m[:, whole]
        return true_rows(self.time_s[whole], *poses)


Obstacles = Callable[[int, int, Floats], tuple[Floats, Floats]]
"""Of two users at times (n,): what is between them in dB (n,), and the slabs among it (n,)."""


def unicycle(
    pose: tuple[float, float, float], goal: Floats, speed_m_s: float, turn_rad_s: float
) -> tuple[float, float, float]:
    """One tick of a walk towards a goal (2,): who faces away turns on the spot."""
    x, y, heading = pose
    step_s = 1.0 / RATE_HZ
    turn = math.remainder(math.atan2(goal[1] - y, goal[0] - x) - heading, 2.0 * math.pi)
    heading += min(max(turn, -turn_rad_s * step_s), turn_rad_s * step_s)
    way_m = speed_m_s * step_s * max(math.cos(turn), 0.0)
    return x + way_m * math.cos(heading), y + way_m * math.sin(heading), heading


def motions(settings: SensingSettings, truth: Walk, rng: np.random.Generator) -> list[Motion]:
    """Every node's dead reckoning: chords of a second, each in its heading at the beginning."""
    made: list[Motion] = []
    middle_s = 0.5 * settings.seconds
    for node, one in enumerate(rng.spawn(len(truth.position_m))):
        phase_s, gap_phase_s = one.uniform(0.05, 1.0), one.uniform(0.0, 60.0)
        drift_rad_s = math.radians(settings.drift_deg_min) / 60.0 * one.choice([-1.0, 1.0])
        time_s = np.arange(phase_s, settings.seconds, 1.0)
        begins_s = np.r_[0.0, time_s]
        poses = truth.at(node, begins_s, claimed=True)
        total = truth.steps_at(node, begins_s)
        taken = None if total is None else np.diff(total).astype(int)
        move, turn = np.diff(poses[:, :2], axis=0), np.diff(poses[:, 2])
        c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
        forward, left = c * move[:, 0] + s * move[:, 1], c * move[:, 1] - s * move[:, 0]
        way = np.hypot(forward, left)
        normals = one.standard_normal((4, time_s.size))
        duration_s = np.diff(np.r_[0.0, time_s])
        noise_m = settings.way_noise_m * np.sqrt(way)
        changed = np.where(time_s > middle_s, settings.scale_change, 1.0)
        scale = settings.step_scale * changed
        x = forward / scale + noise_m * normals[0]
        y = left / scale + noise_m * normals[1]
        noise_rad = math.radians(settings.heading_noise_deg) * np.sqrt(duration_s)
        turned = turn + noise_rad * normals[2] * (way > 0.0)
        turned += settings.turn_noise * turn * normals[3] + drift_rad_s * duration_s
        off_s = settings.clock_off_s if node == DISTURBED else 0.0
        if node == DISTURBED:
            # Who is carried takes no steps, and turns.
            walks = (time_s < middle_s) | (time_s >= middle_s + settings.carried_s)
            x, y, taken = x * walks, y * walks, None if taken is None else taken * walks
        outage_s = max(settings.lost_s, settings.reboot_s) if node == DISTURBED else 0.0
        pending, pending_turn, pending_steps = 0j, 0.0, 0
        for k, (t, dx, dy, angle) in enumerate(zip(time_s, x, y, turned, strict=True)):
            if middle_s <= t < middle_s + outage_s:
                continue
            pending_steps += 0 if taken is None else int(taken[k])
            step = pending + complex(dx, dy) * cmath.rect(1.0, pending_turn)
            angle += pending_turn
            if t > gap_phase_s and (t - gap_phase_s) % 60.0 < settings.gap_s:
                # The next report has the sum.
                pending, pending_turn = step, float(angle)
                continue
            steps = None if taken is None else pending_steps
            pending, pending_turn, pending_steps = 0j, 0.0, 0
            made.append(
                Motion(float(t + off_s), node + 1, step.real, step.imag, float(angle), steps=steps)
            )
    return made


def ranges(
    settings: SensingSettings,
    truth: Walk,
    rng: np.random.Generator,
    obstacles: Obstacles | None = None,
) -> list[Range]:
    """Every pair's ranges."""
    made: list[Range] = []
    middle_s = 0.5 * settings.seconds
    people = len(truth.position_m)
    pairs = [(a, b) for a in range(people) for b in range(a + 1, people)]
    *each, own = rng.spawn(len(pairs) + 1)
    delay_m = settings.delay_m * own.standard_normal(people)
    for (a, b), one in zip(pairs, each, strict=True):
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
        true_m = np.hypot(flat_m, truth.height_at(b, time_s) - truth.height_at(a, time_s))
        range_m = true_m + noise_m + _shadow(settings.shadow_m, at, of) + delay_m[a] + delay_m[b]
        in_half = at[:, 0] < 0.5 * settings.area_m
        range_m += in_half * excess_m[(time_s / EXCESS_HELD_S).astype(int)]
        heard = true_m < settings.max_range_m
        if obstacles is not None:
            more = one.spawn(1)[0]
            loss_db, slabs = obstacles(a, b, time_s)
            fading_db = FADING_DB * more.standard_normal(count)
            # In the open the reach is max_range_m: path loss is 20 dB a decade.
            heard = true_m * 10.0 ** ((loss_db + fading_db) / 20.0) < settings.max_range_m
            range_m += slabs * more.uniform(*SLAB_EXCESS_M)
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
