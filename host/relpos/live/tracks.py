"""Where everybody has been, thinned out so that hours of it stay small."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from relpos.live.picture import to_json

MOST_POINTS = 2000
FIRST_SPACING_S = 0.5


class Tracks:
    """Points (time_s, x_m, y_m) of each node, at most :data:`MOST_POINTS`.

    A track that is full gives up every second point and is twice as coarse from then on, so that
    its points stay evenly apart in time.
    """

    def __init__(self) -> None:
        self._points: dict[int, list[tuple[float, float, float]]] = {}
        self._spacing_s: dict[int, float] = {}

    def add(self, node: int, time_s: float, x_m: float, y_m: float) -> bool:
        """Take a point, unless one as near in time is there; whether it was taken."""
        points = self._points.setdefault(node, [])
        spacing_s = self._spacing_s.get(node, FIRST_SPACING_S)
        if points and time_s < points[-1][0] + spacing_s:
            return False
        points.append((round(time_s, 2), round(x_m, 2), round(y_m, 2)))
        if len(points) > MOST_POINTS:
            del points[1::2]
            self._spacing_s[node] = 2.0 * spacing_s
        return True

    def of(self, node: int) -> list[tuple[float, float, float]]:
        """The node's points, by time."""
        return list(self._points.get(node, ()))

    def to_json(self) -> str:
        """The message ``tracks`` of the page's protocol."""
        return to_json(
            {
                "type": "tracks",
                "tracks": {str(n): points for n, points in sorted(self._points.items())},
            }
        )

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> Tracks:
        """Take a ``tracks`` message's points as they are."""
        tracks = cls()
        for node, points in message["tracks"].items():
            tracks._points[int(node)] = [(t, x, y) for t, x, y in points]
            if len(points) > 2:
                mean_s = (points[-1][0] - points[0][0]) / (len(points) - 1)
                tracks._spacing_s[int(node)] = max(FIRST_SPACING_S, 0.75 * mean_s)
        return tracks
