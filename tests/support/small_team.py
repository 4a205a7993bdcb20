"""A small team that walks about, its truth and an estimate of it with known errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus, Parameter, pairs_of
from relpos.measurements import Event, Motion, Prior, Range, Truth
from relpos.runs import Description, Landmark, NodeInfo, Run, save_run, write_estimates
from support.command import relpos

SECONDS = 40
NAMES = {1: "Åsa", 2: "Kim", 3: "Li & Söhne", 4: None}
LANDMARKS = (Landmark("17", 3.0, -2.0), Landmark("18", 10.0, 4.5, 3.25))


def true_pose(node: int, time_s: float) -> tuple[float, float, float]:
    """Where a node is: circles of different sizes and speeds, facing along them."""
    radius_m, turn_rad = 4.0 + 3.0 * node, 0.3 * node + 0.9 * time_s / (4.0 + 3.0 * node)
    heading_rad = math.remainder(turn_rad + 0.5 * math.pi, 2.0 * math.pi)
    return radius_m * math.cos(turn_rad), radius_m * math.sin(turn_rad) - node, heading_rad


def estimates(
    *, sigma_m: float = 0.4, statuses: dict[tuple[int, int], NodeStatus] | None = None
) -> list[Estimate]:
    """An estimate a second with errors of 0.4 m, the same in every test."""
    noise = np.random.default_rng(4)
    made: list[Estimate] = []
    for second in range(1, SECONDS + 1):
        nodes = []
        for node in NAMES:
            x_m, y_m, heading_rad = true_pose(node, second)
            dx, dy = noise.normal(0.0, sigma_m, 2)
            nodes.append(
                NodeEstimate(
                    node,
                    round(x_m + dx, 6),
                    round(y_m + dy, 6),
                    round(heading_rad, 6),
                    0.25,
                    0.09,
                    0.02,
                    0.05,
                    (statuses or {}).get((node, second), NodeStatus.OK),
                    0.5 * node,
                    0.2,
                )
            )
        learned = (Parameter(float(second), 1, None, "step_scale", 1.0 + 0.001 * second, 0.01),)
        made.append(Estimate(float(second), tuple(nodes), pairs_of(nodes), (), learned))
    return made


def run(*, events: Sequence[Event] = (), truth: bool = True, priors: bool = True) -> Run:
    """The recording: a few measurements, names, and the truth each second."""
    rows = [
        Truth(float(second), node, *true_pose(node, second), z_m=0.5 * node)
        for second in range(SECONDS + 1)
        for node in NAMES
    ]
    measurements = [
        measurement
        for second in range(1, SECONDS + 1)
        for measurement in (
            *(Motion(float(second), node, 0.9, 0.0, 0.1, moving=True) for node in NAMES),
            Range(float(second), 1, 2, 5.0 + 0.1 * second),
        )
    ]
    return Run(
        name="yard",
        description=Description(
            priors=tuple(Prior(n, *true_pose(n, 0.0)) for n in NAMES) if priors else (),
            nodes={node: NodeInfo(name=name) for node, name in NAMES.items()},
        ),
        measurements=tuple(measurements),
        events=tuple(events),
        truth=tuple(rows) if truth else (),
    )


def written(tmp_path: Path, **settings: bool) -> tuple[Path, Path]:
    """The run directory and the estimate directory."""
    save_run(run(**settings), tmp_path / "yard")
    write_estimates(tmp_path / "fused", estimates())
    return tmp_path / "yard", tmp_path / "fused"


class CommandResult:
    """What a command printed and how it ended."""

    def __init__(self, *words: object) -> None:
        result = relpos(*words)
        self.status = result.exit_code
        self.files = [Path(line) for line in result.stdout.splitlines()]
        self.remarks = result.stderr.splitlines()


def convert(*words: object) -> CommandResult:
    """Run ``relpos convert`` and see that it went well."""
    result = CommandResult("convert", *words)
    assert result.status == 0, result.remarks
    return result


def refused(*words: object) -> str:
    """Run ``relpos convert`` and return the one line it fails with."""
    result = CommandResult("convert", *words)
    assert result.status == 1, result.remarks
    assert not result.files
    (line,) = result.remarks
    assert line.startswith("relpos: ")
    return line
