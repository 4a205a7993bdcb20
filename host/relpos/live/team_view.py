"""The team at one moment, as pages, terminals and programs show it.

Metres, radians counter-clockwise from the common frame's x axis, seconds of the session's arrival
clock; ``unix_s`` is the same moment as Unix time. Unknown values are None, null in JSON. The JSON
is the page's protocol, version 1, in which a view is a message of type ``picture``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from relpos.said import said_of

if TYPE_CHECKING:
    # With the estimators behind it, which the page's process does without.
    from relpos.fusion.estimator import PairEstimate

PROTOCOL = 1
STILL_WARNING_S = 20.0
STILL_ALARM_S = 30.0
"""As PASS devices do (NFPA 1982: pre-alarm after 20 s without motion, alarm after 30 s)."""


POST_NAME = "Command post"


def name_of(node: int, names: Mapping[int, str], posts: Collection[int]) -> str:
    """Return the name that a node was given, or what it is called without one."""
    return names.get(node) or (POST_NAME if node in posts else f"Node {node}")


class Level(StrEnum):
    """How urgent a notice is."""

    INFO = "info"
    WARNING = "warning"
    ALARM = "alarm"


class Alert(StrEnum):
    """Why a wearer may need help."""

    STILL_WARNING = "still_warning"
    STILL_ALARM = "still_alarm"
    FALL = "fall"
    LOST = "lost"
    MAYDAY = "mayday"


@dataclass(frozen=True, slots=True)
class Notice:
    """A message about the session as a whole, shown to every user."""

    id: str
    level: Level
    text: str
    since_s: float


@dataclass(frozen=True, slots=True)
class LogEntry:
    """A line of the session's log: what happened, to whom, by whom.

    ``kind`` is ``note``, ``warning``, ``alarm``, ``cleared``, ``acknowledge``, ``shelve`` or
    ``name``; ``node`` is None where it concerns nobody in particular.
    """

    time_s: float
    unix_s: float
    kind: str
    text: str
    node: int | None = None
    by: str = ""
    said: Mapping[str, Any] | None = None
    """Key and values of the text for pages in other languages (:mod:`relpos.said`)."""


MAX_LOG = 5000
"""Newest lines of the log that a page is given."""


@dataclass(frozen=True, slots=True)
class Person:
    """One node's wearer.

    The pose is the newest (nowcast): it contains all motion up to ``motion_s``. ``status`` is one
    of ``ok``, ``ambiguous``, ``unlocated``, ``stale``, ``lost``; ``episode`` one of ``level``,
    ``up``, ``down``, ``lift``, ``disturbed``, ``falling``; ``floor`` 0 is the start's.
    ``frame_loss`` and ``ranging`` are fractions. ``acknowledged``: a user has confirmed the alert.
    ``shelved_s``: seconds for which the person's alarms are silenced. ``post``: nobody wears the
    node, it lies at the command post.
    """

    node: int
    name: str
    x_m: float | None = None
    y_m: float | None = None
    z_m: float | None = None
    sigma_z_m: float | None = None
    heading_rad: float | None = None
    sigma_major_m: float | None = None
    sigma_minor_m: float | None = None
    sigma_angle_rad: float | None = None
    sigma_heading_rad: float | None = None
    episode: str | None = None
    episode_probability: float | None = None
    floor: int | None = None
    floor_probability: float | None = None
    status: str = "unlocated"
    motion_s: float | None = None
    seen_s: float | None = None
    moving: bool | None = None
    still_s: float = 0.0
    alert: Alert | None = None
    acknowledged: bool = False
    acknowledged_by: str = ""
    shelved_s: float = 0.0
    health: str = "green"
    reasons: tuple[str, ...] = ()
    battery_v: float | None = None
    rssi_dbm: float | None = None
    frame_loss: float | None = None
    ranging: float | None = None
    neighbours: int | None = None
    post: bool = False


@dataclass(frozen=True, slots=True)
class MeasuredRange:
    """The newest range of two nodes, and how long ago it was measured."""

    node: int
    peer: int
    range_m: float
    age_s: float


@dataclass(frozen=True, slots=True)
class GhostPerson:
    """A person in an alternative; for a ring, x and y are the centre, sigma_major_m the radius."""

    node: int
    x_m: float
    y_m: float
    heading_rad: float
    sigma_major_m: float
    sigma_minor_m: float
    sigma_angle_rad: float
    shape: str


@dataclass(frozen=True, slots=True)
class Ghosts:
    """One hypothesis of the team while anything is ambiguous."""

    probability: float
    people: tuple[GhostPerson, ...]


@dataclass(frozen=True)
class TeamView:
    """All people at ``time_s``.

    ``arrived_unix_s`` is the arrival of the newest packet in it; ``fused_s`` the time of the newest
    fused estimate. Pairs have node < peer, among located people. ``north_rad`` is the bearing of
    magnetic north in the common frame, None while its standard deviation is too large.
    """

    seq: int
    time_s: float
    unix_s: float
    arrived_unix_s: float | None = None
    fused_s: float | None = None
    north_rad: float | None = None
    sigma_north_rad: float | None = None
    ambiguous: bool = False
    notices: tuple[Notice, ...] = ()
    people: tuple[Person, ...] = ()
    pairs: tuple[PairEstimate, ...] = ()
    ranges: tuple[MeasuredRange, ...] = ()
    alternatives: tuple[Ghosts, ...] = ()

    def to_json(self) -> str:
        """Return the message ``picture`` of the page's protocol."""
        document = {
            "type": "picture",
            "seq": self.seq,
            "time_s": _plain(self.time_s),
            "unix_s": _plain(self.unix_s),
            "arrived_unix_s": _plain(self.arrived_unix_s),
            "fused_s": _plain(self.fused_s),
            "north_rad": _plain(self.north_rad),
            "sigma_north_rad": _plain(self.sigma_north_rad),
            "ambiguous": self.ambiguous,
            "notices": [
                {**_fields(notice), "said": said_of(notice.text)} for notice in self.notices
            ],
            "people": [
                {**_fields(person), "said": [said_of(reason) for reason in person.reasons]}
                for person in self.people
            ],
            "ranges": [(m.node, m.peer, _plain(m.range_m), round(m.age_s, 2)) for m in self.ranges],
            "alternatives": [
                {
                    "probability": _plain(ghosts.probability),
                    "people": [_fields(person) for person in ghosts.people],
                }
                for ghosts in self.alternatives
            ],
        }
        # Twenty people make 190 pairs, of which few have changed since the last view.
        pairs = ",".join(map(_pair_json, self.pairs))
        return f'{to_json(document)[:-1]},"pairs":[{pairs}]}}'


