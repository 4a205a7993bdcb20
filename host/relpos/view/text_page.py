"""The view of the team as lines of characters: alarms, a table, a small map. Pure.

Words and shapes carry everything; colour only repeats it. Distances and directions are those
from *me*, one of the team; the map has me in its middle. Two character sets: braille and arrows
where the terminal takes UTF-8, plain ASCII where not.
"""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from relpos.live.team_view import Alert, GhostPerson, Level, Person, TeamView

if TYPE_CHECKING:
    from rich.text import Text

HEADING_KNOWN_RAD = math.radians(45.0)
"""With a heading worse than this, left and right of somebody would be a guess."""
SPANS_M = (5.0, 7.5, 10.0, 15.0, 20.0, 30.0, 50.0, 75.0, 100.0, 150.0, 200.0, 300.0, 500.0, 1000.0)
"""How far the map reaches from its middle: steps, so that it does not breathe with every step."""
MIN_MAP_ROWS = 6
BESIDE_COLUMNS = 118
"""From this width on the map stands beside the table."""
TABLE_COLUMNS = 79
PAGE_S = 4.0
"""Where not everybody fits, the table turns its page so often; who needs help stays on top."""
SILENT = frozenset(("stale", "lost"))
"""Where somebody of this status stood and faced is known, not where they do."""
STOREY_M = 1.5
"""Smaller height differences are within one storey."""

_STYLES = {Level.ALARM: "bold reverse red", Level.WARNING: "bold yellow", Level.INFO: ""}
_HEALTH_STYLES = {"green": "", "yellow": "yellow", "red": "bold red"}
_WIDTHS = (3, 10, 12, 12, 6, 11, 5, 80)
_ARROWS = "↑↖←↙↓↘→↗"
_NO_STYLE = ""


@dataclass(frozen=True)
class RenderOptions:
    """How it is to be shown: whose view, the size, and what the terminal can do.

    ``zoom`` counts steps in (positive) or out of the map that holds everybody.
    """

    columns: int = 80
    rows: int = 24
    me: int | None = None
    utf8: bool = True
    zoom: int = 0
    heading_up: bool = False
    table: bool = True
    map: bool = True
    muted: bool = False
    title: str = "relpos"
    trails: Mapping[int, Sequence[tuple[float, float]]] = field(default_factory=dict)


@dataclass(frozen=True)
class _Seen:
    """A person relative to me; None where unknown."""

    distance_m: float | None = None
    sigma_m: float | None = None
    bearing_rad: float | None = None
    """Relative to where I face, counter-clockwise."""
    height_difference_m: float | None = None
    is_last: bool = False
    """One of the two is not heard: it leads to a last known place."""
    ways: tuple[tuple[float, float | None], ...] = ()
    """Distance and bearing in each possible view, the most probable first, where they differ."""


