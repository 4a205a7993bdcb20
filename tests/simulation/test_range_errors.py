"""The range errors that are drawn, beside real tables of DW1000 ranges."""

import csv
import gzip

import numpy as np
import pytest

from relpos.simulation import range_errors
from shared_data import DATA


def table(name, condition):
    """True distances and errors of a table's rows."""
    path = DATA / name / "errors.csv.gz"
    if not path.exists():
        pytest.skip(f"no recordings: {name} is not in ../shared/data (or RELPOS_DATA)")
    with gzip.open(path, "rt") as stream:
        rows = [row for row in csv.DictReader(stream) if row["condition"] == condition]
    true_m = np.array([float(row["true_m"]) for row in rows])
    return true_m, np.array([float(row["range_m"]) for row in rows]) - true_m


def drawn(true_m, **kind):
    rng = np.random.default_rng(1)
    normals = rng.standard_normal((2, 40, len(true_m)))
    return range_errors.errors_m(np.broadcast_to(true_m, (40, len(true_m))), *normals, **kind)


@pytest.mark.parametrize(
    ("name", "condition", "kind"),
    [
        ("uwb_errors_outdoor", "los", {}),
        ("uwb_errors_outdoor", "nlos", {"body": True}),
        ("uwb_errors_university", "los", {}),
    ],
)
def test_ranges_in_sight_and_past_a_body_err_as_in_the_tables(name, condition, kind):
    true_m, error_m = table(name, condition)
    for low, high in ((1.5, 5.0), (5.0, 12.0), (12.0, 31.0)):
        chosen = (true_m >= low) & (true_m < high)
        if chosen.sum() < 200:
            continue
        model = drawn(true_m[chosen], **kind)
        assert np.median(model) == pytest.approx(np.median(error_m[chosen]), abs=0.06)
        wide, real = (np.ptp(np.quantile(e, [0.1, 0.9])) for e in (model, error_m[chosen]))
        assert 0.6 < wide / real < 2.0


def test_ranges_through_walls_err_as_in_the_table():
    true_m, error_m = table("uwb_errors_university", "nlos")
    model = drawn(true_m, wall=True)
    for share, tolerance in ((0.1, 0.1), (0.5, 0.1), (0.95, 0.6)):
        real = np.quantile(error_m, share)
        assert np.quantile(model, share) == pytest.approx(real, abs=tolerance)


def test_a_pair_that_stands_keeps_its_error_and_one_that_walks_does_not():
    rng = np.random.default_rng(2)
    still = range_errors.places(np.zeros(500), rng)
    assert np.ptp(still) == 0.0
    walking = range_errors.places(np.full(4000, 3.0), rng)
    assert walking.std() == pytest.approx(1.0, abs=0.05)
    assert abs(np.corrcoef(walking[1:], walking[:-1])[0, 1]) < 0.12
