"""Absurd values: judged once where measurements enter, counted, and never in an estimate."""

import math
import random
import re
from dataclasses import astuple, fields, replace
from pathlib import Path

import pytest

from relpos import fusion
from relpos.errors import DataError
from relpos.fusion.estimator import NodeStatus
from relpos.fusion.switching import SwitchingEstimator
from relpos.fusion.timeline import refusal
from relpos.measurements import (
    BOUNDS,
    Heading,
    Height,
    Motion,
    Prior,
    Range,
    Status,
    Truth,
    common_priors,
    out_of_bounds,
)

MOTION = Motion(1.0, 1, 0.7, 0.0, 0.1, 0.05, 0.05, 0.02, 1, True, 0.03)
RANGE = Range(1.0, 1, 2, 4.0, -80.0)
HEIGHT = Height(1.0, 1, 2.0, 0.5)
HEADING = Heading(1.0, 1, 0.3, 0.4, "phone")
ALL = (MOTION, RANGE, HEIGHT, HEADING)
BOUNDED = [(row, f.name) for row in ALL for f in fields(row) if f.name in BOUNDS]


@pytest.mark.parametrize(("row", "name"), BOUNDED)
def test_a_value_beyond_its_bounds_is_refused_and_one_at_them_is_not(row, name):
    low, high = BOUNDS[name]
    for beyond in (-1e308, math.nextafter(low, -math.inf), math.nextafter(high, math.inf), 1e308):
        assert out_of_bounds(replace(row, **{name: beyond})) == name
        assert refusal(replace(row, **{name: beyond})) == "beyond_bounds"
    assert out_of_bounds(replace(row, **{name: low})) is None
    assert out_of_bounds(replace(row, **{name: high})) is None
    if name.startswith("sigma"):
        assert refusal(replace(row, **{name: 1e-300})) == "beyond_bounds"
        assert refusal(replace(row, **{name: 1e-6})) is None
    for none in (math.nan, math.inf, -math.inf):
        with pytest.raises(DataError, match="not a finite number"):
            refusal(replace(row, **{name: none}))


NO_MEASUREMENTS = [
    Truth(1.0, 1, 0.0, 0.0),
    Status(1.0, 1, "battery_v", 9.0),
    (1.0, 1, 2, 4.0),
    replace(RANGE, range_m=None),
    replace(RANGE, range_m="4"),
    replace(RANGE, time_s=None),
    replace(RANGE, node="1"),
    replace(RANGE, node=math.nan),
    replace(RANGE, node=1.5),
    replace(RANGE, peer=-1),
    replace(MOTION, dx_m=None),
]


@pytest.mark.parametrize("name", ["bank", "particle", "deadreckoning"])
@pytest.mark.parametrize("row", NO_MEASUREMENTS)
def test_what_is_no_measurement_is_refused_at_once_and_leaves_no_trace(name, row):
    priors, one = [Prior(1, 0.0, 0.0, 0.0)], Motion(1.0, 1, 0.7, 0.0, 0.1)
    estimator, other = (fusion.make(name, priors) for _ in range(2))
    for before in (estimator, other):
        before.process(one)
    with pytest.raises(DataError, match=re.escape(repr(row))):
        estimator.process(row)
    for time_s in (2.0, 3.0):
        later = replace(one, time_s=time_s)
        assert estimator.process(later) == other.process(later)
    assert estimator.counters() == other.counters()


def test_a_refused_time_lets_the_default_estimator_remember_no_more_than_else():
    estimator = fusion.make("bank")
    assert isinstance(estimator, SwitchingEstimator)
    estimator.process(replace(RANGE, time_s=1e7))
    for second in range(1, 200):
        estimator.process(replace(MOTION, time_s=float(second)))
    assert len(estimator._recent) < 100


def test_the_page_of_the_run_format_has_every_bound():
    page = Path(__file__).parents[2] / "docs" / "run-format.md"
    rows = re.findall(
        r"^\| (`.+`) \| (-?[\d,.]+) to (-?[\d,.]+) \|", page.read_text(), re.MULTILINE
    )
    shown = {
        name: (float(low.replace(",", "")), float(high.replace(",", "")))
        for names, low, high in rows
        for name in re.findall(r"`(\w+)`", names)
    }
    assert shown == BOUNDS


def absurd(rng, row):
    """One value of a measurement at a bound, beyond it, or very small."""
    name = rng.choice([name for at, name in BOUNDED if type(at) is type(row) and name != "time_s"])
    low, high = BOUNDS[name]
    value = rng.choice([low, high, 0.5 * high, 1e-300, 1e-12, 0.0, 2 * high, 1e200, 1e308])
    return replace(row, **{name: value})


def absurd_walk(seed):
    """Three people for 30 s; one measurement in ten is absurd."""
    rng = random.Random(seed)
    for second in range(1, 31):
        for node in (1, 2, 3):
            rows = (
                replace(MOTION, node=node, dx_m=rng.uniform(-1.0, 1.0)),
                replace(RANGE, node=node, peer=node % 3 + 1, range_m=rng.uniform(1.0, 9.0)),
                replace(HEIGHT, node=node),
                replace(HEADING, node=node, source=rng.choice(["phone", "magnetic"])),
            )
            for k, row in enumerate(rows):
                row = replace(row, time_s=second + 0.01 * node + 0.2 * k)
                yield absurd(rng, row) if rng.random() < 0.1 else row


@pytest.mark.parametrize(
    ("estimator", "seed"),
    [
        ("bank", 1),
        ("bank", 2),
        ("deadreckoning", 1),
        *(
            pytest.param(name, seed, marks=pytest.mark.soak)
            for name in ("bank", "particle")
            for seed in range(3, 40)
        ),
    ],
)
def test_absurd_values_leave_every_estimate_finite(estimator, seed):
    made = fusion.make(estimator, common_priors((1, 2, 3)), seed=seed)
    estimates = [e for row in absurd_walk(seed) for e in made.process(row)] + made.finish()
    assert estimates
    for estimate in estimates:
        for row in (*estimate.nodes, *estimate.pairs):
            if getattr(row, "status", None) is not NodeStatus.UNLOCATED:
                assert all(math.isfinite(v) for v in astuple(row) if isinstance(v, float)), row
    assert made.counters()["beyond_bounds"] > 0
