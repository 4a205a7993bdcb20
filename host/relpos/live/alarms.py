"""Alerts for wearers who lie still, who fall, or whose node is silent.

*Still*, as in PASS devices (NFPA 1982): a warning after 20 s without motion, an alarm after 30 s.
Turning, bending or shuffling counts as motion: the node's dead reckoning shows it as a
displacement, a turn, or an uncertainty that only a moving body causes. Any movement ends the
warning. The alarm, as a PASS device's, survives a twitch: :data:`AWAKE_REPORTS` reports of movement
in a row end it.

*Fallen*: the height fell without steps, faster than a lift's and not for long
(:class:`~relpos.fusion.vertical.falls.FallDetector`). It ends as the alarm of lying still does.

*Lost*: no frame for :data:`LOST_S` while the session was receiving. Time in which the port was
gone or the computer slept does not count. For the same reason the time without motion starts
again after a gap, unless it had led to an alarm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from relpos.fusion.vertical.falls import FallDetector
from relpos.live.team_view import STILL_ALARM_S, STILL_WARNING_S, Alert
from relpos.measurements import Height, Motion
from relpos.said import Said

LOST_S = 10.0
"""As long as the estimators' ``lost``: ten reports in a row. With 2 % loss never by chance, with a
third of all frames lost once in sixteen hours of one node."""
GAP_S = 5.0
"""Two reports farther apart leave open whether the wearer was still in between."""
MOVED_M = 0.1
TURNED_RAD = math.radians(15.0)
"""In one report, of a second: more than sway and the gyroscope's drift."""
LOOSE_M = 0.1
"""The node's deviation of a second in which the body moves without steps is up to 0.3 m
(kLooseNoise in the firmware), at rest 0.02 m; it grows with the root of the time."""
AWAKE_REPORTS = 3
MAX_SHELVED_S = 900.0
"""A shelved alarm comes back by itself: forgotten for longer, it would be lost."""
MAX_TICK_S = 1.0
"""The session ticks twenty times a second; it was not receiving in the rest of a longer gap."""
REPORT_S = 1.5
"""How long after the newest report stillness is assumed to last: until the next one is due."""

RAISED = {
    Alert.STILL_WARNING: Said("still-20", "{name} has not moved for 20 s", name=""),
    Alert.STILL_ALARM: Said("still-30", "{name} has not moved for 30 s", name=""),
    Alert.FALL: Said("fell", "{name} fell", name=""),
    Alert.LOST: Said("lost", "{name} is not heard any more", name=""),
    Alert.MAYDAY: Said("mayday", "{name} calls MAYDAY", name=""),
}
MOVES = Said("moves", "{name} moves again", name="")
CLEARED = {
    Alert.STILL_WARNING: MOVES,
    Alert.STILL_ALARM: MOVES,
    Alert.FALL: MOVES,
    Alert.LOST: Said("heard", "{name} is heard again", name=""),
    Alert.MAYDAY: Said("no-mayday", "{name} has no MAYDAY any more", name=""),
}
"""Texts of the log."""


@dataclass(slots=True)
class Condition:
    """One wearer's movement, silence and alert."""

    silent_s: float = 0.0
    report_s: float | None = None
    still_since_s: float = 0.0
    since_report_s: float = 0.0
    moving: bool | None = None
    awake: int = 0
    falls: FallDetector = field(default_factory=FallDetector)
    fallen: bool = False
    alert: Alert | None = None
    acknowledged: bool = False
    acknowledged_by: str = ""
    shelved_s: float = 0.0
    """Seconds until the wearer's alarms are shown again."""

    @property
    def still_s(self) -> float:
        """The time without movement, as far as it is known."""
        if self.report_s is None or (self.moving and self.still_since_s == self.report_s):
            return 0.0
        return self.report_s - self.still_since_s + min(self.since_report_s, REPORT_S)


@dataclass
class KnownAlert:
    """An alert of a session before: when it was raised, and who has seen it."""

    alert: Alert
    raised_s: float
    seen: bool = False
    by: str = ""


def moved(motion: Motion, duration_s: float = 1.0) -> bool:
    """Whether the wearer's body moved within this report, which covers ``duration_s``."""
    along = motion.sigma_x_m if motion.sigma_x_alone_m is None else motion.sigma_x_alone_m
    return (
        motion.moving is True
        or math.hypot(motion.dx_m, motion.dy_m) >= MOVED_M
        or abs(motion.dtheta_rad) >= TURNED_RAD
        # Only a node that reports its state has its firmware's own standard deviations.
        or (
            motion.moving is not None
            and min(along or 0.0, motion.sigma_y_m or 0.0) >= LOOSE_M * max(duration_s, 1.0) ** 0.5
        )
    )


@dataclass(frozen=True, slots=True)
class Mayday:
    """Somebody calls MAYDAY, or it is over: as a mission's journal has it."""

    node: int
    on: bool


