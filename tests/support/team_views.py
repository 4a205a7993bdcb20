"""Views of a small team, as a live session composes them."""

from __future__ import annotations

from itertools import combinations
from math import atan2, hypot, pi
from typing import Any

from relpos.fusion.estimator import PairEstimate
from relpos.live.team_view import Person, TeamView

UNIX_S = 1_780_000_000.0
PLACES = {1: (0.0, 0.0), 2: (12.0, 5.0), 3: (-7.5, 20.25), 4: (3.0, -9.0)}
NAMES = {1: "Åsa <1>", 2: "Kim", 3: "Li & Söhne", 4: "node 4"}


def person(node: int, **changes: Any) -> Person:
    """Somebody who is well, walks and is known to half a metre."""
    x_m, y_m = PLACES[node]
    known: dict[str, Any] = {
        "node": node,
        "name": NAMES[node],
        "x_m": x_m,
        "y_m": y_m,
        "z_m": 0.5 * node,
        "heading_rad": 0.5 * pi * node - pi,
        "sigma_major_m": 0.8,
        "sigma_minor_m": 0.4,
        "sigma_angle_rad": 0.3,
        "sigma_heading_rad": 0.1,
        "status": "ok",
        "motion_s": 10.0,
        "seen_s": 0.25,
        "moving": True,
        "battery_v": 4.9,
    }
    return Person(**{**known, **changes})


def team_view(
    seq: int = 1, *, changes: dict[int, dict[str, Any]] | None = None, **more: Any
) -> TeamView:
    """Everybody, each with ``changes`` of their own."""
    people = tuple(person(node, **(changes or {}).get(node, {})) for node in PLACES)
    pairs = tuple(
        PairEstimate(
            a.node,
            b.node,
            hypot(b.x_m - a.x_m, b.y_m - a.y_m),
            0.6,
            atan2(b.y_m - a.y_m, b.x_m - a.x_m),
            0.05,
        )
        for a, b in combinations(people, 2)
        if None not in (a.x_m, a.y_m, b.x_m, b.y_m)
    )
    time_s = 10.0 + seq
    return TeamView(
        **{
            "seq": seq,
            "time_s": time_s,
            "unix_s": UNIX_S + time_s,
            "people": people,
            "pairs": pairs,
            **more,
        }
    )
