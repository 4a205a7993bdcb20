"""The bank's kernels against their NumPy reference, finite differences and sampled truth."""

from __future__ import annotations

import numpy as np
import pytest

from reference import bank as small
from reference import joint as reference
from relpos.fusion.bank import lanes, mixture, motion_update, range_update, storage
from relpos.fusion.bank import variance_components as components
from relpos.fusion.bank.detection_update import Attempts, update_detection
from relpos.fusion.bank.hypothesis_count import nonlinearity_index
from relpos.fusion.bank.motion_update import Noise
from relpos.fusion.bank.range_update import RangeModel, Ranges
from relpos.fusion.bank.storage import PER_NODE, Hypotheses, StateIndex
from relpos.fusion.estimator import pair_moments
from relpos.fusion.models import odometry_faults as slips
from relpos.fusion.models.detection import STEP_M
from relpos.fusion.models.motion_variances import COMPONENTS, base_variances
from relpos.fusion.models.ranging import OUTLIERS_SHORT

Floats = np.ndarray
NODES = 3
SIZE = PER_NODE * NODES + 1
CROSS, SHARE = 0.04, 0.5
OUTLIER = (0.05, 9.0, OUTLIERS_SHORT)


def states(count: int, seed: int) -> tuple[Floats, Floats]:
    """Random means (K, D) a few metres apart, and full-rank covariances (K, D, D)."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, SIZE)) * 0.1
    for node in range(NODES):
        x[:, PER_NODE * node : PER_NODE * node + 2] += rng.normal(size=(count, 2)) * 5.0
    root = rng.normal(size=(count, SIZE, SIZE)) * 0.1
    p = root @ root.transpose(0, 2, 1)
    p[:, -1, :] = p[:, :, -1] = 0.0
    return x, p


class Packed:
    """Means (K, D) and covariances (K, D, D) as the kernels take them; back at the end.

    Variance components (K, N, 3) are 1, ranges have a deviation of 0.2 m.
    """

    def __init__(self, x: Floats, p: Floats, component: Floats | None = None) -> None:
        self.dense, self.count = (x, p), len(x)
        self.component = np.ones((len(x), NODES, COMPONENTS)) if component is None else component

    def __enter__(self) -> Hypotheses:
        x, p = storage.pack(*self.dense, NODES)
        sensitivity = lanes.empty_lines(len(x), NODES, COMPONENTS, 6)
        sensitivity[...] = 0.0
        log_weight, variance = np.zeros(self.count), np.full(self.count, 0.04)
        self.arrays = Hypotheses(
            x, p, in_lanes(log_weight), sensitivity, in_lanes(self.component), in_lanes(variance),
            in_lanes(np.zeros(self.count)), in_lanes(np.zeros(self.count)),
        )  # fmt: skip
        return self.arrays

    def __exit__(self, *_: object) -> None:
        back = storage.unpack(self.arrays.x, self.arrays.p, NODES, self.count)
        for mine, now in zip(self.dense, back, strict=True):
            mine[...] = now


def in_lanes(values: Floats) -> Floats:
    """Numbers (K, ...) as (B, ..., LANES); what is left of a block is 0."""
    laid = np.zeros((lanes.blocks_of(len(values)) * lanes.LANES, *values.shape[1:]))
    laid[: len(values)] = values
    return np.ascontiguousarray(
        np.moveaxis(laid.reshape(-1, lanes.LANES, *values.shape[1:]), 1, -1)
    )


def out_of_lanes(laid: Floats, count: int) -> Floats:
    return laid.reshape(-1)[:count]


def advanced(x: Floats, p: Floats, motion: Floats, component: Floats, drawn: Floats) -> None:
    rows = np.arange(len(motion), dtype=np.int64) % NODES
    with Packed(x, p, component) as packed:
        motion_update.advance(packed, rows, motion, Noise(drawn, SHARE, CROSS))


def updated(
    x: Floats, p: Floats, measured: float, dz: float, outlier: tuple[float, ...],
    lever_m: Floats | None = None, sensitivity: Floats | None = None,
    again: tuple[float, float] = (0.0, 0.0),
) -> Floats:  # fmt: skip
    ranges = Ranges(
        np.array([0]), np.array([2]), np.array([measured]), np.array([dz]), np.zeros(1),
        np.ones(1), np.zeros(1), np.full((1, 3), -1), np.zeros((1, 4)),
        np.array([[outlier[0], *again]]),
    )  # fmt: skip
    levers_m = np.zeros((0, 2)) if lever_m is None else lever_m
    model = RangeModel(np.array([*outlier[:2], 1.0, 9.0]), levers_m)
    with Packed(x, p) as packed:
        stats = lanes.empty_lines(1, range_update.STATS, len(packed.x))
        if sensitivity is not None:
            packed.sensitivity[: len(packed.x)] = in_lanes(sensitivity)
        range_update.update(packed, ranges, model, stats)
        if sensitivity is not None:
            carried = np.moveaxis(packed.sensitivity[: len(packed.x)], -1, 1)
            sensitivity[...] = carried.reshape(-1, *sensitivity.shape[1:])[: len(x)]
    return out_of_lanes(packed.log_weight, len(x))


def moments_of(x: Floats, p: Floats, weight: Floats) -> tuple[Floats, Floats]:
    px, pp = storage.pack(x, p, NODES)
    order = storage.order(NODES, SIZE)
    return mixture.moments(px, pp, in_lanes(weight), NODES, order, SIZE)


def predicted(x: Floats, p: Floats) -> tuple[float, float]:
    px, pp = storage.pack(x, p, NODES)
    weight = in_lanes(np.full(len(x), 1.0 / len(x)))
    ends = np.array([0]), np.array([2])
    mean, sigma = mixture.predicted_ranges(px, pp, weight, *ends, np.zeros(1))
    return float(mean[0]), float(sigma[0])


def test_what_is_packed_comes_out_as_it_was() -> None:
    x, p = states(11, 12)
    px, pp = storage.pack(x, p, NODES)
    for mine, back in zip((x, p), storage.unpack(px, pp, NODES, 11), strict=True):
        assert (mine == back).all()
    chosen = np.array([3, 3, 10, 0], dtype=np.int64)
    taken = storage.unpack(
        storage.select_hypotheses(px, chosen), storage.select_hypotheses(pp, chosen), NODES, 4
    )
    assert (taken[0] == x[chosen]).all()
    assert (taken[1] == p[chosen]).all()


def test_a_displacement_is_the_reference_implementation() -> None:
    rng = np.random.default_rng(1)
    x, p = states(4, 2)
    motion = np.abs(rng.normal(size=(5, 7))) * 0.3
    component, drawn = rng.uniform(0.5, 2.0, (4, NODES, 3)), rng.normal(size=(4, 5))
    expected = [(x[k], p[k]) for k in range(4)]
    for m in range(5):
        expected = [
            reference.advance(
                a, b, m % NODES, motion[m], component[k, m % NODES], drawn[k, m], SHARE, CROSS
            )
            for k, (a, b) in enumerate(expected)
        ]
    advanced(x, p, motion, component, drawn)
    assert x == pytest.approx(np.array([a for a, _ in expected]), abs=1e-12)
    assert p == pytest.approx(np.array([b for _, b in expected]), abs=1e-12)


@pytest.mark.parametrize(
    ("measured", "dz", "again"),
    [
        (4.0, 0.0, (0.0, 0.0)),
        (6.5, 1.2, (0.0, 0.0)),
        (30.0, 0.0, (0.0, 0.0)),
        (7.0, 0.0, (0.3, 2.0)),
    ],
)
def test_a_range_is_the_reference_implementation(
    measured: float, dz: float, again: tuple[float, float]
) -> None:
    x, p = states(6, 3)
    outlier = (max(OUTLIER[0], 1.2 * again[0]), *OUTLIER[1:])
    expected = [
        reference.update(a, b, 0, 2, measured, dz, 0.04, outlier, NODES, again=again)
        for a, b in zip(x, p, strict=True)
    ]
    evidence = updated(x, p, measured, dz, outlier, again=again)
    assert x == pytest.approx(np.array([e[0] for e in expected]), abs=1e-10)
    assert p == pytest.approx(np.array([e[1] for e in expected]), abs=1e-10)
    assert evidence == pytest.approx(np.array([e[2] for e in expected]), abs=1e-9)


@pytest.mark.parametrize("dz", [0.0, 1.5])
def test_a_range_between_antennas_is_one_between_people_who_stand_there(dz: float) -> None:
    count = 2 * lanes.LANES + 1
    x, p = states(count, 6)
    lever_m = np.array([[0.1, -0.2], [0.3, 0.1], [-0.15, 0.25]])
    there, to_antennas = x.copy(), np.repeat(np.eye(SIZE)[None], count, axis=0)
    for node, (ahead, left) in enumerate(lever_m):
        at = PER_NODE * node
        c, s = np.cos(x[:, at + 2]), np.sin(x[:, at + 2])
        east, north = c * ahead - s * left, s * ahead + c * left
        there[:, at] += east
        there[:, at + 1] += north
        to_antennas[:, at, at + 2], to_antennas[:, at + 1, at + 2] = -north, east
    spread = to_antennas @ p @ to_antennas.transpose(0, 2, 1)
    before, back = (x.copy(), there.copy()), np.linalg.inv(to_antennas)
    weights = updated(x, p, 6.0, dz, OUTLIER, lever_m)
    expected = updated(there, spread, 6.0, dz, OUTLIER)
    assert weights == pytest.approx(expected, abs=1e-9)
    moved = (back @ (there - before[1])[..., None])[..., 0]
    assert x - before[0] == pytest.approx(moved, abs=1e-9)
    assert p == pytest.approx(back @ spread @ back.transpose(0, 2, 1), abs=1e-9)


def test_each_hypothesis_carries_its_own_sensitivities() -> None:
    count = 2 * lanes.LANES + 1
    x, p = states(count, 7)
    p += np.eye(SIZE) * (np.arange(SIZE) < PER_NODE * NODES)
    carried = np.random.default_rng(8).normal(size=(count, NODES, COMPONENTS, 6)) * 0.01
    alone = carried.copy()
    for k in range(count):
        one = slice(k, k + 1)
        updated(x[one].copy(), p[one].copy(), 6.0, 0.0, OUTLIER, sensitivity=alone[one])
    before = carried.copy()
    updated(x, p, 6.0, 0.0, OUTLIER, sensitivity=carried)
    assert carried == pytest.approx(alone, rel=1e-12)
    assert np.array_equal(carried[:, 1], before[:, 1]), "who takes no part"
    assert (carried[:, [0, 2]] != before[:, [0, 2]]).any(axis=(1, 2, 3)).all()


def test_a_range_turns_with_the_map_it_lies_on() -> None:
    count, angle = lanes.LANES, 0.7
    x, p = states(count, 11)
    p += np.eye(SIZE) * (np.arange(SIZE) < PER_NODE * NODES)
    turn = np.eye(SIZE)
    c, s = np.cos(angle), np.sin(angle)
    for at in range(0, PER_NODE * NODES, PER_NODE):
        turn[at : at + 2, at : at + 2] = [[c, -s], [s, c]]
    entries = np.triu_indices(3)
    order = [0, 1, 3, 2, 4, 5]  # xx, xy, yy, xh, yh, hh of the kernels
    root = np.random.default_rng(12).normal(size=(count, NODES, COMPONENTS, 3, 3)) * 0.05
    explained = root @ root.swapaxes(-1, -2)

    def after(by: Floats) -> tuple[Floats, Floats, Floats]:
        mine, spread = x @ by.T, by @ p @ by.T
        carried = (by[:3, :3] @ explained @ by[:3, :3].T)[..., entries[0], entries[1]][..., order]
        updated(mine, spread, 6.0, 0.0, OUTLIER, sensitivity=carried)
        parts = np.empty_like(explained)
        for k, entry in enumerate(order):
            row, column = entries[0][entry], entries[1][entry]
            parts[..., row, column] = parts[..., column, row] = carried[..., k]
        return mine, spread, parts

    turned, plain = after(turn), after(np.eye(SIZE))
    assert turned[0] == pytest.approx(plain[0] @ turn.T)
    assert turned[1] == pytest.approx(turn @ plain[1] @ turn.T)
    assert turned[2] == pytest.approx(turn[:3, :3] @ plain[2] @ turn[:3, :3].T)


def test_two_ranges_at_once_are_one_after_the_other() -> None:
    x, p = states(2 * lanes.LANES, 9)
    ends, measured = (np.array([0, 1]), np.array([2, 0])), np.array([6.0, 4.0])

    def stats_of(rows: slice) -> Floats:
        number = len(measured[rows])
        ranges = Ranges(
            ends[0][rows], ends[1][rows], measured[rows], np.zeros(number), np.zeros(number),
            np.ones(number), np.zeros(number), np.full((number, 3), -1), np.zeros((number, 4)),
            np.tile([OUTLIER[0], 0.0, 0.0], (number, 1)),
        )  # fmt: skip
        model = RangeModel(np.array([*OUTLIER[:2], 1.0, 9.0]), np.zeros((0, 2)))
        with Packed(x, p) as packed:
            stats = lanes.empty_lines(number, range_update.STATS, len(packed.x))
            range_update.update(packed, ranges, model, stats)
        evidence = stats[:, range_update.EVIDENCE].sum(axis=0)
        assert evidence == pytest.approx(packed.log_weight)
        return stats

    before = x.copy(), p.copy()
    p *= 1e-6
    well_known = stats_of(slice(0, 1))[0]
    spread_m2 = well_known[range_update.VARIANCE] - 0.04
    assert (np.abs(well_known[range_update.CURVATURE]) < 1e-3 * spread_m2).all()
    x[...], p[...] = before
    after = np.concatenate([stats_of(slice(0, 1)), stats_of(slice(1, 2))])
    moved = x.copy()
    x[...], p[...] = before
    assert stats_of(slice(0, 2)) == pytest.approx(after, rel=1e-9, abs=1e-12)
    assert x == pytest.approx(moved, rel=1e-9)


def test_no_component_explains_more_than_the_covariance() -> None:
    x, p = states(1, 10)
    p += np.eye(SIZE) * (np.arange(SIZE) < PER_NODE * NODES)
    carried = np.zeros((1, NODES, COMPONENTS, 6))
    # Of the three position entries and the heading's three: xx, xy, yy, xh, yh, hh.
    carried[..., 0] = carried[..., 2] = carried[..., 5] = 100.0
    updated(x, p, 6.0, 0.0, OUTLIER, sensitivity=carried)
    assert carried[0, 1, :, 0] == pytest.approx(100.0)
    for node in (0, 2):
        explained = carried[0, node][:, [0, 2, 5]].sum(axis=0)
        most = np.diagonal(p[0])[PER_NODE * node : PER_NODE * node + 3]
        assert (explained / most).max() == pytest.approx(1.0)


def test_the_mixtures_moments_are_the_reference_implementation() -> None:
    x, p = states(7, 4)
    weight = np.random.default_rng(5).dirichlet(np.ones(7))
    mean, covariance = moments_of(x, p, weight)
    expected = reference.moments(x, p, weight)
    assert mean == pytest.approx(expected[0], abs=1e-12)
    assert covariance == pytest.approx(expected[1], abs=1e-12)


def test_headings_are_averaged_round_the_circle() -> None:
    x, p = np.zeros((2, SIZE)), np.zeros((2, SIZE, SIZE))
    x[:, StateIndex.HEADING] = (np.pi - 0.1, -np.pi + 0.1)
    mean, covariance = moments_of(x, p, np.array([0.5, 0.5]))
    assert np.cos(mean[StateIndex.HEADING]) == pytest.approx(-1.0)
    assert covariance[StateIndex.HEADING, StateIndex.HEADING] == pytest.approx(0.01)


def test_the_motions_jacobian_is_that_of_finite_differences() -> None:
    x, _ = states(1, 6)
    p = np.zeros((1, SIZE, SIZE))
    # What has no variance is not modelled.
    p[0, StateIndex.DRIFT, StateIndex.DRIFT] = p[0, StateIndex.SCALE, StateIndex.SCALE] = 1e-30
    motion = np.array([[0.6, 0.1, 0.3, 2.0, 0.0, 0.0, 0.0]])
    component, drawn = np.ones((1, NODES, 3)), np.zeros((1, 1))
    step = 1e-6
    jacobian = np.empty((PER_NODE, PER_NODE))
    for column in range(PER_NODE):
        ends = []
        for sign in (-1.0, 1.0):
            moved = x.copy()
            moved[0, column] += sign * step
            advanced(moved, p.copy(), motion, component, drawn)
            ends.append(moved[0, :PER_NODE])
        jacobian[:, column] = (ends[1] - ends[0]) / (2.0 * step)
    p[0, :PER_NODE, :PER_NODE] = 1e-8 * np.eye(PER_NODE)
    advanced(x, p, motion, component, drawn)
    p[0, StateIndex.DRIFT, StateIndex.DRIFT] -= motion_update.DRIFT_WALK * motion[0, 3]
    p[0, StateIndex.SCALE, StateIndex.SCALE] -= motion_update.SCALE_WALK * motion[0, 3]
    assert 1e8 * p[0, :PER_NODE, :PER_NODE] == pytest.approx(jacobian @ jacobian.T, abs=1e-5)


def test_what_an_uncertain_heading_walks_has_the_moments_of_sampled_walks() -> None:
    sigma = 0.5
    x, p = np.zeros((1, SIZE)), np.zeros((1, SIZE, SIZE))
    p[0, StateIndex.HEADING, StateIndex.HEADING] = sigma**2
    advanced(x, p, np.array([[3.0, 0, 0, 0, 0, 0, 0]]), np.ones((1, NODES, 3)), np.zeros((1, 1)))
    heading = sigma * np.random.default_rng(7).standard_normal(400_000)
    walked = 3.0 * np.stack([np.cos(heading), np.sin(heading)])
    assert x[0, :2] == pytest.approx(walked.mean(axis=1), abs=0.01)
    assert p[0, :2, :2] == pytest.approx(np.cov(walked), abs=0.02)


@pytest.mark.parametrize("distance", [1.5, 4.0, 12.0])
def test_a_ranges_predicted_moments_are_those_of_sampled_places(distance: float) -> None:
    x, p = np.zeros((1, SIZE)), np.zeros((1, SIZE, SIZE))
    x[0, 2 * PER_NODE] = distance
    spread = np.array([[0.09, 0.03], [0.03, 0.25]])
    p[0, :2, :2] = spread
    places = np.random.default_rng(8).multivariate_normal([0.0, 0.0], spread, 400_000)
    sampled = np.hypot(distance - places[:, 0], places[:, 1])
    mean, sigma = predicted(x, p)
    assert mean == pytest.approx(sampled.mean(), abs=0.02)
    assert sigma == pytest.approx(sampled.std(), abs=0.02)


def test_two_nodes_that_meet_break_nothing() -> None:
    x, p = np.zeros((1, SIZE)), np.zeros((1, SIZE, SIZE))
    p[0, 0, 0] = p[0, 1, 1] = 0.3
    assert predicted(x, p)[0] == pytest.approx(np.sqrt(0.3))
    updated(x, p, 0.3, 0.0, OUTLIER)
    assert np.isfinite(x).all()
    assert np.isfinite(p).all()
    assert np.linalg.eigvalsh(p[0]).min() > -1e-12


def test_covariances_stay_symmetric_and_positive_over_a_long_run() -> None:
    rng = np.random.default_rng(9)
    x, p = states(3, 10)
    component = np.ones((3, NODES, 3))
    for _ in range(300):
        motion = np.abs(rng.normal(size=(NODES, 7))) * 0.1
        advanced(x, p, motion, component, rng.normal(size=(3, NODES)))
        updated(x, p, predicted(x, p)[0] + float(rng.normal()), 0.0, OUTLIER)
    assert p == pytest.approx(p.transpose(0, 2, 1), abs=1e-9)
    assert np.linalg.eigvalsh(p).min() > -1e-9


def detection(x: Floats, p: Floats, received: bool, edge_m: float) -> Floats:
    curve = np.where(np.arange(201) * STEP_M < edge_m, 0.98, 0.002)
    return with_attempt(x, p, received, 1.0, 1.0, curve)


def with_attempt(
    x: Floats, p: Floats, received: bool, attempted: float, weight: float, curve: Floats
) -> Floats:
    """Log weights (K,) after an attempt of users 0 and 2."""
    attempts = Attempts(
        np.array([0]), np.array([2]), np.zeros(1), np.array([received]), np.array([attempted])
    )
    with Packed(x, p) as packed:
        update_detection(packed, attempts, weight, curve)
    return out_of_lanes(packed.log_weight, len(x))


def apart(distance: float, sigma: float) -> tuple[Floats, Floats]:
    x, p = np.zeros((1, SIZE)), np.zeros((1, SIZE, SIZE))
    x[0, 2 * PER_NODE] = distance
    p[0, 0, 0] = sigma**2
    return x, p


def test_silence_is_likelier_of_those_who_are_far_apart() -> None:
    near, far = detection(*apart(4.0, 0.5), False, 10.0), detection(*apart(14.0, 0.5), False, 10.0)
    assert far[0] == pytest.approx(0.0, abs=0.01)
    assert near[0] < -3.0


@pytest.mark.parametrize(("received", "sign"), [(False, 1.0), (True, -1.0)])
def test_an_edge_within_the_spread_moves_the_two_as_sampled_places_say(
    received: bool, sign: float
) -> None:
    x, p = apart(10.0, 1.0)
    detection(x, p, received, 10.0)
    # Half of a Gaussian: mean sqrt(2/pi), variance 1 - 2/pi; the curve's edge is half a metre wide.
    assert -x[0, 0] == pytest.approx(sign * np.sqrt(2.0 / np.pi), abs=0.25)
    assert p[0, 0, 0] == pytest.approx(1.0 - 2.0 / np.pi, abs=0.12)


def test_what_is_far_from_any_edge_changes_nothing_but_the_weight() -> None:
    x, p = apart(4.0, 0.3)
    before = x.copy(), p.copy()
    detection(x, p, True, 10.0)
    assert (x == before[0]).all()
    assert (p == before[1]).all()


def test_a_place_that_is_no_number_is_looked_up_within_the_curve() -> None:
    x, p = states(16, 31)
    x[3, 0] = np.nan
    log_weight = with_attempt(x, p, False, 1.0, 1.0, np.full(201, 0.5))
    assert np.isfinite(np.delete(log_weight, 3)).all()


@pytest.mark.parametrize(("received", "weight"), [(True, 1.0), (False, 1.0), (False, 0.6)])
def test_an_attempt_is_the_reference_implementation(received: bool, weight: float) -> None:
    curve = 0.002 + 0.97 / (1.0 + np.exp((np.arange(201) * STEP_M - 7.0) / 1.5))
    x, p = states(16, 30)
    expected = [
        reference.detection(a, b, 0, 2, received, 0.9, weight, curve, STEP_M)
        for a, b in zip(x, p, strict=True)
    ]
    log_weight = with_attempt(x, p, received, 0.9, weight, curve)
    assert log_weight == pytest.approx(np.array([e[2] for e in expected]), abs=1e-9)
    assert x == pytest.approx(np.array([e[0] for e in expected]), abs=1e-9)
    assert p == pytest.approx(np.array([e[1] for e in expected]), abs=1e-9)
    assert len({e[0].tobytes() for e in expected} - {s.tobytes() for s in states(16, 30)[0]}) > 2


def test_variance_components_are_learned_from_innovations_and_their_uncertainty_is_honest() -> None:
    errors, sigmas = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        known = components.VarianceComponents()
        known.add_node()
        known.add_node()
        truth = np.array([1.0, 0.0, -0.5, -0.4, 0.0, 0.5, -2.0])
        for _ in range(500):
            # Innovations whose variance is a random mixture of the sorts of noise.
            parts = rng.dirichlet(np.full(7, 0.4))
            scale = np.exp(known.mean)
            stats = np.zeros((1, range_update.STATS, 1))
            stats[0, range_update.SHARES : range_update.CURVATURE, 0] = parts * scale
            stats[0, range_update.VARIANCE] = (parts * scale).sum()
            stats[0, range_update.INLIER] = 1.0
            measured = rng.normal() * np.sqrt((parts * np.exp(truth)).sum())
            ranges = Ranges(
                np.array([0]), np.array([1]), np.array([measured]), np.zeros(1), np.zeros(1),
                np.ones(1), np.zeros(1), np.full((1, 3), -1), np.zeros((1, 4)), np.zeros((1, 3)),
            )  # fmt: skip
            components.learn(known.mean, known.covariance, ranges, stats, np.zeros(1), np.ones(1))
        errors.append(known.mean - truth)
        sigmas.append(np.sqrt(known.covariance.diagonal()))
    ratio = np.sqrt(np.mean(np.square(np.array(errors) / np.array(sigmas))))
    assert np.abs(np.mean(errors, axis=0)).max() < 0.6
    assert np.mean(sigmas) < 0.5
    assert 0.6 < ratio < 1.6


# -- the small ones --------------------------------------------------------------------------------


def test_bases_of_noise_are_the_reference_implementation() -> None:
    rng = np.random.default_rng(20)
    moves = rng.normal(size=(40, 4)) * (0.5, 0.5, 1.0, 1.0)
    moves[:, 3] = np.abs(moves[:, 3])
    moves[0] = 0.0
    reported = np.where(rng.random((40, 3)) < 0.5, np.nan, np.abs(rng.normal(size=(40, 3))))
    expected = small.base_variances(*moves.T, reported)
    assert base_variances(moves, reported) == pytest.approx(expected, rel=1e-12)
    without_reported = small.base_variances(*moves.T, np.full((40, 3), np.nan))
    assert base_variances(moves, np.full((40, 3), np.nan)) == pytest.approx(
        without_reported, rel=1e-12
    )


@pytest.mark.parametrize("nodes", [1, 2, 7])
def test_the_nonlinearity_index_is_the_reference_implementation(nodes: int) -> None:
    rng = np.random.default_rng(nodes)
    root = rng.normal(size=(5 * nodes, 5 * nodes)) * 0.2
    mean, covariance = rng.normal(size=5 * nodes) * 4.0, root @ root.T
    metre = rng.uniform(0.05, 0.5, nodes)
    assert nonlinearity_index(mean, covariance, 0.2, metre) == pytest.approx(
        small.nonlinearity_index(mean, covariance, 0.2, metre), rel=1e-12
    )


@pytest.mark.parametrize("on_one_spot", [False, True])
def test_the_bearings_of_pairs_are_the_reference_implementation(on_one_spot: bool) -> None:
    x, p = states(1, 8)
    if on_one_spot:
        x[0, 5:7] = x[0, 0:2]
    rows = list(range(NODES))
    at = np.array([PER_NODE * row + np.arange(2) for row in rows])
    got = pair_moments(x[0][at], p[0][at[:, :, None, None], at])[:, 2:]
    assert got == pytest.approx(small.bearings(x[0], p[0], rows), rel=1e-9, abs=1e-12)


def test_cumulative_sums_are_the_reference_implementation_until_and_after_an_alarm() -> None:
    rng = np.random.default_rng(22)
    detector = slips.CusumDetector(np.zeros(5), np.ones(1))
    sums, base, alarms = [0.0] * 5, 1.0, 0
    for instant in range(300):
        pairs = [(0, 1), (1, 2), (3, 1), (2, 4), (0, 3)][: rng.integers(1, 6)]
        grown = np.array([8.0 if instant % 100 > 80 and 1 in pair else 1.0 for pair in pairs])
        square, worth = rng.chisquare(1, len(pairs)) * grown, rng.uniform(0.1, 1.0, len(pairs))
        ends = np.array(pairs)
        first, second = np.ascontiguousarray(ends.T)
        faulty = slips.update_cusum(detector, first, second, square, worth, 0.02, False)
        sums, base, expected = small.update_cusum(
            sums, base, pairs, square.tolist(), worth.tolist(), 0.02, slips.TEAM_ALARM
        )
        assert faulty == expected
        assert detector.sums == pytest.approx(sums)
        assert float(detector.base[0]) == pytest.approx(base)
        alarms += expected >= 0
    assert alarms > 1


def test_weights_sum_to_one_and_count_nothing_beyond_the_last_hypothesis() -> None:
    logs = np.random.default_rng(23).normal(size=(2, lanes.LANES)) * 3.0 - 400.0
    expected = np.exp(logs.ravel()[:11] - logs.ravel()[:11].max())
    expected /= expected.sum()
    weight = np.empty_like(logs)
    effective = mixture.normalise(logs, 11, weight)
    assert weight.ravel()[:11] == pytest.approx(expected)
    assert (weight.ravel()[11:] == 0.0).all()
    assert effective == pytest.approx(1.0 / (expected @ expected))
    assert logs.ravel()[:11].max() == 0.0


def test_variance_components_are_drawn_by_what_is_known_of_them() -> None:
    rng = np.random.default_rng(24)
    draw, mean, root = rng.normal(size=(11, 7)), rng.normal(size=7), rng.normal(size=(7, 7))
    covariance = root @ root.T
    laid = lanes.empty_lines(2, 7)
    laid[...] = np.resize(draw, (16, 7)).reshape(2, lanes.LANES, 7).transpose(0, 2, 1)
    low_noise = np.arange(16.0).reshape(2, lanes.LANES) % 2.0
    nothing = lanes.empty_lines(0)
    component, variance = lanes.empty_lines(2, 2, COMPONENTS), lanes.empty_lines(2)
    arrays = Hypotheses(
        nothing[None], nothing[None], nothing, lanes.empty_lines(2, 2, COMPONENTS, 6), component,
        variance, lanes.empty_lines(2), lanes.empty_lines(2),
    )  # fmt: skip
    components.spread(components.Draws(laid, low_noise, 0.5), mean, covariance, arrays)
    sd = np.minimum(0.5 * np.sqrt(covariance.diagonal()), components.SPREAD_MOST)
    lower = np.append(np.tile(components.LOWER, 2), 0.0)
    expected = np.exp(mean + sd * draw - np.outer(low_noise.ravel()[:11], lower))
    back = component.reshape(2, 6, lanes.LANES).transpose(0, 2, 1).reshape(-1, 6)[:11]
    assert back == pytest.approx(expected[:, :-1])
    assert variance.ravel()[:11] == pytest.approx(expected[:, -1])
