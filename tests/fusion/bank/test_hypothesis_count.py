"""How many hypotheses the bank carries: one where one is enough, more where it is not."""

from __future__ import annotations

from copy import deepcopy

import numpy as np

from relpos.evaluation import metrics
from relpos.fusion.bank import hypothesis_count
from relpos.fusion.bank.core import BankCore
from relpos.fusion.bank.estimator import Bank
from relpos.fusion.bank.storage import PER_NODE, StateIndex
from relpos.fusion.estimator import Estimate
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.rewind import Rewinder
from relpos.fusion.switching import SwitchingEstimator
from relpos.simulation.paper import simulate_paper
from support.plain_ranges import plain_ranges

GOOD = {"heading_noise_deg": 0.3, "turn_noise": 0.0, "distance_noise_scale": 0.16}
"""Turn noise 0.3 deg a second, 2 % of the way; ranges of 0.1 m in ``paper-p1``."""


def _run(
    scenario: str, overrides: dict[str, float], seed: int = 0
) -> tuple[list[Estimate], list[int], Rewinder, metrics.Metrics]:
    run = simulate_paper(scenario, seed, overrides)
    bank = SwitchingEstimator(run.priors, seed=seed).estimator
    estimates: list[Estimate] = []
    counts = []
    for measurement in run.measurements:
        made = bank.process(measurement)
        counts += [_core(bank).hypotheses.count] * len(made)
        estimates += made
    estimates += bank.finish()
    figures = metrics.of_estimates(estimates, run.truth)
    return estimates, counts, bank, figures


def _core(bank: Rewinder) -> BankCore:
    assert isinstance(bank.core, Bank)
    return bank.core.core


def test_a_good_team_is_followed_by_one_hypothesis_and_as_well() -> None:
    alone = []
    for seed in (0, 4):
        _, counts, bank, figures = _run("paper-p1", {**GOOD, "seconds": 400.0}, seed)
        assert counts[-1] == 1
        alone.append(np.mean(np.array(counts) == 1))
        assert bank.counters()["hypotheses_shrunk"] >= len(hypothesis_count.STEPS)
        # 0.109 m with 200 throughout (600 s, seed 0).
        assert figures.relative_distance_rmse_m < 0.135
    # When that is certain differs: after 155 s to never on eight seeds.
    assert np.mean(alone) > 0.15


def test_the_dice_of_shrinking_and_growing_are_those_of_the_seed() -> None:
    first, again = (_run("paper-p1", {**GOOD, "seconds": 250.0}, 2) for _ in range(2))
    assert min(first[1]) < BankSettings().hypotheses
    assert [e.nodes for e in again[0]] == [e.nodes for e in first[0]]


def test_a_team_whose_headings_are_poor_keeps_all_of_them() -> None:
    _, counts, bank, _ = _run("paper-h", {"seconds": 120.0})
    assert min(counts) == BankSettings().hypotheses
    assert bank.counters().get("hypotheses_shrunk", 0) == 0


def test_one_hypothesis_becomes_many_when_somebody_is_carried_off() -> None:
    _, counts, bank, figures = _run(
        "paper-p1", {**GOOD, "seconds": 500.0, "kidnap_m": 5.0, "kidnap_s": 380.0}, seed=2
    )
    assert counts[375] == 1
    assert max(counts[380:400]) >= BankSettings().hypotheses
    assert bank.counters()["hypotheses_grown"] >= 1
    assert figures.relative_distance_rmse_m < 0.35


