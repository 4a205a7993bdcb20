"""The emulated team in a building: stairs under their feet, slabs between them, air around them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import relpos
from relpos.emulator.serving import record_team
from relpos.emulator.team import TeamConfig
from relpos.evaluation import vertical
from relpos.measurements import Height
from relpos.simulation.team import make_team
from relpos.simulation.walker import RATE_HZ
from relpos.tracks import true_tracks


@cache
def team(scenario: str, seconds: float = 130.0, seed: int = 1):
    return make_team(scenario, 2, seconds, seed)


def test_a_flight_lifts_its_climber_by_a_storey_in_twenty_steps() -> None:
    walkers, _ = team("building")
    for walker in walkers:
        first = walker.flights[0]
        before, after = (
            walker.position_m[round(t * RATE_HZ), 2]
            for t in (first.begin_s - 1.0, first.end_s + 1.0)
        )
        assert after - before == pytest.approx(3.5, abs=0.1)
        steps = (walker.steps.time_s > first.begin_s) & (walker.steps.time_s < first.end_s)
        assert steps.sum() == 20
        assert walker.steps.length_m[steps][1:] == pytest.approx(0.28, abs=0.03)


def test_forces_and_rates_are_still_those_of_the_path() -> None:
    (walker, _), _ = team("building")
    force = np.einsum("nij,nj->ni", walker.attitude, walker.specific_force_m_s2)
    climbed_m_s = np.cumsum(force[:, 2] - 9.80665) / RATE_HZ
    drift = climbed_m_s - (walker.velocity_m_s[:, 2] - walker.velocity_m_s[0, 2])
    assert np.abs(drift).max() < 0.1


def test_a_slab_shortens_the_reach_and_a_stairwell_is_open() -> None:
    _, world = team("building")
    rng = np.random.default_rng(0)

    def heard(first: tuple[float, ...], second: tuple[float, ...]) -> float:
        tags = np.array(first), np.array(second)
        return np.mean([world.measure_range(rng, *tags) is not None for _ in range(200)])

    assert heard((5.0, 0.0, 1.3), (15.0, 0.0, 1.3)) > 0.7
    assert heard((5.0, 0.0, 1.3), (15.0, 0.0, 4.8)) == 0.0
    assert heard((5.0, 0.0, 1.3), (7.0, 0.0, 4.8)) > 0.4
    assert heard((24.0, 5.0, 1.3), (24.0, 6.0, 8.3)) > 0.7


@pytest.mark.parametrize(("seed", "descend"), [(1, 0), (3, 1)])
def test_a_fan_presses_on_one_stairwell_alone(seed: int, descend: int) -> None:
    calm, _ = team("building", 190.0, seed)
    blown, _ = team("building-fan", 190.0, seed)
    pressed = 0
    for one, other in zip(calm, blown, strict=True):
        over_pa = other.pressure_pa - one.pressure_pa
        west = np.zeros(over_pa.shape, dtype=bool)  # up in the east, down in the west
        for flight in other.flights[1::2]:
            west |= (other.time_s > flight.begin_s + 0.2) & (other.time_s < flight.end_s - 0.2)
        blowing = other.time_s > 131.0
        assert np.abs(over_pa[other.time_s < 119.0]).max() < 1e-9
        assert np.median(over_pa[blowing & ~west]) == pytest.approx(2.5, 0.3)
        if (blowing & west).any():
            pressed += 1
            assert over_pa[blowing & west].min() > 20.0
    assert pressed == descend


def test_the_firmware_reports_the_climb_and_claims_twice_its_way() -> None:
    run = record_team(TeamConfig("building", 2, 75.0, 1))
    assert run.description.floors_m == (0.0, 3.5, 7.0, 10.5)
    heights = [m.height_m for m in run.measurements if isinstance(m, Height) and m.node == 1]
    assert heights[-1] == pytest.approx(3.5, abs=0.5)
    score = vertical.score(
        relpos.fuse(run, "deadreckoning").estimates, true_tracks(run.truth),
        run.description.floors_m, run.events,
    )  # fmt: skip
    assert score.flights == 2
    assert score.relative_rmse_m < 0.5
    assert score.floor_by_height > 0.95
    assert 1.6 < score.stairs_way < 2.6
