"""Latency from a packet's last byte on the serial port to its view in a browser.

An emulated team's bytes go into a pseudo-terminal at their own times; ``relpos fuse PORT --view``
reads it as a real coordinator's port, and a WebSocket client in a process of its own stamps every
view that it gets. A packet is shown by the first view that contains it: a motion report when
its node's pose contains that motion (``motion_s``), a ranges report when all of its ranges, but
those that newer ones of the same pair have replaced, are among the view's.

Prints the median and the 99th percentile of both, of the part from the view's making to its
arrival (``page``), how old the newest fused estimate is, processor and memory of the session and
its server, and the computer's load, which is part of the answer. A phone gets what a browser gets.

    python bench/live_latency.py --nodes 20 --seconds 120
"""

from __future__ import annotations

import argparse
import bisect
import contextlib
import json
import multiprocessing
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from live_session import page_of
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.link.port import Link
from relpos.measurements import Motion, Range

SETTLE_S = 15.0
"""Not scored: nodes boot, and the estimator meets them."""
MEDIAN_MS, MOST_MS = 50.0, 150.0


@dataclass
class Packet:
    """What one write brought, and when its last byte had been written (monotonic clock)."""

    written_s: float
    motions: list[tuple[int, float]] = field(default_factory=list)
    ranges: list[tuple[int, int, float]] = field(default_factory=list)


def record(nodes: int, seconds: float, seed: int) -> list[tuple[float, bytes]]:
    """Bytes of an emulated team at their virtual times."""
    with EmulatedTeam(TeamConfig("paper", nodes, seconds, seed, beacons=True)) as team:
        return [(time_us * 1e-6, data) for time_us, data in team.stream()]


def follow(url: str, pipe: Connection) -> None:
    """Body of the client's process: stamp everything, send it all at the end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    got: list[tuple[float, str]] = []
    with contextlib.suppress(WebSocketException, OSError), connect(url) as socket:
        pipe.send("connected")
        for message in socket:
            got.append((time.monotonic(), str(message)))
            if pipe.poll():
                break
    pipe.send(got)


def play(stream: Sequence[tuple[float, bytes]], port: int) -> list[Packet]:
    """Write at the stream's own pace; what each write meant and when it was done."""
    link = Link()
    packets: list[Packet] = []
    started_s = time.monotonic() - stream[0][0]
    for time_s, data in stream:
        wait_s = started_s + time_s - time.monotonic()
        if wait_s > 0.0:
            time.sleep(wait_s)
        observations = link.feed(data, time_s)
        while data:
            data = data[os.write(port, data) :]
        packet = Packet(time.monotonic())
        for o in observations:
            if isinstance(o, Motion):
                packet.motions.append((o.node, o.time_s))
            elif isinstance(o, Range):
                packet.ranges.append((o.node, o.peer, round(o.range_m, 4)))
        packets.append(packet)
    return packets


def score(packets: Sequence[Packet], got: Sequence[tuple[float, str]]) -> dict[str, list[float]]:
    """Seconds from writing to showing of each motion and ranges report, and the fused age."""
    views = [(s, m) for s, text in got if (m := json.loads(text))["type"] == "picture"]
    shown_s: dict[int, list[tuple[float, float]]] = defaultdict(list)
    ranged_s: dict[tuple[int, int, float], list[float]] = defaultdict(list)
    newest: dict[int, float] = {}
    fused: list[float] = []
    page: list[float] = []
    to_unix_s = time.time() - time.monotonic()
    begin_s = packets[0].written_s + SETTLE_S
    for at_s, view in views:
        for person in view["people"]:
            motion_s = person["motion_s"]
            placed = motion_s is not None and person["x_m"] is not None
            if placed and motion_s > newest.get(person["node"], -1.0):
                newest[person["node"]] = motion_s
                shown_s[person["node"]].append((motion_s, at_s))
        for node, peer, range_m, age_s in view["ranges"]:
            if age_s < 5.0:
                ranged_s[node, peer, round(range_m, 4)].append(at_s)
        if at_s > begin_s:
            if view["fused_s"] is not None:
                fused.append(view["time_s"] - view["fused_s"])
            page.append(at_s + to_unix_s - view["unix_s"])
    # The session's clock began earlier or later than the stream's: by as much for all.
    offset_s = clock_offset_s(packets, shown_s)
    result: dict[str, list[float]] = {"motion": [], "ranges": [], "missing": []}
    result |= {"page": page, "fused": fused}
    for packet in packets:
        if packet.written_s < begin_s:
            continue
        for node, motion_s in packet.motions:
            rows = shown_s[node]
            place = bisect.bisect_left(rows, (motion_s + offset_s - 0.3, 0.0))
            if place < len(rows):
                result["motion"].append(rows[place][1] - packet.written_s)
            else:
                result["missing"].append(motion_s)
        firsts = []
        for key in packet.ranges:
            times = ranged_s.get(key, [])
            place = bisect.bisect_left(times, packet.written_s)
            if place < len(times):
                firsts.append(times[place] - packet.written_s)
        if firsts:
            result["ranges"].append(max(firsts))
    return result


