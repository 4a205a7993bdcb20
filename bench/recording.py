"""What a recording costs: bytes an hour, and processor time beside the session's own.

An emulated team is decoded and fused first; then its session is handed to a recorder at its own
pace, as the live session does, and nothing else is computed meanwhile. Prints the file's size, by
topic before compression, the fraction of one processor that recorder and calls took, and the
longest time that the session had to wait in a call.

    python bench/recording.py --nodes 20 --seconds 60
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path

from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.fusion import make
from relpos.link.port import Link
from relpos.measurements import Measurement
from relpos.recording import make_recorder, open_recording
from relpos.recording.about import About

SETTLE_S = 30.0
"""Not recorded: nodes boot, and the estimator meets them."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--nodes", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()

    link, steps = Link(), []
    length_s = SETTLE_S + options.seconds
    with EmulatedTeam(
        TeamConfig("paper", options.nodes, length_s, options.seed, beacons=True)
    ) as team:
        estimator = make("bank", team.priors())
        for time_us, data in team.stream():
            observations = link.feed(data, time_us * 1e-6)
            estimates = [
                estimate
                for o in observations
                if isinstance(o, Measurement)
                for estimate in estimator.process(o)
            ]
            steps.append((time_us * 1e-6, data, observations, estimates))
    steps = [step for step in steps if step[0] >= SETTLE_S]

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.mcap"
        recorder = make_recorder(path, About(time.time_ns()))
        longest_s = 0.0
        began_s, cpu_s = time.monotonic(), time.process_time()
        for time_s, data, observations, estimates in steps:
            time.sleep(max(began_s + time_s - SETTLE_S - time.monotonic(), 0.0))
            called_s = time.perf_counter()
            recorder.received(time_s, data)
            recorder.observed(time_s, observations)
            for estimate in estimates:
                recorder.estimated(estimate)
            longest_s = max(longest_s, time.perf_counter() - called_s)
        recorder.close()
        took_s = time.monotonic() - began_s
        cpu_s = time.process_time() - cpu_s
        size = path.stat().st_size
        by_topic: Counter[str] = Counter()
        for entry in open_recording(path).entries():
            by_topic[entry.topic] += len(entry.data)
    hours = took_s / 3600.0
    print(f"{options.nodes} nodes, {took_s:.0f} s: {size / hours / 1e6:.0f} MB an hour")
    print(f"serial bytes alone: {sum(len(s[1]) for s in steps) / hours / 1e6:.1f} MB an hour")
    print(f"processor: {100.0 * cpu_s / took_s:.2f} % of one, the sleeping loop included")
    print(f"longest wait of the session in a call: {1e3 * longest_s:.2f} ms")
    for topic, count in by_topic.most_common():
        print(f"  {topic:<14} {count / hours / 1e6:7.1f} MB an hour before compression")


if __name__ == "__main__":
    main()
