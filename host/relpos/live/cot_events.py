"""Members of the team as Cursor-on-Target events, for ATAK, WinTAK and TAK servers.

The attributes of an event (base schema 2.0), and what this project puts there:

- ``uid`` is the member's in every session; an emergency's has ``-9-1-1`` added, as in ATAK;
- ``type`` a-f-G-U-C, a friendly unit on the ground; a-f-G-I, an installation, the command post's
  node, which nobody wears; b-a-o-tbl an emergency, b-a-o-can its end;
- ``how`` m-g while the position is measured and fresh: TAK clients show a moving member.
  h-e, estimated, where it is ambiguous or the member is stale or lost. m-s, simulated, and
  EXERCISE in the remarks, where the team is emulated or replayed;
- ``start`` is when the member was last received, ``stale`` ``STALE_S`` later: clients grey it out;
- ``ce`` and ``le`` are the radius, and the height up and down, that hold the member with 90 %
  probability (CE90 and LE90, as TAK's clients take them), of the relative position alone: the
  pin's own error comes on top;
- ``hae`` is known where the pin has an altitude; 9999999 stands for unknown.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from relpos.geodesy import MapFrame
from relpos.live.team_view import Alert, Person, TeamView

STALE_S = 15.0
"""Nodes report every second and count as lost after ten: then TAK clients grey the member out."""
ALARM_STALE_S = 600.0
LAST_KNOWN = "b-m-p-s-m"
"""A spot on the map."""
DELETION = "t-x-d-d"
LAST_KNOWN_STALE_S = 86_400.0
"""An emergency is not forgotten because the link to the server broke."""
MEMBER = "a-f-G-U-C"
POST = "a-f-G-I"
EMERGENCY = "b-a-o-tbl"
EMERGENCY_OVER = "b-a-o-can"
UNKNOWN = "9999999.0"
DECIMALS = 8
"""Of latitude and longitude: millimetres. pytak's own default, four, is eleven metres."""

_NORMAL_90 = 1.6448536269514722
"""Two-sided 90 % of a normal distribution, in standard deviations."""
_NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True)
class Moved:
    """Position of a member at its last event, from which its speed follows."""

    time_s: float
    x_m: float
    y_m: float


@dataclass(frozen=True)
class Events:
    """Makes the events of a team; ``prefix`` keeps teams on one server apart."""

    prefix: str
    exercise: bool = False

    def uid(self, node: int) -> str:
        """Return the member's uid, the same in every session of this team."""
        return f"{self.prefix}.{node}"

    def member(
        self,
        person: Person,
        view: TeamView,
        frame: MapFrame,
        *,
        sigma_z_m: float | None = None,
        before: Moved | None = None,
    ) -> ET.Element | None:
        """Return the event of one member; None while its position is unknown or never received."""
        if person.seen_s is None or not is_located(person):
            return None
        fresh = person.status == "ok"
        seen_unix_s = view.unix_s - person.seen_s
        details = [
            ET.Element("contact", callsign=text(person.name)),
            ET.Element("uid", Droid=text(person.name)),
            ET.Element("__group", name="Red", role="HQ" if person.post else "Team Member"),
            self._remarks(person),
        ]
        if person.heading_rad is not None and fresh:
            course, speed = frame.course_deg(person.heading_rad), _speed(person, before)
            details.append(ET.Element("track", course=f"{course:.1f}", speed=f"{speed:.2f}"))
        event = self._event(
            self.uid(person.node),
            POST if person.post else MEMBER,
            "m-g" if fresh else "h-e",
            _point(person, frame, sigma_z_m),
            details,
        )
        return _timed(event, view.unix_s, seen_unix_s, seen_unix_s + STALE_S)

    def emergency(
        self,
        person: Person,
        view: TeamView,
        frame: MapFrame,
        *,
        over: bool = False,
        sigma_z_m: float | None = None,
    ) -> ET.Element:
        """Return the event that a member lies still, or with ``over`` does so no longer.

        A member without a position is placed at the pin, with an unknown error.
        """
        name = text(person.name)
        tag = ET.Element("emergency", {"cancel": "true"} if over else {"type": "911 Alert"})
        tag.text = name
        event = self._event(
            f"{self.uid(person.node)}-9-1-1",
            EMERGENCY_OVER if over else EMERGENCY,
            "m-g" if person.status == "ok" else "h-e",
            _point(person, frame, sigma_z_m),
            [
                ET.Element("link", uid=self.uid(person.node), type=MEMBER, relation="p-p"),
                ET.Element("contact", callsign=f"{name}-Alert"),
                tag,
                self._remarks(person),
            ],
        )
        now_s = view.unix_s
        return _timed(event, now_s, now_s, now_s + (STALE_S if over else ALARM_STALE_S))

    def last_known(
        self, person: Person, view: TeamView, frame: MapFrame, *, over: bool = False
    ) -> ET.Element:
        """Return a marker at a lost member's last known place, or with ``over`` its deletion.

        Clients delete a member some minutes after it is stale; the marker stays for a day.
        """
        uid = f"{self.uid(person.node)}-last"
        seen_unix_s = view.unix_s - (person.seen_s or 0.0)
        seen = datetime.fromtimestamp(seen_unix_s).astimezone().strftime("%H:%M:%S")
        details = [
            ET.Element("contact", callsign=text(f"{person.name}, last known {seen}")),
            ET.Element("link", uid=uid if over else self.uid(person.node), type=MEMBER,
                       relation="none" if over else "p-p"),
            self._remarks(person),
        ]  # fmt: skip
        if over:
            details.append(ET.Element("__forcedelete"))
        kind = DELETION if over else LAST_KNOWN
        event = self._event(uid, kind, "h-e", _point(person, frame, None), details)
        now_s = view.unix_s
        return _timed(event, now_s, now_s, now_s + (STALE_S if over else LAST_KNOWN_STALE_S))

    def _event(
        self, uid: str, kind: str, how: str, point: ET.Element, details: Sequence[ET.Element]
    ) -> ET.Element:
        import pytak

        event: ET.Element = pytak.cot_event(
            uid=uid,
            cot_type=kind,
            how="m-s" if self.exercise else how,
            point=point,
            detail=pytak.cot_detail(*details, flow_tag=False),
        )
        return event

    def _remarks(self, person: Person) -> ET.Element:
        """Return the remarks: what the symbol cannot show."""
        words = []
        if self.exercise:
            words.append("EXERCISE")
        if person.alert is Alert.MAYDAY:
            words.append("MAYDAY")
        if person.alert is Alert.STILL_ALARM:
            words.append(f"LIES STILL for {person.still_s:.0f} s")
        if person.alert is Alert.FALL:
            words.append("FELL")
        if person.floor is not None:
            words.append(f"floor {person.floor}")
        if not is_located(person):
            words.append("position unknown")
        elif person.status == "ambiguous":
            words.append("position ambiguous")
        elif person.status in ("stale", "lost"):
            words.append(f"{person.status}: last heard {person.seen_s or 0.0:.0f} s ago")
        remarks = ET.Element("remarks")
        remarks.text = text("; ".join([*words, *person.reasons]))
        return remarks


