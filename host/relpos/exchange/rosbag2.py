"""ROS 2 bags through rosbags: standard messages alone, MCAP storage (the default since Iron).

Topics of node N: ``/relpos/node_N/pose`` (PoseWithCovarianceStamped in the frame ``map``, only
while it is located), ``/relpos/node_N/odometry`` (Odometry: its own motion since its first report,
in the frame ``node_N/odom``), ``/relpos/node_N/range_to_M`` (Range), ``/relpos/node_N/truth``
(PoseStamped), and ``/tf`` (map -> node_N). Frames and signs are REP-103's, as everywhere here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from relpos.errors import DataError
from relpos.exchange.content import PLACED, Content
from relpos.extras import missing_extra
from relpos.fusion.estimator import NodeEstimate

MAP = "map"
UNKNOWN_M2 = 1e6
"""Variance of what is not estimated; ROS knows no "unknown"."""
MOST_RANGE_M = 100.0
"""The reach of the Pozyx in the open, for the message's field ``max_range``."""
_Rows = Iterator[tuple[float, str, str, Any]]


def write_rosbag2(out: Path, content: Content) -> None:
    """Write everything that has a standard message, by time, as a bag in the folder ``out``."""
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise missing_extra("rosbags", "ros") from None
    store = get_typestore(Stores.ROS2_HUMBLE)
    messages = _Messages(store.types, content)
    rows = [*messages.estimates(), *messages.motions(), *messages.ranges(), *messages.truth()]
    if not rows:
        raise DataError(f"{content.run.name}: neither measurements nor estimates nor truth")
    rows.sort(key=lambda row: (row[0], row[1]))
    with Writer(out, version=8, storage_plugin=StoragePlugin.MCAP) as bag:
        connections: dict[str, Any] = {}
        for time_s, topic, kind, message in rows:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=store)
            bag.write(
                connections[topic], messages.stamp_ns(time_s), store.serialize_cdr(message, kind)
            )


