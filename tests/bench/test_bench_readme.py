"""The table of benchmarks names what there is."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

BENCH = Path(__file__).parents[2] / "bench"


RUN = {
    path.relative_to(BENCH).as_posix(): path.read_text()
    for path in BENCH.rglob("*.py")
    if '__name__ == "__main__"' in path.read_text()
}


def test_the_readme_names_every_file_that_can_be_run_and_no_other() -> None:
    named = re.findall(r"`([\w/]+\.py)`", (BENCH / "README.md").read_text())
    assert set(named) == set(RUN)
    assert len(named) == len(RUN)


@pytest.mark.parametrize("name", sorted(RUN))
def test_what_can_be_run_says_how_and_answers_help(name: str) -> None:
    head = ast.get_docstring(ast.parse(RUN[name])) or ""
    assert f"python bench/{name}" in head
    assert ".parse_args(" in RUN[name], "else --help runs it"
