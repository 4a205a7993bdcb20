"""The table of benchmarks names what there is."""

from __future__ import annotations

import re
from pathlib import Path

BENCH = Path(__file__).parents[2] / "bench"


def test_the_readme_names_every_file_that_can_be_run_and_no_other() -> None:
    named = re.findall(r"`([\w/]+\.py)`", (BENCH / "README.md").read_text())
    there = {
        path.relative_to(BENCH).as_posix()
        for path in BENCH.rglob("*.py")
        if '__name__ == "__main__"' in path.read_text()
    }
    assert set(named) == there
    assert len(named) == len(there)
