"""A team in a building of several storeys: measurements, truth, floors and episodes.

Everybody starts on the ground floor and walks between waypoints of a storey; crews change floors
together, over stairwells or by lift (:mod:`~relpos.simulation.climbers`). Barometers feel what the
air does (:mod:`~relpos.simulation.pressure`), ranges the slabs
(:mod:`~relpos.simulation.storeys`); dead reckoning, noise and faults are those of the missions
(:mod:`~relpos.simulation.sensing`).
:data:`CONDITIONS` names what the estimator has to stand; they combine by ``--set``.

Everything is a pure function of the settings and the seed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from relpos.errors import RelposError
from relpos.measurements import Event, Height, Measurement, Motion
from relpos.settings import parse, setting
from relpos.simulation import pressure
from relpos.simulation.climbers import Climb, Climber, ClimberSettings, make_plan
from relpos.simulation.paper import SimulatedRun
from relpos.simulation.pressure import Surroundings
from relpos.simulation.sensing import DISTURBED, RATE_HZ, Walk, motions, ranges
from relpos.simulation.storeys import STOREY_M, Building, Place, StairKind, Stairwell

Floats = npt.NDArray[np.float64]

PREFIX = "building"

EPISODE = "episode"
"""The event that says what somebody truly does from its time on."""

RISERS_M, TREADS_M = (0.15, 0.20), (0.25, 0.30)
"""Of stairs of every kind."""

POST_M = (15.0, -3.0)
"""Where the command post's node lies, outside."""


@dataclass(frozen=True, slots=True)
class BuildingSettings(ClimberSettings):
    """What ``--set`` may change; the defaults are the calm building."""

    seconds: float = setting(1200.0, "length of the run", 10.0, 1e5)
    storeys: int = setting(4, "storeys", 2, 40)
    basements: int = setting(0, "of them below the start's floor", 0, 10)
    storey_m: float = setting(STOREY_M, "from floor to floor", 2.2, 10.0)
    slab_db: float = setting(14.0, "attenuation of a slab", 0.0, 100.0)
    stairs: int = setting(0, "0 dog-leg, 1 straight, 2 spiral, 3 drawn, with risers", 0, 3)
    dead_s: float = setting(0.0, "one node's barometer dies", 0.0, 1e5)
    stuck: int = setting(0, "1: it repeats its last height instead", 0, 1)
    without: int = setting(0, "so many nodes have no barometer", 0, 1000)
    post: int = setting(0, "1: a node lies at the command post", 0, 1)


CONDITIONS: Mapping[str, Mapping[str, float]] = {
    "calm": {},
    "stairs": {"stairs": 3, "two_share": 0.25},
    "lift": {"lift_share": 1.0},
    "fan": {"fan_pa": 25.0},
    "fan-whole": {"fan_pa": 25.0, "fan_whole": 1},
    "weather": {"weather_pa_h": 100.0},
    "weather-post": {"weather_pa_h": 100.0, "post": 1},
    "late": {"late_s": 300.0, "weather_pa_h": 100.0},
    "fall": {"fall_s": 300.0},
    "teams": {"teams": 2},
    "heat": {"door_pa": 10.0, "heat_k": 280.0, "stack_pa": 10.0, "crawl_share": 0.3},
    "dead": {"dead_s": 600.0},
    "stuck": {"dead_s": 600.0, "stuck": 1},
    "without": {"without": 1},
    "basement": {"basements": 1},
}
"""Condition -> how it differs from the defaults."""

NAMES = (PREFIX, *(f"{PREFIX}-{condition}" for condition in CONDITIONS))


def settings_of(
    scenario: str, overrides: Mapping[str, str | float] | None = None
) -> BuildingSettings:
    """Return a building's settings, changed by ``overrides`` (the values of ``--set``)."""
    if scenario not in NAMES:
        raise RelposError(f"unknown scenario '{scenario}': one of {', '.join(NAMES)}")
    condition = scenario.removeprefix(PREFIX).removeprefix("-") or "calm"
    settings = parse(BuildingSettings, {**CONDITIONS[condition], **(overrides or {})}, scenario)
    if settings.basements >= settings.storeys:
        raise RelposError("setting basements: there is no storey left over the ground")
    return settings


def make_building(settings: BuildingSettings, rng: np.random.Generator) -> Building:
    """Return the building; of stairs of every kind the kinds and measures are drawn."""
    wells = []
    for place, outwards in ((Place.WEST, -1.0), (Place.EAST, 1.0)):
        kind, riser, tread = int(rng.integers(3)), rng.uniform(*RISERS_M), rng.uniform(*TREADS_M)
        if settings.stairs < len(StairKind):
            wells.append(Stairwell(place, outwards, StairKind(settings.stairs)))
        else:
            wells.append(Stairwell(place, outwards, StairKind(kind), float(riser), float(tread)))
    below = settings.basements
    floors_m = tuple(settings.storey_m * k for k in range(-below, settings.storeys - below))
    return Building(floors_m, tuple(wells), settings.slab_db)


