"""The page of a run: what a browser gets, and that its numbers are those of the other commands."""

from __future__ import annotations

import json
import re
import warnings
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import relpos
from relpos.evaluation import report as reports
from relpos.evaluation.report import PICTURES, drawing
from relpos.measurements import Height, Motion, Range, Status
from relpos.runs import NodeInfo
from support.command import relpos as command

VOID = {"meta", "link", "br", "img", "input", "hr"}
CLOSED_BY_ITSELF = {"path", "use", "rect", "image"}


class Page(HTMLParser):
    """A strict reader: tags have to nest, ids to be there once; gathers what is looked for."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.outside: list[str] = []
        self.values: list[str] = []
        self.captions: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.headless_tables = 0
        self.unscoped_heads = 0
        self.text: list[str] = []
        self.json = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag not in VOID:
            self.open.append(tag)
        self._look(tag, given)
        if tag == "table":
            self.headless_tables += 1
        if tag == "thead":
            self.headless_tables -= 1
        if tag == "th" and given.get("scope") not in ("row", "col"):
            self.unscoped_heads += 1

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._look(tag, dict(attrs))

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> of nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        inside = self.open[-1] if self.open else ""
        if inside == "script":
            self.json += data
        elif inside not in ("style",):
            self.text.append(data)
        if inside == "caption":
            self.captions.append(data)

    def _look(self, tag: str, given: dict[str, str | None]) -> None:
        if given.get("id"):
            self.ids.append(str(given["id"]))
        for name in ("href", "src", "xlink:href", "action", "data", "poster", "srcset"):
            value = given.get(name)
            if value is None or (tag == "data" and name == "data"):
                continue
            if value.startswith("#"):
                self.references.append(value[1:])
            elif not value.startswith("data:"):
                self.outside.append(value)
        for value in given.values():
            self.references += re.findall(r"url\(#([^)]+)\)", value or "")
        if tag == "svg":
            self.images.append(given)
        if tag == "data":
            self.values.append(str(given["value"]))


@pytest.fixture(scope="module")
def run() -> relpos.Run:
    """A simulated walk with what simulations leave out: status reports, heights, failed ranges."""
    made = relpos.simulate("paper", 2, seconds=60, nodes=4)
    extra = []
    for node in made.node_ids:
        for time_s in range(5, 60, 10):
            t = float(time_s)
            figures = {
                "battery_v": 4.9 - 0.02 * time_s if node == 1 else 5.0,
                "uptime_s": t if node != 2 or time_s < 30 else t - 30.0,
                "reset_cause": 1.0,
                "ranging_successes": 3.0 * time_s,
                "ranging_failures": 1.0 * time_s,
                "health": 63.0,
                "link_received": 10.0 * time_s,
                "link_lost": 1.0 * time_s,
                "link_rssi_dbm": -60.0 - node,
            }
            extra += [Status(t, node, name, value) for name, value in figures.items()]
    heights = [Height(float(t), n, 0.1 * n, 0.3) for t in range(1, 60) for n in made.node_ids]
    failed = [Range(30.0, 1, 2, 0.0)]
    # Node 3 falls silent for 12 s.
    kept = [
        m
        for m in made.measurements
        if not (isinstance(m, Motion) and m.node == 3 and 20.0 < m.time_s < 32.0)
    ]
    order = sorted([*kept, *heights, *failed], key=lambda m: m.time_s)
    return replace(
        made,
        measurements=tuple(order),
        statuses=tuple(sorted(extra, key=lambda s: s.time_s)),
        truth=tuple(replace(t, z_m=1.2) for t in made.truth),
    )


@pytest.fixture(scope="module")
def directory(run: relpos.Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "walk"
    relpos.save(run, path)
    return path


@pytest.fixture(scope="module")
def made(directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of an estimate that `fuse` wrote, and its figures."""
    out = tmp_path_factory.mktemp("report")
    fused = command(
        "fuse", directory, "--estimator", "particle", "--set", "particles=60", "--out",
        out / "estimate", "--no-report", "--json",
    )  # fmt: skip
    assert fused.exit_code == 0, fused.stderr
    outcome = command(
        "report", directory, "--estimate", out / "estimate", "--out", out / "report.html",
        "--figures", out / "figures", "--json",
    )  # fmt: skip
    assert outcome.exit_code == 0, outcome.stderr
    (out / "stdout.json").write_text(outcome.stdout)
    return out


