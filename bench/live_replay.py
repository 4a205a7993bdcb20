"""An hour's recording on the page: how soon it opens, how long a seek takes, what the page holds.

Writes a recording of a team that walks by a formula, in blocks of a quarter of a second as a live
session does, then runs ``relpos replay`` and asks for moments all over the hour: at once, while the
recording is still being read for its events, and afterwards. A seek ends when a WebSocket client
has the picture of that moment. Memory is that of the page's process and of its JavaScript heap, in
Chromium, where there is one. Prints the computer's load, which is part of the answer.

    python bench/live_replay.py [--people 20] [--minutes 60] [--seeks 60]
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import httpx
from websockets.sync.client import connect

from live_session import page_of
from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus, PairEstimate
from relpos.measurements import Event, Motion, Range, Status
from relpos.recording import container
from relpos.recording.about import About
from relpos.recording.encoder import Encoder, Item
from relpos.recording.schemas import all_topics

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "view"))

from stage import browser_of, chromium, sync_playwright

BLOCK_S = 0.25
RANGES_EACH = 3
OPEN_S, SEEK_S, PAGE_MB = 2.0, 0.3, 300.0


def pose(node: int, time_s: float) -> tuple[float, float, float]:
    """Where somebody is: everybody goes round a circle of their own."""
    radius_m = 4.0 + node
    angle = 1.2 * time_s / radius_m
    return radius_m * math.cos(angle), radius_m * math.sin(angle), angle + 0.5 * math.pi


def items(people: int, seconds: int) -> Iterator[tuple[float, Item]]:
    """What a session records, a second after the other."""
    nodes = range(1, people + 1)
    for second in range(1, seconds):
        for node in nodes:
            at_s = second + node / (people + 1)
            x_m, y_m, _ = pose(node, at_s)
            # Somebody lies still for a minute in every ten.
            still = second % 600 > 540 and node == 1 + second // 600
            rows: list[Any] = [Motion(at_s, node, 0.0 if still else 1.2, 0.0, 0.05)]
            for k in range(RANGES_EACH):
                peer = 1 + (node + second + 5 * k) % people
                if peer != node:
                    to = pose(peer, at_s)
                    range_m = math.hypot(x_m - to[0], y_m - to[1])
                    rows.append(Range(at_s, node, peer, range_m))
            if (second + node) % 10 == 0:
                rows.append(Status(at_s, node, "battery_v", 4.1))
            if second % 300 == 0 and node == 2:
                rows.append(Event(at_s, node, "landmark", str(second // 300)))
            yield at_s, tuple(rows)
        found = [
            NodeEstimate(node, *pose(node, second), 0.04, 0.03, 0.0, 0.1, NodeStatus.OK)
            for node in nodes
        ]
        pairs = [
            PairEstimate(
                a.node, b.node, math.hypot(b.x_m - a.x_m, b.y_m - a.y_m), 0.2,
                math.atan2(b.y_m - a.y_m, b.x_m - a.x_m), 0.1,
            )
            for k, a in enumerate(found) for b in found[k + 1 :]
        ]  # fmt: skip
        yield second + 0.99, Estimate(float(second), tuple(found), tuple(pairs))


def write(path: Path, people: int, seconds: int) -> None:
    """Write the recording."""
    about, topics = About(time.time_ns()), all_topics()
    encoder = Encoder(about.started_unix_ns, {})
    block = container.Block(container.numbered(topics))
    due_s = BLOCK_S
    with path.open("wb") as file:
        file.write(container.beginning(about.metadata(), topics))
        for at_s, item in items(people, seconds):
            if at_s >= due_s and len(block):
                file.write(block.pop())
                due_s = at_s + BLOCK_S
            for message in encoder.messages(at_s, item):
                block.add(message)
        file.write(block.pop())
    container.finish(path)


class Follower:
    """A client that has the newest picture and the newest time line."""

    def __init__(self, url: str) -> None:
        self.at_s = math.nan
        self.people = 0
        self.reading = True
        self._news = threading.Condition()
        threading.Thread(target=self._follow, args=(url,), daemon=True).start()

    def _follow(self, url: str) -> None:
        with connect(url, max_size=None) as socket:
            for text in socket:
                message = json.loads(text)
                with self._news:
                    if message["type"] == "picture":
                        self.at_s, self.people = message["time_s"], len(message["people"])
                    elif message["type"] == "timeline":
                        self.reading = message["reading"]
                    self._news.notify_all()

    def wait(self, condition: Any) -> float:
        """Wait for a condition; return when it came about (monotonic)."""
        with self._news:
            assert self._news.wait_for(lambda: condition(self), 120.0), "it did not come about"
        return time.monotonic()


def seek(client: httpx.Client, follower: Follower, seconds: int, count: int) -> list[float]:
    """Seconds of so many seeks to anywhere."""
    took = []
    anywhere = random.Random(len(str(count)))
    for _ in range(count):
        at_s = round(anywhere.uniform(20.0, seconds - 20.0), 1)
        asked_s = time.monotonic()
        client.post("/api/replay", json={"at_s": at_s, "playing": False}).raise_for_status()
        took.append(follower.wait(lambda f, at=at_s: abs(f.at_s - at) < 0.01) - asked_s)
    return took


def page_memory(url: str, seek_all: Any) -> tuple[float, float]:
    """Megabytes of the page's process and of its heap after the seeks."""
    with sync_playwright() as playwright, browser_of(playwright) as browser:
        page = browser.new_page(viewport={"width": 1366, "height": 768})
        page.goto(url)
        page.locator("#people li").first.wait_for(timeout=60_000)
        seek_all()
        page.wait_for_timeout(2000)
        session = page.context.new_cdp_session(page)
        session.send("Performance.enable")
        found = session.send("Performance.getMetrics")["metrics"]
        heap = next(m["value"] for m in found if m["name"] == "JSHeapUsedSize")
        whole = browser.new_browser_cdp_session().send("SystemInfo.getProcessInfo")
        renderers = [p["id"] for p in whole["processInfo"] if p["type"] == "renderer"]
        return max(resident_mb(pid) for pid in renderers), heap / 1e6


