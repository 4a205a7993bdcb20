"""The command post's node lies still, and its pressure is the weather."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

import relpos
from relpos import fusion
from relpos.cli.fuse import Job
from relpos.errors import DataError
from relpos.fusion.models.pressure import FAST_S, Weather
from relpos.fusion.post import Referring, referring
from relpos.measurements import Height, Motion, Prior
from relpos.runs import NodeInfo
from relpos.runs.description import Description, description_text, parse_description

POST, OTHER_POST, WEARER = 7, 8, 1


def test_the_weather_that_a_post_shows_is_no_climb_of_anybody() -> None:
    reference = Referring(fusion.make("deadreckoning", []), frozenset({POST}))
    weather_m_s = 0.01  # More than 4 hPa an hour.
    left_m = []
    for second in range(1200):
        reference.refer(Height(second, POST, weather_m_s * second))
        climbed_m = 3.5 if second > 600 else 0.0
        height = Height(second + 0.5, WEARER, weather_m_s * (second + 0.5) + climbed_m)
        referred = reference.refer(height)
        assert isinstance(referred, Height)
        left_m.append(referred.height_m - climbed_m)
    assert max(map(abs, left_m)) < 0.4
    assert abs(left_m[-1]) < 0.2


def test_a_second_post_that_begins_in_a_gust_makes_the_weather_no_worse() -> None:
    weather, off_m = Weather(), []
    for second in range(1200):
        weather.measure(Height(float(second), POST, 0.0))
        if second >= 300:
            gust_m = 0.4 * math.exp((300 - second) / FAST_S)
            weather.measure(Height(float(second), OTHER_POST, 2.0 + gust_m))
        off_m.append(abs(weather.at(float(second))))
    assert max(off_m) < 0.1
    assert off_m[-1] < 0.05


def test_a_post_stays_where_it_is_whatever_it_reports() -> None:
    nodes = {POST: NodeInfo(post=True), WEARER: NodeInfo()}
    priors = [Prior(node, 0.0, 0.0, 0.0, 0.1, 0.1) for node in nodes]
    estimator = fusion.make("deadreckoning", priors, nodes=nodes)
    moves = [Motion(float(s), node, 1.0, 0.0, 0.0) for s in range(1, 20) for node in nodes]
    estimates = [e for move in moves for e in estimator.process(move)] + estimator.finish()
    last = {node.node: node for node in estimates[-1].nodes}
    assert (last[POST].x_m, last[POST].y_m) == (0.0, 0.0)
    assert last[WEARER].x_m > 10.0


def test_without_a_post_an_estimator_is_left_as_it_is() -> None:
    estimator = fusion.make("deadreckoning", [])
    assert referring(estimator, {WEARER: NodeInfo()}) is estimator


def test_a_post_is_written_and_read_again() -> None:
    text = description_text(Description(nodes={POST: NodeInfo(post=True)}))
    assert parse_description("run.toml", text).nodes[POST].post
    with pytest.raises(DataError, match="neither true nor false"):
        parse_description("run.toml", "[nodes.7]\npost = 1\n")


def test_a_post_that_is_no_node_of_the_run_is_refused(tmp_path: Path) -> None:
    run = relpos.simulate("paper-p1", 1, seconds=5, nodes=3)
    job = Job("walk", "bank", {}, 0, tmp_path, post=9)
    with pytest.raises(DataError, match="--post 9: no such node in walk: 1, 2, 3"):
        job.described(run)
