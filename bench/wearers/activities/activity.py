"""One element of a script: what a wearer does."""

from __future__ import annotations

from dataclasses import dataclass

from relpos.errors import DataError

ACTIVITIES = (
    "stand",
    "walk",
    "turn",
    "side",
    "backward",
    "shuffle",
    "carry",
    "stairs_up",
    "stairs_down",
    "crawl",
    "bend",
    "fall",
    "remount",
)
"""Labels of the truth; the label array holds indices into this."""

FORWARD = ("walk", "shuffle", "carry", "stairs_up", "stairs_down")
"""Activities that follow one another without a stop."""


@dataclass(frozen=True, slots=True)
class Activity:
    """One element of a script. 0 and None mean: drawn, or not applicable.

    ``walk``, ``shuffle``, ``carry``: over ``distance_m``, turning by ``turn_rad`` in all (left
    positive) evenly over it. ``turn``: on the spot by ``turn_rad``. ``side``: ``distance_m``,
    to the left if positive. ``backward``, ``crawl``: ``distance_m``. ``stairs_up``,
    ``stairs_down``: ``count`` steps. ``bend``: ``count`` times. ``stand``: ``seconds``, looking
    about and reaching ``count`` times.
    ``fall``: falls, lies for ``seconds`` and gets up. ``remount``: the sensor is turned on the
    body, standing; where ``distance_m`` is given, it slips while walking that far.
    """

    kind: str
    distance_m: float = 0.0
    turn_rad: float = 0.0
    seconds: float = 0.0
    speed_m_s: float | None = None
    count: int = 0

    def __post_init__(self) -> None:
        if self.kind not in ACTIVITIES:
            raise DataError(f"unknown activity {self.kind!r}; known are {', '.join(ACTIVITIES)}")