def resident_mb(pid: int) -> float:
    """Resident memory of a process, what it shares with others included."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def words(took: Sequence[float]) -> str:
    """Median, worst."""
    ordered = sorted(took)
    return f"median {ordered[len(ordered) // 2]:.2f} s, worst {ordered[-1]:.2f} s"


def main() -> int:
    """Run it; 1 where a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--people", type=int, default=20)
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--seeks", type=int, default=60)
    parser.add_argument("--recording", type=Path, help="keep it there, or use what is there")
    wanted = parser.parse_args()
    seconds = 60 * wanted.minutes
    with tempfile.TemporaryDirectory() as folder:
        path = wanted.recording or Path(folder) / "hour.mcap"
        if not path.exists():
            write(path, wanted.people, seconds)
        print(f"{wanted.minutes} min of {wanted.people} people: {path.stat().st_size / 1e6:.0f} MB")
        began_s = time.monotonic()
        command = [sys.executable, "-m", "relpos.cli.main", "replay", str(path), "--no-open"]
        replay = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            host, key = page_of(replay)
            follower = Follower(f"ws{host}/ws?{key}")
            opened_s = follower.wait(lambda f: f.people > 0) - began_s
            client = httpx.Client(base_url=f"http{host}", timeout=60.0, follow_redirects=True)
            client.get(f"/?{key}")
            early = seek(client, follower, seconds, wanted.seeks)
            read_s = follower.wait(lambda f: not f.reading) - began_s
            late = seek(client, follower, seconds, wanted.seeks)
            memory = None
            if chromium() is not None:
                address = f"http{host}/?{key}"
                memory = page_memory(address, lambda: seek(client, follower, seconds, wanted.seeks))
            server_mb = resident_mb(replay.pid)
        finally:
            replay.send_signal(signal.SIGINT)
            replay.wait(30.0)
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print(f"first picture after {opened_s:.2f} s, whole recording read after {read_s:.1f} s")
    print(f"seeks while it is read: {words(early)}")
    print(f"seeks afterwards:       {words(late)}")
    print(f"replay's process {server_mb:.0f} MB")
    if memory is not None:
        print(f"page {memory[0]:.0f} MB, of that its JavaScript heap {memory[1]:.0f} MB")
    good = opened_s < OPEN_S and max(*early, *late) < SEEK_S
    return int(not good or (memory is not None and memory[0] >= PAGE_MB))


if __name__ == "__main__":
    sys.exit(main())
