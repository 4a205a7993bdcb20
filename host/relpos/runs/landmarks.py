"""Landmark presses as ground truth, and the presses that cannot count."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from relpos.errors import DataError
from relpos.measurements import Event, Truth
from relpos.runs.table import Column, bounded, numbered_rows, read_text

PRESS = "landmark"
"""The event of a press; its value is the landmark's id."""

REPEATED_WITHIN_S = 2.0
"""A second press of the same landmark so soon is the same passing: a button that bounced, or a
wearer in doubt. Who walks on is 2 m further by then, and the truth is where the first was."""

_SHOWN = 3


@dataclass(frozen=True, slots=True)
class Landmark:
    """A surveyed place a wearer can press a button at."""

    landmark: str
    x_m: float
    y_m: float
    z_m: float | None = None


@dataclass(frozen=True)
class Presses:
    """Presses as ``truth``, and the presses left out, by reason."""

    truth: tuple[Truth, ...] = ()
    unknown: tuple[Event, ...] = ()
    """Of landmarks without a survey."""
    repeated: tuple[Event, ...] = ()
    """Within ``REPEATED_WITHIN_S`` after the same node's press of the same landmark."""
    strangers: tuple[Event, ...] = ()
    """By nodes without other data in the run."""

    def remarks(self) -> list[str]:
        """One line for each reason that left presses out; none where all counted."""
        return [
            f"{len(events)} landmark {'press' if len(events) == 1 else 'presses'} left out, "
            f"{why}: {_listed(events)}"
            for events, why in (
                (self.unknown, "of landmarks without a survey"),
                (self.repeated, f"within {REPEATED_WITHIN_S:g} s after the same one"),
                (self.strangers, "by nodes without other data"),
            )
            if events
        ]

    def counters(self) -> dict[str, int]:
        """Return the number left out for each reason, by the names of a run's counters."""
        return {
            "landmarks_unknown": len(self.unknown),
            "landmarks_repeated": len(self.repeated),
            "landmarks_of_strangers": len(self.strangers),
        }


def truth_from_presses(
    landmarks: Sequence[Landmark], events: Iterable[Event], nodes: Collection[int]
) -> Presses:
    """Place every press at its landmark; ``nodes`` are those the run knows (empty: any may be).

    Without landmarks nothing is concluded, and nothing left out.
    """
    places = {landmark.landmark: landmark for landmark in landmarks}
    if not places:
        return Presses()
    truth: list[Truth] = []
    unknown: list[Event] = []
    repeated: list[Event] = []
    strangers: list[Event] = []
    last: dict[int, Event] = {}
    for event in sorted((e for e in events if e.event == PRESS), key=lambda e: e.time_s):
        before = last.get(event.node)
        place = places.get(event.value)
        if nodes and event.node not in nodes:
            strangers.append(event)
        elif place is None:
            unknown.append(event)
        elif (
            before is not None
            and before.value == event.value
            and event.time_s - before.time_s <= REPEATED_WITHIN_S
        ):
            repeated.append(event)
        else:
            truth.append(Truth(event.time_s, event.node, place.x_m, place.y_m, None, place.z_m))
        last[event.node] = event
    return Presses(tuple(truth), tuple(unknown), tuple(repeated), tuple(strangers))


def read_landmarks(path: Path) -> list[Landmark]:
    """Read a table of surveyed landmarks; DataError names line and column of a fault."""
    columns = (
        Column("id", str),
        Column("x_m", bounded("x_m")),
        Column("y_m", bounded("y_m")),
        Column("z_m", bounded("z_m"), optional=True),
    )
    landmarks: dict[str, Landmark] = {}
    for line, cells in numbered_rows(path, read_text(path), columns):
        landmark = Landmark(*cells)
        if landmark.landmark in landmarks:
            raise DataError(f"{path}: line {line}: column id: {landmark.landmark!r} is there twice")
        landmarks[landmark.landmark] = landmark
    return list(landmarks.values())


def _listed(events: Sequence[Event]) -> str:
    shown = [f"{e.value or 'no id'} (node {e.node}, at {e.time_s:.1f} s)" for e in events[:_SHOWN]]
    more = len(events) - len(shown)
    return ", ".join(shown) + f" and {more} more" * bool(more)
