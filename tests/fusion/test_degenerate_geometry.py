"""Random steps and geometry that gives an estimator nothing: covariances stay positive, no NaN."""

import contextlib
import itertools
import math
import random

import numpy as np
import pytest

from relpos import api, fusion
from relpos.errors import RelposError
from relpos.fusion.bank.core import BankCore
from relpos.fusion.bank.storage import unpack
from relpos.fusion.estimator import NodeStatus
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.smoother.graph import build_graph
from relpos.fusion.smoother.problem import Problem
from relpos.fusion.smoother.solution import smooth as optimum
from relpos.fusion.timeline import refusal
from relpos.measurements import Heading, Height, Motion, Range, common_priors
from relpos.runs import Description
from relpos.runs.description import InitialPose
from relpos.runs.run import assemble
from support.plain_ranges import plain_ranges


def one_spot(rng, node):
    return 0.0, 0.0


def one_line(rng, node):
    return 3.0 * node, 0.0


def anywhere(rng, node):
    return rng.uniform(-50.0, 50.0), rng.uniform(-50.0, 50.0)


def steps(rng, nodes, place, ranges, count):
    """Motions of all nodes second by second, and what else comes in between."""
    places = {node: place(rng, node) for node in nodes}
    for step in range(count):
        node, time_s = nodes[step % len(nodes)], 1.0 + step / len(nodes)
        stands = rng.random() < 0.3
        dx_m, turn = (0.0, 0.0) if stands else (rng.gauss(0.7, 0.5), rng.gauss(0.0, 0.6))
        sigma_m = rng.choice([0.0, 1e-6, 0.05, 0.05, 0.05, 50.0])
        yield Motion(time_s, node, dx_m, 0.0, turn, sigma_m, sigma_m, rng.choice([0.0, 0.02, 3.0]))
        kind = rng.random()
        if kind < 0.5 and len(nodes) > 1:
            peer = rng.choice([n for n in nodes if n != node])
            true_m = math.dist(places[node], places[peer])
            yield Range(time_s, node, peer, ranges(rng, true_m))
        elif kind < 0.55:
            yield Height(time_s, node, rng.uniform(-5.0, 5.0), rng.choice([1e-6, 0.5]))
        elif kind < 0.6:
            sigma_rad = rng.choice([1e-6, 0.4, 10.0])
            yield Heading(time_s, node, rng.uniform(-4.0, 4.0), sigma_rad, "phone")


def as_measured(rng, true_m):
    return max(true_m + rng.gauss(0.0, 0.1), 0.0)


def nothing(rng, true_m):
    return 0.0


def any_distance(rng, true_m):
    return rng.choice([0.0, 1e-3, 1.0, 30.0, 200.0])


def check(estimate):
    for node in estimate.nodes:
        if node.status is NodeStatus.UNLOCATED:
            continue
        xx, yy, xy = node.variance_x_m2, node.variance_y_m2, node.covariance_xy_m2
        numbers = (node.x_m, node.y_m, node.heading_rad, xx, yy, xy, node.sigma_heading_rad)
        numbers = (*numbers, node.z_m, node.sigma_z_m)
        assert all(map(math.isfinite, numbers)), node
        assert min(xx, yy) > 0.0, node
        assert min(node.sigma_heading_rad, node.sigma_z_m) >= 0.0, node
        assert xx * yy - xy * xy >= -1e-9 * xx * yy, node
    for pair in estimate.pairs:
        assert math.isfinite(pair.distance_m), pair
        assert pair.sigma_distance_m >= 0.0, pair


CASES = {
    "one spot": ((1, 2, 3), one_spot, as_measured),
    "one line": ((1, 2, 3, 4), one_line, as_measured),
    "one node": ((7,), anywhere, as_measured),
    "ranges of zero": ((1, 2, 3), anywhere, nothing),
    "any range": ((1, 2, 3), anywhere, any_distance),
}


def rows_of(case, count, seed):
    nodes, place, ranges = CASES[case]
    return common_priors(nodes), list(steps(random.Random(seed), nodes, place, ranges, count))


def run(estimator, case, count, seed):
    priors, rows = rows_of(case, count, seed)
    made = fusion.make(estimator, priors)
    estimates = 0
    for row in rows:
        for estimate in made.process(row):
            check(estimate)
            estimates += 1
    assert estimates
    with contextlib.suppress(RelposError):  # says in words what these measurements cannot tell
        for estimate in made.finish():
            check(estimate)


def smooth(case, count, seed):
    priors, rows = rows_of(case, count, seed)
    description = Description(initial_pose=InitialPose.COMMON, priors=priors)
    estimates = 0
    with contextlib.suppress(RelposError):
        for estimate in api.fuse(assemble("random", description, rows), smooth=True).estimates:
            check(estimate)
            estimates += 1
    return estimates


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("estimator", ["bank", "particle"])
def test_random_steps_leave_every_covariance_positive(estimator, case):
    run(estimator, case, 60, 1)


