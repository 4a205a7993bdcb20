"""Heights and floors of recorded walkers with a barometer, beside what the barometer alone gives.

Get the recordings first, then run ``.venv/bin/python bench/heights.py FOLDER``:

    relpos recordings get height_phone_museum --out FOLDER/height_phone_museum
    relpos recordings get height_phone_hamburg --out FOLDER/height_phone_hamburg

Phones' sensors go through the firmware (steps, height) and the estimator `bank`. Each
walker is alone: nobody else shows the weather. Both are asked at the surveyed points:

- returns: difference of two visits of one point, more than a minute apart;
- floors, counted from the start's: right, not said, wrong; the barometer's is the nearest of
  storeys of 3.5 m;
- changes of the floor between two points, found with the true number of storeys; false ones are
  changes where there was none;
- error: of the height over the start, where the plan tells it.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np

import relpos
from relpos import fusion
from relpos.emulator.deadreckoning import WearerSettings, play
from relpos.fusion.estimator import NodeEstimate
from relpos.measurements import Height, Prior
from relpos.runs import Run

LATER_S = 60.0
SAME_PLACE_M = 0.5
STOREY_M = 3.5


@dataclass
class Figures:
    """What one source of heights says at the points of a set's walks."""

    returns_m: list[float] = field(default_factory=list)
    errors_m: list[float] = field(default_factory=list)
    floors: list[int | None] = field(default_factory=list)
    """Said less true; None: not said."""
    changes: list[bool] = field(default_factory=list)
    false_changes: list[bool] = field(default_factory=list)

    def line(self, name: str) -> str:
        """One row of the table."""
        apart = np.abs(self.returns_m)
        spread = np.median(apart), np.sqrt(np.mean(apart**2)), np.quantile(apart, 0.9)
        returns = " / ".join(f"{value:.2f}" for value in spread)
        error = f"{np.sqrt(np.mean(np.square(self.errors_m))):.2f}" if self.errors_m else ""
        right, unsaid = self.floors.count(0), self.floors.count(None)
        floors = f"{right}, {unsaid}, {len(self.floors) - right - unsaid}" if self.floors else ""
        cells = (floors, share(self.changes), share(self.false_changes), error)
        return f"| {name} | {returns} | {' | '.join(cells)} |"


def share(found: list[bool]) -> str:
    """``3 of 4``; empty where there is nothing."""
    return f"{sum(found)} of {len(found)}" if found else ""


def reported(run: Run) -> tuple[list[tuple[float, NodeEstimate]], list[Height]]:
    """Estimates of the walk with their times, and the heights that the node reported."""
    recording = run.load_imu()[1]
    output = play(1, recording, WearerSettings())
    estimator = fusion.make("bank", [Prior(1, 0.0, 0.0, 0.0)], {}, seed=1)
    measured = sorted((*output.motions, *output.heights), key=lambda m: m.time_s)
    estimates = [e for m in measured for e in estimator.process(m)]
    return [(e.time_s, e.nodes[0]) for e in estimates], list(output.heights)


def at(time_s: float, times_s: list[float]) -> int:
    """Index of the newest of ``times_s`` at ``time_s``, the first where there is none yet."""
    return max(int(np.searchsorted(times_s, time_s, side="right")) - 1, 0)


def add(run: Run, ours: Figures, barometer: Figures) -> None:
    """Score one walk."""
    estimates, heights = reported(run)
    points = [(t.time_s, t.x_m, t.y_m, t.z_m) for t in run.truth]
    marks = {round(e.time_s, 2): int(e.value) for e in run.events if e.event == "floor"}
    estimate_s, height_s = [time_s for time_s, _ in estimates], [h.time_s for h in heights]
    said = [estimates[at(time_s, estimate_s)][1] for time_s, *_ in points]
    pressed = [heights[at(time_s, height_s)].height_m for time_s, *_ in points]
    floors = [marks.get(round(time_s, 2)) for time_s, *_ in points]
    known = [z for *_, z in points]
    for figures, z, own in (
        (ours, [s.z_m for s in said], [0, *(s.floor for s in said[1:])]),
        (barometer, pressed, [round((h - pressed[0]) / STOREY_M) for h in pressed]),
    ):
        for i, j in combinations(range(len(points)), 2):
            (time_i, *place_i, _), (time_j, *place_j, _) = points[i], points[j]
            same = floors[i] == floors[j] and known[i] == known[j]
            if same and time_j - time_i > LATER_S and math.dist(place_i, place_j) < SAME_PLACE_M:
                figures.returns_m.append(z[j] - z[i])
        if known[0] is not None:
            figures.errors_m += [zk - z[0] - k + known[0] for zk, k in zip(z, known, strict=True)]
        if floors[0] is None:
            continue
        over = [f - floors[0] for f in floors]
        figures.floors += [
            None if o is None else o - f for o, f in zip(own[1:], over[1:], strict=True)
        ]
        for (own_a, own_b), (a, b) in zip(pairwise(own), pairwise(over), strict=True):
            change = None if own_a is None or own_b is None else own_b - own_a
            if a != b:
                figures.changes.append(change == b - a)
            else:
                figures.false_changes.append(change not in (0, None))


def main() -> None:
    """Print a table of both sets."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="with both sets in it")
    folder = parser.parse_args().folder
    names = ("height_phone_museum", "height_phone_hamburg")
    walks = {name: sorted((folder / name).glob("*/run.toml")) for name in names}
    if missing := [name for name, found in walks.items() if not found]:
        raise SystemExit(f"no {' and no '.join(missing)} in {folder}: see --help")
    columns = ("returns: median / RMS / 90 %", "floors: right, not said, wrong")
    print(f"| walks | {' | '.join(columns)} | changes | false | error |")
    print("|---|---|---|---|---|---|")
    for name, found in walks.items():
        ours, barometer = Figures(), Figures()
        for path in found:
            add(relpos.load(path.parent), ours, barometer)
        print(ours.line(f"{name}, {len(found)}"))
        print(barometer.line("barometer alone"))


if __name__ == "__main__":
    main()
