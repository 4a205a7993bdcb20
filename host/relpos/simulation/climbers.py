"""Walkers of a building: they walk, climb, ride, crawl and fall, in ticks of a tenth of a second.

Dead reckoning claims more than the true way on stairs (2.1 times up, 1.9 down) and on hands and
knees (1.35): docs/notebook/deadreckoning.md, 12 simulated wearers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from relpos.settings import setting
from relpos.simulation.pressure import AirSettings, Surroundings
from relpos.simulation.sensing import DISTURBED, RATE_HZ, unicycle
from relpos.simulation.storeys import SIZE_M, Building, Leg, Place, Stairwell, along

Floats = npt.NDArray[np.float64]

TURN_RAD_S = math.radians(120.0)
TICK_S = 1.0 / RATE_HZ

STEP_M = 0.65
"""Of level walking at 1 m/s."""
CADENCE_HZ = (1.1, 2.1)
"""On stairs (Riener 2002)."""
CLAIMED_UP, CLAIMED_DOWN, CLAIMED_CRAWL = 2.1, 1.9, 1.35
CLAIMED_TWO = 1.2
"""Taking two steps at a time: a step's length is limited by its duration (assumed)."""
CLAIMED_SPREAD = 0.05
"""Of people, as a share."""
PAUSE_SHARE = 0.1
"""Of flights, on which somebody stops halfway."""

CRAWL_M_S, CRAWL_STEP_M, CRAWL_DROP_M = 0.35, 0.3, 0.8
KNEEL_S = 2.5
LIFT_M_S, LIFT_M_S2, LIFT_DOORS_S = 1.0, 0.8, 4.0
FALL_S, FALL_BACK_M = 2.0, 1.4
"""Somebody who falls is so long about it, and ends so far back."""

STAY_S, FIRST_STAY_S = (60.0, 150.0), (15.0, 40.0)
"""A crew goes to another floor after so long."""
MARGIN_M = 1.0
"""Of waypoints from the outer walls."""


@dataclass(frozen=True, slots=True)
class ClimberSettings(AirSettings):
    """What ``--set`` may change of what people do."""

    crew: int = setting(3, "people who change floors together", 1, 1000)
    lift_share: float = setting(0.0, "of the changes of floor that are rides", 0.0, 1.0)
    two_share: float = setting(0.0, "of the flights climbed two steps at a time", 0.0, 1.0)
    crawl_share: float = setting(0.0, "of the ways between waypoints that are crawled", 0.0, 1.0)
    teams: int = setting(1, "2: one team stays on the floor above the other", 1, 2)
    late_s: float = setting(0.0, "one node is switched on so late, two floors up", 0.0, 1e5)
    fall_s: float = setting(0.0, "one person falls down stairs soon after", 0.0, 1e5)
    fall_m: float = setting(1.7, "by so much", 0.0, 3.0)


@dataclass(frozen=True, slots=True)
class Change:
    """A crew leaves its floor at a time, by a stairwell or by lift."""

    leave_s: float
    target: int
    well: int
    ride: bool


def make_plan(
    settings: ClimberSettings, building: Building, rng: np.random.Generator
) -> list[Change]:
    """Return where a crew goes, and when: it searches floor after floor, up or down."""
    plan, floor, leave_s = [], building.start, float(rng.uniform(*FIRST_STAY_S))
    while leave_s < settings.seconds:
        nearest = [k for k in (floor - 1, floor + 1) if 0 <= k < len(building.floors_m)]
        floor = int(rng.choice(nearest))
        ride = rng.random() < settings.lift_share
        plan.append(Change(leave_s, floor, int(rng.integers(2)), ride))
        leave_s += float(rng.uniform(*STAY_S))
    return plan


@dataclass(frozen=True, slots=True)
class Climb:
    """One walker over time (T,): what :class:`Surroundings` has, and what dead reckoning sees."""

    at: Surroundings
    y_m: Floats
    heading_rad: Floats
    claimed_m: Floats
    """(T, 2)."""
    steps: Floats
    episode: tuple[str, ...]


