"""What ranges have in common: bias, body shadow, lateness, growth and clocks."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

import relpos
from reference import joint as reference
from relpos import fusion, tracks
from relpos.fusion.bank.core import BankCore
from relpos.fusion.bank.hypothesis_models import LEAST_SHARE, LEAST_WEIGHT, RangeErrors
from relpos.fusion.bank.storage import COMMON, PER_NODE, StateIndex
from relpos.fusion.clocks import LEAST_S, SLEW, Clocks, time_offsets
from relpos.fusion.estimator import Estimate, Parameter
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.models import detection
from relpos.fusion.models.ranging import OUTLIERS_SHORT, PASSING_SHARE, CommonIndex, Repeats
from relpos.measurements import Measurement, Motion, Range
from relpos.simulation.paper import simulate_paper
from support.plain_ranges import plain_ranges

NODES = 3


def last_parameters(
    scenario: str, seed: int, **settings: float
) -> dict[tuple[str, int], Parameter]:
    run = relpos.simulate(scenario, seed, **settings)
    result = relpos.fuse(run)
    return {(p.name, p.node): p for p in result.estimates[-1].parameters if p.peer is None}


def test_a_range_with_all_terms_is_the_reference_implementation() -> None:
    settings = BankSettings(hypotheses=8, wrong_starts=0.0, biased=1.0, constants=0.0, outliers=0.0)
    core = BankCore(settings, 3)
    for n in range(NODES):
        core.add_node((3.0 * n, 4.0 * n * n, 0.5 * n), 0.3, 0.1)
    these = core.hypotheses
    pair = np.array([0]), np.array([2])
    entry = int(these.biases.entries(*pair)[0, 0])
    x, p = these.dense()
    common = PER_NODE * NODES
    x[:, common:] = np.random.default_rng(1).normal(size=(8, x.shape[1] - common)) * 0.1
    these.store(x, p)
    heights, passing = (these.models.has(k) for k in (RangeErrors.HEIGHT, RangeErrors.PASSING))
    assert 0.0 < heights.sum() < 8.0
    assert 0.0 < passing.sum() < 8.0
    x[:, entry] += 7.0 * heights
    these.store(x, p)
    sigma2 = these.arrays.range_variance.ravel()[:8].copy()
    velocity = np.array([[1.2, 0.1], [0.7, -0.2]])
    slope = reference.common_terms(x[0], p[0], NODES, 0, 2, velocity)
    slope[entry], slope[common] = slope[common], 0.0
    assert (slope[common:] != 0.0).sum() >= 4
    repeats = Repeats(np.ones(1), np.array([0.6]))
    nought = np.zeros(1), np.zeros(1)
    speeds, no_outliers = velocity.reshape(1, 4), np.zeros((1, 3))
    core.update(*pair, np.array([17.5]), *nought, repeats, speeds, no_outliers)
    after = these.dense()
    share = core._sensors.model.outlier
    for k in range(8):
        outlier = float(share[0]), float(share[1]), OUTLIERS_SHORT
        square = heights[k] * x[k, entry]
        x_k, p_k = x[k], p[k]
        if passing[k]:
            x_k, p_k = reference.pass_bias(x_k, p_k, entry, common, 0.6, PASSING_SHARE * sigma2[k])
        slope_k = reference.common_terms(x_k, p_k, NODES, 0, 2, velocity, np.sqrt(square))
        slope_k[entry], slope_k[common] = 1.0, 0.0
        if heights[k]:
            mean, *_ = reference.predict_range(x_k, p_k, 0, 2, np.sqrt(square))
            # r^2 - m^2 = (r + m) (r - m).
            slope_k[entry], slope_k[common] = 1.0 / (17.5 + mean), 1.0
        # What is in the mean already is not to be added again.
        measured = 17.5 + slope_k[entry] * square
        expected = reference.update(
            x_k, p_k, 0, 2, measured, np.sqrt(square), sigma2[k], outlier, NODES, slope_k
        )
        assert after[0][k] == pytest.approx(expected[0], rel=1e-3, abs=1e-3)
        assert after[1][k] == pytest.approx(expected[1], rel=1e-3, abs=1e-3)


def test_in_a_team_of_more_than_six_both_antenna_delays_are_in_a_range() -> None:
    nodes, settings = 7, BankSettings(hypotheses=8, wrong_starts=0.0, biased=1.0, constants=0.0)
    core = BankCore(settings, 3)
    for n in range(nodes):
        core.add_node((3.0 * n, 4.0 * n * n, 0.5 * n), 0.3, 0.1)
    these = core.hypotheses
    these.biases.know_heights()
    common, *delays = these.biases.entries(np.array([4]), np.array([2]))[0].tolist()
    x, p = these.dense()
    assert p[:, delays, delays] == pytest.approx((0.5 * settings.pair_bias_m) ** 2)
    x[:, delays] = 0.2, -0.3
    these.store(x, p)
    slope = reference.common_terms(x[0], p[0], nodes, 4, 2, np.zeros((2, 2)))
    slope[delays] = slope[common]
    sigma2 = these.arrays.range_variance.ravel()[:8].copy()
    core.update(*plain_ranges(np.array([4]), np.array([2]), np.array([48.0])))
    after, share = these.dense(), core._sensors.model.outlier
    for k in range(8):
        outlier = float(share[0]), float(share[1]), OUTLIERS_SHORT
        expected = reference.update(x[k], p[k], 4, 2, 48.0, 0.0, sigma2[k], outlier, nodes, slope)
        assert after[0][k] == pytest.approx(expected[0], rel=1e-3, abs=1e-3)
        assert after[1][k] == pytest.approx(expected[1], rel=1e-3, abs=1e-3)


def test_a_tag_whose_ranges_are_all_too_long_is_found_and_told() -> None:
    nodes = 8
    run = relpos.simulate("mission-base", 1, nodes=nodes, seconds=80)
    ranges = (
        dataclasses.replace(m, range_m=m.range_m + 0.3)
        if isinstance(m, Range) and 3 in (m.node, m.peer) and m.range_m > 0.0
        else m
        for m in run.measurements
    )
    late = dataclasses.replace(run, measurements=tuple(ranges))
    result = relpos.fuse(late)
    score = relpos.evaluate(result, run, bound=False).metrics
    assert score.relative_distance_rmse_m < 0.16
    assert score.nees_distance < 1.2
    assert score.ok_over_3_sigma < 0.01
    told = {p.node: p for p in result.estimates[-1].parameters if p.name == "antenna_delay_m"}
    assert told[3].value == pytest.approx(0.3 * (1.0 - 1.0 / nodes), abs=0.1)
    assert all(abs(told[n].value) < 0.1 for n in told if n != 3)


def test_a_new_node_and_a_new_pair_keep_what_is_known_of_the_others() -> None:
    core = BankCore(BankSettings(hypotheses=8, biased=1.0), 3)
    for n in range(2):
        core.add_node((3.0 * n, 0.0, 0.0), 0.1, 0.1)
    these = core.hypotheses
    these.biases.entries(np.array([0]), np.array([1]))
    x, p = these.dense()
    x[:, PER_NODE * 2 :] = np.arange(x.shape[1] - PER_NODE * 2)
    these.store(x, p)
    core.add_node((9.0, 0.0, 0.0), 0.1, 0.1)
    x, _ = these.dense()
    assert x[0, PER_NODE * 3 : PER_NODE * 3 + COMMON].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert [x[0, these.clock_entry(row)] for row in range(3)] == [4.0, 5.0, 0.0]
    assert x[0, these.biases.pairs[0, 1]] == 6.0


@pytest.mark.parametrize(
    ("condition", "seconds", "name", "node", "value"),
    [
        pytest.param("late-0.3", 300, "range_lateness_s", 1, 0.3, marks=pytest.mark.soak),
        ("late-1", 300, "range_lateness_s", 3, 1.0),
        ("clock", 200, "clock_offset_s", 2, 1.0),
        ("shadow", 200, "body_shadow_m", 1, 0.4 * 0.9),
    ],
)
def test_what_ranges_have_in_common_is_learned_within_a_tenth(
    condition: str, seconds: float, name: str, node: int, value: float
) -> None:
    run = relpos.simulate(f"mission-{condition}", 73, seconds=seconds)
    result = relpos.fuse(run)
    learned = {(p.name, p.node): p.value for p in result.estimates[-1].parameters}
    # A shadow's prior, which is narrow, holds it back by a tenth.
    assert learned[name, node] == pytest.approx(value, rel=0.1)
    metrics = relpos.evaluate(result, run, bound=False).metrics
    assert metrics.relative_distance_rmse_m < 0.22


@pytest.mark.parametrize(
    ("smooth", "seconds", "distance_m"),
    [(False, 120, 0.16), pytest.param(True, 80, 0.10, marks=pytest.mark.soak)],
)
def test_ranges_that_grow_with_the_logarithm_of_the_distance_make_no_distance_longer(
    smooth: bool, seconds: float, distance_m: float
) -> None:
    run = relpos.simulate("mission-base", 75, seconds=seconds)
    truth = tracks.true_tracks(run.truth)

    def place(node: int, time_s: float) -> list[float]:
        own = truth[node]
        return [float(np.interp(time_s, own.time_s, axis)) for axis in (own.x_m, own.y_m)]

    def grown(m: Measurement) -> Measurement:
        if not isinstance(m, Range) or m.range_m <= 0.0:
            return m
        true_m = math.dist(place(m.node, m.time_s), place(m.peer, m.time_s))
        return dataclasses.replace(m, range_m=m.range_m + 0.2 * math.log(max(true_m, 1.0) / 5.0))

    off = dataclasses.replace(run, measurements=[grown(m) for m in run.measurements])
    metrics = relpos.evaluate(relpos.fuse(off, smooth=smooth), run, bound=False).metrics
    assert metrics.relative_distance_rmse_m < distance_m
    assert metrics.nees_distance is not None
    assert 0.5 < metrics.nees_distance < 1.6


def test_distances_are_less_sure_where_walls_may_be_a_scale_of_ranges(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    conditions = {"nodes": 5, "area_m": 30, "walls": 1, "max_range_m": 30, "range_rate_hz": 2.0}
    runs = [
        relpos.simulate("mission-base", seed, seconds=90, sigma_range_m=0.05, **conditions)
        for seed in (701, 704, 705, 707)
    ]

    def too_sure(results: list[relpos.Result]) -> float:
        both = zip(results, runs, strict=True)
        scores = [relpos.evaluate(result, run, bound=False).metrics for result, run in both]
        return float(np.mean([score.ok_over_3_sigma for score in scores]))

    def without_scale(result: relpos.Result) -> relpos.Result:
        """Take out of the distances' sigmas what is told of the ranges' scale."""
        estimates = []
        for e in result.estimates:
            sd = next((p.sigma for p in e.parameters if p.name == "range_scale"), 0.0)
            pairs = []
            for p in e.pairs:
                own_m2 = p.sigma_distance_m**2 - (sd * p.distance_m) ** 2
                pairs.append(dataclasses.replace(p, sigma_distance_m=math.sqrt(own_m2)))
            estimates.append(dataclasses.replace(e, pairs=tuple(pairs)))
        return dataclasses.replace(result, estimates=tuple(estimates))

    with_walls = too_sure([relpos.fuse(run) for run in runs])
    assert with_walls < 0.015
    monkeypatch.setattr(detection, "WALLS_SCALE_SD", 0.0)
    results = [relpos.fuse(run) for run in runs]
    biases_alone = too_sure(results)
    # 0.004, 0.016 and 0.048.
    assert with_walls < 0.5 * biases_alone
    assert biases_alone < 0.5 * too_sure([without_scale(result) for result in results])


@pytest.mark.parametrize("seed", [602, pytest.param(603, marks=pytest.mark.soak)])
def test_what_bodies_add_is_found_though_all_start_at_one_place(seed: int) -> None:
    # Uncertain starts take it at first, so that noise alone seems to explain all ranges.
    conditions = {"area_m": 15, "range_rate_hz": 3, "shadow_m": 0.3, "start_m": 0.5}
    run = relpos.simulate("mission-base", seed, seconds=150, start_deg=10, **conditions)
    metrics = relpos.evaluate(relpos.fuse(run, seed=seed), run, bound=False).metrics
    assert metrics.nees_distance < 1.4
    assert metrics.ok_over_3_sigma < 0.015


def test_where_nothing_is_off_nothing_is_learned_and_nothing_told() -> None:
    learned = last_parameters("mission-base", 74, seconds=200)
    for (name, _), p in learned.items():
        if name in ("range_lateness_s", "clock_offset_s", "body_shadow_m"):
            assert abs(p.value) < 0.06
    told = Estimate(0.0, (), (), parameters=tuple(learned.values()))
    assert time_offsets(told) == []


def test_time_offsets_are_told_once_in_a_sentence_each() -> None:
    late = [Parameter(9.0, n, None, "range_lateness_s", 0.32, 0.01) for n in (1, 2)]
    clocks = [
        Parameter(9.0, 1, None, "clock_offset_s", 0.02, 0.01),
        Parameter(9.0, 2, None, "clock_offset_s", 1.01, 0.01),
        Parameter(9.0, 3, None, "clock_offset_s", -0.5, 0.3),
    ]
    assert time_offsets(Estimate(9.0, (), (), parameters=(*late, *clocks))) == [
        "ranges are dated 0.3 s late",
        "the clock of node 2 is 1.0 s ahead",
    ]


def test_time_stamps_are_put_right_bit_by_bit_and_only_by_what_is_certain() -> None:
    clocks = Clocks()
    motion = Motion(10.0, 2, 1.0, 0.0, 0.0)
    clocks.slew(1.0, (0.5 * LEAST_S, 0.0), {2: (0.3, 0.2)})
    assert clocks.redate(motion) is motion
    for _ in range(3):
        clocks.slew(1.0, (0.4, 0.01), {2: (1.0, 0.01)})
    assert clocks.redate(motion).time_s == pytest.approx(10.0 - 3 * SLEW)
    measured = Range(10.0, 2, 1, 4.0)
    assert clocks.redate(measured).time_s == pytest.approx(10.0 - 6 * SLEW)
    assert dataclasses.replace(clocks.redate(measured), time_s=10.0) == measured
    assert clocks.longest_s == pytest.approx(6 * SLEW)


def test_the_shared_entries_are_named_in_their_order() -> None:
    core = BankCore(BankSettings(hypotheses=8), 3)
    core.add_node((0.0, 0.0, 0.0), 0.1, 0.1)
    these = core.hypotheses
    assert [these.common_entry(index) for index in CommonIndex] == [5, 6, 7, 8]
    assert these.clock_entry(0) == 9


def test_a_model_that_hardly_any_weight_had_comes_back_after_hypotheses_are_joined() -> None:
    core = BankCore(BankSettings(biased=0.5), 3)
    for n in range(NODES):
        core.add_node((3.0 * n, 0.0, 0.0), 0.1, 0.1)
    these = core.hypotheses
    these.log_weight[:] -= 60.0 * np.maximum(these.models.has_biases, these.models.constants)
    core.adaptive._shrink(10, these.unperturbed_weights())
    core.adaptive.grow()
    for _ in range(40):
        these.resample(these.weights())
    _, p = these.dense()
    for entry, prior in ((these.clock_entry(1), 0.07), (StateIndex.SCALE, 0.1)):
        assert p[:, entry, entry].max() == pytest.approx(prior**2)


def test_each_kind_of_range_error_keeps_hypotheses_and_some_weight() -> None:
    core = BankCore(BankSettings(biased=0.5), 3)
    for n in range(NODES):
        core.add_node((3.0 * n, 0.0, 0.0), 0.1, 0.1)
    these = core.hypotheses
    these.biases.entries(np.array([0]), np.array([1]))
    these.log_weight[:] -= 60.0 * these.models.has_biases
    for _ in range(5):
        these.resample(these.weights())
    numbers = np.bincount(these.models.range_errors)
    assert (numbers[1:] >= LEAST_SHARE * these.count - 1).all()
    assert these.models.share_of_kinds(these.weights())[1:] == pytest.approx(LEAST_WEIGHT, rel=0.1)


def test_nothing_is_told_of_clocks_that_no_hypothesis_models() -> None:
    run = simulate_paper("paper-p1", 33, {"seconds": 80})
    for biased in (0.0, 0.5):
        bank = fusion.make("bank", run.priors, {"hypotheses": 50, "biased": biased}, seed=1)
        estimates = [e for m in run.measurements for e in bank.process(m)] + bank.finish()
        told = [p for e in estimates for p in e.parameters if p.name == "clock_offset_s"]
        assert all(p.sigma > 0.0 for p in told)
        assert bool(told) == (biased > 0.0)
