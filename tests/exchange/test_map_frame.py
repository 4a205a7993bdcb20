"""Pins: how they are parsed, and that the transform between plane and map is WGS84's."""

from __future__ import annotations

import math

import pytest
from geographiclib.geodesic import Geodesic

from relpos.errors import DataError
from relpos.geodesy import MapFrame, Pin, parse_pin, place

SITES = [(48.137, 11.575), (-33.92, 18.42), (69.65, 18.96), (0.0, -78.5), (35.0, 179.9999)]


def no_position(node: int, time_s: float | None) -> None:
    return None


@pytest.mark.parametrize(("latitude_deg", "longitude_deg"), SITES)
@pytest.mark.parametrize("bearing_deg", [0.0, 90.0, 213.7])
def test_a_position_within_a_kilometre_is_right_to_a_centimetre(
    latitude_deg: float, longitude_deg: float, bearing_deg: float
) -> None:
    frame = MapFrame(latitude_deg, longitude_deg, math.radians(bearing_deg), place_m=(12.0, -7.0))
    for distance_m in (1.0, 30.0, 300.0, 1000.0):
        for angle_deg in range(0, 360, 24):
            # From x towards y is counter-clockwise, a compass goes clockwise.
            there = Geodesic.WGS84.Direct(
                latitude_deg, longitude_deg, bearing_deg - angle_deg, distance_m
            )
            x_m = 12.0 + distance_m * math.cos(math.radians(angle_deg))
            y_m = -7.0 + distance_m * math.sin(math.radians(angle_deg))
            lat, lon = frame.to_map(x_m, y_m)
            missed = Geodesic.WGS84.Inverse(there["lat2"], there["lon2"], float(lat), float(lon))
            assert missed["s12"] < 0.001
            back_x_m, back_y_m = frame.to_world(there["lat2"], there["lon2"])
            assert math.hypot(back_x_m - x_m, back_y_m - y_m) < 0.001
            assert -180.0 <= lon <= 180.0


def test_headings_turn_left_and_courses_turn_right() -> None:
    frame = MapFrame(48.0, 11.0, math.radians(30.0))
    assert frame.course_deg(0.0) == pytest.approx(30.0)
    assert frame.course_deg(math.radians(90.0)) == pytest.approx(300.0)


def test_a_pin_says_where_and_what_lies_there() -> None:
    assert parse_pin("48.1,11.5") == Pin(48.1, 11.5)
    full = parse_pin("-33.9, 18.4, 90, 25.5@3:12.5")
    assert full == Pin(-33.9, 18.4, math.pi / 2, 25.5, node=3, time_s=12.5)
    assert parse_pin("48.1,11.5@2").node == 2
    assert parse_pin("48.1,11.5,0@-4.5,2").place_m == (-4.5, 2.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("48.1", "LAT,LON[,BEARING[,ALTITUDE]]"),
        ("48.1,east", "'east' is not a number"),
        ("48.1,11.5,90,1,2", "is wanted"),
        ("91,11", "latitude 91 is not between"),
        ("11,200", "longitude 200 is not between"),
        ("48,nan", "'nan' is not a finite number"),
        ("48,11@", "'' is no node id"),
        ("48,11@Kim", "'Kim' is no node id"),
        ("48,11@1,2,3", "two numbers"),
        ("48,11@1:noon", "'noon' is not a number"),
    ],
)
def test_a_wrong_pin_is_reported_in_one_line(text: str, words: str) -> None:
    with pytest.raises(DataError) as caught:
        parse_pin(text)
    assert words in str(caught.value)
    assert str(caught.value).startswith(f"pin {text}: ")
    assert "\n" not in str(caught.value)


def test_one_pin_without_a_bearing_says_what_is_taken_for_it() -> None:
    placing = place([Pin(48.0, 11.0)], no_position)
    assert placing.frame.bearing_rad == pytest.approx(math.pi / 2)
    assert "east" in placing.remarks[0]
    assert place([Pin(48.0, 11.0, 0.0)], no_position).remarks == ()


def test_a_pin_on_a_node_lies_where_the_node_was() -> None:
    placing = place([Pin(48.0, 11.0, 0.0, node=3, time_s=2.0)], lambda n, t: (n + 1.0, t or 0.0))
    assert placing.frame.place_m == (4.0, 2.0)
    with pytest.raises(DataError, match=r"node 3 was not located at 2 s"):
        place([Pin(48.0, 11.0, 0.0, node=3, time_s=2.0)], no_position)


def test_two_pins_give_the_bearing() -> None:
    true = MapFrame(48.0, 11.0, math.radians(77.0), place_m=(5.0, 5.0))
    pins = []
    for x_m, y_m in ((-20.0, 3.0), (40.0, 11.0)):
        lat, lon = true.to_map(x_m, y_m)
        pins.append(Pin(float(lat), float(lon), place_m=(x_m, y_m)))
    placing = place(pins, no_position)
    # North at the first pin, some 20 m further west, is a quarter of a thousandth further round.
    assert math.degrees(placing.frame.bearing_rad) == pytest.approx(77.0, abs=1e-3)
    for x_m, y_m in ((0.0, 0.0), (100.0, -50.0)):
        expected, got = true.to_map(x_m, y_m), placing.frame.to_map(x_m, y_m)
        missed = Geodesic.WGS84.Inverse(*(float(v) for v in (*expected, *got)))
        assert missed["s12"] < 0.001
    assert "fit to within 0.00 m" in placing.remarks[0]


def test_pins_that_do_not_fit_say_by_how_much() -> None:
    lat, lon = MapFrame(48.0, 11.0).to_map(30.0, 0.0)
    pins = [Pin(48.0, 11.0), Pin(float(lat), float(lon), place_m=(40.0, 0.0))]
    assert "fit to within 5.00 m" in place(pins, no_position).remarks[0]


def test_pins_that_give_no_bearing_are_refused() -> None:
    with pytest.raises(DataError, match="at one place in the picture"):
        place([Pin(48.0, 11.0), Pin(48.001, 11.0)], no_position)
    with pytest.raises(DataError, match="at one place on the map"):
        place([Pin(48.0, 11.0), Pin(48.0, 11.0, place_m=(9.0, 0.0))], no_position)
    with pytest.raises(DataError, match="leave it out"):
        place([Pin(48.0, 11.0, 0.0), Pin(48.001, 11.0, place_m=(9.0, 0.0))], no_position)


def test_a_position_on_another_continent_is_a_mistake() -> None:
    frame = MapFrame(48.0, 11.0)
    for latitude_deg, longitude_deg in ((11.0, 48.0), (-48.0, -169.0)):
        with pytest.raises(DataError, match="swapped"):
            frame.to_world(latitude_deg, longitude_deg)


def test_altitudes_are_given_only_where_the_pin_has_one() -> None:
    assert MapFrame(48.0, 11.0).altitude_of(1.0) is None
    assert MapFrame(48.0, 11.0, altitude_m=520.0).altitude_of(1.5) == 521.5
    assert MapFrame(48.0, 11.0, altitude_m=520.0).altitude_of(math.nan) is None
