"""Putting the team's plane on a map: pinned positions, and the plane between world and WGS84.

The team has a frame of its own: x, y in metres from an origin, headings from x. A *pin* says
where one point of it is on Earth. Together with the compass bearing of world x, or with a second
pin, that places everything else on the plane that touches WGS84's ellipsoid at the pin. Within
a kilometre the plane is true to a hundredth of a millimetre.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from relpos.errors import DataError
from relpos.extras import missing_extra

Floats = npt.NDArray[np.float64]

PIN_GRAMMAR = "LAT,LON[,BEARING[,ALTITUDE]][@X,Y or @NODE[:TIME]]"

EAST_RAD = math.pi / 2.0
"""The default bearing of world x: x is east-like, y north-like."""

FARTHEST_M = 100_000.0
"""The plane is 8 m off at this distance, and a position further off is a mistake."""


@dataclass(frozen=True)
class Pin:
    """A point of the team's plane whose place on Earth is known.

    The point is ``place_m`` in world coordinates, or where ``node`` was at ``time_s`` (None: where
    it was first located). ``bearing_rad`` is the compass bearing, clockwise from true north, that
    world x points to; ``altitude_m`` the height of the team's z = 0 over WGS84's ellipsoid.
    """

    latitude_deg: float
    longitude_deg: float
    bearing_rad: float | None = None
    altitude_m: float | None = None
    place_m: tuple[float, float] = (0.0, 0.0)
    node: int | None = None
    time_s: float | None = None


Locate = Callable[[int, float | None], tuple[float, float] | None]
"""Returns a node's position at a time, or its first (None), in world metres; None if unknown."""


def parse_pin(text: str) -> Pin:
    """Read a pin in ``PIN_GRAMMAR``, degrees, metres and seconds; DataError says what is wrong."""
    where, at, anchor = text.partition("@")
    numbers = [_number(text, part) for part in where.split(",")]
    if not 2 <= len(numbers) <= 4:
        raise _wrong(text, f"{PIN_GRAMMAR} is wanted")
    latitude_deg, longitude_deg, *rest = numbers
    # At the pole itself there is no bearing to give.
    if not -90.0 < latitude_deg < 90.0:
        raise _wrong(text, f"latitude {latitude_deg:g} is not between -90 and 90")
    if not -180.0 <= longitude_deg <= 180.0:
        raise _wrong(text, f"longitude {longitude_deg:g} is not between -180 and 180")
    bearing_rad = math.radians(rest[0]) if rest else None
    altitude_m = rest[1] if len(rest) > 1 else None
    pin = (latitude_deg, longitude_deg, bearing_rad, altitude_m)
    if not at:
        return Pin(*pin)
    if "," in anchor:
        place = [_number(text, part) for part in anchor.split(",")]
        if len(place) != 2:
            raise _wrong(text, "@X,Y takes two numbers, in metres")
        return Pin(*pin, place_m=(place[0], place[1]))
    node, colon, time = anchor.partition(":")
    if not re.fullmatch(r"[0-9]+", node.strip()):
        raise _wrong(text, f"{node.strip()!r} is no node id")
    return Pin(*pin, node=int(node), time_s=_number(text, time) if colon else None)


