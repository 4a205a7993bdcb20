"""What each node and its link report: the newest values, and counts over the last half minute."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from relpos.link.decoder import Decoder
from relpos.measurements import Observation, Status
from relpos.nodes.health import Health, HealthInputs, assess
from relpos.protocol import messages as wire

WINDOW_S = 30.0
"""Three status reports at their usual period."""
_COUNTS = (
    "ranging_successes",
    "ranging_failures",
    "missed_ticks",
    "refused_frames",
    "damaged_bytes",
    "lost_bytes",
)
UNWANTED = {
    wire.ResetCause.BROWN_OUT: "brown-out",
    wire.ResetCause.WATCHDOG: "watchdog",
    wire.ResetCause.UNKNOWN: "brown-out or button",
}
"""Many boot loaders hide the cause: unknown is unwanted where the node had been heard before."""
_FLAGS = {
    "imu": wire.Health.IMU,
    "magnetometer": wire.Health.MAGNETOMETER,
    "pozyx": wire.Health.POZYX,
    "pressure": wire.Health.PRESSURE,
    "beacon": wire.Health.BEACON,
}


def reset_cause(value: float) -> wire.ResetCause:
    """Return the cause that a status names; UNKNOWN for a value without a meaning."""
    return next((c for c in wire.ResetCause if c == value), wire.ResetCause.UNKNOWN)


class WindowedCount:
    """Growth within the window of a count that wraps at ``modulus`` and restarts with a boot."""

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._newest: tuple[int, int] | None = None
        self._growth: deque[tuple[float, int]] = deque()

    def update(self, time_s: float, boot: int, value: int) -> None:
        """Add the count's ``value`` at ``time_s`` in that boot."""
        if self._newest is not None and self._newest[0] == boot:
            grown = (value - self._newest[1]) % self._modulus
        else:
            # The count of a node that already runs is unknown before its first report; a new
            # boot's count starts at zero.
            grown = 0 if self._newest is None else value
        self._newest = (boot, value)
        self._growth.append((time_s, grown))

    def within(self, now_s: float) -> int:
        """Return the growth within the window that ends at ``now_s``."""
        while self._growth and self._growth[0][0] < now_s - WINDOW_S:
            self._growth.popleft()
        return sum(grown for _, grown in self._growth)


@dataclass
class NodeMonitor:
    """The state of one node."""

    node: int
    boot: int = 0
    heard_s: float = 0.0
    received: int = 0
    frames_lost: int = 0
    rssi_dbm: float | None = None
    status: dict[str, float] = field(default_factory=dict)
    restarted: bool = False
    """Since it was first heard."""
    _frames: deque[tuple[float, int, int]] = field(default_factory=deque)
    _counters: dict[str, WindowedCount] = field(default_factory=dict)

    def counted(self, name: str, now_s: float) -> int:
        """Return the growth of one of the status's counts within the window."""
        counter = self._counters.get(name)
        return 0 if counter is None else counter.within(now_s)

    def add_status(self, now_s: float, name: str, value: float) -> None:
        """Add one value of a status report."""
        self.status[name] = value
        if name in _COUNTS:
            modulus = wire.STATUS.field[name].modulus
            counter = self._counters.setdefault(name, WindowedCount(modulus))
            counter.update(now_s, self.boot, int(value))

    def add_link(self, now_s: float, received: int, lost: int) -> None:
        """Add the total numbers of frames received and lost."""
        self.received, self.frames_lost = received, lost
        self.heard_s = now_s
        self._frames.append((now_s, received, lost))

    def firmware(self) -> str | None:
        """Return the firmware's version; None before the first status."""
        parts = [self.status.get(f"firmware_{part}") for part in ("major", "minor", "patch")]
        return ".".join(f"{p:.0f}" for p in parts if p is not None) if None not in parts else None

    def reset_cause(self) -> str | None:
        """Return the cause of the last reset; None before the first status."""
        cause = self.status.get("reset_cause")
        return None if cause is None else reset_cause(cause).name.lower()

    def frame_loss(self, now_s: float) -> float | None:
        """Return the fraction of frames lost within the window; None without frames."""
        frames = self._frames
        while len(frames) > 1 and frames[1][0] < now_s - WINDOW_S:
            frames.popleft()
        if not frames:
            return None
        received = self.received - frames[0][1]
        lost = self.frames_lost - frames[0][2]
        return max(lost, 0) / (received + lost) if received + lost > 0 else None

    def ranging(self, now_s: float) -> tuple[float | None, int]:
        """Return the successful fraction of ranging exchanges in the window, and their number."""
        good = self.counted("ranging_successes", now_s)
        attempted = good + self.counted("ranging_failures", now_s)
        return (good / attempted if attempted else None), attempted

    def flag(self, flag: wire.Health) -> bool | None:
        """Return one of the status's health flags; None before the first status."""
        value = self.status.get("health")
        return None if value is None else bool(int(value) & flag)

    def health_inputs(self, now_s: float) -> HealthInputs:
        """Return the inputs of :func:`relpos.nodes.health.assess`."""
        status = self.status
        success, attempted = self.ranging(now_s)
        cause = reset_cause(status.get("reset_cause", 0))
        known = self.restarted or cause is not wire.ResetCause.UNKNOWN

        def integer(name: str) -> int | None:
            return int(status[name]) if name in status else None

        return HealthInputs(
            silent_s=now_s - self.heard_s,
            status=bool(status),
            frame_loss=self.frame_loss(now_s),
            rssi_dbm=self.rssi_dbm,
            battery_v=status.get("battery_v"),
            ranging=success,
            exchanges=attempted,
            neighbours=integer("neighbours"),
            team=integer("team"),
            uptime_s=status.get("uptime_s"),
            unwanted_start=UNWANTED.get(cause) if known else None,
            missed_ticks=self.counted("missed_ticks", now_s),
            refused_frames=self.counted("refused_frames", now_s),
            damaged_bytes=self.counted("damaged_bytes", now_s),
            lost_bytes=self.counted("lost_bytes", now_s),
            free_stack_bytes=integer("free_stack_bytes"),
            **{name: self.flag(flag) for name, flag in _FLAGS.items()},
        )

    def health(self, now_s: float) -> tuple[Health, list[str]]:
        """Return the node's colour and its reasons."""
        return assess(self.health_inputs(now_s))


