"""Drawings for Foxglove without any set-up: the team in its 3D panel, frames, log.

World axes as everywhere: x east-like, y north-like, z up, metres. The common frame is called
``team``, a wearer's ``node N``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from foxglove import Schema
from foxglove import messages as m

from relpos.files import displayable
from relpos.fusion.estimator import Alternative, Estimate, NodeEstimate, NodeStatus, Shape
from relpos.measurements import Range
from relpos.recording.topics import LOG, TEAM, TRANSFORMS

FRAME = "team"
SCALE_90 = math.sqrt(-2.0 * math.log(0.1))
"""Sigmas of the ellipse that holds a position in the plane with 90 %."""
RANGE_SHOWN_S = 10.0
TRAIL_EVERY_S = 4.0
TRAIL_POINTS = 30
"""Two minutes: enough to see the last path, and a file that stays small."""
GRID_M = 1.0 / 256.0
"""Drawn figures are rounded to a power of two: eyes see no difference, and they compress."""
RING_POINTS = 48
LIFETIME_S = 15
"""Nothing stays on the screen much longer than what it was drawn from."""

COLOURS: Mapping[NodeStatus, tuple[float, float, float]] = {
    NodeStatus.OK: (0.10, 0.45, 0.95),
    NodeStatus.AMBIGUOUS: (0.95, 0.60, 0.05),
    NodeStatus.UNLOCATED: (0.60, 0.60, 0.60),
    NodeStatus.STALE: (0.60, 0.50, 0.70),
    NodeStatus.LOST: (0.90, 0.10, 0.10),
}


def schemas() -> dict[str, Schema]:
    """Topic -> Foxglove's schema."""
    return {
        TEAM: m.SceneUpdate.get_schema(),
        TRANSFORMS: m.FrameTransforms.get_schema(),
        LOG: m.Log.get_schema(),
    }


def log_message(unix_ns: int, level: str, text: str) -> bytes:
    """A line for Foxglove's log panel; ``level`` is info, warning or alarm."""
    levels = {"warning": m.LogLevel.Warning, "alarm": m.LogLevel.Error}
    message = m.Log(
        timestamp=_stamp(unix_ns),
        level=levels.get(level, m.LogLevel.Info),
        message=displayable(text),
        name="relpos",
    )
    return bytes(message.encode())


@dataclass
class Scene:
    """Draws estimates, with recent ranges and trails.

    ``names``: node -> what its wearer is called.
    """

    started_unix_ns: int
    names: Mapping[int, str] = field(default_factory=dict)
    _ranges: dict[tuple[int, int], Range] = field(default_factory=dict)
    _trails: dict[int, list[tuple[float, float, float]]] = field(default_factory=dict)
    _trail_s: float = -math.inf

    def range(self, measured: Range) -> None:
        """Remember the newest range of each pair."""
        if measured.range_m > 0.0:
            pair = (min(measured.node, measured.peer), max(measured.node, measured.peer))
            self._ranges[pair] = measured

    def draw(self, estimate: Estimate) -> Iterator[tuple[str, bytes]]:
        """Yield topics and messages that draw an estimate."""
        unix_ns = self.started_unix_ns + round(estimate.time_s * 1e9)
        stamp = _stamp(unix_ns)
        drawn = {n.node: n for n in estimate.nodes if _can_be_drawn(n)}
        self._lengthen_trails(estimate.time_s, drawn)
        lifetime = m.Duration(LIFETIME_S, 0)

        def entity(name: str, **parts: Any) -> Any:
            return m.SceneEntity(
                timestamp=stamp, frame_id=FRAME, id=name, lifetime=lifetime, **parts
            )

        entities = [
            entity(
                f"node {node.node}",
                cylinders=[_ellipse(node)],
                spheres=[_body(node)],
                arrows=[_heading(node)] if node.status is NodeStatus.OK else [],
                texts=[_label(node, self.names.get(node.node, str(node.node)))],
                lines=[self._trail(node)],
            )
            for node in drawn.values()
        ]
        links = self._links(estimate.time_s, drawn)
        if links is not None:
            entities.append(entity("ranges", lines=[links]))
        ghosts = [row for row in estimate.alternatives if _is_finite(row.x_m, row.y_m)]
        if ghosts:
            entities.append(
                entity(
                    "alternatives",
                    cylinders=[_ghost(row) for row in ghosts if row.shape is not Shape.RING],
                    lines=[_ring(row) for row in ghosts if row.shape is Shape.RING],
                )
            )
        # Delete entities without a drawing now: a rejected alternative, an unlocated node.
        keep = {f"node {node}" for node in drawn}
        if ghosts:
            keep.add("alternatives")
        gone = {f"node {n.node}" for n in estimate.nodes} | {"alternatives"}
        deletions = [
            m.SceneEntityDeletion(
                timestamp=stamp, type=m.SceneEntityDeletionType.MatchingId, id=name
            )
            for name in sorted(gone - keep)
        ]
        yield TEAM, bytes(m.SceneUpdate(deletions=deletions, entities=entities).encode())
        transforms = [
            m.FrameTransform(
                timestamp=stamp,
                parent_frame_id=FRAME,
                child_frame_id=f"node {node.node}",
                translation=m.Vector3(**_xyz(node)),
                rotation=_turned(node.heading_rad),
            )
            for node in drawn.values()
            if math.isfinite(node.heading_rad)
        ]
        yield TRANSFORMS, bytes(m.FrameTransforms(transforms=transforms).encode())

    def _lengthen_trails(self, time_s: float, drawn: Mapping[int, NodeEstimate]) -> None:
        if time_s - self._trail_s < TRAIL_EVERY_S:
            return
        self._trail_s = time_s
        for node, estimate in drawn.items():
            trail = self._trails.setdefault(node, [])
            if estimate.status in (NodeStatus.OK, NodeStatus.AMBIGUOUS):
                trail.append(tuple(_xyz(estimate).values()))  # type: ignore[arg-type]
            del trail[:-TRAIL_POINTS]

    def _trail(self, node: NodeEstimate) -> Any:
        points = [*self._trails.get(node.node, ()), tuple(_xyz(node).values())]
        return m.LinePrimitive(
            type=m.LinePrimitiveLineType.LineStrip,
            pose=_pose(0.0, 0.0, 0.0),
            thickness=2.0,
            scale_invariant=True,
            points=[m.Point3(x=x, y=y, z=z) for x, y, z in points],
            color=_colour(node.status, 0.5),
        )

    def _links(self, time_s: float, drawn: Mapping[int, NodeEstimate]) -> Any:
        """Lines between nodes with a recent range; None without any."""
        points: list[Any] = []
        for (node, peer), measured in self._ranges.items():
            if node in drawn and peer in drawn and time_s - measured.time_s <= RANGE_SHOWN_S:
                points += [m.Point3(**_xyz(drawn[end])) for end in (node, peer)]
        if not points:
            return None
        return m.LinePrimitive(
            type=m.LinePrimitiveLineType.LineList,
            pose=_pose(0.0, 0.0, 0.0),
            thickness=1.0,
            scale_invariant=True,
            points=points,
            color=m.Color(r=0.3, g=0.7, b=0.4, a=0.5),
        )


