"""Error of the height that nodes report: climbs through chips, firmware, radio and link.

    python bench/ranging/height.py [--climbers 6] [--seed 1]

Everybody stands, climbs three flights of 18 steps, comes down one and stands again. The pieces'
pressure sensors are as in docs/emulator.md.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from unittest import mock

import numpy as np

from relpos.emulator import team as emulated
from relpos.link.port import Link
from relpos.measurements import Height
from relpos.simulation.world import FloatArray, World

sys.path.insert(0, str(Path(__file__).parents[1]))
from wearers.activities import Activity
from wearers.solo import make_walker

STAND_S = 15.0
FLIGHT = (Activity("stairs_up", count=18), Activity("stand", seconds=2.0))
SCRIPT = (
    Activity("stand", seconds=STAND_S),
    Activity("walk", 6.0),
    *FLIGHT,
    *FLIGHT,
    *FLIGHT,
    Activity("stairs_down", count=18),
    Activity("stand", seconds=STAND_S),
)


def climb(climbers: int, seed: int) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Each climber's (time in seconds, height reported, true height) in metres over the start."""
    walkers = [make_walker(SCRIPT, 100 * seed + k, node=k)[0] for k in range(1, climbers + 1)]
    end_s = max(float(walker.time_s[-1]) for walker in walkers)
    reported: dict[int, list[tuple[float, float]]] = {walker.node: [] for walker in walkers}
    link = Link()
    with (
        mock.patch.object(emulated, "make_team", return_value=(walkers, World())),
        emulated.EmulatedTeam(
            emulated.TeamConfig("stairs", climbers, end_s, seed, beacons=True)
        ) as team,
    ):
        for time_us, data in team.stream():
            for seen in link.feed(data, time_us * 1e-6):
                if isinstance(seen, Height):
                    reported[seen.node].append((seen.time_s, seen.height_m))
    rows = []
    for walker in walkers:
        time_s, height_m = np.array(reported[walker.node]).T
        start_m = walker.position_m[walker.time_s < STAND_S / 2.0, 2].mean()
        true_m = np.interp(time_s, walker.time_s, walker.position_m[:, 2]) - start_m
        kept = time_s < walker.time_s[-1]
        rows.append((time_s[kept], height_m[kept], true_m[kept]))
    return rows


def main() -> None:
    """Read the arguments, measure, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--climbers", type=int, default=6)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    print("| node | climbed | at the start: mean, sd | on the stairs: mean, largest "
          "| at the end: mean, sd |\n|---|---|---|---|---|")  # fmt: skip
    for node, (time_s, height_m, true_m) in enumerate(climb(given.climbers, given.seed), 1):
        error_m = height_m - true_m
        start, end = time_s < STAND_S, time_s > time_s[-1] - STAND_S
        stairs = ~(start | end)
        print(
            f"| {node} | {true_m.max():.1f} m "
            f"| {error_m[start].mean():+.2f} m, {error_m[start].std():.2f} m "
            f"| {error_m[stairs].mean():+.2f} m, {np.abs(error_m[stairs]).max():.2f} m "
            f"| {error_m[end].mean():+.2f} m, {error_m[end].std():.2f} m |"
        )


if __name__ == "__main__":
    main()
