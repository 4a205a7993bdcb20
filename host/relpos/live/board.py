"""The accountability board: who is in since when, roll calls, MAYDAYs, evacuations.

The board knows what people have said and entered, nothing that was measured: a roll call is
answered by people, never by a node. Its state follows from its events alone, so that a mission's
journal gives it back; a request that makes no sense is refused with a sentence and changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

STATES = ("", "standby", "entered", "withdrawing", "out")
"""Empty: nobody has said; alarms are raised as for somebody who is in."""
WAITING = ("standby", "out")
"""Whoever is not in may sit still."""
TEXTS = ("team", "sector", "task")
MAX_TEXT = 40
MAX_AIR_BAR = 400.0
ROLL_CALL_S = 900.0
BOARD_EVENTS = ("board", "rollcall", "mayday", "evacuate")


class BoardError(ValueError):
    """A request that makes no sense, in words."""


@dataclass
class Place:
    """A person on the board; ``air_bar`` was entered at ``air_unix_s``, and is not measured."""

    team: str = ""
    sector: str = ""
    task: str = ""
    state: str = ""
    entered_unix_s: float | None = None
    air_bar: float | None = None
    air_unix_s: float | None = None


@dataclass
class RollCall:
    """A roll call: ``answers`` are ``confirmed`` or ``missing`` by node, and who has said so."""

    started_unix_s: float
    within_s: float
    by: str
    emergency: bool
    nodes: list[int]
    answers: dict[int, dict[str, Any]] = field(default_factory=dict)
    ended_unix_s: float | None = None
    outcome: str = ""


@dataclass
class Evacuation:
    """An order to leave: given by radio, and shown on the wearers' phones, which answer."""

    unix_s: float
    by: str
    nodes: list[int]
    delivered: dict[int, float] = field(default_factory=dict)
    acknowledged: dict[int, dict[str, Any]] = field(default_factory=dict)


@dataclass
class Board:
    """The board; see the module."""

    people: dict[int, Place] = field(default_factory=dict)
    mayday: dict[int, dict[str, Any]] = field(default_factory=dict)
    roll_call: RollCall | None = None
    evacuation: Evacuation | None = None

    def to_message(self) -> dict[str, Any]:
        """Return the message ``board`` of the page's protocol."""
        return {"type": "board", **asdict(self)}

    @property
    def waiting(self) -> set[int]:
        """The people who are not in."""
        return {node for node, place in self.people.items() if place.state in WAITING}

    def apply(self, event: Mapping[str, Any]) -> str:
        """Apply an event; return what to log, empty for what is not worth a line. BoardError."""
        do: Callable[[Mapping[str, Any]], str] = getattr(self, f"_{event['kind']}")
        try:
            return do(event)
        except BoardError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise BoardError(f"not a request that the board knows: {error!r}") from None

    def _board(self, event: Mapping[str, Any]) -> str:
        place = self.people.get(event["node"], Place())
        changes = {name: event[name] for name in (*TEXTS, "state", "air_bar") if name in event}
        for name in TEXTS:
            text = changes.get(name, "")
            if not isinstance(text, str) or len(text) > MAX_TEXT or not text.isprintable():
                raise BoardError(f"{name}: not at most {MAX_TEXT} printable characters")
        if changes.get("state", "") not in STATES:
            raise BoardError(f"state: none of {', '.join(STATES[1:])}")
        air = changes.get("air_bar")
        if air is not None and not (isinstance(air, int | float) and 0.0 <= air <= MAX_AIR_BAR):
            raise BoardError(f"air_bar: not from 0 to {MAX_AIR_BAR:.0f}")
        self.people[event["node"]] = place
        for name, value in changes.items():
            setattr(place, name, value)
        if "air_bar" in changes:
            place.air_unix_s = event["unix_s"]
        if changes.get("state") == "entered" and place.entered_unix_s is None:
            place.entered_unix_s = event["unix_s"]
        elif changes.get("state") in WAITING:
            place.entered_unix_s = None
        return ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in changes.items())

    def _rollcall(self, event: Mapping[str, Any]) -> str:
        call, action = self.roll_call, event.get("action")
        if action == "start":
            nodes = [node for node in event["nodes"] if isinstance(node, int)]
            within_s = float(event.get("within_s", ROLL_CALL_S))
            if not 0.0 < within_s <= 7200.0:
                raise BoardError("within_s: not from 0 to 7200 s")
            emergency = bool(event.get("emergency"))
            self.roll_call = RollCall(event["unix_s"], within_s, event["by"], emergency, nodes)
            return f"{'emergency ' * emergency}roll call of {len(nodes)}"
        if call is None or call.ended_unix_s is not None:
            raise BoardError("no roll call is under way")
        if action == "answer":
            if (
                event.get("answer") not in ("confirmed", "missing")
                or event["node"] not in call.nodes
            ):
                raise BoardError("answer: confirmed or missing, of somebody who is called")
            call.answers[event["node"]] = {
                "answer": event["answer"], "by": event["by"], "unix_s": event["unix_s"],
            }  # fmt: skip
            return f"roll call: {event['answer']}"
        if action != "end":
            raise BoardError("action: start, answer or end")
        said = [call.answers.get(node, {}).get("answer") for node in call.nodes]
        call.ended_unix_s = event["unix_s"]
        call.outcome = (
            "complete" if all(answer == "confirmed" for answer in said)
            else "incomplete" if None in said else "missing"
        )  # fmt: skip
        counted = f"{said.count('confirmed')} confirmed, {said.count('missing')} missing"
        return f"roll call {call.outcome}: {counted} of {len(said)}"

    def _mayday(self, event: Mapping[str, Any]) -> str:
        if event.get("on"):
            self.mayday[event["node"]] = {"by": event["by"], "unix_s": event["unix_s"]}
            return "MAYDAY"
        if self.mayday.pop(event["node"], None) is None:
            raise BoardError("no MAYDAY of that person")
        return "MAYDAY is over"

    def _evacuate(self, event: Mapping[str, Any]) -> str:
        order, action = self.evacuation, event.get("action")
        if action == "order":
            nodes = [node for node in event["nodes"] if isinstance(node, int)]
            self.evacuation = Evacuation(event["unix_s"], event["by"], nodes)
            return f"EVACUATE {len(nodes)}: order by radio and on phones"
        if order is None:
            raise BoardError("no evacuation is ordered")
        if action == "end":
            self.evacuation = None
            return "evacuation is over"
        if event["node"] not in order.nodes:
            raise BoardError("that person is not called out")
        if action == "delivered":
            order.delivered.setdefault(event["node"], event["unix_s"])
            return ""
        if action != "acknowledged":
            raise BoardError("action: order, delivered, acknowledged or end")
        order.acknowledged[event["node"]] = {"by": event["by"], "unix_s": event["unix_s"]}
        return "evacuation understood"