def _is_finite(*values: float) -> bool:
    return all(map(math.isfinite, values))


def _can_be_drawn(node: NodeEstimate) -> bool:
    return node.status is not NodeStatus.UNLOCATED and _is_finite(node.x_m, node.y_m)


def _round(value_m: float) -> float:
    return round(value_m / GRID_M) * GRID_M if math.isfinite(value_m) else 0.0


def _xyz(node: NodeEstimate) -> dict[str, float]:
    return {"x": _round(node.x_m), "y": _round(node.y_m), "z": _round(node.z_m)}


def _stamp(unix_ns: int) -> Any:
    return m.Timestamp(*divmod(max(unix_ns, 0), 1_000_000_000))


def _turned(angle_rad: float) -> Any:
    half_rad = 0.5 * angle_rad if math.isfinite(angle_rad) else 0.0
    return m.Quaternion(x=0.0, y=0.0, z=math.sin(half_rad), w=math.cos(half_rad))


def _pose(x_m: float, y_m: float, z_m: float, angle_rad: float = 0.0) -> Any:
    return m.Pose(
        position=m.Vector3(x=_round(x_m), y=_round(y_m), z=_round(z_m)),
        orientation=_turned(angle_rad),
    )


def _colour(status: NodeStatus, opacity: float) -> Any:
    red, green, blue = COLOURS[status]
    return m.Color(r=red, g=green, b=blue, a=opacity)


def _flat_ellipse(pose: Any, major_m: float, minor_m: float, colour: Any) -> Any:
    return m.CylinderPrimitive(
        pose=pose,
        size=m.Vector3(
            x=_round(2.0 * SCALE_90 * major_m) + GRID_M,
            y=_round(2.0 * SCALE_90 * minor_m) + GRID_M,
            z=0.03125,
        ),
        bottom_scale=1.0,
        top_scale=1.0,
        color=colour,
    )


def _ellipse(node: NodeEstimate) -> Any:
    pose = _pose(node.x_m, node.y_m, node.z_m, node.sigma_angle_rad)
    return _flat_ellipse(pose, node.sigma_major_m, node.sigma_minor_m, _colour(node.status, 0.25))


def _body(node: NodeEstimate) -> Any:
    return m.SpherePrimitive(
        pose=_pose(node.x_m, node.y_m, node.z_m),
        size=m.Vector3(x=0.5, y=0.5, z=0.5),
        color=_colour(node.status, 1.0),
    )


def _heading(node: NodeEstimate) -> Any:
    return m.ArrowPrimitive(
        pose=_pose(node.x_m, node.y_m, node.z_m, node.heading_rad),
        shaft_length=0.75,
        shaft_diameter=0.125,
        head_length=0.375,
        head_diameter=0.3125,
        color=_colour(node.status, 1.0),
    )


def _label(node: NodeEstimate, text: str) -> Any:
    words = text if node.status is NodeStatus.OK else f"{text} ({node.status})"
    return m.TextPrimitive(
        pose=_pose(node.x_m, node.y_m, node.z_m + 0.75),
        billboard=True,
        font_size=14.0,
        scale_invariant=True,
        color=_colour(node.status, 1.0),
        text=words,
    )


def _ghost_colour(row: Alternative) -> Any:
    red, green, blue = COLOURS[NodeStatus.AMBIGUOUS]
    return m.Color(r=red, g=green, b=blue, a=0.0625 + 0.5 * row.probability)


def _ghost(row: Alternative) -> Any:
    pose = _pose(row.x_m, row.y_m, 0.0, row.sigma_angle_rad)
    return _flat_ellipse(pose, row.sigma_major_m, row.sigma_minor_m, _ghost_colour(row))


def _ring(row: Alternative) -> Any:
    turns = (2.0 * math.pi * k / RING_POINTS for k in range(RING_POINTS))
    return m.LinePrimitive(
        type=m.LinePrimitiveLineType.LineLoop,
        pose=_pose(row.x_m, row.y_m, 0.0),
        thickness=max(_round(2.0 * row.sigma_minor_m), GRID_M),
        points=[
            m.Point3(
                x=_round(row.sigma_major_m * math.cos(turn)),
                y=_round(row.sigma_major_m * math.sin(turn)),
                z=0.0,
            )
            for turn in turns
        ],
        color=_ghost_colour(row),
    )
