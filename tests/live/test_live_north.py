"""North on the live map: shown when it is known, and steady enough to be read."""

from __future__ import annotations

import math

import pytest

from relpos.fusion.estimator import Estimate, MagneticNorth
from relpos.live.composer import Composer


def shown_after(*norths: tuple[float, float] | None) -> list[float | None]:
    """Bearing of north on the map after each estimate of (bearing, deviation) in degrees."""
    composer, shown = Composer(), []
    for k, north in enumerate(norths):
        known = north and MagneticNorth(*map(math.radians, north))
        composer.add_estimate(Estimate(float(k), (), (), north=known or None), k)
        north_rad = composer.view(float(k), 1e9 + k).north_rad
        shown.append(None if north_rad is None else math.degrees(north_rad))
    return shown


def test_north_is_not_shown_before_it_is_known_well_enough_to_go_by() -> None:
    assert shown_after(None, (40.0, 60.0), (40.0, 16.0)) == [None, None, None]
    assert shown_after((40.0, 10.0)) == [pytest.approx(40.0)]


def test_the_map_does_not_turn_with_every_reading() -> None:
    assert shown_after((40.0, 5.0), (43.0, 5.0), (37.0, 5.0), (46.0, 5.0)) == pytest.approx(
        [40.0, 40.0, 40.0, 46.0]
    )
    assert shown_after((179.0, 5.0), (-179.0, 5.0)) == pytest.approx([179.0, 179.0])


def test_north_that_is_lost_is_shown_no_longer() -> None:
    assert shown_after((40.0, 10.0), (40.0, 30.0)) == [pytest.approx(40.0), None]