@pytest.mark.soak  # a million motions of one node in the particle filter
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(("estimator", "count"), [("bank", 5_000), ("particle", 200_000)])
def test_long_random_walks_leave_every_covariance_positive(estimator, count, case):
    for seed in range(count // 1_000):
        run(estimator, case, 1_000, seed)


def test_a_short_random_walk_is_smoothed_to_positive_covariances():
    assert smooth("one spot", 18, 1)


@pytest.mark.soak
@pytest.mark.parametrize("case", CASES)
def test_random_walks_are_smoothed_to_positive_covariances(case):
    for seed in range(3):
        # Without a range there is nothing to smooth.
        assert (smooth(case, 300, seed) > 0) is (case not in ("one node", "ranges of zero"))


@pytest.mark.parametrize("place", [one_spot, one_line], ids=lambda place: place.__name__)
@pytest.mark.parametrize("count", [33, pytest.param(1000, marks=pytest.mark.soak)])
def test_a_large_team_in_one_spot_or_line_stays_finite(place, count):
    nodes, rng = tuple(range(1, count + 1)), random.Random(1)
    made = fusion.make("bank", common_priors(nodes))
    for row in steps(rng, nodes, place, as_measured, 2 * count):
        for estimate in made.process(row):
            check(estimate)
    for estimate in made.finish():
        check(estimate)


# -- a million steps of each filter --------------------------------------------------------------

EVERY = 50
"""Rounds between two looks at every covariance."""
STEPS = 200_000
"""A step is one motion of one node; five cases make a million of the bank and of the smoother."""
RUN = 1_200
"""Steps from one beginning."""


def check_matrices(covariances):
    """Symmetric and positive to rounding, as correlations: (K, D, D)."""
    assert np.isfinite(covariances).all()
    deviations = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    scale = deviations[:, :, None] * deviations[:, None, :]
    known = scale > 0.0
    assert not covariances[~known].any(), "correlated with what is known exactly"
    correlations = np.divide(covariances, scale, out=np.zeros_like(scale), where=known)
    assert np.abs(correlations - correlations.swapaxes(1, 2)).max() < 1e-9
    assert np.linalg.eigvalsh(correlations).min() > -1e-6


def walk_the_core(case, count, seed):
    """The bank's kernels below its reports: motion, ranges of an instant, headings, resampling."""
    nodes, place, ranges = CASES[case]
    rng = random.Random(seed)
    core = BankCore(BankSettings(hypotheses=8), seed)
    places = {node: place(rng, node) for node in nodes}
    for node in nodes:
        core.add_node((*places[node], 0.0), 0.1, 0.1)
    rows = np.arange(len(nodes))
    pairs = list(itertools.combinations(rows.tolist(), 2))
    for k in range(1, 1 + count // len(nodes)):
        moves = np.array(
            [
                (0.0, 0.0, 0.0, 1.0)
                if rng.random() < 0.3
                else (rng.gauss(0.7, 0.5), 0.0, rng.gauss(0.0, 0.6), 1.0)
                for _ in nodes
            ]
        )
        sigma_m = [rng.choice([0.0, 1e-6, 0.05, 0.05, 50.0]) for _ in nodes]
        sigmas = np.array([(s, s, rng.choice([0.0, 0.02, 3.0])) for s in sigma_m])
        core.move(rows, moves, sigmas)
        if pairs and rng.random() < 0.5:
            some = rng.sample(pairs, rng.randrange(1, 1 + len(pairs)))
            first, second = np.array(some).T.copy()
            true_m = [math.dist(places[nodes[i]], places[nodes[j]]) for i, j in some]
            range_m = np.array([ranges(rng, m) for m in true_m])
            core.update(*plain_ranges(first, second, range_m))
        if rng.random() < 0.1:
            core.update_heading(
                rng.choice(rows.tolist()), rng.uniform(-4.0, 4.0), rng.choice([1e-6, 0.4])
            )
        core.end_instant(float(k))
        if k % EVERY == 0:
            check_matrices(hypotheses_of(core, len(nodes)))
            mean, covariance, shared = core.moments()
            assert np.isfinite(mean).all()
            check_matrices(covariance[None])
            check_matrices((covariance + shared)[None])


def hypotheses_of(core, nodes):
    these = core.hypotheses
    means, covariances = unpack(these.arrays.x, these.arrays.p, nodes, these.count)
    assert np.isfinite(means).all()
    assert np.isfinite(these.arrays.log_weight).all()
    return covariances


def smooth_alone(case, count, seed):
    """The smoother from dead reckoning on, every pose's joint covariance looked at."""
    priors, rows = rows_of(case, count, seed)
    problem = Problem(build_graph([row for row in rows if refusal(row) is None], priors)[0])
    solution = optimum(
        problem, problem.first_state(problem.graph.dead_reckoned(problem.graph.prior))
    )
    assert np.isfinite(solution.state.poses).all()
    check_matrices(solution.covariance.diagonal)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("walk", [walk_the_core, smooth_alone])
@pytest.mark.parametrize(
    ("runs", "steps"), [(1, 240), pytest.param(-(-STEPS // RUN), RUN, marks=pytest.mark.soak)]
)
def test_random_steps_leave_every_matrix_symmetric_and_positive(walk, case, runs, steps):
    for seed in range(runs):
        walk(case, steps, seed)
