"""The default estimator from outside: accuracy, honesty, and what it does with odd input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import relpos
from relpos import fusion, settings
from relpos.errors import RelposError
from relpos.evaluation import metrics
from relpos.fusion.bank.core import BankCore
from relpos.fusion.bank.estimator import Bank
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.switching import SwitchingEstimator
from relpos.measurements import Motion, Range
from relpos.simulation.paper import simulate_paper
from support.plain_ranges import plain_ranges


def _run(scenario: str, seed: int, overrides: dict[str, float] | None = None) -> metrics.Metrics:
    run = simulate_paper(scenario, seed, overrides)
    estimator = fusion.make("bank", run.priors, {}, seed)
    estimates = [e for m in run.measurements for e in estimator.process(m)] + estimator.finish()
    return metrics.of_estimates(estimates, run.truth)


@pytest.mark.parametrize(
    ("scenario", "seconds", "limit_m"),
    [
        pytest.param("paper", 600.0, 0.8, marks=pytest.mark.soak),
        pytest.param("paper-p1", 600.0, 0.21, marks=pytest.mark.soak),
        ("paper-p1", 150.0, 0.18),
    ],
)
def test_the_bank_is_near_the_bound_without_knowing_the_noise(
    scenario: str, seconds: float, limit_m: float
) -> None:
    figures = [_run(scenario, seed, {"seconds": seconds}) for seed in range(4)]
    assert np.mean([f.relative_distance_rmse_m for f in figures]) < limit_m
    assert 0.5 < np.mean([f.nees_distance for f in figures]) < 1.6


@pytest.mark.parametrize(
    ("overrides", "limit_m"),
    [
        ({"nlos_probability": 0.2}, 0.4),
        pytest.param({"start_shift_m": 4.0}, 0.6, marks=pytest.mark.soak),
        pytest.param({"noisy_factor": 3.0}, 0.55, marks=pytest.mark.soak),
        ({"scale_error": 0.1, "heading_drift_deg_s": 0.5}, 0.25),
    ],
)
def test_the_bank_adapts_to_unknown_settings(overrides: dict[str, float], limit_m: float) -> None:
    figures = _run("paper-p1", 0, {**overrides, "seconds": 300.0})
    assert figures.relative_distance_rmse_m < limit_m


@pytest.mark.soak  # In 200 s: test_people_are_not_lost_to_low_heading_noise.
def test_white_heading_noise_and_a_short_reach_leave_the_team_in_shape() -> None:
    figures = _run("paper-h", 1)
    assert figures.relative_distance_rmse_m < 1.27
    assert figures.nees_distance < 2.5


def test_a_run_without_motion_is_refused() -> None:
    with pytest.raises(RelposError, match="no motion"):
        fusion.make("bank").finish()


def test_arrays_that_do_not_fit_are_refused_before_a_kernel_reads_them() -> None:
    core = BankCore(BankSettings(hypotheses=2), 0)
    for x_m in (0.0, 3.0):
        core.add_node((x_m, 0.0, 0.0), 0.1, 0.1)
    one, two = np.ones(1), np.ones(2)
    fitting = plain_ranges(np.array([0]), np.array([1]), one)
    with pytest.raises(ValueError, match="shape"):
        core.update(*fitting[:3], two, *fitting[4:])
    with pytest.raises(IndexError, match="2 users"):
        core.update(*plain_ranges(np.array([0]), np.array([2]), one))
    with pytest.raises(IndexError, match="2 users"):
        core.move(np.array([-1]), np.ones((1, 4)), np.ones((1, 3)))


def test_a_state_that_is_no_longer_finite_is_an_error() -> None:
    core = BankCore(BankSettings(hypotheses=8))
    core.add_node((0.0, 0.0, 0.0), 0.1, 0.1)
    core.hypotheses.arrays.x[0, 0, 0] = np.nan
    with pytest.raises(RelposError, match="no longer finite"):
        core.hypotheses.moments()


def test_a_setting_that_is_none_any_more_is_told_once_and_left_out(
    caplog: pytest.LogCaptureFixture,
) -> None:
    settings.tell_former.cache_clear()
    for _ in range(2):
        fusion.check("bank", {"jump_m": "5", "jumps_most": "0.01"})
    (told,) = caplog.messages
    assert told == "bank: jump_m is no setting any more, and left out; it is 3"
    assert "jump_m" not in {info.key for info in fusion.settings_of("bank")}


def test_ranges_of_nodes_that_are_sought_do_not_end_rounds_of_those_that_are_located() -> None:
    run = simulate_paper("paper", 3)
    estimator = SwitchingEstimator([p for p in run.priors if p.node < 3])
    turn = 0
    for m in run.measurements:
        if m.time_s > 20.0:
            break
        if isinstance(m, Range):
            turn += 1
            estimator.process(replace(m, time_s=m.time_s + 0.001 * (turn % 500)))
        elif isinstance(m, Motion):
            estimator.process(m)
    core = estimator.estimator.core
    assert isinstance(core, Bank)
    assert core.detection.rounds._turns == 1.0


def test_two_people_who_range_often_are_not_drawn_together() -> None:
    """Between two a missed attempt is never seen: that one succeeded says nothing of nearness."""
    often = {"nodes": 2, "seconds": 60, "range_rate_hz": 20, "sigma_range_m": 0.3}
    for seed in (2, 5):
        run = relpos.simulate("mission-base", seed, **often)
        found = relpos.evaluate(relpos.fuse(run), run, bound=False).metrics
        assert found.relative_distance_rmse_m < 0.3
        assert found.nees_distance < 1.4
