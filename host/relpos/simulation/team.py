"""Teams: who walks where in which scenario.

`make_team` is the one entry: the emulator's chips sample what it returns.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from relpos.errors import DataError
from relpos.simulation import pressure
from relpos.simulation.bench import BENCH, SPACING_M, lie_still
from relpos.simulation.gait import walk
from relpos.simulation.pressure import AirSettings
from relpos.simulation.sensing import RATE_HZ
from relpos.simulation.spectral import make_grid
from relpos.simulation.storeys import STOREY_M, Building, Place
from relpos.simulation.turntable import TURNTABLE, turn_by_hand
from relpos.simulation.walker import Route, RouteStairs, WalkerTruth, make_person, make_plan
from relpos.simulation.world import MagneticField, UwbChannel, World

MAX_WALKERS = 20


@dataclass(frozen=True, slots=True)
class Scenario:
    """What is the same for all people of a walk. Change one with `dataclasses.replace`."""

    path_m: tuple[float, float]
    """Sides of the rectangle that is walked counter-clockwise from the origin."""
    speed_m_s: tuple[float, float]
    """Each walker's mean speed is drawn uniformly from here."""
    spacing_m: float
    """A walker starts when the one before has this lead."""
    still_s: float = 5.0
    """All stand at least this long at the beginning."""
    pause_every_s: float = 0.0
    """Mean time between brief pauses; 0 for none."""
    distance_limit_m: float | None = None
    mount_sd_rad: float = math.radians(3.0)
    world: World = field(default_factory=World)
    air: Mapping[str, float] | None = None
    """Of a building: changes to :class:`~relpos.simulation.pressure.AirSettings`."""


_HOUSE = Scenario(
    # Stairs in the middle of both short sides, storeys on the long ones in turn.
    path_m=(24.0, 12.0),
    speed_m_s=(0.6, 1.0),
    spacing_m=5.0,
    pause_every_s=120.0,
    world=World(
        size_m=(24.0, 12.0),
        uwb=UwbChannel(max_range_m=30.0),
        building=Building(tuple(STOREY_M * k for k in range(4)), ()),
    ),
    air={},
)

SCENARIOS = {
    "paper": Scenario(
        path_m=(20.0, 10.0),
        speed_m_s=(0.5, 1.1),
        spacing_m=8.0,
        pause_every_s=120.0,
        world=World(size_m=(20.0, 10.0)),
    ),
    "lab": Scenario(
        # One metre from the walls of 25 m x 15 m.
        path_m=(23.0, 13.0),
        # 310 m of the 380 s, of which the first seconds are spent standing and waiting.
        speed_m_s=(0.82, 0.88),
        spacing_m=4.0,
        distance_limit_m=310.0,
        world=World(
            size_m=(25.0, 15.0),
            uwb=UwbChannel(detection_near=0.9, detection_far=0.5, nlos_probability=0.05),
            magnetic=MagneticField(disturbance_ut=5.0),
        ),
    ),
    "straight": Scenario(
        # A wearer who walks a measured length once and stops: for `relpos node calibrate walk`.
        path_m=(60.0, 20.0),
        speed_m_s=(0.9, 1.3),
        spacing_m=4.0,
        still_s=10.0,
        distance_limit_m=40.0,
        world=World(size_m=(60.0, 20.0)),
    ),
    "building": _HOUSE,
    "building-fan": replace(_HOUSE, air={"fan_pa": 25.0, "fan_s": 120.0, "fan_off_s": 200.0}),
    "building-weather": replace(_HOUSE, air={"weather_pa_h": 200.0}),
}
"""By name. `paper` with the paper's own pace: replace(SCENARIOS["paper"], speed_m_s=(0.5, 0.5))."""


