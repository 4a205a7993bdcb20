"""A live session of hours: whether its memory stays flat and its views stay fresh.

An emulated team walks behind a pseudo-terminal; ``relpos fuse PORT --view`` runs as a user would
start it; a WebSocket client follows the page's views. Every so often the processes' resident
memory is read. Compared are the time after the warm-up and the end:

- memory of the session and of the page's server: the last quarter's median against that of the
  first quarter after the warm-up;
- the view's age when it arrives (from its newest packet's arrival), and how far the fused
  estimate is behind the view.

    python bench/live_soak.py --hours 2 --nodes 20 --speed 10
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from live_session import page_of
from relpos.emulator.process import EmulatorProcess
from relpos.emulator.team import TeamConfig

WARM_UP_SHARE = 0.1
FLAT = 1.05


@dataclass
class Sample:
    """One look: virtual time, memory in MB, ages in seconds since the look before."""

    time_s: float
    session_mb: float
    view_mb: float
    age_s: list[float]
    behind_s: list[float]


@dataclass
class Follower:
    """A browser's part: takes pictures as they come."""

    url: str
    time_s: float = 0.0
    pictures: int = 0
    age_s: list[float] = field(default_factory=list)
    behind_s: list[float] = field(default_factory=list)
    notices: set[str] = field(default_factory=set)

    def follow(self) -> None:
        """Until the session ends."""
        with contextlib.suppress(WebSocketException, OSError), connect(self.url) as socket:
            for message in socket:
                view = json.loads(message)
                if view["type"] != "picture":
                    continue
                self.pictures += 1
                self.notices |= {n["text"] for n in view["notices"] if n["id"] != "fusion"}
                if view["time_s"] > self.time_s and view["arrived_unix_s"] is not None:
                    self.age_s.append(time.time() - view["arrived_unix_s"])
                    if view["fused_s"] is not None:
                        self.behind_s.append(view["time_s"] - view["fused_s"])
                self.time_s = max(self.time_s, view["time_s"])


def resident_mb(pid: int) -> float:
    """Resident memory of a process."""
    status = Path(f"/proc/{pid}/status").read_text()
    found = re.search(r"VmRSS:\s+(\d+) kB", status)
    return int(found[1]) / 1024 if found else 0.0


def view_of(pid: int) -> int | None:
    """The page's server among a session's children."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    for child in map(int, children):
        with contextlib.suppress(OSError):
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                return child
    return None


def main() -> int:
    """Run it; 1 where something grows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=float, default=2.0, help="of the team's time")
    parser.add_argument("--nodes", type=int, default=20)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--estimator", default="bank")
    parser.add_argument("--initial", default="unknown")
    parser.add_argument("--look-s", type=float, default=10.0, help="between two looks, wall clock")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="where the session's files go")
    parser.add_argument("--json", type=Path, help="where the looks go")
    wanted = parser.parse_args()
    seconds = wanted.hours * 3600.0
    with contextlib.ExitStack() as stack:
        out = wanted.out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        print(f"preparing a walk of {seconds:.0f} s of {wanted.nodes} people", flush=True)
        team = stack.enter_context(
            EmulatorProcess(
                TeamConfig(nodes=wanted.nodes, seconds=seconds, seed=wanted.seed), wanted.speed
            )
        )
        session = subprocess.Popen(
            [
                sys.executable, "-m", "relpos.cli.main", "fuse", team.port, "--view", "--no-open",
                "--estimator", wanted.estimator, "--initial", wanted.initial,
                "--out", str(out),
            ],
            stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        stack.callback(session.kill)
        host, key = page_of(session)
        follower = Follower(f"ws{host}/ws?{key}")
        threading.Thread(target=follower.follow, daemon=True).start()
        looks = watch(session, follower, seconds, wanted.look_s)
        session.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            session.wait(60.0)
    if wanted.json:
        wanted.json.write_text(json.dumps([vars(look) for look in looks]))
    print("notices seen:", *sorted(follower.notices), sep="\n  ")
    return judge(looks, wanted.speed)


def watch(
    session: subprocess.Popen[str], follower: Follower, seconds: float, look_s: float
) -> list[Sample]:
    """Look until the walk is over."""
    looks: list[Sample] = []
    stood_s = 0.0
    while session.poll() is None and follower.time_s < seconds - 5.0 and stood_s < 60.0:
        before_s = follower.time_s
        time.sleep(look_s)
        stood_s = stood_s + look_s if follower.time_s == before_s else 0.0
        view = view_of(session.pid)
        age_s, follower.age_s = follower.age_s, []
        behind_s, follower.behind_s = follower.behind_s, []
        looks.append(
            Sample(
                follower.time_s,
                resident_mb(session.pid),
                0.0 if view is None else resident_mb(view),
                age_s,
                behind_s,
            )
        )
        look = looks[-1]
        print(
            f"{look.time_s:7.0f} s  session {look.session_mb:6.1f} MB  view {look.view_mb:5.1f} MB"
            f"  age {1e3 * (median(age_s)):5.1f} ms  fused {median(behind_s):5.2f} s behind",
            flush=True,
        )
    return looks


def median(values: list[float]) -> float:
    """Median, or NaN of nothing."""
    return statistics.median(values) if values else float("nan")


def judge(looks: list[Sample], speed: float) -> int:
    """Print first against last; 1 where memory grew by more than allowed."""
    looks = looks[int(WARM_UP_SHARE * len(looks)) :]
    quarter = max(len(looks) // 4, 1)
    first, last = looks[:quarter], looks[-quarter:]
    grew = 0
    print(f"{looks[0].time_s:.0f} to {looks[-1].time_s:.0f} s of the walk, {speed:g} x real time")
    for name in ("session_mb", "view_mb"):
        a, b = (median([getattr(look, name) for look in part]) for part in (first, last))
        grew |= b > FLAT * a
        print(f"{name:12} {a:8.1f} -> {b:8.1f}  {100 * (b / a - 1):+.1f} %")
    for name in ("age_s", "behind_s"):
        a, b = (median([v for look in part for v in getattr(look, name)]) for part in (first, last))
        print(f"{name:12} {a:8.3f} -> {b:8.3f}")
    return int(grew)


if __name__ == "__main__":
    sys.exit(main())