class Alarms:
    """Every wearer's condition; motions carry their own time, ``tick`` gets the session's."""

    def __init__(self) -> None:
        self.changes: list[tuple[int, Alert | None, Alert | None]] = []
        """Alerts that have come or gone: node, before, after; emptied by the reader."""
        self._states: dict[int, Condition] = {}
        self._ticked_s: float | None = None
        self.waiting: set[int] = set()
        """Who is not in, and may sit still."""
        self.mayday: set[int] = set()
        self.posts: frozenset[int] = frozenset()
        """Nodes that lie at the command post."""

    def remember(self, node: int, heard_s: float, now_s: float, known: KnownAlert | None) -> None:
        """Go on from a session before: last heard at ``heard_s``, with that alert.

        Silence, the alert, who has seen it and its cause go on; movement, detection of falls, and a
        fall that another alert hides begin anew. Shelving and MAYDAY come back by their own events.
        """
        state = self._states.setdefault(node, Condition())
        state.silent_s = max(now_s - heard_s, 0.0)
        state.report_s = state.still_since_s = heard_s
        if known is None:
            return
        state.alert, state.acknowledged, state.acknowledged_by = known.alert, known.seen, known.by
        state.fallen = known.alert is Alert.FALL
        if known.alert in (Alert.STILL_ALARM, Alert.STILL_WARNING):
            limit_s = STILL_ALARM_S if known.alert is Alert.STILL_ALARM else STILL_WARNING_S
            state.still_since_s = min(known.raised_s - limit_s, heard_s)

    def mark_heard(self, node: int) -> None:
        """Note that any frame came from the node."""
        self._states.setdefault(node, Condition()).silent_s = 0.0

    def add_motion(self, motion: Motion) -> None:
        """Add a motion report."""
        state = self._states.setdefault(motion.node, Condition())
        state.silent_s = 0.0
        first = state.report_s is None
        covered_s = 0.0 if state.report_s is None else motion.time_s - state.report_s
        state.report_s = motion.time_s
        state.since_report_s = 0.0
        state.falls.step(motion.steps or 0)
        # A first report covers all motion since the node's start.
        state.moving = bool(motion.moving) if first else moved(motion, covered_s)
        if state.moving:
            state.awake += 1
            awake = state.awake >= AWAKE_REPORTS
            state.fallen &= not awake
            # A twitch ends neither the alarm nor its count.
            if state.alert is not Alert.STILL_ALARM or awake:
                state.still_since_s = motion.time_s
        else:
            state.awake = 0
            if first or (covered_s > GAP_S and state.alert is not Alert.STILL_ALARM):
                state.still_since_s = motion.time_s

    def add_height(self, height: Height) -> None:
        """Add a reported height."""
        state = self._states.setdefault(height.node, Condition())
        if state.falls.measure(height):
            # The fall itself moved the body.
            state.fallen, state.awake = True, 0

    def tick(self, now_s: float, *, listening: bool) -> None:
        """Advance to ``now_s``; ``listening`` says whether frames could arrive meanwhile."""
        passed_s = 0.0 if self._ticked_s is None else max(now_s - self._ticked_s, 0.0)
        self._ticked_s = now_s
        passed_s = min(passed_s, MAX_TICK_S)
        for node in self.mayday:
            # Whom nobody has heard yet cannot fall silent.
            self._states.setdefault(node, Condition(silent_s=-math.inf))
        for node, state in self._states.items():
            if listening:
                state.silent_s += passed_s
                state.since_report_s += passed_s
            state.shelved_s = max(state.shelved_s - passed_s, 0.0)
            before = state.alert
            self._update_alert(node, state)
            if state.alert is not before:
                self.changes.append((node, before, state.alert))

    def shelve(self, node: int, for_s: float) -> bool:
        """Silence the node's alarms for so long, at most :data:`MAX_SHELVED_S`; 0 ends it.

        False where there is no such node, or its wearer calls MAYDAY: that is never silenced.
        """
        state = self._states.get(node)
        if state is None or node in self.mayday:
            return False
        state.shelved_s = min(max(for_s, 0.0), MAX_SHELVED_S)
        return True

    def acknowledge(self, node: int, by: str = "") -> bool:
        """Mark the node's alert as seen; return False where there is none."""
        state = self._states.get(node)
        if state is None or state.alert is None:
            return False
        state.acknowledged, state.acknowledged_by = True, by
        return True

    def condition(self, node: int) -> Condition:
        """Return the condition of the node's wearer."""
        return self._states.get(node) or Condition()

    def _update_alert(self, node: int, state: Condition) -> None:
        rests = node in self.waiting or node in self.posts
        still_s = 0.0 if rests else state.still_s
        alert: Alert | None = None
        if node in self.mayday:
            alert, state.shelved_s = Alert.MAYDAY, 0.0
        elif still_s >= STILL_ALARM_S:
            alert = Alert.STILL_ALARM
        elif state.fallen and not rests:
            alert = Alert.FALL
        elif state.silent_s >= LOST_S:
            alert = Alert.LOST
        elif still_s >= STILL_WARNING_S:
            alert = Alert.STILL_WARNING
        if alert is not state.alert:
            state.alert, state.acknowledged, state.acknowledged_by = alert, False, ""
