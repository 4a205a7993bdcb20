"""One wearer doing anything: the entry beside `team.make_team`.

    truth, world = make_walker("mixed", seed=7)
    truth, world = make_walker("paper310", 3, world=INDOOR, begin_walking=True)
    truth, world = make_walker([Activity("stand", seconds=5), Activity("crawl", 6.0)], 1)

``truth`` is a `WearerTruth`: what `WalkerTruth` has (200 Hz; position, heading, attitude,
specific force, angular rate, field, pressure, steps), so the emulator takes it as it takes a
team's walker, and besides ``facing_rad``, ``path_m`` (moved distance), ``activity`` and
``intervals`` (labels). Scripts by name are `activities.SCRIPTS`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from relpos.errors import DataError
from relpos.simulation.spectral import make_grid
from relpos.simulation.world import World
from wearers.activities import SCRIPTS, Activity, make_itinerary
from wearers.motion import WearerTruth, move
from wearers.wearer import Wearer, make_wearer

PAPER_SECONDS = 380.0
"""How long the 310 m of the paper's laboratory walk took."""

_LEAST_TAIL_S = 2.0


def make_walker(
    script: str | Sequence[Activity],
    seed: int,
    *,
    wearer: Wearer | None = None,
    world: World | None = None,
    begin_walking: bool = False,
    node: int = 1,
    place: str | None = None,
    carried_ut: tuple[float, float, float] | None = None,
) -> tuple[WearerTruth, World]:
    """Truth of one wearer and the world; the same arguments give the same arrays.

    ``script`` is one of `activities.SCRIPTS` or a sequence of `Activity`. ``wearer`` and
    ``place`` (`wearer.PLACES`) are drawn from ``seed`` where not given; so is the world's
    magnetic disturbance. ``begin_walking`` switches the sensor on 2 to 10 s after the first step.
    ``carried_ut`` is a field fixed to the body. The paper's walks last 380 s in all, everything
    else two seconds longer than its script. Raises `DataError` for an unknown script.
    """
    if isinstance(script, str) and script not in SCRIPTS:
        raise DataError(f"unknown script {script!r}; known are {', '.join(sorted(SCRIPTS))}")
    if seed < 0:
        raise DataError(f"a seed is not negative, unlike {seed}")
    rng = np.random.default_rng([seed, 0x50])
    wearer_rng, script_rng, plan_rng, move_rng = rng.spawn(4)
    paper = isinstance(script, str) and script.startswith("paper310")
    if wearer is None:
        wearer = make_wearer(wearer_rng, place=place)
    if paper:
        wearer = replace(wearer, speed_m_s=310.0 / PAPER_SECONDS)
    listed = SCRIPTS[script](script_rng, wearer) if isinstance(script, str) else list(script)
    if not listed:
        raise DataError("a script has at least one activity")
    state = plan_rng.bit_generator.state
    plan = make_itinerary(plan_rng, wearer, listed)
    if paper:
        # The speed is set so that the walk ends 3 s before the time is up, standing still. A
        # step more or less changes what is drawn, so it takes a few attempts.
        for _ in range(25):
            if abs(plan.end_s - PAPER_SECONDS + 3.0) < 1.5:
                break
            walked_s = plan.end_s - listed[0].seconds
            share = walked_s / (PAPER_SECONDS - listed[0].seconds - 3.0)
            wearer = replace(wearer, speed_m_s=wearer.speed_m_s * share**0.6)
            plan_rng.bit_generator.state = state
            plan = make_itinerary(plan_rng, wearer, listed)
    seconds = PAPER_SECONDS if paper else plan.end_s + _LEAST_TAIL_S
    seconds = math.floor(seconds * 50.0) / 50.0
    world = World() if world is None else world
    world = replace(world, magnetic=replace(world.magnetic, seed=seed))
    heading = float(move_rng.uniform(-math.pi, math.pi))
    late = float(move_rng.uniform(2.0, 10.0))
    truth = move(
        move_rng,
        node,
        wearer,
        plan,
        make_grid(seconds),
        world,
        heading,
        None if carried_ut is None else np.array(carried_ut),
    )
    if begin_walking:
        truth = truth.since(min(truth.walk_start_s + late, 0.5 * seconds))
    return truth, world