def _number(pin: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise _wrong(pin, f"{text.strip()!r} is not a number; {PIN_GRAMMAR} is wanted") from None
    if not math.isfinite(value):
        raise _wrong(pin, f"{text.strip()!r} is not a finite number")
    return value


def _wrong(pin: str, words: str) -> DataError:
    return DataError(f"pin {pin}: {words}")


@dataclass(frozen=True)
class MapFrame:
    """The plane that touches the ellipsoid at ``place_m`` of the world, turned by the bearing."""

    latitude_deg: float
    longitude_deg: float
    bearing_rad: float = EAST_RAD
    altitude_m: float | None = None
    place_m: tuple[float, float] = (0.0, 0.0)

    def to_map(self, x_m: Any, y_m: Any) -> tuple[Floats, Floats]:
        """Return WGS84 latitudes and longitudes in degrees of world positions in metres."""
        geodesy = _library()
        dx, dy = np.asarray(x_m, float) - self.place_m[0], np.asarray(y_m, float) - self.place_m[1]
        s, c = math.sin(self.bearing_rad), math.cos(self.bearing_rad)
        latitude, longitude, _ = geodesy.enu2geodetic(
            dx * s - dy * c, dx * c + dy * s, np.zeros_like(dx), *self._origin()
        )
        return np.asarray(latitude, float), np.asarray(longitude, float)

    def to_world(self, latitude_deg: Any, longitude_deg: Any) -> tuple[Floats, Floats]:
        """Return world positions in metres of WGS84 positions; DataError for one far away."""
        geodesy = _library()
        latitude = np.asarray(latitude_deg, float)
        east, north, up = geodesy.geodetic2enu(
            latitude, np.asarray(longitude_deg, float), np.zeros_like(latitude), *self._origin()
        )
        east, north, up = (np.asarray(part, float) for part in (east, north, up))
        # What is behind the horizon has a small shadow on the plane, and a large depth.
        far_m = float(np.max(np.sqrt(east**2 + north**2 + up**2), initial=0.0))
        if far_m > FARTHEST_M:
            raise DataError(
                f"a position is {far_m / 1000.0:.0f} km from the pin "
                f"{self.latitude_deg:g},{self.longitude_deg:g}: are latitude and longitude swapped?"
            )
        s, c = math.sin(self.bearing_rad), math.cos(self.bearing_rad)
        return east * s + north * c + self.place_m[0], north * s - east * c + self.place_m[1]

    def altitude_of(self, z_m: float) -> float | None:
        """Return the height over the ellipsoid of a height in the team's frame; None if unknown."""
        if self.altitude_m is None or not math.isfinite(z_m):
            return None
        return self.altitude_m + z_m

    def course_deg(self, heading_rad: float) -> float:
        """Return the compass course, clockwise from true north in [0, 360), of a heading."""
        return math.degrees(self.bearing_rad - heading_rad) % 360.0

    def _origin(self) -> tuple[float, float, float]:
        # The plane lies on the ellipsoid: heights are added beside it, not along its normal.
        return self.latitude_deg, self.longitude_deg, 0.0


@dataclass(frozen=True)
class Placing:
    """A frame, and what there is to say of how it came about."""

    frame: MapFrame
    remarks: tuple[str, ...] = ()


def place(pins: Sequence[Pin], locate: Locate) -> Placing:
    """Turn pins into one frame: one pin with a bearing, or several that give it together.

    With several, the best turn and shift count, and a remark states the residual. DataError where a
    pinned node was not there, or the pins contradict what they are for.
    """
    if not pins:
        raise DataError("no pin: nothing says where on the map the picture lies")
    places = [_place_of(pin, locate) for pin in pins]
    if len(pins) == 1:
        pin = pins[0]
        bearing_rad = EAST_RAD if pin.bearing_rad is None else pin.bearing_rad
        frame = MapFrame(
            pin.latitude_deg, pin.longitude_deg, bearing_rad, pin.altitude_m, places[0]
        )
        assumed = "the pin has no bearing: world x is taken to point east (a second pin sets it)"
        return Placing(frame, (assumed,) * (pin.bearing_rad is None))
    if any(pin.bearing_rad is not None for pin in pins):
        raise DataError("several pins give the bearing together: leave it out of each")
    return _fit(pins, np.array(places))


def _place_of(pin: Pin, locate: Locate) -> tuple[float, float]:
    if pin.node is None:
        return pin.place_m
    found = locate(pin.node, pin.time_s)
    if found is None:
        when = "ever" if pin.time_s is None else f"at {pin.time_s:g} s"
        raise DataError(f"the pin's node {pin.node} was not located {when}")
    return found


def _fit(pins: Sequence[Pin], places_m: Floats) -> Placing:
    from relpos.tracks import align

    first = MapFrame(pins[0].latitude_deg, pins[0].longitude_deg)
    on_map_m = np.column_stack(
        first.to_world([p.latitude_deg for p in pins], [p.longitude_deg for p in pins])
    )
    for points_m, where in ((places_m, "in the picture"), (on_map_m, "on the map")):
        if float(np.ptp(points_m, axis=0).max()) < 1.0:
            raise DataError(f"the pins are at one place {where}: they give no bearing")
    fitted = align(places_m, on_map_m)
    missed_m = float(np.sqrt(((fitted(places_m) - on_map_m) ** 2).sum(axis=1)).max())
    # The plane stays where the fit was made: north turns with the longitude.
    c, s = fitted.cosine, fitted.sine
    to_x_m, to_y_m = (float(v) for v in fitted.to_m)
    x_m, y_m = (float(v) for v in fitted.from_m)
    frame = replace(
        first,
        bearing_rad=EAST_RAD - fitted.angle_rad,
        altitude_m=next((p.altitude_m for p in pins if p.altitude_m is not None), None),
        place_m=(x_m - c * to_x_m - s * to_y_m, y_m + s * to_x_m - c * to_y_m),
    )
    course = math.degrees(frame.bearing_rad) % 360.0
    return Placing(
        frame,
        (f"world x points to {course:.1f} deg; the pins fit to within {missed_m:.2f} m",),
    )


def _library() -> Any:
    try:
        import pymap3d
    except ImportError:
        raise missing_extra("pymap3d", "exchange") from None
    return pymap3d
