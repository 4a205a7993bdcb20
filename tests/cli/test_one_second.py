"""What is printed at the end of a run is of one second."""

from __future__ import annotations

import re
from pathlib import Path

from relpos.measurements import Motion, Prior, Range, Truth
from relpos.runs import Description, Run, save_run
from support.command import relpos


def test_both_tables_of_a_scored_run_show_the_same_second(tmp_path: Path) -> None:
    rows = range(1, 31)
    run = Run(
        name="corridor",
        description=Description(priors=(Prior(1, 0, 0, 0), Prior(2, 0, 3, 0))),
        measurements=tuple(
            m
            for k in rows
            for m in (
                *(Motion(k + 0.4, node, 1.0, 0.0, 0.0) for node in (1, 2)),
                Range(k + 0.4, 1, 2, 3.0),
            )
        ),
        # The truth ends before the measurements do.
        truth=tuple(
            Truth(float(k), node, k - 0.4, 3.0 * (node - 1), 0.0)
            for k in range(1, 21)
            for node in (1, 2)
        ),
    )
    save_run(run, tmp_path / "run")
    words = ("fuse", tmp_path / "run", "--estimator", "deadreckoning", "--no-report")
    done = relpos(*words, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    first = re.search(r"deadreckoning, at (\S+) s", done.stdout)
    second = re.search(r"the end at (\d+) s", done.stdout)
    assert first
    assert second
    assert abs(float(first[1]) - float(second[1])) <= 0.5
