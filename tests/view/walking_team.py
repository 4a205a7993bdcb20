"""A team that walks by a formula, as views: what the pages show in these tests.

Everybody goes round a rectangle of 20 m x 10 m at walking speed, each on a path of their own.
The tests switch faults on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from relpos.fusion.estimator import PairEstimate
from relpos.live.team_view import (
    STILL_ALARM_S,
    STILL_WARNING_S,
    Alert,
    GhostPerson,
    Ghosts,
    Level,
    MeasuredRange,
    Notice,
    Person,
    TeamView,
)

NAMES = (
    "Anna", "Ben", "Chloé", "Dmitri", "Emil", "Fatima", "Gustav Adolf", "Hana", "Ivo", "Jo",
    "Kwame", "Lena", "Mehmet", "Nora", "Oleg", "Pia", "Quentin", "Rosa", "Sven", "Tara",
)  # fmt: skip
SIDES_M = (20.0, 10.0)
SPEED_M_S = 1.2


@dataclass
class WalkingTeam:
    """State of the team; ``view`` returns it as the server sends it."""

    size: int = 6
    spread_m: float = 2.0
    lost_since: dict[int, float] = field(default_factory=dict)
    still_since: dict[int, float] = field(default_factory=dict)
    acknowledged: dict[int, str] = field(default_factory=dict)
    shelved_s: dict[int, float] = field(default_factory=dict)
    names: dict[int, str] = field(default_factory=dict)
    ambiguous: int | None = None
    ring: int | None = None
    health: dict[int, tuple[str, tuple[str, ...]]] = field(default_factory=dict)
    notices: tuple[Notice, ...] = ()
    north_rad: float | None = None

    def name(self, node: int) -> str:
        """Name of a node's wearer."""
        return self.names.get(node, NAMES[node - 1])

    def pose(self, node: int, time_s: float) -> tuple[float, float, float]:
        """Where somebody is: x, y in metres, heading in radians."""
        time_s = min(
            time_s, self.still_since.get(node, math.inf), self.lost_since.get(node, math.inf)
        )
        off_m = self.spread_m * ((node * 7) % 5 - 2) / 2
        width_m, depth_m = SIDES_M[0] + off_m, SIDES_M[1] + off_m
        along_m = (SPEED_M_S * time_s + 60.0 * node / self.size + node) % (2 * (width_m + depth_m))
        for length_m, x_m, y_m, heading in (
            (width_m, 0.0, 0.0, 0.0),
            (depth_m, width_m, 0.0, math.pi / 2),
            (width_m, width_m, depth_m, math.pi),
            (depth_m, 0.0, depth_m, -math.pi / 2),
        ):
            if along_m <= length_m:
                cx, cy = math.cos(heading), math.sin(heading)
                x_m, y_m = x_m + along_m * cx - off_m / 2, y_m + along_m * cy - off_m / 2
                return x_m, y_m, heading + 0.12 * math.sin(time_s + node)
            along_m -= length_m
        raise AssertionError("off the rectangle")

    def person(self, node: int, time_s: float) -> Person:
        """Make a person of a view."""
        if node == self.ring:
            return Person(node, self.name(node), status="unlocated", seen_s=0.4, health="green")
        x_m, y_m, heading_rad = self.pose(node, time_s)
        lost_s = time_s - self.lost_since.get(node, time_s)
        still_s = time_s - self.still_since.get(node, time_s)
        alert = None
        if lost_s > 5.0:
            alert = Alert.LOST
        elif still_s >= STILL_ALARM_S:
            alert = Alert.STILL_ALARM
        elif still_s >= STILL_WARNING_S:
            alert = Alert.STILL_WARNING
        else:
            self.acknowledged.pop(node, None)
        status = "ok" if lost_s <= 3.0 else "stale" if lost_s <= 10.0 else "lost"
        if node == self.ambiguous and status == "ok":
            status = "ambiguous"
        health, reasons = self.health.get(node, ("green", ()))
        if lost_s > 5.0:
            health, reasons = "red", (f"silent for {lost_s:.0f} s",)
        grown_m = 0.25 * lost_s
        return Person(
            node, self.name(node), x_m, y_m, z_m=0.0, heading_rad=heading_rad,
            sigma_major_m=0.45 + 0.05 * node + grown_m,
            sigma_minor_m=0.25 + 0.02 * node + grown_m, sigma_angle_rad=0.4 * node,
            sigma_heading_rad=0.08 + 0.02 * node, status=status, motion_s=time_s - lost_s,
            seen_s=0.2 + lost_s, moving=still_s <= 0.0, still_s=still_s, alert=alert,
            acknowledged=node in self.acknowledged,
            acknowledged_by=self.acknowledged.get(node, ""),
            shelved_s=self.shelved_s.get(node, 0.0), health=health, reasons=reasons,
            battery_v=5.02 - 0.03 * node, rssi_dbm=-52.0 - 3 * node, frame_loss=0.005 * node,
            ranging=0.93 - 0.02 * node, neighbours=self.size - 1,
        )  # fmt: skip

    def view(self, seq: int, time_s: float, unix_s: float) -> TeamView:
        """Show everybody at that time."""
        people = tuple(self.person(node, time_s) for node in range(1, self.size + 1))
        placed = [p for p in people if p.x_m is not None]
        pairs, ranges = [], []
        for k, a in enumerate(placed):
            for b in placed[k + 1 :]:
                dx, dy = _place(b)[0] - _place(a)[0], _place(b)[1] - _place(a)[1]
                distance_m = math.hypot(dx, dy)
                sigma_m = 0.1 + 0.1 * ((a.node + b.node) % 4)
                bearing_sd = min(sigma_m / max(distance_m, 0.1), 1.8)
                pairs.append(
                    PairEstimate(
                        a.node, b.node, distance_m, sigma_m, math.atan2(dy, dx), bearing_sd
                    )
                )
                received = not {a.node, b.node} & self.lost_since.keys()
                if received and distance_m < 16.0:
                    age_s = (time_s + 1.3 * a.node + 0.7 * b.node) % 4.0
                    error_m = 0.2 * math.sin(3.0 * a.node + b.node + 0.1 * time_s)
                    ranges.append(MeasuredRange(a.node, b.node, distance_m + error_m, age_s))
        return TeamView(
            seq, time_s, unix_s, unix_s - 0.02, time_s - 1.2,
            self.north_rad, None if self.north_rad is None else 0.1,
            ambiguous=self.ambiguous is not None or self.ring is not None,
            notices=self.notices, people=people, pairs=tuple(pairs), ranges=tuple(ranges),
            alternatives=self.alternatives(people),
        )  # fmt: skip

    def alternatives(self, people: tuple[Person, ...]) -> tuple[Ghosts, ...]:
        """List the other places that somebody may be at, and the shown one."""
        if self.ambiguous is None and self.ring is None:
            return ()

        def ghost(person: Person, moved_m: tuple[float, float] = (0.0, 0.0)) -> GhostPerson:
            if person.node == self.ring:
                return GhostPerson(person.node, 10.0, 5.0, 0.0, 6.0, 0.4, 0.0, "ring")
            x_m, y_m = _place(person)
            return GhostPerson(
                person.node, x_m + moved_m[0], y_m + moved_m[1],
                person.heading_rad or 0.0, 0.8, 0.5, 0.3, "ellipse",
            )  # fmt: skip

        shown = tuple(ghost(p) for p in people)
        if self.ambiguous is None:
            return (Ghosts(1.0, shown),)

        def other(moved_m: tuple[float, float]) -> tuple[GhostPerson, ...]:
            return tuple(
                ghost(p, moved_m if p.node == self.ambiguous else (0.0, 0.0)) for p in people
            )

        return (
            Ghosts(0.62, shown),
            Ghosts(0.29, other((-4.0, 7.0))),
            Ghosts(0.09, other((5.0, -6.0))),
        )


def _place(person: Person) -> tuple[float, float]:
    assert person.x_m is not None
    assert person.y_m is not None
    return person.x_m, person.y_m


def disk_full() -> Notice:
    """A notice as a sink's trouble makes it."""
    return Notice(
        "disk", Level.WARNING, "disk full: the recording stands still until there is room", 3.0
    )
