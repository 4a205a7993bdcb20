"""The topics of a recording: what each is called, how it is encoded, and back again.

The same topics go into an MCAP file and to Foxglove's viewer. What people's scripts read is JSON
with a schema, one message a row of the run format, its fields named as the columns are; what
Foxglove draws by itself (:mod:`relpos.recording.scene`) is in Foxglove's own protobuf schemas.
What was received and decoded survives exactly: JSON holds every float in full. Estimates, which a
replay gives again, have nine digits. A value that is not known, or is not a finite number, is
left out.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, get_type_hints

from relpos.fusion.estimator import (
    Alternative,
    Estimate,
    NodeEstimate,
    NodeStatus,
    PairEstimate,
    Parameter,
)
from relpos.measurements import (
    BOUNDS,
    Event,
    Heading,
    Height,
    Motion,
    Observation,
    Range,
    Status,
    Step,
    Truth,
    out_of_bounds,
)
from relpos.runs.landmarks import Landmark
from relpos.runs.table import plain_type

SERIAL = "/serial"
LANDMARK = "/landmark"
TRUTH = "/truth"
GAP = "/gap"
TEAM = "/team"
TRANSFORMS = "/tf"
LOG = "/log"


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic: its name, how its messages are encoded and the schema that says so."""

    name: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes


@dataclass(frozen=True, slots=True)
class Message:
    """One message: when the session had it and what time it speaks of, in Unix time."""

    topic: str
    log_ns: int
    publish_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Serial:
    """Bytes of the serial port as they were read, at ``arrival_s`` of the session."""

    arrival_s: float
    data: bytes


@dataclass(frozen=True, slots=True)
class Gap:
    """Items lost between two times of the session, because the disk did not accept them.

    ``inputs``: reads of the serial port and what phones sent; ``others``: messages that a replay of
    the inputs gives again.
    """

    from_s: float
    to_s: float
    inputs: int
    others: int


Row = Observation | Truth | Landmark | Gap

ROWS: Mapping[type, str] = {
    Motion: "/motion",
    Range: "/range",
    Height: "/height",
    Heading: "/heading",
    Status: "/status",
    Event: "/event",
    Step: "/step",
    Truth: TRUTH,
    Landmark: LANDMARK,
    Gap: GAP,
}
"""Class -> topic of what has a message each."""

LISTS: Mapping[type, str] = {
    NodeEstimate: "/estimate",
    PairEstimate: "/pairs",
    Alternative: "/alternatives",
    Parameter: "/parameters",
}
"""Class -> topic of what an estimate has many of: one message an estimate, ``time_s`` beside."""

LIST_NAMES: Mapping[type, str] = {
    NodeEstimate: "nodes",
    PairEstimate: "pairs",
    Alternative: "alternatives",
    Parameter: "parameters",
}
"""Class -> the list's name, in messages and in :class:`Estimate`."""

DIGITS = 9


class BeyondTimeError(ValueError):
    """A time beyond the bounds of ours, as of a session that has lasted for more than a week."""


ELLIPSE = ("sigma_major_m", "sigma_minor_m", "sigma_angle_rad")
"""Follow from the covariance and are there for plots; not read back."""


PHONE_KINDS = (Event, Heading)
"""Observations that phones send."""


def is_input(observation: Observation) -> bool:
    """Return whether an observation came from a phone, and not from the serial port."""
    return isinstance(observation, Event) or (
        isinstance(observation, Heading) and observation.source == "phone"
    )


# -- to messages -----------------------------------------------------------------------------------


def encode_serial(serial: Serial) -> bytes:
    """One read of the port."""
    return _json(
        {"arrival_s": serial.arrival_s, "data": base64.b64encode(serial.data).decode("ascii")}
    )


def encode_row(row: Row) -> tuple[str, bytes]:
    """Topic and message of an observation, a truth, a landmark or a gap."""
    kind: type = type(row)
    return ROWS[kind], _json(_object(row, names_of(kind)))


