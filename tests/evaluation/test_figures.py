"""The paper's figures: what is written, what stands beside the paper's values, what is drawn."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path

import numpy as np
import pytest

from relpos.cli import figures as command
from relpos.evaluation import bounds, executors, study
from relpos.evaluation.figures import FIGURES, Work, page, save
from relpos.evaluation.figures.sheet import key
from support.command import relpos

OWN = f"{Path(__file__).parents[1] / 'fusion' / 'own_estimators.py'}:Adder"
WRITTEN = ("detection", "tracks-lab")


class Invented(Work):
    """Figures of numbers that are made up: a case's RMSE is a function of the case."""

    def __init__(self, pool: Executor) -> None:
        super().__init__(range(3), pool)

    def outcomes(self, cases: Sequence[study.Case]) -> list[study.Outcome]:
        return [study.Outcome(c, tuple(self.score(c, s) for s in self.seeds)) for c in cases]

    def score(self, case: study.Case, seed: int) -> study.Score:
        rmse = rmse_of(case) + 0.1 * (seed - 1)
        time_s = np.arange(1.0, 601.0)
        return study.Score(
            seed, rmse, rmse / 2, 0.0, 1.0, 0.0, time_s, np.full(600, rmse), np.full(600, rmse), {}
        )

    def bounds(self, cases: Sequence[study.Case]) -> list[bounds.Totals]:
        return [bounds.Totals(0.5, 0.4, 0.2, 0.1) for _ in cases]

    def each(self, function: object, jobs: Sequence[tuple[object, ...]]) -> list[object]:
        return [np.array([[1.0, 600.0], [0.5, 0.5]]) for _ in jobs]


def rmse_of(case: study.Case) -> float:
    base = {"deadreckoning": 9.0, "bank": 0.7, "particle": 2.0}[case.estimator]
    alpha = float(str(case.settings.get("alpha", 0.01)))
    return base + alpha + float(case.overrides.get("start_shift_m", 0.0)) / 10.0


@pytest.mark.parametrize(
    ("name", "printed"),
    [
        ("range-noise", {"10": 9.01, "2.1": 2.01}),
        ("particles", {"1.8": 2.01, "2.0": 2.0}),
        ("wrong-start", {"2.6": 2.41, "4.5": 2.4}),
        ("over-time-simulation", {"10": 9.01, "2.1": 2.01}),
        ("over-time-lab", {"3.0": 9.01, "2.2": 2.01}),
    ],
)
def test_the_papers_values_stand_beside_ours_of_the_same_settings(
    name: str, printed: dict[str, float], tmp_path: Path
) -> None:
    sheet = FIGURES[name](Invented(executors.Serial()))
    assert {b.paper: b.ours for b in sheet.beside} == pytest.approx(printed)
    # Three seeds 0.1 apart: standard error .1 / sqrt(3).
    assert all(b.half_width == pytest.approx(1.96 * 0.1 / 3**0.5) for b in sheet.beside)
    svg, png, table = save(sheet, tmp_path)
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(sheet.rows)
    assert {"bank", "bound"} <= {row["estimator"] for row in rows}
    words = svg.read_text()
    assert "bound" in words
    assert "(m)" in words
    assert png.stat().st_size > 10_000


def test_cases_that_two_figures_share_are_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def run(cases: Sequence[study.Case], *_: object) -> list[study.Outcome]:
        asked.extend(str(key(case)) for case in cases)
        return [study.Outcome(case, ()) for case in cases]

    monkeypatch.setattr(study, "run", run)
    work = Work(range(2), executors.Serial())
    default, same, other = study.Case("a"), study.Case("b"), study.Case("c", estimator="bank")
    assert len(work.outcomes([default, same, other])) == 3
    work.outcomes([other, default])
    assert len(asked) == len(set(asked)) == 2


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command writes, with an estimator of one's own."""
    folder = tmp_path_factory.mktemp("figures") / "f"
    chosen = [word for name in WRITTEN for word in ("--figure", name)]
    options = ["--estimator", OWN, "--seeds", "2", "--workers", "1"]
    made = relpos("figures", *chosen, *options, "--out", folder)
    assert made.exit_code == 0, made.output
    return folder


def test_the_command_writes_pictures_numbers_and_one_page_that_needs_no_other_file(
    written: Path,
) -> None:
    for name in WRITTEN:
        for kind in ("svg", "png", "csv"):
            assert (written / f"{name}.{kind}").stat().st_size > 500
    words = (written / "index.html").read_text()
    assert words.count("src='data:image/svg+xml;base64,") == len(WRITTEN)
    assert not re.search(r"(src|href)=['\"](?!data:)", words)
    assert "--seeds 2" in words


def test_an_estimator_of_ones_own_is_drawn_beside_ours(written: Path) -> None:
    assert "Adder" in (written / "tracks-lab.svg").read_text()
    assert OWN in (written / "tracks-lab.csv").read_text()


def test_an_unknown_figure_is_wrong_usage_that_names_the_known_ones(tmp_path: Path) -> None:
    made = relpos("figures", "--figure", "x", "--out", tmp_path)
    assert made.exit_code == 2
    assert set(command.NAMES.split(", ")) == set(FIGURES)


def test_a_page_shows_numbers_and_intervals(tmp_path: Path) -> None:
    sheet = FIGURES["particles"](Invented(executors.Serial()))
    svg, _, _ = save(sheet, tmp_path)
    page.write([sheet], [svg], tmp_path / "index.html", "how <it> was made")
    words = (tmp_path / "index.html").read_text()
    assert "how &lt;it&gt; was made" in words
    assert "<td>1.8 m</td><td>2.01 ± 0.11 m</td>" in words
