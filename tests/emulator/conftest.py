"""Walkers that several tests of a file emulate are made once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from functools import lru_cache

import numpy as np
import pytest

from relpos.emulator import team
from relpos.simulation.team import Scenario
from relpos.simulation.walker import WalkerTruth
from relpos.simulation.world import World


@pytest.fixture(scope="module", autouse=True)
def _walkers_made_once() -> Iterator[None]:
    """The same arguments give the same arrays (tests/simulation/test_gait.py), and none is written.

    To make them takes a quarter of an emulated team's ten seconds.
    """
    make = team.make_team
    kept = lru_cache(16)(make)

    def make_team(
        scenario: str | Scenario, nodes: int | Sequence[int], seconds: float, seed: int
    ) -> tuple[list[WalkerTruth], World]:
        of = nodes if isinstance(nodes, int) else tuple(nodes)
        walkers, world = kept(scenario, of, seconds, seed)
        for walker in walkers:
            for field in fields(walker):
                column = getattr(walker, field.name)
                if isinstance(column, np.ndarray):
                    column.flags.writeable = False
        return list(walkers), world

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(team, "make_team", make_team)
        yield