def test_fewer_hypotheses_have_the_moments_that_the_many_had() -> None:
    rng = np.random.default_rng(1)
    x = rng.standard_normal((200, 6))
    x[:, 2] += 3.1  # a heading across the cut
    mean = x.mean(axis=0)
    covariance = np.eye(6) + np.cov(x.T, bias=True)
    for count, kept in ((50, 0.7), (10, 0.3), (1, 0.0)):
        chosen = np.arange(count) * (200 // count)
        fewer, p = hypothesis_count.thinned(x, mean, covariance, chosen, np.array([2]), kept)
        assert len(fewer) == count
        np.testing.assert_allclose(fewer.mean(axis=0), mean, atol=1e-9)
        np.testing.assert_allclose(p + np.cov(fewer.T, bias=True), covariance, atol=1e-9)
        assert np.linalg.eigvalsh(p)[0] > 0.0


def test_drawn_headings_take_their_part_out_of_the_covariance() -> None:
    rng = np.random.default_rng(2)
    root = rng.standard_normal((6, 6))
    covariance = root @ root.T
    x, p = hypothesis_count.parted(
        np.zeros((200, 6)), np.repeat(covariance[None], 200, axis=0), np.array([2, 5]), 0.5, rng
    )
    np.testing.assert_allclose(p[0] + np.cov(x.T, bias=True), covariance, atol=1e-6)
    np.testing.assert_allclose(p[0][[2, 5]], 0.5 * covariance[[2, 5]], atol=1e-6)


def test_the_nonlinearity_of_an_arc_is_its_sagitta() -> None:
    # Two users 2 m apart, the second's place 0.4 m uncertain across: 0.4^2 / 4 = 0.04 m.
    mean = np.zeros(2 * PER_NODE)
    mean[PER_NODE] = 2.0
    covariance = np.zeros((2 * PER_NODE, 2 * PER_NODE))
    covariance[PER_NODE + StateIndex.Y, PER_NODE + StateIndex.Y] = 0.4**2
    metre = np.full(2, 0.06)
    assert np.isclose(hypothesis_count.nonlinearity_index(mean, covariance, 0.1, metre), 0.4)
    # A metre at a heading 0.3 rad uncertain is 0.045 m shorter.
    covariance[StateIndex.HEADING, StateIndex.HEADING] = 0.09
    assert np.isclose(hypothesis_count.nonlinearity_index(mean, covariance, 1.0, metre), 0.75)


def _epochs(core: BankCore, first: int, count: int) -> None:
    """Three who walk in parallel and range each other."""
    pair = np.array([0, 0, 1]), np.array([1, 2, 2])
    places = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]])
    distance = np.hypot(*(places[pair[0]] - places[pair[1]]).T)
    noise_m = 0.1 * np.random.default_rng(9).standard_normal((first + count, 3))
    for k in range(first, first + count):
        turned = 0.6 * float(np.sin(0.3 * k))
        core.move(
            np.arange(3),
            np.tile([0.5, 0.0, turned, 1.0], (3, 1)),
            np.tile([0.02, 0.02, 0.005], (3, 1)),
        )
        core.update(*plain_ranges(*pair, distance + noise_m[k]))
        core.end_instant(float(k))


def test_a_copy_is_exact_across_a_change_of_number() -> None:
    # Models that a few of the many get back would change moments.
    core = BankCore(BankSettings(constants=0.0, biased=0.0), seed=5)
    for x_m, y_m in ((0.0, 0.0), (4.0, 0.0), (0.0, 3.0)):
        core.add_node((x_m, y_m, 0.0), 0.01, 0.01)
    many = deepcopy(core)
    _epochs(core, 0, 200)
    assert core.hypotheses.count == 1
    few, expected = deepcopy(core), core.hypotheses.moments()
    core = many
    assert core.hypotheses.count == 200
    _epochs(core, 0, 200)
    for got, wanted in zip(core.hypotheses.moments(), expected, strict=True):
        np.testing.assert_array_equal(got, wanted)
    core.adaptive.grow()
    assert core.hypotheses.count == 200
    grown = core.hypotheses.moments()
    for got, wanted in zip(grown, expected, strict=True):
        np.testing.assert_allclose(got, wanted, atol=1e-5)
    core = few
    assert core.hypotheses.count == 1
    core.adaptive.grow()
    for got, wanted in zip(core.hypotheses.moments(), grown, strict=True):
        np.testing.assert_array_equal(got, wanted)


def test_a_strongly_nonlinear_mixture_has_more_hypotheses_and_few_states_the_usual() -> None:
    _, counts, _, _ = _run("paper-h2", {"seconds": 150.0})
    usual = BankSettings().hypotheses
    assert max(counts) == hypothesis_count.most(usual, 55) > 4 * usual
    assert counts[5] == usual
    assert hypothesis_count.most(usual, 40) == hypothesis_count.MORE * usual
    assert hypothesis_count.most(usual, 123) == usual
    # A range noise of a metre hides what bends by less.
    _, counts, _, _ = _run("paper", {"seconds": 150.0})
    assert np.mean(np.array(counts) > usual) < 0.2


def test_people_are_not_lost_to_low_heading_noise() -> None:
    run = simulate_paper("paper-h", 1, {"seconds": 200.0})
    bank = SwitchingEstimator(run.priors, BankSettings(steady=1.0), 1).estimator
    estimates = [e for m in run.measurements for e in bank.process(m)] + bank.finish()
    core = _core(bank)
    assert float(core.hypotheses.weights() @ core.hypotheses.models.low_heading_noise) < 0.1
    figures = metrics.of_estimates(estimates, run.truth)
    assert figures.relative_distance_rmse_m < 1.0
