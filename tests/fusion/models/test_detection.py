"""A missed range is a measurement: the detection curve is learned, and used with care."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from itertools import combinations, groupby, permutations

import numpy as np
import pytest

from reference import detection as reference
from relpos import fusion
from relpos.fusion.models.detection import (
    LENGTH,
    Attempts,
    Detection,
    Round,
    Rounds,
    Statistics,
    add_attempts,
    on_one_floor,
)
from relpos.measurements import Range
from relpos.simulation.paper import simulate_paper


def always(_: int) -> float:
    return math.inf


def taught_by(scenario: str, seed: int) -> Detection:
    """A curve learned over a simulated run, distances known to 0.1 m."""
    run = simulate_paper(scenario, seed)
    places: dict[float, dict[int, complex]] = {}
    for t in run.truth:
        places.setdefault(t.time_s, {})[t.node] = complex(t.x_m, t.y_m)
    rng = np.random.default_rng(seed)
    learner = Detection()
    ranges = [m for m in run.measurements if isinstance(m, Range)]
    for time_s, group in groupby(ranges, key=lambda r: r.time_s):
        for one in learner.rounds.add(time_s, list(group), always):
            at = places[one.time_s]

            def seen(
                pairs: Sequence[tuple[int, int]], at: dict[int, complex] = at
            ) -> tuple[np.ndarray, np.ndarray]:
                true = np.array([abs(at[a] - at[b]) for a, b in pairs])
                return np.abs(true + rng.normal(0, 0.1, len(pairs))), np.full(len(pairs), 0.1)

            learner.update(one, *seen(one.received + one.missed))
    return learner


@pytest.mark.parametrize(
    ("scenario", "near", "edge_m"), [("paper", 0.5, 15.0), ("paper-h", 1.0, 10.0)]
)
def test_the_learned_curve_is_the_simulated_one(scenario: str, near: float, edge_m: float) -> None:
    learner = taught_by(scenario, 5)
    inside = learner.probability(np.array([1.0, 4.0, 0.8 * edge_m]))
    beyond = learner.probability(np.array([1.15 * edge_m, 2.0 * edge_m]))
    assert inside == pytest.approx(near, abs=0.04)
    assert (beyond < 0.02).all()
    assert learner.known
    assert abs(learner.range_m - edge_m) < 0.08 * edge_m
    assert learner.weight > 0.6  # independent misses keep most of their weight


def test_before_anything_is_learned_a_miss_says_little() -> None:
    learner = Detection()
    near, far = np.log1p(-learner.probability(np.array([2.0, 30.0])))
    assert 0.0 < far - near < 1.0
    assert not learner.known


def outcomes(law: Callable[[float], float], rounds: int) -> Detection:
    """What is learned from four nodes at random places, whose attempts succeed by a law."""
    rng = np.random.default_rng(8)
    learner, pairs = Detection(), list(combinations(range(4), 2))
    for k in range(rounds):
        place = rng.uniform(0.0, 25.0, (4, 2))
        distance = {p: float(np.hypot(*(place[p[0]] - place[p[1]]))) for p in pairs}
        got = [p for p in pairs if rng.random() < law(distance[p])]
        missed = [p for p in pairs if p not in got]
        of = np.array([distance[p] for p in (*got, *missed)])
        one = Round(float(k), tuple(got), tuple(missed), (True,) * len(got))
        learner.update(one, of, np.full(len(pairs), 0.2))
    return learner


@pytest.mark.parametrize(
    ("law", "obstructed"),
    [
        # Half are lost for each wall, of which there is one every eight metres.
        (lambda distance_m: 0.9 * 0.5 ** (distance_m / 8.0), True),
        (lambda distance_m: 0.4 * 0.5 ** (distance_m / 8.0), True),
        # Between two curves of the family, whose half is at 12 m.
        (lambda distance_m: 0.95 / (1.0 + math.exp((distance_m / 12.0 - 1.0) / 0.3)), True),
        (lambda _: 0.9, False),
        (lambda _: 0.4, False),
        (lambda distance_m: 0.7 * (distance_m < 15.0), False),
    ],
)
def test_ranges_that_fade_with_distance_are_told_from_ranges_lost_at_random_and_from_an_edge(
    law: Callable[[float], float], obstructed: bool
) -> None:
    assert Detection().obstructed == 0.0
    learned = outcomes(law, 400).obstructed
    assert learned > 0.8 if obstructed else learned < 0.05


def instants(
    rounds: Rounds,
    ranged: Sequence[tuple[float, list[tuple[int, int]]]],
    alive: Callable[..., float],
) -> list[Round]:
    return [
        one
        for time_s, pairs in ranged
        for one in rounds.add(time_s, [Range(time_s, a, b, 3.0) for a, b in pairs], alive)
    ]


ALL = [(1, 2), (1, 3), (2, 3)]


def test_a_pair_counts_as_attempted_when_one_of_the_two_ranged_another() -> None:
    rounds = Rounds()
    given = instants(rounds, [(0.0, ALL), (2.0, [(1, 2), (2, 3)])], always)
    assert given[0].missed == ()
    assert given[1].missed == ((1, 3),)


def test_misses_of_a_node_that_is_off_say_nothing() -> None:
    rounds = Rounds()
    everyone = [*ALL, (1, 4), (2, 4), (3, 4)]
    given = instants(rounds, [(0.0, everyone)], always)
    off = {4: 0.0}  # its last motion; the others go on
    given += instants(rounds, [(10.0, ALL)], lambda node: off.get(node, 10.0))
    assert given[-1].missed == ()
    on = instants(rounds, [(12.0, ALL)], always)
    assert on[-1].missed == ((1, 4), (2, 4), (3, 4))


def test_a_pair_that_never_ranged_is_not_taken_for_missed() -> None:
    rounds = Rounds()
    given = instants(rounds, [(float(t), [(1, 2), (3, 4), (2, 3)]) for t in range(9)], always)
    assert all(one.missed == () for one in given)


def test_a_round_of_nodes_in_turn_lasts_until_a_pair_ranges_again() -> None:
    rounds = Rounds()
    turns = [
        (2.0 * cycle + 0.3 * node + 0.02 * peer, [(node, peer)])
        for cycle in range(20)
        for node, peer in permutations((1, 2, 3), 2)
        if not (cycle > 5 and {node, peer} == {1, 3})
    ]
    given = instants(rounds, turns, always)
    assert {one.missed for one in given[4:6]} == {()}
    assert {one.missed for one in given[8:]} == {((1, 3),)}
    assert 17 <= len(given) <= 21


def learn(learner: Detection, one: Round, far_m: float = 2.0) -> np.ndarray:
    received, missed = len(one.received), len(one.missed)
    distance_m = np.repeat([2.0, far_m], [received, missed])
    return learner.update(one, distance_m, np.full(distance_m.size, 0.1))


def test_a_node_that_is_not_received_for_long_is_taken_for_broken_and_not_for_far() -> None:
    learner = Detection()
    everyone = [(a, b) for a in (1, 2, 3, 4) for b in range(a + 1, 5)]
    for one in instants(learner.rounds, [(float(t), everyone) for t in range(60)], always):
        learn(learner, one)
    alone = instants(learner.rounds, [(60.0 + t, ALL) for t in range(12)], always)
    worth = [float(learn(learner, one).max()) for one in alone]
    assert worth[-1] < 0.01
    # It is received again: believed at once.
    instants(learner.rounds, [(80.0, everyone)], always)
    learn(learner, Round(80.0, tuple(everyone), (), (True,) * 6))
    again = instants(learner.rounds, [(81.0, [*ALL, (1, 4), (2, 4)])], always)
    assert learn(learner, again[-1]).min() > 0.9


def test_misses_that_follow_each_other_count_less_than_independent_ones() -> None:
    rng = np.random.default_rng(1)
    blocked, free = Detection(), Detection()
    for learner, stays in ((blocked, 0.97), (free, 0.5)):
        state = dict.fromkeys(ALL, True)
        for t in range(400):
            for pair in ALL:
                if rng.random() > stays:
                    state[pair] = not state[pair]
            received = tuple(p for p in ALL if state[p])
            missed = tuple(p for p in ALL if not state[p])
            learn(learner, Round(float(t), received, missed, (True,) * len(received)))
    assert blocked.weight < 0.25
    assert free.weight > 0.8


def test_learning_after_a_copy_does_not_change_the_copy() -> None:
    learner = Detection()
    given = instants(learner.rounds, [(float(t), ALL) for t in range(30)], always)
    kept = deepcopy(learner)
    before = kept.curve.copy()
    for one in given:
        learn(learner, one)
    assert (kept.curve == before).all()
    assert not np.allclose(learner.curve, before)


def test_the_bank_reports_the_detection_range() -> None:
    run = simulate_paper("paper-h2", 2, {"seconds": 100.0})
    bank = fusion.make("bank", run.priors, {}, 1)
    estimates = [e for m in run.measurements for e in bank.process(m)] + bank.finish()
    found = [p for p in estimates[-1].parameters if p.name == "detection_range_m"]
    assert {p.node for p in found} == {1, 2, 3, 4, 5, 6}
    assert found[0].value == pytest.approx(10.0, abs=1.5)
    assert found[0].sigma < 1.5


def test_the_statistics_of_attempts_are_those_of_the_reference() -> None:
    rng = np.random.default_rng(2)
    pairs = np.array([(a, b) for a in range(5) for b in range(a + 1, 5)])
    ours, expected = (
        Statistics(
            np.ones(5), np.full((5, 5), np.nan), np.zeros((2, LENGTH)), np.array([0.0, 25.0, 0.0])
        )
        for _ in range(2)
    )
    curve = Detection().curve
    for received in (10, 4, 0, 6, 1):
        first, second = np.ascontiguousarray(rng.permutation(pairs).T)
        distance_m, sigma_m = rng.uniform(0.0, 130.0, 10), rng.uniform(0.0, 2.0, 10)
        observable = rng.integers(0, 2, received).astype(float)
        attempts = Attempts(first, second, received, observable, distance_m, sigma_m)
        attempted = add_attempts(attempts, curve, ours)
        again = reference.add_attempts(attempts, curve, expected)
        assert attempted == pytest.approx(again, abs=1e-12)
        for got, wanted in zip(ours, expected, strict=True):
            assert got == pytest.approx(wanted, abs=1e-9, nan_ok=True)


def test_distances_that_are_no_numbers_are_counted_within_the_arrays() -> None:
    # The kernel checks no bounds: the rows before and after are what it could hit.
    room = np.zeros((4, LENGTH))
    learned = Statistics(np.ones(2), np.full((2, 2), np.nan), room[1:3], np.zeros(3))
    for distance_m, sigma_m in ((np.nan, 1.0), (1.0, np.nan), (np.inf, 1.0), (-np.inf, 1.0)):
        ends = np.array([0]), np.array([1])
        for received in (0, 1):
            attempts = Attempts(
                *ends, received, np.ones(received), np.array([distance_m]), np.array([sigma_m])
            )
            add_attempts(attempts, Detection().curve, learned)
    assert not room[[0, 3]].any()
    assert not room[1:3, 2:-2].any()


def test_a_pair_that_may_be_a_storey_apart_counts_neither_as_received_nor_as_missed() -> None:
    rounds = Rounds()
    below = {3: (3.5, 0.1), 4: (0.2, 0.1), 5: (0.0, 5.0)}

    def level(pairs: Sequence[tuple[int, int]]) -> np.ndarray:
        heights = [(below.get(a, (0.0, 0.1)), below.get(b, (0.0, 0.1))) for a, b in pairs]
        dz = np.array([b[0] - a[0] for a, b in heights])
        return on_one_floor(dz, np.array([a[1] ** 2 + b[1] ** 2 for a, b in heights]))

    everybody = [(1, peer) for peer in (2, 3, 4, 5)]
    found = []
    for time_s, pairs in enumerate([everybody, [(1, 2)], everybody]):
        found += rounds.add(
            float(time_s), [Range(float(time_s), a, b, 3.0) for a, b in pairs], always, level
        )
    assert found[0].received == ((1, 2), (1, 4))
    assert found[1].received == ((1, 2),)
    assert found[1].missed == ((1, 4),)