class Climber:
    """Makes one walker's track; every method goes on until its end or the run's."""

    def __init__(
        self, settings: ClimberSettings, building: Building, node: int, rng: np.random.Generator
    ) -> None:
        self.settings, self.building, self.node, self.rng = settings, building, node, rng
        self.count = round(settings.seconds * RATE_HZ) + 1
        self.floor = building.start
        size = np.array(SIZE_M)
        self.x, self.y = rng.uniform(MARGIN_M, size - MARGIN_M).tolist()
        self.heading = float(rng.uniform(-math.pi, math.pi))
        self.claimed = (self.x, self.y)
        self.feet_m, self.drop_m, self.steps = building.floors_m[self.floor], 0.0, 0.0
        self.place, self.episode = Place.STOREY, "level"
        self.cadence_hz = float(rng.uniform(*CADENCE_HZ))
        self.claims = 1.0 + CLAIMED_SPREAD * float(rng.standard_normal())
        self.rows: list[tuple[float, ...]] = []
        self.episodes: list[str] = []
        self._note()

    @property
    def over(self) -> bool:
        """Whether the run has ended."""
        return len(self.rows) >= self.count

    @property
    def now_s(self) -> float:
        """Time of the last tick."""
        return (len(self.rows) - 1) * TICK_S

    def track(self) -> Climb:
        """Return what was walked."""
        x, y, feet, drop, heading, cx, cy, steps, place = np.array(self.rows[: self.count]).T
        at = Surroundings(feet, feet - drop, place.astype(np.int64), x)
        episodes = tuple(self.episodes[: self.count])
        return Climb(at, y, np.unwrap(heading), np.column_stack([cx, cy]), steps, episodes)

    # -- single activities -------------------------------------------------------------------------

    def stand(self, seconds: float) -> None:
        """Stand still."""
        for _ in range(round(seconds * RATE_HZ)):
            self._tick(self.x, self.y)

    def walk(self, goal_m: Floats, near_m: float = 0.5) -> None:
        """Walk on the level."""
        self._go(goal_m, near_m, self.settings.speed_m_s, STEP_M, 1.0)

    def crawl(self, goal_m: Floats) -> None:
        """Go down on hands and knees, crawl and get up."""
        self.episode = "crawl"
        self._sink(CRAWL_DROP_M, KNEEL_S)
        self._go(goal_m, 0.5, CRAWL_M_S, CRAWL_STEP_M, CLAIMED_CRAWL * self.claims)
        self._sink(-CRAWL_DROP_M, KNEEL_S)
        self.episode = "level"

    def flight(self, leg: Leg) -> None:
        """Walk to a flight and climb it, or go down, in one go or with a stop halfway."""
        up = leg.rise_m > 0.0
        two = self.rng.random() < self.settings.two_share
        count = math.ceil(leg.risers / 2) if two else leg.risers
        cadence_hz = self.cadence_hz * (0.85 if two else 1.0) * float(self.rng.uniform(0.9, 1.1))
        factor = CLAIMED_TWO if two else (CLAIMED_UP if up else CLAIMED_DOWN)
        stop = self.rng.random() < PAUSE_SHARE
        stop_s = float(self.rng.uniform(2.0, 15.0)) if stop else 0.0
        self.walk(leg.points_m[0], 0.15)
        self._face(leg.points_m[1] - leg.points_m[0])
        ticks = max(2, round(count / cadence_hz * RATE_HZ))
        bottom_m = self.feet_m
        self.episode = "up" if up else "down"
        for k, (x, y, heading) in enumerate(along(leg.points_m, ticks)):
            if stop and k == ticks // 2:
                self.stand(stop_s)
            self.heading = heading
            self.feet_m = bottom_m + leg.rise_m * (k + 1) / ticks
            self.steps += count / ticks
            self._tick(x, y, factor * self.claims)
        self.episode = "level"

    def take_stairs(self, well: Stairwell, target: int) -> None:
        """Walk to a stairwell and climb to a floor, or down."""
        self.walk(well.door_m, 0.3)
        self.place = well.place
        while self.floor != target and not self.over:
            self._climb_storey(well, 1 if target > self.floor else -1)
        self.walk(well.door_m, 0.3)
        self.place = Place.STOREY

    def ride(self, target: int) -> None:
        """Take the lift."""
        door_m = self.building.lift_door_m
        self.walk(door_m, 0.3)
        self.stand(float(self.rng.uniform(2.0, 20.0)))
        self.place = Place.LIFT
        self.walk(door_m + np.array([0.0, 1.5]), 0.3)
        self.stand(LIFT_DOORS_S)
        bottom_m = self.feet_m
        way_m = self.building.floors_m[target] - bottom_m
        speed_m_s = min(LIFT_M_S, math.sqrt(LIFT_M_S2 * abs(way_m)))
        ramp_s = speed_m_s / LIFT_M_S2
        end_s = abs(way_m) / speed_m_s + ramp_s
        self.episode = "lift"
        for k in range(1, math.ceil(end_s * RATE_HZ) + 1):
            t = min(k * TICK_S, end_s)
            rising, falling = min(t, ramp_s), max(t - (end_s - ramp_s), 0.0)
            gone_m = 0.5 * LIFT_M_S2 * rising**2 + speed_m_s * max(t - ramp_s, 0.0)
            gone_m -= 0.5 * LIFT_M_S2 * falling**2
            self.feet_m = bottom_m + math.copysign(gone_m, way_m)
            self._tick(self.x, self.y)
        self.feet_m, self.floor, self.episode = self.building.floors_m[target], target, "level"
        self.stand(LIFT_DOORS_S)
        self.walk(door_m, 0.3)
        self.place = Place.STOREY

    def fall(self) -> None:
        """Climb the stairs as far as it takes to fall down again, and lie there."""
        well = self._nearest()
        if self.floor == len(self.building.floors_m) - 1:
            self.take_stairs(well, self.floor - 1)
        self.walk(well.door_m, 0.3)
        if self.over:
            return
        self.place = well.place
        for leg in well.up(self._storey_m(1)):
            self._pass(leg)
            if leg.is_flight:
                break
        back = -FALL_BACK_M * np.array([math.cos(self.heading), math.sin(self.heading)])
        x, y, ticks, top_m = self.x, self.y, round(FALL_S * RATE_HZ), self.feet_m
        self.episode = "falling"
        for k in range(1, ticks + 1):
            self.feet_m = top_m - self.settings.fall_m * k / ticks
            # Without steps the node hardly follows.
            share = k / ticks
            self._tick(x + share * back[0], y + share * back[1], 0.3)
        self.episode = "lying"
        while not self.over:
            self.stand(1.0)

    # -- the whole run -----------------------------------------------------------------------------

    def live(self, plan: Sequence[Change]) -> Climb:
        """Go about until the run's end."""
        settings, top = self.settings, len(self.building.floors_m) - 1
        if settings.late_s > 0.0 and self.node == settings.nodes - 1:
            self._begin_on(min(self.building.start + 2, top))
            self.stand(settings.late_s)
            plan = [change for change in plan if change.leave_s > settings.late_s]
        if settings.teams > 1:
            upper = self.building.start + (2 if self.node >= settings.nodes // 2 else 1)
            plan = [replace(change, target=min(upper, top)) for change in plan[:1]]
        fall_s = settings.fall_s if settings.fall_s > 0.0 and self.node == DISTURBED else math.inf
        self.stand(float(self.rng.uniform(3.0, 12.0)))
        for change in plan:
            self._wander(min(change.leave_s, fall_s))
            if self.now_s >= fall_s:
                break
            if change.target == self.floor:
                continue
            if change.ride:
                self.ride(change.target)
            else:
                self.take_stairs(self.building.stairwells[change.well], change.target)
        self._wander(fall_s)
        if not self.over:
            self.fall()
        return self.track()

    def _wander(self, until_s: float) -> None:
        """Walk between waypoints of a storey."""
        rng = self.rng
        while self.now_s < until_s and not self.over:
            goal_m = rng.uniform(MARGIN_M, np.array(SIZE_M) - MARGIN_M)
            if rng.random() < self.settings.crawl_share:
                self.crawl(self._near(goal_m))
            else:
                self.walk(goal_m)
            self.stand(float(rng.exponential(self.settings.pause_s)))

    def _begin_on(self, floor: int) -> None:
        self.floor, self.feet_m = floor, self.building.floors_m[floor]
        self.rows.clear()
        self.episodes.clear()
        self._note()

    # -- parts -------------------------------------------------------------------------------------

    def _storey_m(self, direction: int) -> float:
        floors_m = self.building.floors_m
        return abs(floors_m[self.floor + direction] - floors_m[self.floor])

    def _climb_storey(self, well: Stairwell, direction: int) -> None:
        storey_m = self._storey_m(direction)
        for leg in well.up(storey_m) if direction > 0 else well.down(storey_m):
            self._pass(leg)
        self.floor += direction
        self.feet_m = self.building.floors_m[self.floor] if not self.over else self.feet_m

    def _pass(self, leg: Leg) -> None:
        if leg.is_flight:
            self.flight(leg)
            return
        for point_m in leg.points_m:
            self.walk(point_m, 0.15)

    def _nearest(self) -> Stairwell:
        here = np.array([self.x, self.y])
        return min(self.building.stairwells, key=lambda w: float(np.hypot(*(w.door_m - here))))

    def _near(self, goal_m: Floats) -> Floats:
        """Bring a goal so near that crawling there takes half a minute."""
        here = np.array([self.x, self.y])
        off = goal_m - here
        most_m = 30.0 * CRAWL_M_S
        return np.asarray(here + off * min(1.0, most_m / float(np.hypot(*off))))

    def _go(
        self, goal_m: Floats, near_m: float, speed_m_s: float, step_m: float, factor: float
    ) -> None:
        while math.hypot(goal_m[0] - self.x, goal_m[1] - self.y) > near_m and not self.over:
            pose = (self.x, self.y, self.heading)
            x, y, self.heading = unicycle(pose, goal_m, speed_m_s, TURN_RAD_S)
            self.steps += math.hypot(x - self.x, y - self.y) / step_m
            self._tick(x, y, factor)

    def _face(self, direction: Floats) -> None:
        wanted = math.atan2(direction[1], direction[0])
        while not self.over:
            turn = math.remainder(wanted - self.heading, 2.0 * math.pi)
            if abs(turn) < 1e-6:
                return
            self.heading += min(max(turn, -TURN_RAD_S * TICK_S), TURN_RAD_S * TICK_S)
            self._tick(self.x, self.y)

    def _sink(self, by_m: float, seconds: float) -> None:
        ticks = round(seconds * RATE_HZ)
        for _ in range(ticks):
            self.drop_m += by_m / ticks
            self._tick(self.x, self.y)

    def _tick(self, x: float, y: float, factor: float = 1.0) -> None:
        if self.over:
            return
        claimed_x, claimed_y = self.claimed
        self.claimed = claimed_x + factor * (x - self.x), claimed_y + factor * (y - self.y)
        self.x, self.y = float(x), float(y)
        self._note()

    def _note(self) -> None:
        self.rows.append(
            (self.x, self.y, self.feet_m, self.drop_m, self.heading, *self.claimed, self.steps,
             float(self.place))
        )  # fmt: skip
        self.episodes.append(self.episode)