def encode_estimate(estimate: Estimate) -> Iterable[tuple[str, bytes]]:
    """Topics and messages of an estimate; what it has nothing of is left out."""
    for kind, topic in LISTS.items():
        rows = getattr(estimate, LIST_NAMES[kind])
        if rows or kind is NodeEstimate:
            names = list_names_of(kind)
            document = {
                "time_s": estimate.time_s,
                LIST_NAMES[kind]: [_rounded(_object(row, names)) for row in rows],
            }
            yield topic, _json(document)


def _object(row: Any, names: Iterable[str]) -> dict[str, Any]:
    values = {name: getattr(row, name) for name in names}
    return {name: value for name, value in values.items() if _is_known(value)}


def _rounded(values: dict[str, Any]) -> dict[str, Any]:
    """Nine digits of each figure: nanometres of a metre, and files two thirds the size."""
    return {
        name: float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
        for name, value in values.items()
    }


def _is_known(value: object) -> bool:
    return value is not None and not (isinstance(value, float) and not math.isfinite(value))


def _json(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode()


@cache
def names_of(kind: type) -> tuple[str, ...]:
    """Return the fields of a class, which are those of its messages."""
    return tuple(field.name for field in fields(kind))


@cache
def list_names_of(kind: type) -> tuple[str, ...]:
    """Return the fields of one entry of a list; its time stands beside the list."""
    names = tuple(name for name in names_of(kind) if name != "time_s")
    return (*names, *ELLIPSE) if kind is NodeEstimate else names


# -- and back --------------------------------------------------------------------------------------

_KIND_OF_TOPIC = {topic: kind for kind, topic in ROWS.items()}
_LIST_OF_TOPIC = {topic: kind for kind, topic in LISTS.items()}


def decode_serial(data: bytes) -> Serial:
    """Undo :func:`encode_serial`; ValueError or KeyError where it is none."""
    document = json.loads(data)
    return Serial(_time_s(document["arrival_s"]), base64.b64decode(document["data"], validate=True))


def _time_s(value: Any) -> float:
    low, high = BOUNDS["time_s"]
    time_s = float(value)
    if not low <= time_s <= high:
        raise BeyondTimeError(f"a time of {time_s:g} s")
    return time_s


def decode_row(topic: str, data: bytes) -> Any:
    """The row that a message holds; None where the topic has no rows, TypeError where it is none.

    What a later version has added is passed over.
    """
    kind = _KIND_OF_TOPIC.get(topic)
    if kind is None:
        return None
    row = _build(kind, json.loads(data))
    beyond = out_of_bounds(row)
    if beyond is not None:
        error = BeyondTimeError if beyond == "time_s" else ValueError
        raise error(f"{beyond} is {getattr(row, beyond):g}")
    return row


def decode_list(topic: str, data: bytes) -> tuple[float, type, tuple[Any, ...]] | None:
    """Time, class and entries of an estimate's message; None where the topic has none."""
    kind = _LIST_OF_TOPIC.get(topic)
    if kind is None:
        return None
    document = json.loads(data)
    time_s = _time_s(document["time_s"])
    entries = document[LIST_NAMES[kind]]
    for entry in entries:
        if "time_s" in names_of(kind):
            entry["time_s"] = time_s
        # The variance of an unlocated node is infinite, which JSON cannot express.
        if entry.get("status") == NodeStatus.UNLOCATED:
            entry.setdefault("variance_x_m2", math.inf)
            entry.setdefault("variance_y_m2", math.inf)
    return time_s, kind, tuple(_build(kind, entry) for entry in entries)


def _build(kind: type, values: Mapping[str, Any]) -> Any:
    known: dict[str, Any] = {}
    for name, (make, missing) in _makers(kind).items():
        # KeyError for what has to be there and is not.
        known[name] = make(values[name]) if name in values or missing is ... else missing
    return kind(**known)


@cache
def _makers(kind: type) -> dict[str, tuple[Any, Any]]:
    """Return how each field is made of its JSON value, and the value for a missing one."""
    makers: dict[str, tuple[Any, Any]] = {}
    for name, hint in get_type_hints(kind).items():
        optional, plain = plain_type(hint)
        missing = None if optional else math.nan if plain is float else ...
        makers[name] = (plain, missing)
    return makers