def simulate_building(
    scenario: str = PREFIX, seed: int = 0, overrides: Mapping[str, str | float] | None = None
) -> SimulatedRun:
    """Measurements, priors and truth of one run; the same arguments, the same run."""
    settings = settings_of(scenario, overrides)
    house_rng, walk_rng, motion_rng, range_rng, air_rng = (
        np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(5)
    )
    building = make_building(settings, house_rng)
    plans_rng, *own = walk_rng.spawn(1 + settings.nodes)
    plans = [make_plan(settings, building, rng) for rng in plans_rng.spawn(settings.nodes)]
    climbs = [
        Climber(settings, building, node, rng).live(plans[node // settings.crew])
        for node, rng in enumerate(own)
    ]
    if settings.post:
        climbs.append(_post(climbs[0]))
    truth = _walk(climbs)

    def obstacles(a: int, b: int, time_s: Floats) -> tuple[Floats, Floats]:
        ticks = np.clip(np.rint(time_s * RATE_HZ).astype(int), 0, truth.time_s.size - 1)
        first, second = climbs[a].at, climbs[b].at
        return building.between(
            (first.feet_m[ticks], second.feet_m[ticks]), (first.place[ticks], second.place[ticks])
        )

    moved = motions(settings, truth, motion_rng)
    measurements: list[Measurement] = [
        *moved,
        *ranges(settings, truth, range_rng, obstacles),
        *_heights(settings, building, climbs, moved, air_rng),
    ]
    on_s = _switched_on(settings)
    measurements = [
        m for m in measurements
        if m.time_s >= max(on_s.get(m.node, 0.0), on_s.get(getattr(m, "peer", m.node), 0.0))
    ]  # fmt: skip
    return SimulatedRun(
        scenario,
        tuple(sorted(measurements, key=lambda m: m.time_s)),
        tuple(prior for prior in truth.priors() if prior.node not in on_s),
        tuple(row for row in truth.rows() if row.time_s >= on_s.get(row.node, 0.0)),
        events=_episodes(climbs, on_s),
        floors_m=building.floors_m,
        posts=(settings.nodes + 1,) * settings.post,
    )


def _switched_on(settings: BuildingSettings) -> dict[int, float]:
    """When nodes are switched on that are not from the start."""
    return {settings.nodes: settings.late_s} if settings.late_s > 0.0 else {}


def _post(other: Climb) -> Climb:
    """Return the command post's node, which lies still outside."""
    nought = np.zeros(other.y_m.size)
    at = Surroundings(nought, nought, np.full(nought.size, int(Place.OUTSIDE)), nought + POST_M[0])
    place_m = np.tile(np.array(POST_M), (nought.size, 1))
    return Climb(at, place_m[:, 1], nought, place_m, nought, ("level",) * nought.size)


def _walk(climbs: Sequence[Climb]) -> Walk:
    positions = [np.column_stack([climb.at.x_m, climb.y_m]) for climb in climbs]
    return Walk(
        np.arange(climbs[0].y_m.size) / RATE_HZ,
        np.stack(positions),
        np.stack([climb.heading_rad for climb in climbs]),
        np.stack([climb.at.tag_m for climb in climbs]),
        np.stack([climb.claimed_m for climb in climbs]),
        np.stack([climb.steps for climb in climbs]),
    )


def _heights(
    settings: BuildingSettings,
    building: Building,
    climbs: Sequence[Climb],
    moved: Sequence[Motion],
    rng: np.random.Generator,
) -> list[Height]:
    """Every node's heights, with its motions, as its frames bring them."""
    time_s = np.arange(climbs[0].y_m.size) / RATE_HZ
    weather_rng, fan_rng, *own = rng.spawn(2 + len(climbs))
    weather = pressure.weather_pa(settings, time_s, weather_rng)
    fan = pressure.fan_pa(settings, time_s, fan_rng)
    hot_m = building.floors_m[min(building.start + 1, len(building.floors_m) - 1)]
    on_s = _switched_on(settings)
    made: list[Height] = []
    for node, (climb, one) in enumerate(zip(climbs, own, strict=True)):
        over = weather + pressure.field_pa(settings, climb.at, time_s, fan, hot_m)
        over += pressure.doors_pa(settings, time_s, one) * (climb.at.place == Place.STOREY)
        seen_m = pressure.reported_m(settings, climb.at.tag_m, over, time_s, one)
        seen_m = _since_start(settings, node, time_s, seen_m, on_s.get(node + 1, 0.0))
        reports = [m for m in moved if m.node == node + 1]
        off_s = settings.clock_off_s if node == DISTURBED else 0.0
        true_s = np.array([m.time_s for m in reports]) - off_s
        heights_m = np.interp(true_s, time_s, seen_m)
        heights_m += settings.noise_m * one.standard_normal(true_s.size)
        if node in range(settings.nodes - settings.without, settings.nodes):
            continue
        dies = node == DISTURBED and settings.dead_s > 0.0
        last_m = 0.0
        for m, t, height_m in zip(reports, true_s.tolist(), heights_m.tolist(), strict=True):
            dead = dies and t >= settings.dead_s
            if dead and not settings.stuck:
                break
            last_m = last_m if dead else round(height_m, 2)
            made.append(Height(m.time_s, m.node, last_m))
    return made


def _since_start(
    settings: BuildingSettings, node: int, time_s: Floats, seen_m: Floats, on_s: float
) -> Floats:
    """Count a node's heights from where it was switched on.

    After a restart it counts from there, and the link adds the last height before.
    """
    seen_m = seen_m - np.interp(on_s, time_s, seen_m)
    if node == DISTURBED and settings.reboot_s > 0.0:
        off_s = 0.5 * settings.seconds
        again_s = off_s + settings.reboot_s
        missed_m = np.interp(again_s, time_s, seen_m) - np.interp(off_s, time_s, seen_m)
        seen_m = seen_m - missed_m * (time_s >= again_s)
    return np.asarray(seen_m)


def _episodes(climbs: Sequence[Climb], on_s: Mapping[int, float]) -> tuple[Event, ...]:
    events = []
    for node, climb in enumerate(climbs, 1):
        last = ""
        for k, word in enumerate(climb.episode):
            time_s = k / RATE_HZ
            if word != last and time_s >= on_s.get(node, 0.0):
                events.append(Event(time_s, node, EPISODE, word))
                last = word
    return tuple(sorted(events, key=lambda e: e.time_s))


__all__ = ["CONDITIONS", "NAMES", "BuildingSettings", "settings_of", "simulate_building"]