class TeamMonitor:
    """All nodes that are received."""

    def __init__(self) -> None:
        self.nodes: dict[int, NodeMonitor] = {}
        self.foreign_frames = 0
        """Frames under another key."""

    def update(self, now_s: float, decoder: Decoder, observations: Iterable[Observation]) -> None:
        """Take in what has just arrived, at ``now_s`` on the clock of the views."""
        self.foreign_frames = decoder.counts["FrameTagError"]
        for node, track in decoder.nodes.items():
            monitor = self.nodes.get(node)
            if monitor is None:
                monitor = self.nodes[node] = NodeMonitor(node, track.boot, now_s)
            monitor.restarted |= monitor.boot != track.boot
            monitor.boot = track.boot
            received = track.counts["received"]
            if received != monitor.received:
                monitor.add_link(now_s, received, track.counts["lost"])
            monitor.rssi_dbm = None if track.rssi_dbm is None else float(track.rssi_dbm)
        self._statuses(now_s, observations)

    def update_without_link(self, now_s: float, observations: Iterable[Observation]) -> None:
        """Like :meth:`update` for recorded observations, without a link."""
        observations = list(observations)
        for observation in observations:
            monitor = self.nodes.get(observation.node)
            if monitor is None:
                monitor = self.nodes[observation.node] = NodeMonitor(observation.node)
            monitor.heard_s = now_s
        self._statuses(now_s, observations)

    def _statuses(self, now_s: float, observations: Iterable[Observation]) -> None:
        for observation in observations:
            if isinstance(observation, Status) and not observation.name.startswith("link_"):
                self.nodes[observation.node].add_status(now_s, observation.name, observation.value)

    def rows(self, now_s: float) -> list[Mapping[str, object]]:
        """Return one row a node, by id: plain values for tables and JSON."""
        rows: list[Mapping[str, object]] = []
        for node in sorted(self.nodes):
            monitor = self.nodes[node]
            health, reasons = monitor.health(now_s)
            success, attempted = monitor.ranging(now_s)
            rows.append(
                {
                    "node": node,
                    "health": health.name.lower(),
                    "reasons": reasons,
                    "firmware": monitor.firmware(),
                    "uptime_s": monitor.status.get("uptime_s"),
                    "reset_cause": monitor.reset_cause(),
                    "boots": monitor.boot,
                    "battery_v": monitor.status.get("battery_v"),
                    "rssi_dbm": monitor.rssi_dbm,
                    "loss": monitor.frame_loss(now_s),
                    "received": monitor.received,
                    "lost": monitor.frames_lost,
                    "seen_s": round(now_s - monitor.heard_s, 3),
                    "ranging": success,
                    "exchanges": attempted,
                    "key_set": monitor.flag(wire.Health.KEY_SET),
                    "range_offset_m": monitor.status.get("range_offset_m"),
                    "neighbours": monitor.status.get("neighbours"),
                    "team": monitor.status.get("team"),
                }
            )
        return rows