def page(view: TeamView, options: RenderOptions) -> list[Text]:
    """Return exactly ``rows`` lines of at most ``columns`` characters."""
    lines = [_title(view, options), *_alarms(view, options, max(1, options.rows // 4))]
    me = find_me(view, options.me)
    left = options.rows - len(lines) - 1
    beside = options.table and options.map and options.columns >= BESIDE_COLUMNS
    if beside:
        table = _table(view, me, options, left)
        drawn = _map(view, me, options, options.columns - TABLE_COLUMNS - 1, left)
        for k in range(left):
            line = table[k] if k < len(table) else _line("", options)
            line.truncate(TABLE_COLUMNS, overflow="ellipsis" if options.utf8 else "crop")
            line.pad_right(TABLE_COLUMNS + 1 - line.cell_len)
            lines.append(line + drawn[k] if k < len(drawn) else line)
    else:
        wanted = len(view.people) + 1
        rows = left if not options.map else min(wanted, max(left - MIN_MAP_ROWS, 4))
        if options.table:
            lines += _table(view, me, options, rows)
        left = options.rows - len(lines) - 1
        if options.map:
            lines += _map(view, me, options, options.columns, left)
    lines = lines[: options.rows - 1]
    lines += [_line("", options) for _ in range(options.rows - 1 - len(lines))]
    lines.append(_keys(options))
    for line in lines:
        line.truncate(options.columns, overflow="ellipsis" if options.utf8 else "crop")
    return lines


def alarming(view: TeamView) -> frozenset[str | int]:
    """Return what rings the bell: nodes that lie still or are lost, ids of the session's alarms."""
    people: set[str | int] = {person.node for person in unattended(view)}
    return frozenset(people | {n.id for n in view.notices if n.level is Level.ALARM})


def unattended(view: TeamView) -> list[Person]:
    """Return people with an alarm that is not acknowledged, in the order of the page."""
    ranks = (Alert.MAYDAY, Alert.STILL_ALARM, Alert.FALL, Alert.LOST)
    waiting = [p for p in view.people if p.alert in ranks and not p.acknowledged and not p.post]
    return sorted(waiting, key=lambda person: ranks.index(person.alert))


def find_me(view: TeamView, wanted: int | None) -> Person | None:
    """Return the person whose view it is: the wanted one, else the first."""
    people = sorted(view.people, key=lambda person: person.post)
    return next((p for p in people if p.node == wanted), people[0] if people else None)


def _title(view: TeamView, options: RenderOptions) -> Text:
    minutes, seconds = divmod(max(int(view.time_s), 0), 60)
    hours, minutes = divmod(minutes, 60)
    clock = f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes:02d}:{seconds:02d}"
    count = sum(not person.post for person in view.people)
    words = f"{options.title}  {clock}  {count} {'person' if count == 1 else 'people'}"
    if view.fused_s is None:
        words += "  no position yet"
    if options.muted:
        words += "  bell off"
    return _line(words, options, "bold")


def _alarms(view: TeamView, options: RenderOptions, most: int) -> list[Text]:
    """Return at most ``most`` lines of alarms and notices, the worst on top."""
    alarms: list[tuple[int, str, str]] = []
    me = find_me(view, options.me)
    for person in view.people:
        where = _where(person, me, view, options)
        seen = " (seen to)" if person.acknowledged else ""
        match person.alert:
            case Alert.MAYDAY:
                alarms.append((-1, f"!! MAYDAY {person.name}{where}{seen}", _STYLES[Level.ALARM]))
            case Alert.STILL_ALARM:
                lies = "lay still, moves again" if person.moving else _still(person)
                words = f"!! {person.name} {lies}{where}{seen}"
                alarms.append((0 if not seen else 2, words, _STYLES[Level.ALARM]))
            case Alert.FALL:
                words = f"!! {person.name} FELL{where}{seen}"
                alarms.append((0 if not seen else 2, words, _STYLES[Level.ALARM]))
            case Alert.LOST if person.post:
                words = f"! {person.name} is silent for {_ago(person.seen_s)}: no reference"
                alarms.append((3, words, _STYLES[Level.WARNING]))
            case Alert.LOST:
                words = f"!! {person.name} is LOST: silent for {_ago(person.seen_s)}{where}{seen}"
                alarms.append((1 if not seen else 2, words, _STYLES[Level.ALARM]))
            case Alert.STILL_WARNING:
                words = f"! {person.name} has not moved for {person.still_s:.0f} s{where}"
                alarms.append((3, words, _STYLES[Level.WARNING]))
            case None:
                pass
    for notice in view.notices:
        mark, rank = {Level.ALARM: ("!!", 1), Level.WARNING: ("!", 4)}.get(notice.level, ("-", 6))
        alarms.append((rank, f"{mark} {notice.text}", _STYLES[notice.level]))
    if view.ambiguous and view.alternatives:
        percentages = ", ".join(f"{100.0 * g.probability:.0f} %" for g in view.alternatives[:4])
        more = len(view.alternatives) - 4
        percentages += f" and {more} more" * (more > 0)
        words = f"? ambiguous: {len(view.alternatives)} alternatives ({percentages})"
        alarms.append((5, words, _STYLES[Level.WARNING]))
    alarms.sort(key=lambda row: row[0])
    if len(alarms) > most:
        left_out = len(alarms) - most + 1
        alarms[most - 1 :] = [(9, f"... and {left_out} more", "bold")]
    return [_line(words, options, style) for _, words, style in alarms]


def _still(person: Person) -> str:
    return f"LIES STILL for {person.still_s:.0f} s"


def _where(person: Person, me: Person | None, view: TeamView, options: RenderOptions) -> str:
    if me is None or person.node == me.node:
        return ""
    seen = _seen(person, me, view)
    if seen.distance_m is None:
        return ", place unknown"
    direction = _direction(seen, options)
    return f", {seen.distance_m:.0f} m from {me.name}" + f", {direction}" * (direction != "-")


def _table(view: TeamView, me: Person | None, options: RenderOptions, rows: int) -> list[Text]:
    head = _row("#", "who", "distance", "direction", "height", "state", "seen", "health")
    lines = [_line(head, options, "underline")]
    people = sorted(
        view.people,
        key=lambda p: (me is None or p.node != me.node, _urgency(p), p.node),
    )
    room = max(rows - 1, 1)
    if len(people) > room:
        urgent = sum(_urgency(p) < 3 for p in people[1:]) + 1
        stay = min(urgent, max(room - 2, 1))
        turning, places = people[stay:], max(room - stay - 1, 1)
        pages = -(-len(turning) // places)
        shown = int(view.time_s / PAGE_S) % pages
        people = [*people[:stay], *turning[shown * places : (shown + 1) * places]]
        more = f"    page {shown + 1} of {pages}; t shows the table alone"
    else:
        more = ""
    lines += [_person(person, me, view, options) for person in people]
    if more:
        lines.append(_line(more, options, "dim"))
    return lines


def _row(*cells: str) -> str:
    from rich.cells import cell_len, set_cell_size

    row = ""
    for cell, width in zip(cells, _WIDTHS, strict=True):
        fits = cell if cell_len(cell) <= width else f"{set_cell_size(cell, width - 1)}…"
        row += f"{set_cell_size(fits, width)} "
    return row.rstrip()


def _person(person: Person, me: Person | None, view: TeamView, options: RenderOptions) -> Text:
    seen = _Seen() if me is None or person.node == me.node else _seen(person, me, view)
    own = me is not None and person.node == me.node
    health = "ok" if person.health == "green" else ", ".join(person.reasons) or person.health
    height_difference = seen.height_difference_m
    cells = (
        str(person.node),
        person.name,
        "me" if own else _distance(seen, options),
        "-" if own else _direction(seen, options),
        ""
        if height_difference is None or abs(height_difference) < STOREY_M
        else f"{height_difference:+.0f} m",
        _state(person),
        _ago(person.seen_s),
        health,
    )
    style = _HEALTH_STYLES.get(person.health, _NO_STYLE)
    if _urgency(person) < 2:
        style = "bold reverse"
    elif own:
        style = f"bold {style}".strip()
    return _line(_row(*cells), options, style)


def _urgency(person: Person) -> int:
    match person.alert:
        case Alert.MAYDAY:
            return -1
        case Alert.STILL_ALARM | Alert.FALL:
            return 0
        case Alert.LOST:
            return 2 if person.post else 1
        case Alert.STILL_WARNING:
            return 2
    return 3


def _state(person: Person) -> str:
    if person.post:
        return "silent" if person.status in SILENT else "post"
    if person.alert is Alert.LOST or person.status == "lost":
        return "LOST"
    if person.alert is Alert.STILL_ALARM and not person.moving:
        return f"STILL {person.still_s:.0f} s"
    if person.alert is Alert.FALL:
        return "FELL"
    if person.status == "unlocated":
        return "not located"
    if person.status in ("ambiguous", "stale"):
        return person.status
    if person.moving is None:
        return "-"
    return "moving" if person.moving else f"stands {person.still_s:.0f} s"


def _ago(seen_s: float | None) -> str:
    if seen_s is None:
        return "-"
    if seen_s < 60.0:
        return f"{seen_s:.0f} s"
    return f"{seen_s / 60.0:.0f} min" if seen_s < 3600.0 else f"{seen_s / 3600.0:.0f} h"


def _seen(person: Person, me: Person, view: TeamView) -> _Seen:
    """Return distance and direction from me; from the pair where there is one, with its sigma."""
    facing = _facing(me)
    ways = _ways(person.node, me.node, facing, view)
    last = bool({person.status, me.status} & SILENT)
    pair = next((p for p in view.pairs if {p.node, p.peer} == {person.node, me.node}), None)
    height_difference = None if person.z_m is None or me.z_m is None else person.z_m - me.z_m
    if pair is not None:
        bearing = pair.bearing_rad if pair.node == me.node else pair.bearing_rad + math.pi
        vague = math.hypot(pair.sigma_bearing_rad, me.sigma_heading_rad or 0.0) > HEADING_KNOWN_RAD
        relative = None if facing is None or vague else _wrapped(bearing - facing)
        sigma_m = pair.sigma_distance_m
        return _Seen(pair.distance_m, sigma_m, relative, height_difference, last, ways)
    here, there = _xy(me), _xy(person)
    if here is None or there is None:
        return _Seen(height_difference_m=height_difference, is_last=last, ways=ways)
    dx, dy = there[0] - here[0], there[1] - here[1]
    relative = None if facing is None else _wrapped(math.atan2(dy, dx) - facing)
    return _Seen(math.hypot(dx, dy), None, relative, height_difference, last, ways)


def _facing(person: Person) -> float | None:
    """Return where somebody faces now; None while it is not known."""
    known = person.sigma_heading_rad is not None and person.sigma_heading_rad <= HEADING_KNOWN_RAD
    return person.heading_rad if known and person.status not in SILENT and not person.post else None


def _ways(
    node: int, me: int, facing: float | None, view: TeamView
) -> tuple[tuple[float, float | None], ...]:
    """Return how far and whereto somebody is in each possible view, if that differs."""
    found: list[tuple[float, float | None]] = []
    for ghosts in view.alternatives:
        places = {ghost.node: ghost for ghost in ghosts.people}
        a, b = places.get(me), places.get(node)
        if a is None or b is None or "ring" in (a.shape, b.shape):
            continue
        dx, dy = b.x_m - a.x_m, b.y_m - a.y_m
        bearing = _wrapped(math.atan2(dy, dx) - a.heading_rad) if facing is not None else None
        found.append((math.hypot(dx, dy), bearing))
    if len(found) < 2:
        return ()
    first = found[0]
    others = [
        way
        for way in found[1:]
        if abs(way[0] - first[0]) > 2.0 + 0.1 * first[0]
        or (
            way[1] is not None
            and first[1] is not None
            and abs(_wrapped(way[1] - first[1])) > math.radians(30.0)
        )
    ]
    return (first, others[0]) if others else ()


def _xy(person: Person) -> tuple[float, float] | None:
    if person.x_m is None or person.y_m is None or person.status == "unlocated":
        return None
    return person.x_m, person.y_m


def _wrapped(angle_rad: float) -> float:
    return math.remainder(angle_rad, 2.0 * math.pi)


def _distance(seen: _Seen, options: RenderOptions) -> str:
    if seen.ways:
        (first, _), (second, _) = seen.ways
        return f"{first:.0f} or {second:.0f} m"
    if seen.distance_m is None:
        return "-"
    if seen.is_last:
        return f"last {seen.distance_m:.0f} m"
    if seen.sigma_m is None:
        return f"{seen.distance_m:.1f} m"
    # No decimetres where the standard deviation is a metre or more.
    digits = 1 if seen.sigma_m < 1.0 and seen.distance_m < 100.0 else 0
    sign = "±" if options.utf8 else "+-"
    return f"{seen.distance_m:.{digits}f} m {sign}{seen.sigma_m:.{digits}f}"


def _direction(seen: _Seen, options: RenderOptions) -> str:
    if seen.ways:
        first, second = (_arrow(bearing, options) for _, bearing in seen.ways)
        return f"{first} or {second}" if "" not in (first, second) else "-"
    if seen.bearing_rad is None:
        return "-"
    degrees = round(math.degrees(seen.bearing_rad) / 5.0) * 5
    side = "left" if degrees > 0 else "right"
    words = f"{abs(degrees)}{'°' if options.utf8 else ''} {side}"
    if degrees == 0:
        words = "ahead"
    elif abs(degrees) == 180:
        words = "behind"
    return f"{_arrow(seen.bearing_rad, options)} {words}" if options.utf8 else words


def _arrow(bearing_rad: float | None, options: RenderOptions) -> str:
    if bearing_rad is None:
        return ""
    eighth = round(bearing_rad / (math.pi / 4.0)) % 8
    if options.utf8:
        return _ARROWS[eighth]
    return ("ahead", "left", "left", "left", "behind", "right", "right", "right")[eighth]


def _keys(options: RenderOptions) -> Text:
    up = "map up" if options.heading_up else "face up"
    bell = "bell on" if options.muted else "bell off"
    words = f"a seen to  m/M me  +/-/0 zoom  u {up}  t table  c chart  b {bell}  q quit"
    return _line(words, options, "dim")


class Canvas:
    """A field of dots, two by four in a character (braille; one in ASCII), and words over it."""

    def __init__(self, columns: int, rows: int, *, utf8: bool) -> None:
        self.columns, self.rows = columns, rows
        self.width, self.height = 2 * columns, 4 * rows
        self._utf8 = utf8
        self._dots: dict[tuple[int, int], int] = {}
        self._words: dict[tuple[int, int], str] = {}

    def dot(self, x: float, y: float) -> None:
        """Set the dot at x to the right and y down, if it is in the field."""
        column, row = math.floor(x), math.floor(y)
        if 0 <= column < self.width and 0 <= row < self.height:
            bit = (1, 8, 2, 16, 4, 32, 64, 128)[2 * (row % 4) + column % 2]
            cell = (column // 2, row // 4)
            self._dots[cell] = self._dots.get(cell, 0) | bit

    def write(self, x: float, y: float, words: str, *, over: bool = True) -> None:
        """Write words with their first character at a dot; at the border what is beyond it.

        Where there are words already, ``over`` says whether these replace them.
        """
        column = min(max(math.floor(x / 2), 0), self.columns - len(words))
        row = min(max(math.floor(y / 4), 0), self.rows - 1)
        places = [(column + k, row) for k in range(len(words))]
        if over or not any(place in self._words for place in places):
            self._words.update(zip(places, words, strict=True))

    def lines(self) -> list[str]:
        """Return the rows of characters."""
        return [
            "".join(self._character(column, row) for column in range(self.columns))
            for row in range(self.rows)
        ]

    def _character(self, column: int, row: int) -> str:
        words = self._words.get((column, row))
        if words is not None:
            return words
        dots = self._dots.get((column, row), 0)
        if not dots:
            return " "
        return chr(0x2800 + dots) if self._utf8 else "."


def _map(
    view: TeamView, me: Person | None, options: RenderOptions, columns: int, rows: int
) -> list[Text]:
    """Return the map: me in the middle, north (unknown: y) or where I face up, a scale below."""
    if rows < 3:
        return []
    canvas = Canvas(columns, rows - 1, utf8=options.utf8)
    middle = _xy(me) if me is not None else None
    places = {p.node: xy for p in view.people if (xy := _xy(p)) is not None}
    if middle is None and places:
        middle = (
            sum(x for x, _ in places.values()) / len(places),
            sum(y for _, y in places.values()) / len(places),
        )
    if middle is None:
        return [_line("    (no position known yet)", options, "dim")]
    x0, y0 = middle
    turn = 0.0 if view.north_rad is None else 0.5 * math.pi - view.north_rad
    facing = _facing(me) if options.heading_up and me is not None else None
    if facing is not None:
        turn = 0.5 * math.pi - facing
    c, s = math.cos(turn), math.sin(turn)
    span_m = _span_m(canvas, [((x - x0), (y - y0)) for x, y in places.values()], options.zoom, turn)
    dots_per_m = 0.5 * min(canvas.width, canvas.height) / span_m

    def at(x_m: float, y_m: float) -> tuple[float, float]:
        dx, dy = x_m - x0, y_m - y0
        return (
            0.5 * canvas.width + dots_per_m * (c * dx - s * dy),
            0.5 * canvas.height - dots_per_m * (s * dx + c * dy),
        )

    for trail in options.trails.values():
        for x_m, y_m in trail:
            canvas.dot(*at(x_m, y_m))
    for ghosts in view.alternatives:
        for ghost in ghosts.people:
            for point in _outline(ghost):
                canvas.dot(*at(*point))
    for person in view.people:
        if person.node in places and person.status != "ambiguous":
            for point in _outline(person):
                canvas.dot(*at(*point))
    for ghosts in view.alternatives[:4]:
        for ghost in ghosts.people:
            if ghost.shape != "ring" and _is_ambiguous(ghost.node, view):
                canvas.write(*_label(at(ghost.x_m, ghost.y_m), f"{ghost.node}?"), over=False)
    for person in sorted(view.people, key=_urgency, reverse=True):
        if person.node in places and not (person.status == "ambiguous" and view.alternatives):
            mark = {0: "!", 1: "!", 2: "!"}.get(_urgency(person), "")
            words = f"{person.node}{mark}" + _faces(person, turn, options)
            canvas.write(*_label(at(*places[person.node]), words))
    up = "magnetic north" if view.north_rad is not None else "y"
    up = "where I face" if facing is not None else up
    return [
        _line(line, options) for line in (*canvas.lines(), _scale(canvas, dots_per_m, options, up))
    ]


def _label(at: tuple[float, float], words: str) -> tuple[float, float, str]:
    return at[0] - len(words) + 1, at[1], words


def _is_ambiguous(node: int, view: TeamView) -> bool:
    return any(p.node == node and p.status == "ambiguous" for p in view.people)


def _span_m(
    canvas: Canvas, offsets_m: Iterable[tuple[float, float]], zoom: int, turn: float
) -> float:
    """Return how far the shorter side reaches, in steps, so that everybody is within."""
    c, s = math.cos(turn), math.sin(turn)
    least = min(canvas.width, canvas.height)
    wide, high = canvas.width / least, canvas.height / least
    needed_m = max(
        (
            max(abs(c * dx - s * dy) / wide, abs(s * dx + c * dy) / high) * 1.1
            for dx, dy in offsets_m
        ),
        default=0.0,
    )
    fits = next((k for k, span_m in enumerate(SPANS_M) if span_m >= needed_m), len(SPANS_M) - 1)
    return SPANS_M[min(max(fits - zoom, 0), len(SPANS_M) - 1)]


def _outline(shape: Person | GhostPerson) -> Iterable[tuple[float, float]]:
    """Return points of the two-sigma ellipse, or of the ring's middle."""
    if None in (shape.x_m, shape.y_m, shape.sigma_major_m, shape.sigma_minor_m):
        return
    ring = getattr(shape, "shape", "ellipse") == "ring"
    major = float(shape.sigma_major_m or 0.0) * (1.0 if ring else 2.0)
    minor = major if ring else 2.0 * float(shape.sigma_minor_m or 0.0)
    angle = shape.sigma_angle_rad or 0.0
    c, s = math.cos(angle), math.sin(angle)
    count = 64
    for k in range(count):
        along = major * math.cos(2.0 * math.pi * k / count)
        across = minor * math.sin(2.0 * math.pi * k / count)
        yield (
            float(shape.x_m or 0.0) + c * along - s * across,
            float(shape.y_m or 0.0) + s * along + c * across,
        )


def _faces(person: Person, turn: float, options: RenderOptions) -> str:
    """Return an arrow for where somebody faces, in UTF-8 and where it is known."""
    facing = _facing(person)
    if facing is None or not options.utf8:
        return ""
    return _arrow(_wrapped(facing + turn - 0.5 * math.pi), options)


def _scale(canvas: Canvas, dots_per_m: float, options: RenderOptions, up: str) -> str:
    """Return a scale bar of 1, 2 or 5 times a power of ten, at most a quarter of the width."""
    most_m = 0.25 * canvas.width / dots_per_m
    power = 10.0 ** math.floor(math.log10(most_m))
    length_m = next(f * power for f in (5.0, 2.0, 1.0) if f * power <= most_m)
    cells = max(round(length_m * dots_per_m / 2.0), 2)
    ends, line = ("├┤", "─") if options.utf8 else ("||", "-")
    return f"{ends[0]}{line * (cells - 2)}{ends[1]} {length_m:g} m  up: {up}"


def _line(words: str, options: RenderOptions, style: str = "") -> Text:
    """Return one line of what the terminal can show, and nothing that could command it.

    Names come from phones: anyone on the network may have typed them.
    """
    from rich.text import Text

    plain = "".join(letter if letter.isprintable() else "?" for letter in words)
    if not options.utf8:
        plain = plain.replace("…", "~")
        bare = unicodedata.normalize("NFKD", plain)
        plain = "".join(a if a.isascii() else "?" for a in bare if not unicodedata.combining(a))
    return Text(plain, style=style, no_wrap=True, end="")
