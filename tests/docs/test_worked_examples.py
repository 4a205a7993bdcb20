"""The worked examples, executed as a reader would, and what they claim."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import pytest

import relpos

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"


def test_comparing_estimators_ranks_them_above_the_bound_and_draws(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = EXAMPLES / "compare_estimators.py"
    monkeypatch.setattr(sys, "argv", [str(script), str(tmp_path / "figures")])
    names = runpy.run_path(str(script))
    output = capsys.readouterr().out
    ratios = {
        name: float(value) for name, value in re.findall(r"(\w+): ([\d.]+) times the bound", output)
    }
    assert ratios["deadreckoning"] > max(ratios["particle"], ratios["bank"])
    assert min(ratios.values()) > 0.8
    assert set(names["scores"]) == {"deadreckoning", "particle", "bank"}
    written = {path.name for path in (tmp_path / "figures").iterdir()}
    assert written == {"particle.svg", "bank.html"}


def test_a_plugin_estimator_is_scored_beside_the_built_in_ones() -> None:
    scores = runpy.run_path(str(EXAMPLES / "own_estimator.py"))["main"]()
    errors = {name: score.metrics.relative_distance_rmse_m for name, score in scores.items()}
    assert errors["SmallEkf, turn_rad 0.01"] < 1.5
    assert errors["bank"] < errors["SmallEkf, turn_rad 0.02"]
    assert all(score.bound is not None for score in scores.values())


def test_the_examples_estimator_runs_by_its_file(tmp_path: Path) -> None:
    run = relpos.simulate("paper", 1, seconds=30)
    name = f"{EXAMPLES / 'own_estimator.py'}:SmallEkf"
    result = relpos.fuse(run, name, settings={"range_m": "1.0"})
    assert result.counters["motions"] == len(run.motions)
    with pytest.raises(relpos.RelposError, match="where everybody starts"):
        relpos.fuse(run, name, initial="unknown")
