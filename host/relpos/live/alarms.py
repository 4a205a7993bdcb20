"""Who needs help: somebody who does not move any more, or is not heard any more.

*Motionless*, as PASS devices have it (NFPA 1982): a warning after 20 s, an alarm after 30 s. Moving
is not walking alone: who turns, bends or shuffles moves, which the node's dead reckoning tells by
a displacement, a turn, or an uncertainty that only a body in motion gives it. The warning ends
with any movement; the alarm, as a PASS device's, is not ended by a twitch: it takes
:data:`AWAKE_REPORTS` reports of movement in a row.

*Lost*: nothing was heard for :data:`LOST_S` while somebody was listening. Time in which the port
was gone or this computer slept does not count: nothing follows from what nobody could hear. For
the same reason the time without motion begins anew after a gap, unless it had led to an alarm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from relpos.live.picture import STILL_ALARM_S, STILL_WARNING_S, Alert
from relpos.measurements import Motion

LOST_S = 10.0
"""As long as the estimators' ``lost``: ten reports in a row. With 2 % loss never by chance, with a
third of all frames lost once in sixteen hours of one node."""
GAP_S = 5.0
"""Reports farther apart say nothing certain about stillness in between."""
MOVED_M = 0.1
TURNED_RAD = math.radians(15.0)
"""In one report, of a second: more than sway and the gyroscope's drift."""
LOOSE_M = 0.1
"""The node's deviation of a second in which the body moves without steps is up to 0.3 m
(kLooseNoise in the firmware), at rest 0.02 m; it grows with the root of the time."""
AWAKE_REPORTS = 3
LONGEST_TICK_S = 1.0
"""The session looks twenty times a second; what is longer was not listened to."""
REPORT_S = 1.5
"""How long after its newest report stillness is taken to go on: until the next one is due."""


@dataclass(slots=True)
class _Watch:
    """What is known of one wearer's movement and silence."""

    silent_s: float = 0.0
    report_s: float | None = None
    still_since_s: float = 0.0
    since_report_s: float = 0.0
    moving: bool | None = None
    awake: int = 0
    alert: Alert | None = None
    acknowledged: bool = False

    def still_s(self) -> float:
        """How long without movement, as far as it is known."""
        if self.report_s is None or (self.moving and self.still_since_s == self.report_s):
            return 0.0
        return self.report_s - self.still_since_s + min(self.since_report_s, REPORT_S)


@dataclass(frozen=True, slots=True)
class Condition:
    """How somebody is."""

    moving: bool | None
    still_s: float
    silent_s: float
    alert: Alert | None
    acknowledged: bool


def moved(motion: Motion, duration_s: float = 1.0) -> bool:
    """Whether the wearer's body moved within this report, which covers ``duration_s``."""
    along = motion.sigma_x_m if motion.sigma_x_alone_m is None else motion.sigma_x_alone_m
    return (
        motion.moving is True
        or math.hypot(motion.dx_m, motion.dy_m) >= MOVED_M
        or abs(motion.dtheta_rad) >= TURNED_RAD
        # Only where the node tells its state are its deviations those of its firmware.
        or (
            motion.moving is not None
            and min(along or 0.0, motion.sigma_y_m or 0.0) >= LOOSE_M * max(duration_s, 1.0) ** 0.5
        )
    )


class Alarms:
    """Everybody's condition. Times of motions are theirs; ``tick`` is given the session's."""

    def __init__(self) -> None:
        self._watches: dict[int, _Watch] = {}
        self._ticked_s: float | None = None

    def heard(self, node: int) -> None:
        """Note that anything at all came from the node."""
        self._watches.setdefault(node, _Watch()).silent_s = 0.0

    def take(self, motion: Motion) -> None:
        """Take a motion report."""
        watch = self._watches.setdefault(motion.node, _Watch())
        watch.silent_s = 0.0
        first = watch.report_s is None
        covered_s = 0.0 if watch.report_s is None else motion.time_s - watch.report_s
        watch.report_s = motion.time_s
        watch.since_report_s = 0.0
        # A first report covers all since the node's start, which is no movement of now.
        watch.moving = bool(motion.moving) if first else moved(motion, covered_s)
        if watch.moving:
            watch.awake += 1
            # A twitch ends neither the alarm nor its count.
            if watch.alert is not Alert.STILL_ALARM or watch.awake >= AWAKE_REPORTS:
                watch.still_since_s = motion.time_s
        else:
            watch.awake = 0
            if first or (covered_s > GAP_S and watch.alert is not Alert.STILL_ALARM):
                watch.still_since_s = motion.time_s

    def tick(self, now_s: float, *, listening: bool) -> None:
        """Let time pass; ``listening`` is whether anybody could have been heard meanwhile."""
        passed_s = 0.0 if self._ticked_s is None else max(now_s - self._ticked_s, 0.0)
        self._ticked_s = now_s
        passed_s = min(passed_s, LONGEST_TICK_S)
        for watch in self._watches.values():
            if listening:
                watch.silent_s += passed_s
                watch.since_report_s += passed_s
            self._judge(watch)

    def acknowledge(self, node: int) -> bool:
        """Note that somebody has seen the alert; False where there is none."""
        watch = self._watches.get(node)
        if watch is None or watch.alert is None:
            return False
        watch.acknowledged = True
        return True

    def of(self, node: int) -> Condition:
        """How the node's wearer is."""
        watch = self._watches.get(node) or _Watch()
        return Condition(
            watch.moving, watch.still_s(), watch.silent_s, watch.alert, watch.acknowledged
        )

    @staticmethod
    def _judge(watch: _Watch) -> None:
        still_s = watch.still_s()
        alert: Alert | None = None
        if still_s >= STILL_ALARM_S:
            alert = Alert.STILL_ALARM
        elif watch.silent_s >= LOST_S:
            alert = Alert.LOST
        elif still_s >= STILL_WARNING_S:
            alert = Alert.STILL_WARNING
        if alert is not watch.alert:
            watch.alert, watch.acknowledged = alert, False