class _Messages:
    """Makes the messages of a content, as (time, topic, type, message)."""

    def __init__(self, types: Any, content: Content) -> None:
        self._types = types
        self._content = content
        self._start_s = content.start_unix_s or 0.0

    def stamp_ns(self, time_s: float) -> int:
        """Return the Unix time in ns; a bag knows none before 1970."""
        return max(round((self._start_s + time_s) * 1e9), 0)

    def _make(self, kind: str, *values: Any) -> Any:
        return self._types[kind](*values)

    def _header(self, time_s: float, frame: str) -> Any:
        second, nanosecond = divmod(self.stamp_ns(time_s), 1_000_000_000)
        time = self._make("builtin_interfaces/msg/Time", second, nanosecond)
        return self._make("std_msgs/msg/Header", time, frame)

    def _turn(self, heading_rad: float) -> Any:
        half = 0.0 if math.isnan(heading_rad) else heading_rad / 2.0
        return self._make("geometry_msgs/msg/Quaternion", 0.0, 0.0, math.sin(half), math.cos(half))

    def _pose(self, x_m: float, y_m: float, z_m: float | None, heading_rad: float) -> Any:
        height_m = 0.0 if z_m is None or math.isnan(z_m) else z_m
        point = self._make("geometry_msgs/msg/Point", float(x_m), float(y_m), float(height_m))
        return self._make("geometry_msgs/msg/Pose", point, self._turn(heading_rad))

    def estimates(self) -> _Rows:
        """Poses with their covariances, and the transforms that a map display follows."""
        for estimate in self._content.estimates:
            at_s = estimate.time_s
            transforms = []
            for n in estimate.nodes:
                if n.status not in PLACED:
                    continue
                pose = self._pose(n.x_m, n.y_m, n.z_m, n.heading_rad)
                uncertain = self._make("geometry_msgs/msg/PoseWithCovariance", pose, _covariance(n))
                kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
                stamped = self._make(kind, self._header(at_s, MAP), uncertain)
                yield at_s, f"/relpos/node_{n.node}/pose", kind, stamped
                place = pose.position
                move = self._make("geometry_msgs/msg/Vector3", place.x, place.y, place.z)
                transforms.append(
                    self._make(
                        "geometry_msgs/msg/TransformStamped",
                        self._header(at_s, MAP),
                        f"node_{n.node}",
                        self._make("geometry_msgs/msg/Transform", move, pose.orientation),
                    )
                )
            if transforms:
                kind = "tf2_msgs/msg/TFMessage"
                yield at_s, "/tf", kind, self._make(kind, transforms)

    def motions(self) -> _Rows:
        """Each node's dead reckoning: its displacements one after the other."""
        at: dict[int, tuple[float, float, float]] = {}
        before_s: dict[int, float] = {}
        for m in sorted(self._content.run.motions, key=lambda m: m.time_s):
            x_m, y_m, heading = at.get(m.node, (0.0, 0.0, 0.0))
            cos, sin = math.cos(heading), math.sin(heading)
            x_m, y_m = x_m + cos * m.dx_m - sin * m.dy_m, y_m + sin * m.dx_m + cos * m.dy_m
            heading += m.dtheta_rad
            at[m.node] = x_m, y_m, heading
            lasted_s = m.time_s - before_s.get(m.node, m.time_s - 1.0)
            before_s[m.node] = m.time_s
            rate = 1.0 / lasted_s if lasted_s > 0.0 else 0.0
            vector = "geometry_msgs/msg/Vector3"
            twist = self._make(
                "geometry_msgs/msg/Twist",
                self._make(vector, m.dx_m * rate, m.dy_m * rate, 0.0),
                self._make(vector, 0.0, 0.0, m.dtheta_rad * rate),
            )
            unknown = np.diag([UNKNOWN_M2] * 6).ravel()
            kind = "nav_msgs/msg/Odometry"
            message = self._make(
                kind,
                self._header(m.time_s, f"node_{m.node}/odom"),
                f"node_{m.node}",
                self._make(
                    "geometry_msgs/msg/PoseWithCovariance", self._pose(x_m, y_m, 0.0, heading),
                    unknown,
                ),
                self._make("geometry_msgs/msg/TwistWithCovariance", twist, unknown.copy()),
            )  # fmt: skip
            yield m.time_s, f"/relpos/node_{m.node}/odometry", kind, message

    def ranges(self) -> _Rows:
        """Measured distances; the message has no kind for radio, so it says 0 (ultrasound).

        A failed one is +Inf (REP 117): no detection within reach; 0 would be a distance.
        """
        kind = "sensor_msgs/msg/Range"
        for r in self._content.run.ranges:
            header = self._header(r.time_s, f"node_{r.node}")
            range_m = float(r.range_m) if r.range_m > 0.0 else math.inf
            message = self._make(kind, header, 0, 2.0 * math.pi, 0.0, MOST_RANGE_M, range_m)
            yield r.time_s, f"/relpos/node_{r.node}/range_to_{r.peer}", kind, message

    def truth(self) -> _Rows:
        """Where everybody really was."""
        kind = "geometry_msgs/msg/PoseStamped"
        for t in self._content.run.truth:
            heading_rad = math.nan if t.heading_rad is None else t.heading_rad
            pose = self._pose(t.x_m, t.y_m, t.z_m, heading_rad)
            message = self._make(kind, self._header(t.time_s, MAP), pose)
            yield t.time_s, f"/relpos/node_{t.node}/truth", kind, message


def _covariance(n: NodeEstimate) -> Any:
    """Return the 6 x 6 covariance (x, y, z, roll, pitch, yaw) by rows."""
    matrix = np.diag([UNKNOWN_M2] * 6)
    matrix[0, 0], matrix[1, 1] = n.variance_x_m2, n.variance_y_m2
    matrix[0, 1] = matrix[1, 0] = n.covariance_xy_m2
    if n.sigma_z_m > 0.0:
        matrix[2, 2] = n.sigma_z_m**2
    matrix[5, 5] = n.sigma_heading_rad**2
    return np.nan_to_num(matrix, nan=UNKNOWN_M2).ravel()