@pytest.fixture(scope="module")
def page(made: Path) -> Page:
    return Page((made / "report.html").read_text())


def test_the_page_is_well_formed_and_loads_nothing_from_elsewhere(page: Page, made: Path) -> None:
    assert page.outside == []
    assert "http" not in (made / "report.html").read_text()
    assert len(page.ids) == len(set(page.ids))
    assert set(page.references) <= set(page.ids)


def test_every_figure_has_a_text_and_every_table_heads(page: Page) -> None:
    assert len(page.images) >= 8
    for image in page.images:
        assert image["role"] == "img"
        assert set(str(image["aria-labelledby"]).split()) <= set(page.ids)
    assert page.headless_tables == 0
    assert page.unscoped_heads == 0
    assert "Metrics of ISO/IEC 18305:2016" in page.captions


def test_its_numbers_are_those_of_evaluate(page: Page, directory: Path, made: Path) -> None:
    outcome = command("evaluate", directory, "--estimate", made / "estimate", "--json")
    scored = json.loads(outcome.stdout)
    embedded = json.loads(page.json)
    assert {key: embedded[key] for key in scored} == scored
    assert json.loads((made / "stdout.json").read_text()) == embedded
    # And they stand in its tables with all their digits.
    flat = scored["iso_18305"]["frames"]["per_run"]["horizontal"]
    wanted = [scored["relative_distance_rmse_m"], scored["nees_distance"]]
    wanted += [flat[name] for name in ("mean_m", "rms_m", "variance_m2", "e50_m", "e95_m")]
    wanted += [scored["iso_18305"]["frames"]["as_given"]["vertical"]["e95_m"]]
    wanted += [pair["distance_rmse_m"] for pair in scored["pairs"]]
    for value in wanted:
        assert repr(value) in page.values, value


def test_the_page_describes_links_and_nodes(page: Page) -> None:
    words = " ".join(" ".join(page.text).split())
    health = {row["node"]: row for row in json.loads(page.json)["health"]}
    assert health[2]["restarts"] == 1
    assert health[1]["restarts"] == 0
    assert health[3]["silences"] == 1
    assert health[1]["loss"] == pytest.approx(1.0 / 11.0, abs=1e-6)
    assert "1 restart, 1 silence" in words
    assert health[1]["worst"] == "red"  # 4.9 V - 1.1 V


