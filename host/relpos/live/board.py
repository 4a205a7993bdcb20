"""The accountability board: who is in since when, roll calls, MAYDAYs, evacuations.

The board knows what people have said and entered, nothing that was measured: a roll call is
answered by people, never by a node. Its state follows from its events alone, so that a mission's
journal gives it back; a request that makes no sense is refused with a sentence and changes nothing.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from relpos.said import Said, joined

STATES = ("", "standby", "entered", "withdrawing", "out")
"""Empty: nobody has said; alarms are raised as for somebody who is in."""
WAITING = ("standby", "out")
"""Whoever is not in may sit still."""
TEXTS = ("team", "sector", "task")
MAX_TEXT = 40
MAX_AIR_BAR = 400.0
ROLL_CALL_S = 900.0
_COUNTS = {"whom": "", "confirmed": 0, "missing": 0, "called": 0}
OUTCOMES = {
    "complete": Said(
        "roll-complete",
        "{whom}roll call complete: {confirmed} confirmed, {missing} missing of {called}",
        **_COUNTS,
    ),
    "incomplete": Said(
        "roll-incomplete",
        "{whom}roll call incomplete: {confirmed} confirmed, {missing} missing of {called}",
        **_COUNTS,
    ),
    "missing": Said(
        "roll-missing",
        "{whom}roll call missing: {confirmed} confirmed, {missing} missing of {called}",
        **_COUNTS,
    ),
}
STATE_WORDS = {
    "standby": Said("standby", "{whom}state standby", whom=""),
    "entered": Said("entered", "{whom}state entered", whom=""),
    "withdrawing": Said("withdrawing", "{whom}state withdrawing", whom=""),
    "out": Said("out", "{whom}state out", whom=""),
}
BOARD_EVENTS: Mapping[str, tuple[str, ...]] = {
    "board": ("node", *TEXTS, "state", "air_bar"),
    "rollcall": ("action", "node", "nodes", "answer", "within_s", "emergency"),
    "mayday": ("node", "on", "id"),
    "evacuate": ("action", "node", "nodes"),
    "marker": ("action", "id", "sign", "x_m", "y_m", "node"),
    "plan": ("action", "image", "points"),
    "floor": ("floor", "name"),
}
"""Kind -> what a request of it may say; who asks is added."""
EDITS = {
    "team": Said("edit-team", "team {text}", text=""),
    "sector": Said("edit-sector", "sector {text}", text=""),
    "task": Said("edit-task", "task {text}", text=""),
    "state": Said("edit-state", "state {text}", text=""),
    "air_bar": Said("edit-air", "air {text} bar", text=""),
}
SIGNS = {
    "entrance": Said("marked-entrance", "{whom}marker set: entrance", whom=""),
    "exit": Said("marked-exit", "{whom}marker set: exit", whom=""),
    "hydrant": Said("marked-hydrant", "{whom}marker set: hydrant", whom=""),
    "hazard": Said("marked-hazard", "{whom}marker set: hazard", whom=""),
    "found": Said("marked-found", "{whom}marker set: found", whom=""),
}
MOST_MARKERS = 500
FARTHEST_M = 1e5
IMAGE = r"[\w-]{1,40}\.(png|jpg|webp)"
MOST_FLOORS = 100


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
    """An order to leave: given by radio, by the nodes' LEDs and on the wearers' phones.

    ``lit``: when a node confirmed its LED, ``delivered``: when a phone showed it. People answer.
    """

    unix_s: float
    by: str
    nodes: list[int]
    lit: dict[int, float] = field(default_factory=dict)
    delivered: dict[int, float] = field(default_factory=dict)
    acknowledged: dict[int, dict[str, Any]] = field(default_factory=dict)


@dataclass
class Marker:
    """A sign on the map, in the common frame."""

    sign: str
    x_m: float
    y_m: float
    by: str
    unix_s: float


@dataclass
class Plan:
    """An image under the map; each point is its pixel (right, down) and its place on the map."""

    image: str
    points: list[list[float]] = field(default_factory=list)


@dataclass
class Board:
    """The board; see the module."""

    people: dict[int, Place] = field(default_factory=dict)
    mayday: dict[int, dict[str, Any]] = field(default_factory=dict)
    mayday_ids: set[str] = field(default_factory=set)
    """The ids of the MAYDAYs that were called: a phone repeats its call until it has an answer."""
    roll_call: RollCall | None = None
    evacuation: Evacuation | None = None
    markers: dict[str, Marker] = field(default_factory=dict)
    plan: Plan | None = None
    floors: dict[int, str] = field(default_factory=dict)
    """What people call a floor; 0 is the start's."""

    def to_message(self) -> dict[str, Any]:
        """Return the message ``board`` of the page's protocol."""
        message = {"type": "board", **asdict(self)}
        del message["mayday_ids"]
        return message

    @property
    def called_out(self) -> list[int]:
        """The people who are to leave, and have not said that they understand."""
        order = self.evacuation
        return [] if order is None else [n for n in order.nodes if n not in order.acknowledged]

    @property
    def waiting(self) -> set[int]:
        """The people who are not in."""
        return {node for node, place in self.people.items() if place.state in WAITING}

    def apply(self, event: Mapping[str, Any]) -> Said | None:
        """Apply an event; return what to log, None for what is not worth a line. BoardError."""
        do: Callable[[Mapping[str, Any]], Said | None] = getattr(self, f"_{event['kind']}")
        try:
            return do(event)
        except BoardError:
            raise
        except KeyError as error:
            raise BoardError(f"{error.args[0]}: is missing") from None
        except (TypeError, ValueError, OverflowError):
            raise BoardError(f"{event['kind']}: a value is of the wrong type") from None

    def _board(self, event: Mapping[str, Any]) -> Said | None:
        place = self.people.get(event["node"], Place())
        changes = {name: event[name] for name in (*TEXTS, "state", "air_bar") if name in event}
        for name in TEXTS:
            text = changes.get(name, "")
            if not isinstance(text, str) or len(text) > MAX_TEXT or not text.isprintable():
                raise BoardError(
                    Said(
                        "long-text",
                        "{field}: not at most {most} printable characters",
                        field=name,
                        most=MAX_TEXT,
                    )
                )
        if changes.get("state", "") not in STATES:
            raise BoardError(f"state: none of {', '.join(STATES[1:])}")
        air = changes.get("air_bar")
        if air is not None and not (type(air) in (int, float) and 0.0 <= air <= MAX_AIR_BAR):
            raise BoardError(Said("air", "air: not from 0 to {most:.0f} bar", most=MAX_AIR_BAR))
        self.people[event["node"]] = place
        for name, value in changes.items():
            setattr(place, name, value)
        if "air_bar" in changes:
            place.air_unix_s = event["unix_s"]
        if changes.get("state") == "entered" and place.entered_unix_s is None:
            place.entered_unix_s = event["unix_s"]
        elif changes.get("state") in WAITING:
            place.entered_unix_s = None
        if list(changes) == ["state"] and changes["state"]:
            return STATE_WORDS[changes["state"]]
        if not changes:
            return None
        edits = [EDITS[name].filled(text=str(value)) for name, value in changes.items()]
        return Said("edited", "{whom}{changes}", whom="", changes=joined(edits))

    def _rollcall(self, event: Mapping[str, Any]) -> Said:
        call, action = self.roll_call, event.get("action")
        if action == "start":
            nodes = _nodes(event["nodes"])
            within_s = _number(event.get("within_s", ROLL_CALL_S))
            if not 0.0 < within_s <= 7200.0:
                raise BoardError("within_s: not from 0 to 7200 s")
            emergency = bool(event.get("emergency"))
            self.roll_call = RollCall(event["unix_s"], within_s, event["by"], emergency, nodes)
            if emergency:
                return Said(
                    "emergency-roll",
                    "{whom}emergency roll call of {count}",
                    whom="",
                    count=len(nodes),
                )
            return Said("roll", "{whom}roll call of {count}", whom="", count=len(nodes))
        if call is None or call.ended_unix_s is not None:
            raise BoardError(Said("no-roll", "no roll call is under way"))
        if action == "answer":
            if (
                event.get("answer") not in ("confirmed", "missing")
                or event["node"] not in call.nodes
            ):
                raise BoardError("answer: confirmed or missing, of somebody who is called")
            call.answers[event["node"]] = {
                "answer": event["answer"], "by": event["by"], "unix_s": event["unix_s"],
            }  # fmt: skip
            if event["answer"] == "confirmed":
                return Said("confirmed", "{whom}roll call: confirmed", whom="")
            return Said("missing-person", "{whom}roll call: missing", whom="")
        if action != "end":
            raise BoardError("action: start, answer or end")
        said = [call.answers.get(node, {}).get("answer") for node in call.nodes]
        call.ended_unix_s = event["unix_s"]
        call.outcome = (
            "complete" if all(answer == "confirmed" for answer in said)
            else "incomplete" if None in said else "missing"
        )  # fmt: skip
        return OUTCOMES[call.outcome].filled(
            confirmed=said.count("confirmed"), missing=said.count("missing"), called=len(said)
        )

    def _marker(self, event: Mapping[str, Any]) -> Said | None:
        name = _id(event["id"])
        if event.get("action") == "remove":
            if self.markers.pop(name, None) is None:
                raise BoardError(Said("no-marker", "no such marker"))
            return Said("unmarked", "{whom}marker removed", whom="")
        if event.get("sign") not in list(SIGNS) or event.get("action") != "set":
            raise BoardError(f"sign: none of {', '.join(SIGNS)}")
        if name in self.markers:
            if self.markers[name].sign != event["sign"]:
                raise BoardError("id: another marker has it")
            return None  # Asked again, as a phone does that has had no answer.
        if len(self.markers) >= MOST_MARKERS:
            raise BoardError(Said("many-markers", "more than {most} markers", most=MOST_MARKERS))
        x_m, y_m = _numbers([event.get("x_m"), event.get("y_m")])
        self.markers[name] = Marker(event["sign"], x_m, y_m, event["by"], event["unix_s"])
        return SIGNS[event["sign"]]

    def _plan(self, event: Mapping[str, Any]) -> Said | None:
        action = event.get("action")
        if action == "set":
            image = event["image"]
            if not isinstance(image, str) or not re.fullmatch(IMAGE, image, re.ASCII):
                raise BoardError("image: not the name of an image")
            self.plan = Plan(image)
            return Said("plan", "{whom}a plan lies under the map", whom="")
        # A page may have measured on the one before.
        if self.plan is None or event.get("image", self.plan.image) != self.plan.image:
            raise BoardError(Said("without-plan", "there is no plan"))
        if action == "remove":
            self.plan = None
            return Said("no-plan", "{whom}the plan is removed", whom="")
        points = event.get("points")
        if action != "align" or not isinstance(points, list) or len(points) > 3:
            raise BoardError("action: set, align (with two or three points) or remove")
        self.plan.points = [_numbers(point, 4) for point in points]
        return Said("aligned", "{whom}the plan is aligned", whom="") if len(points) > 1 else None

    def _floor(self, event: Mapping[str, Any]) -> Said:
        floor, name = event.get("floor"), event.get("name")
        if type(floor) is not int or abs(floor) > MOST_FLOORS:
            raise BoardError(f"floor: not a number from -{MOST_FLOORS} to {MOST_FLOORS}")
        if not isinstance(name, str) or len(name) > MAX_TEXT or not (name + " ").isprintable():
            raise BoardError(f"name: not at most {MAX_TEXT} printable characters")
        if name.strip():
            self.floors[floor] = name.strip()
            words = Said("floor-named", "{whom}floor {floor} is {name}", whom="", floor="", name="")
            return words.filled(floor=str(floor), name=name.strip())
        self.floors.pop(floor, None)
        return Said("floor-unnamed", "{whom}floor {floor} has no name", whom="", floor="").filled(
            floor=str(floor)
        )

    def _mayday(self, event: Mapping[str, Any]) -> Said | None:
        if event.get("on"):
            if "id" in event:
                call = _id(event["id"])
                if call in self.mayday_ids:
                    return None  # On its way for long: it may have been ended meanwhile.
                self.mayday_ids.add(call)
            self.mayday[event["node"]] = {"by": event["by"], "unix_s": event["unix_s"]}
            return Said("mayday-of", "{whom}MAYDAY", whom="")
        if self.mayday.pop(event["node"], None) is None:
            raise BoardError(Said("not-mayday", "no MAYDAY of that person"))
        return Said("mayday-over", "{whom}MAYDAY is over", whom="")

    def _evacuate(self, event: Mapping[str, Any]) -> Said | None:
        order, action = self.evacuation, event.get("action")
        if action == "order":
            nodes = _nodes(event["nodes"])
            if order is None:
                order = self.evacuation = Evacuation(event["unix_s"], event["by"], [])
            order.nodes = sorted({*order.nodes, *nodes})
            # Whoever has answered an order before is shown the new one, and asked again.
            for node in order.acknowledged.keys() & set(nodes):
                for said in (order.lit, order.delivered, order.acknowledged):
                    said.pop(node, None)
            text = "{whom}EVACUATE {count}: order by radio, LED and phone"
            return Said("evacuate", text, whom="", count=len(nodes))
        if order is None:
            raise BoardError(Said("no-evacuation", "no evacuation is ordered"))
        if action == "end":
            self.evacuation = None
            return Said("evacuated", "{whom}evacuation is over", whom="")
        if event["node"] not in order.nodes:
            raise BoardError(Said("not-called", "that person is not called out"))
        if action in ("lit", "delivered"):
            times = order.lit if action == "lit" else order.delivered
            times.setdefault(event["node"], event["unix_s"])
            return None
        if action != "acknowledged":
            raise BoardError("action: order, lit, delivered, acknowledged or end")
        order.acknowledged[event["node"]] = {"by": event["by"], "unix_s": event["unix_s"]}
        return Said("understood", "{whom}evacuation understood", whom="")


def _nodes(values: Any) -> list[int]:
    """Return the numbers of nodes in a list, each once. BoardError."""
    if not isinstance(values, list):
        raise BoardError("nodes: not a list")
    return sorted({node for node in values if type(node) is int and 0 < node < 255})


def _id(value: Any) -> str:
    """Return an id that a page made. BoardError."""
    if not isinstance(value, str) or not 0 < len(value) <= MAX_TEXT or not value.isprintable():
        raise BoardError(f"id: not 1 to {MAX_TEXT} printable characters")
    return value


def _number(value: Any) -> float:
    """Return the value as a number; NaN, which is within no bounds, where it is none."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _numbers(values: Any, count: int = 2) -> list[float]:
    """Return that many finite numbers. BoardError."""
    good = isinstance(values, list) and len(values) == count
    if not good or not all(
        isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= FARTHEST_M
        for v in values
    ):
        raise BoardError(f"not {count} numbers up to {FARTHEST_M:.0f}")
    return [float(value) for value in values]