def make_team(
    scenario: str | Scenario, nodes: int | Sequence[int], seconds: float, seed: int
) -> tuple[list[WalkerTruth], World]:
    """Truth of a whole team and its world; the same arguments give the same arrays.

    ``nodes`` is a count (ids 1 to N) or the ids themselves, 1 to 20 of them. Raises `DataError`
    for an unknown scenario, a number of nodes or a duration that cannot be.
    """
    known = (*SCENARIOS, TURNTABLE, BENCH)
    if isinstance(scenario, str) and scenario not in known:
        raise DataError(f"unknown scenario {scenario!r}; known are {', '.join(sorted(known))}")
    ids = list(range(1, nodes + 1)) if isinstance(nodes, int) else list(nodes)
    if not 1 <= len(ids) <= MAX_WALKERS or len(set(ids)) != len(ids):
        raise DataError(f"a team has 1 to {MAX_WALKERS} different nodes, not {nodes}")
    if not (math.isfinite(seconds) and 0.0 < seconds <= 86_400.0):
        raise DataError(f"a walk lasts more than 0 and at most 86400 seconds, not {seconds}")
    if seed < 0:
        raise DataError(f"a seed is not negative, unlike {seed}")

    if scenario == TURNTABLE:
        world = World(size_m=(2.0, 2.0))
        return [turn_by_hand(node, seconds, seed, world) for node in ids], world
    if scenario == BENCH:
        world = World(
            size_m=(SPACING_M * len(ids), SPACING_M),
            uwb=UwbChannel(detection_near=0.98, detection_far=0.5, nlos_probability=0.0),
        )
        return [lie_still(node, k, seconds, seed, world) for k, node in enumerate(ids)], world
    if isinstance(scenario, str):
        scenario = SCENARIOS[scenario]
    world = replace(scenario.world, magnetic=replace(scenario.world.magnetic, seed=seed))
    width, depth = scenario.path_m
    corners = np.array([[0.0, 0.0], [width, 0.0], [width, depth], [0.0, depth]])
    grid = make_grid(seconds)
    until_s = float(grid.time_s[-1])
    start_s = scenario.still_s
    team: list[WalkerTruth] = []
    for place, node in enumerate(ids):
        # One stream a place: more walkers in the team do not change those before them.
        rng = np.random.default_rng([seed, place])
        person = make_person(rng, scenario.speed_m_s, scenario.mount_sd_rad)
        route = Route(corners, person.turn_length_m)
        plan_rng, walk_rng = rng.spawn(2)
        plan = make_plan(
            plan_rng,
            person,
            route,
            start_s,
            until_s,
            scenario.pause_every_s,
            scenario.distance_limit_m,
            _stairs(route, scenario),
        )
        team.append(walk(walk_rng, node, person, route, plan, grid, world))
        start_s += scenario.spacing_m / person.speed_m_s
    if scenario.air is not None:
        team = in_air(team, dict(scenario.air), seed)
    return team, world


RISERS, TREAD_M = 20, 0.28
"""Of a storey."""


def _stairs(route: Route, scenario: Scenario) -> RouteStairs | None:
    """Flights in the middle of the route's second and fourth side."""
    building = scenario.world.building
    if building is None:
        return None
    width, depth = scenario.path_m
    way_m = np.arange(0.0, route.lap_m + width, 0.01)
    place_m, _ = route.at(way_m)
    half_m = 0.5 * RISERS * TREAD_M
    begins_m = []
    for x in (width, 0.0):
        off_m = np.hypot(*(place_m - (x, 0.5 * depth)).T)
        # The first lap begins in a corner that later laps round.
        begins_m.append(float(way_m[int(off_m[way_m < route.lap_m].argmin())]) - half_m)
    storeys = len(building.floors_m)
    storey_m = building.floors_m[1] - building.floors_m[0]
    return RouteStairs(tuple(begins_m), route.lap_m, storeys, storey_m, RISERS, TREAD_M)


def in_air(team: list[WalkerTruth], changes: dict[str, float], seed: int) -> list[WalkerTruth]:
    """Add to the walkers' pressure what the air of a building does."""
    settings = AirSettings(**changes)  # type: ignore[arg-type]
    time_s = team[0].time_s
    ticks_s = np.arange(math.floor(time_s[-1] * RATE_HZ) + 2) / RATE_HZ
    weather_rng, fan_rng, *own = np.random.default_rng([seed, 0xA1]).spawn(2 + len(team))
    weather = pressure.weather_pa(settings, ticks_s, weather_rng)
    fan = pressure.fan_pa(settings, ticks_s, fan_rng)
    moved = []
    for walker, rng in zip(team, own, strict=True):
        columns = (walker.position_m[:, 0], walker.position_m[:, 2])
        x, z = (np.interp(ticks_s, time_s, c) for c in columns)
        place = np.full(ticks_s.size, int(Place.STOREY))
        for k, flight in enumerate(walker.flights):
            climbs = (ticks_s >= flight.begin_s) & (ticks_s < flight.end_s)
            place[climbs] = Place.EAST if k % 2 == 0 else Place.WEST
        feet_m = z - walker.person.sensor_height_m
        at = pressure.Surroundings(feet_m, feet_m, place, x)
        over = weather + pressure.field_pa(settings, at, ticks_s, fan, 0.0)
        over += pressure.doors_pa(settings, ticks_s, rng) * (place == Place.STOREY)
        moved.append(
            replace(walker, pressure_pa=walker.pressure_pa + np.interp(time_s, ticks_s, over))
        )
    return moved
