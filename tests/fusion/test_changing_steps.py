"""Step scales: who begins to crawl, and who walks side by side."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

import relpos
from relpos import fusion
from relpos.fusion import Estimate
from relpos.fusion.smoother.estimator import Smoother

BANK = {"seconds": 240}
SMOOTHER = {"seconds": 160, "nodes": 3, "scale_change": 0.6}
LARGE_TEAM = {"seconds": 100, "nodes": 21, "range_rate_hz": 0.3}


@pytest.mark.parametrize(
    ("given", "seed", "smooth", "most_m"),
    [(BANK, 7, False, 0.3), (SMOOTHER, 4, True, 0.2), (LARGE_TEAM, 1, False, 0.3)],
    ids=["bank", "smoother", "large team"],
)
def test_who_begins_to_crawl_is_neither_far_off_nor_surer_than_right(
    given: dict[str, float], seed: int, smooth: bool, most_m: float
) -> None:
    """With constant scales: 0.53, 0.34 and 0.47 m; NEES 5.0, 0.6 and 5.8."""
    run = relpos.simulate("mission-crawl", seed, **given)
    result = relpos.fuse(run, smooth=smooth)
    scored = relpos.evaluate(result, run, bound=False).metrics
    assert scored.relative_distance_rmse_m < most_m
    assert scored.nees_distance < 2.5


ABREAST = {"seconds": 240, "nodes": 3, "abreast": 1, "area_m": 15, "heading_noise_deg": 4}


class Abreast(NamedTuple):
    """Three who walk side by side: what is told while they walk, and afterwards."""

    run: relpos.Run
    online: list[Estimate]
    smoothed: list[Estimate]


@pytest.fixture(scope="module", params=[3, 7])
def abreast(request: pytest.FixtureRequest) -> Abreast:
    run = relpos.simulate("mission-base", request.param, **ABREAST)
    smoother = fusion.make_smoother("bank", run.priors)
    assert isinstance(smoother, Smoother)
    for measurement in run.measurements:
        smoother.process(measurement)
    smoothed = smoother.finish()
    return Abreast(run, smoother._estimates, smoothed)


def test_steps_of_those_who_walk_side_by_side_do_not_grow_shorter(abreast: Abreast) -> None:
    """While ranges told of a common scale here, too, it was 0.62 with a sigma of 0.04."""
    scales = [p.value for p in abreast.online[-1].parameters if p.name == "step_scale"]
    assert scales == pytest.approx([1.0] * 3, abs=0.1)


def test_those_who_walk_side_by_side_are_smoothed_as_near_as_they_are_said_to_be(
    abreast: Abreast,
) -> None:
    """While the spread of step scales could grow: 0.20 and 0.29 m, NEES 2.8 and 4.3."""
    scored = relpos.evaluate(abreast.smoothed, abreast.run, bound=False).metrics
    assert scored.relative_distance_rmse_m < 0.19
    assert scored.nees_distance < 2.0


@pytest.mark.parametrize("seed", [0, 1])
def test_a_crowd_side_by_side_is_told_to_have_walked_as_far_as_it_did(seed: int) -> None:
    """While noisy headings told of step scales it was 0.66 and 0.76 of it, after a minute."""
    run = relpos.simulate("mission-base", seed, seconds=60, nodes=22, abreast=1)
    told = [[(n.x_m, n.y_m) for n in e.nodes] for e in relpos.fuse(run).estimates]
    rows = sorted(run.truth, key=lambda row: (row.time_s, row.node))
    true = np.array([(row.x_m, row.y_m) for row in rows]).reshape(np.shape(told))
    walked, walked_truly = (
        np.linalg.norm(np.diff(track, axis=0), axis=2).sum() for track in (told, true)
    )
    assert walked == pytest.approx(walked_truly, rel=0.1)