def serialized(event: ET.Element) -> bytes:
    """Return the event as it goes over the wire."""
    import pytak

    data: bytes = pytak.serialize_cot(event, trailing_newline=True)
    return data


def circle_90_m(sigma_major_m: float, sigma_minor_m: float) -> float:
    """Return the radius around the centre of a normal distribution that holds 90 % of it."""
    if sigma_major_m <= 0.0:
        return 0.0
    ratios, radii = _circles()
    return sigma_major_m * float(np.interp(sigma_minor_m / sigma_major_m, ratios, radii))


@cache
def _circles() -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """The radius for a long axis of 1 by the ratio of the axes, (n,), (n,)."""
    ratios = np.linspace(0.0, 1.0, 41)
    radii = np.full(ratios.shape, _NORMAL_90)
    angles = (np.arange(4000) + 0.5) * (0.5 * math.pi / 4000)
    c2, s2 = np.cos(angles) ** 2, np.sin(angles) ** 2
    for k, ratio in enumerate(ratios[1:], start=1):
        # In a direction the distribution is Rayleigh with this width, and of this density.
        width = c2 + s2 / ratio**2
        low, high = _NORMAL_90, 2.2
        for _ in range(40):
            middle = 0.5 * (low + high)
            inside = 1.0 - float(np.mean(np.exp(-0.5 * middle**2 * width) / (ratio * width)))
            low, high = (middle, high) if inside < 0.9 else (low, middle)
        radii[k] = low
    return ratios, radii


def text(value: str) -> str:
    """Return a name without the characters that XML cannot hold."""
    return _NOT_XML.sub("", value)


def is_located(person: Person) -> bool:
    """Return whether a member has a position, certain or not."""
    return person.x_m is not None and person.y_m is not None and person.status != "unlocated"


def _point(person: Person, frame: MapFrame, sigma_z_m: float | None) -> ET.Element:
    import pytak

    if not is_located(person):
        point: ET.Element = pytak.cot_point(
            frame.latitude_deg, frame.longitude_deg, precision=DECIMALS
        )
        return point
    latitude, longitude = frame.to_map(person.x_m, person.y_m)
    height_m = frame.altitude_of(math.nan if person.z_m is None else person.z_m)
    known: Mapping[str, Any] = {
        "ce": None
        if person.sigma_major_m is None or person.sigma_minor_m is None
        else f"{max(circle_90_m(person.sigma_major_m, person.sigma_minor_m), 0.1):.1f}",
        "hae": None if height_m is None else f"{height_m:.1f}",
        "le": None
        if height_m is None or not sigma_z_m or not math.isfinite(sigma_z_m)
        else f"{max(_NORMAL_90 * sigma_z_m, 0.1):.1f}",
    }
    there: ET.Element = pytak.cot_point(
        float(latitude), float(longitude), **known, precision=DECIMALS
    )
    return there


def _speed(person: Person, before: Moved | None) -> float:
    if not person.moving or before is None or person.motion_s is None:
        return 0.0
    passed_s = person.motion_s - before.time_s
    if passed_s <= 0.0 or person.x_m is None or person.y_m is None:
        return 0.0
    return math.hypot(person.x_m - before.x_m, person.y_m - before.y_m) / passed_s


def _timed(event: ET.Element, now_s: float, start_s: float, stale_s: float) -> ET.Element:
    for name, unix_s in (("time", now_s), ("start", start_s), ("stale", stale_s)):
        at = datetime.fromtimestamp(unix_s, UTC)
        event.set(name, at.strftime("%Y-%m-%dT%H:%M:%S.%fZ"))
    return event