def clock_offset_s(
    packets: Sequence[Packet], shown_s: dict[int, list[tuple[float, float]]]
) -> float:
    """The session's clock less the stream's: median over each node's first shown motions."""
    offsets = []
    for node, rows in shown_s.items():
        sent = [(s, p.written_s) for p in packets for n, s in p.motions if n == node]
        for motion_s, at_s in rows[5:50]:
            # The newest that had been written when it was shown.
            before = [s for s, written_s in sent if written_s <= at_s]
            if before:
                offsets.append(motion_s - before[-1])
    return statistics.median(offsets)


def percentile(values: Sequence[float], share: float) -> float:
    """The nearest-rank percentile."""
    ordered = sorted(values)
    return ordered[min(int(share * len(ordered)), len(ordered) - 1)] if ordered else float("nan")


def main() -> int:
    """Run it; 1 where a target is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--nodes", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--estimator", default="bank")
    parser.add_argument(
        "--initial", default="unknown", help="common: everybody's one start is known"
    )
    parser.add_argument("--browsers", type=int, default=1, help="how many follow at once")
    parser.add_argument("--seed", type=int, default=1)
    wanted = parser.parse_args()
    print(f"emulating {wanted.nodes} nodes for {wanted.seconds:g} s", flush=True)
    stream = record(wanted.nodes, wanted.seconds, wanted.seed)
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as out:
        session = subprocess.Popen(
            [
                sys.executable, "-m", "relpos.cli.main", "fuse", os.ttyname(theirs), "--view",
                "--no-open", "--no-report", "--no-teach", "--estimator", wanted.estimator,
                "--initial", wanted.initial, "--out", out,
            ],
            stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        clients = []
        try:
            host, key = page_of(session)
            url = f"ws{host}/ws?{key}"
            for _ in range(wanted.browsers):
                pipe, end = context.Pipe()
                process = context.Process(target=follow, args=(url, end), daemon=True)
                process.start()
                clients.append((pipe, process))
            for pipe, _ in clients:
                pipe.recv()
            # Discard beacons and commands of the session, so that the buffer does not fill up.
            threading.Thread(target=_swallow, args=(ours,), daemon=True).start()
            before = usage(session.pid)
            packets = play(stream, ours)
            spent = [after - first for after, first in zip(usage(session.pid), before, strict=True)]
            memory_mb = resident_mb(session.pid)
            load = os.getloadavg()[0]
            time.sleep(1.0)
            for pipe, _ in clients:
                pipe.send(None)
            results = [score(packets, pipe.recv()) for pipe, _ in clients]
        finally:
            session.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                session.wait(120.0)
            session.kill()
    print(f"load {load:.1f} on {os.cpu_count()} cores; {wanted.browsers} browsers")
    ran_s = packets[-1].written_s - packets[0].written_s
    print(
        f"session {100 * spent[0] / ran_s:.0f} %, page's server {100 * spent[1] / ran_s:.0f} % of "
        f"a core; {memory_mb[0]:.0f} MB and {memory_mb[1]:.0f} MB"
    )
    failed = False
    for what in ("motion", "ranges", "page", "fused"):
        values = [v for result in results for v in result[what]]
        median, most = statistics.median(values), percentile(values, 0.99)
        unit, scale = ("s", 1.0) if what == "fused" else ("ms", 1e3)
        print(
            f"{what:8} {len(values):6}  median {scale * median:7.1f} {unit}  "
            f"99th {scale * most:7.1f} {unit}  most {scale * max(values):7.1f} {unit}"
        )
        if what in ("motion", "ranges"):
            failed |= 1e3 * median >= MEDIAN_MS or 1e3 * most >= MOST_MS
    missing = sum(len(result["missing"]) for result in results)
    print(f"never shown: {missing} motions")
    return int(failed or missing > 0)


def family(pid: int) -> list[int]:
    """The session's process, and its servers'."""
    return [pid, *map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split())]


def usage(pid: int) -> tuple[float, float]:
    """Processor seconds so far of the session, and of its servers."""
    ticks = []
    for process in family(pid):
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        ticks.append((int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"))
    return ticks[0], sum(ticks[1:])


def resident_mb(pid: int) -> tuple[float, float]:
    """Memory of the session, and of its servers; what they share is counted once, in parts."""
    parts = []
    for process in family(pid):
        rollup = Path(f"/proc/{process}/smaps_rollup").read_text()
        parts.append(1.024e-3 * int(rollup.split("Pss:")[1].split()[0]))
    return parts[0], sum(parts[1:])


def _swallow(port: int) -> None:
    with contextlib.suppress(OSError):
        while os.read(port, 4096):
            pass


if __name__ == "__main__":
    sys.exit(main())