@lru_cache(maxsize=4096)
def _pair_json(pair: PairEstimate) -> str:
    return _ENCODE([_plain(getattr(pair, name)) for name in pair.__slots__ if name != "status"])


@dataclass(frozen=True)
class Hello:
    """The first message to a page: the session and its limits.

    ``replay``: a recording is played; ``recorded_unix_s`` is the Unix time of its second 0, None
    where it does not say.
    """

    name: str
    source: str
    estimator: str
    started_unix_s: float
    emulated: bool = False
    replay: bool = False
    recorded_unix_s: float | None = None
    live_port: int | None = None
    """Where the mission's page is while its recording is played."""
    mission: bool = False
    """Whether it is of a mission, which goes on after its end."""
    waiting: bool = False
    """Whether no session runs yet: a commander chooses its source on the page."""
    limits: Mapping[str, float] = field(
        default_factory=lambda: {
            "still_warning_s": STILL_WARNING_S,
            "still_alarm_s": STILL_ALARM_S,
        }
    )

    def to_json(self) -> str:
        """Return the message ``hello`` of the page's protocol."""
        session = asdict(self)
        limits = session.pop("limits")
        return to_json(
            {"type": "hello", "protocol": PROTOCOL, "session": session, "limits": limits}
        )


_ENCODE = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode


def to_json(document: Mapping[str, Any]) -> str:
    """Return compact JSON; ValueError for NaN, which browsers cannot parse."""
    return _ENCODE(document)


def _fields(row: Any) -> dict[str, Any]:
    return {name: _plain(getattr(row, name)) for name in row.__slots__}


def _plain(value: Any) -> Any:
    if type(value) is float:
        # To a tenth of a millimetre and of a milliradian.
        return round(value, 4) if math.isfinite(value) else None
    return value