def test_figures_are_written_as_svg_and_png(made: Path) -> None:
    files = {path.name for path in (made / "figures").iterdir()}
    drawn = {name for name in PICTURES if f"{name}.svg" in files}
    assert drawn >= {"tracks", "error", "distances", "consistency", "residuals", "height", "health"}
    assert files == {f"{name}.{kind}" for name in drawn for kind in ("svg", "png")}
    for name in drawn:
        assert (made / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert "<text" in (made / "figures" / f"{name}.svg").read_text()


def test_the_same_estimate_gives_the_same_page(made: Path, directory: Path) -> None:
    again = made / "again.html"
    outcome = command("report", directory, "--estimate", made / "estimate", "--out", again)
    assert outcome.exit_code == 0, outcome.stderr
    assert again.read_bytes() == (made / "report.html").read_bytes()


def test_a_page_without_truth_shows_what_is_known(run: relpos.Run, tmp_path: Path) -> None:
    blind = replace(run, truth=())
    blind = replace(blind, description=replace(run.description, simulated=None))
    relpos.save(blind, tmp_path / "blind")
    outcome = command(
        "report", tmp_path / "blind", "--estimator", "particle", "--set", "particles=60",
        "--out", tmp_path / "r.html", "--json",
    )  # fmt: skip
    assert outcome.exit_code == 0, outcome.stderr
    page = Page((tmp_path / "r.html").read_text())
    assert page.outside == []
    numbers = json.loads(outcome.stdout)
    assert "relative_distance_rmse_m" not in numbers
    assert sum(pair["ranges"] for pair in numbers["ranges"]) == sum(
        r.range_m > 0.0 for r in run.ranges
    )
    assert numbers["latency"]["wait_median_s"] > 0.0
    for name in ("tracks", "distances", "status", "detection", "residuals", "health"):
        assert f"figure-{name}" in page.ids
    for name in ("error", "consistency"):
        assert f"figure-{name}" not in page.ids
    assert "has no truth" in " ".join(page.text)


def test_presses_of_landmarks_alone_are_a_truth_that_is_scored(run: relpos.Run) -> None:
    presses = tuple(
        replace(t, time_s=t.time_s + 0.0, heading_rad=None)
        for t in run.truth
        if (t.node, t.time_s) in {(1, 12.0), (1, 40.0), (4, 25.0), (4, 50.0)}
    )
    result = relpos.fuse(run, "deadreckoning")
    content = reports.gather(replace(run, truth=presses), result)
    assert content.evaluation is not None
    assert content.evaluation.metrics.epochs == 0
    assert content.evaluation.iso.frames["per_run"].horizontal.count == 4


def test_range_residuals_and_the_learned_edge_are_those_of_the_run(run: relpos.Run) -> None:
    result = relpos.Result("truth", _copied(run))
    content = reports.gather(run, result)
    for pair in content.ranges:
        # An estimate that is the truth leaves the measurement's own errors, of a metre here.
        np.testing.assert_allclose(pair.residual_m, pair.error_m, atol=1e-9)
    assert content.ranges[0].failed == 1
    spreads = [float(np.nanstd(pair.error_m)) for pair in content.ranges]
    assert np.median(spreads) == pytest.approx(1.0, abs=0.35)
    assert content.heard is not None
    assert content.heard.true
    assert content.heard.distance_m.size > 50
    near = content.heard.heard[content.heard.distance_m < 5.0].mean()
    far = content.heard.heard[content.heard.distance_m > 12.0].mean()
    assert near > 2.0 * far


def _copied(run: relpos.Run) -> tuple[relpos.Estimate, ...]:
    by_time: dict[float, list[relpos.NodeEstimate]] = {}
    for t in run.truth:
        node = relpos.NodeEstimate(
            t.node, t.x_m, t.y_m, t.heading_rad or 0.0, 0.01, 0.01, 0.0, 0.1, relpos.NodeStatus.OK
        )
        by_time.setdefault(t.time_s, []).append(node)
    return tuple(
        relpos.Estimate(time_s, tuple(nodes), relpos.pairs_of(nodes))
        for time_s, nodes in sorted(by_time.items())
    )


def test_an_unknown_figure_is_named_among_the_known(run: relpos.Run) -> None:
    result = relpos.fuse(run, "deadreckoning")
    with pytest.raises(relpos.RelposError, match="no figure 'trucks': one of tracks"):
        relpos.plot(result, run, "trucks")
    with pytest.raises(relpos.RelposError, match="nothing to draw for the figure 'parameters'"):
        relpos.plot(result, run, "parameters")


def test_a_missing_run_or_estimate_is_one_clear_line(directory: Path, tmp_path: Path) -> None:
    for words in (("report", tmp_path / "no"), ("report", directory, "--estimate", tmp_path)):
        outcome = command(*words, "--out", tmp_path / "r.html")
        assert outcome.exit_code == 1
        assert outcome.stderr.count("\n") == 1
        assert not (tmp_path / "r.html").exists()


def test_a_name_in_letters_that_the_font_lacks_gives_no_warning(run: relpos.Run) -> None:
    nodes = {node: NodeInfo(name="李雷") for node in run.node_ids}
    named = replace(run, description=replace(run.description, nodes=nodes))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        document = drawing.svg(relpos.plot(relpos.fuse(run, "deadreckoning"), named))
    assert "李雷" in document
