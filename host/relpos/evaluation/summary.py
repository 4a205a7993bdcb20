"""Metrics as plain JSON values: what ``--json`` prints and a script reads."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from relpos.evaluation import consistency
from relpos.evaluation.iso18305 import Assessment, Frame, Latency
from relpos.evaluation.metrics import Metrics
from relpos.evaluation.regions import Ambiguity
from relpos.evaluation.vertical import Vertical

FIGURES = (
    "relative_distance_rmse_m",
    "relative_position_rmse_m",
    "body_frame_rmse_m",
    "nees_distance",
)


def as_json(metrics: Metrics) -> dict[str, Any]:
    """Return the figures under their names in the run format, per pair and over time.

    An undefined figure is None, which JSON writes as null.
    """
    return {
        **figures(metrics),
        "nees_distance_interval": _interval(consistency.of_distances([metrics])),
        "epochs": metrics.epochs,
        "nees_left_out": metrics.nees_left_out,
        "ok_over_3_sigma": figure(metrics.ok_over_3_sigma),
        "ok_over_2_m": figure(metrics.ok_over_2_m),
        "ok_wrong_side": figure(metrics.ok_wrong_side),
        "pairs": [
            {"node": node, "peer": peer, **plain(pair)}
            for (node, peer), pair in metrics.pairs.items()
        ],
        "over_time": {
            "time_s": plain(metrics.time_s),
            "relative_distance_rmse_m": plain(metrics.distance_rmse_over_time_m),
            "relative_position_rmse_m": plain(metrics.position_rmse_over_time_m),
            "body_frame_rmse_m": plain(metrics.body_frame_rmse_over_time_m),
            "nees_distance": plain(metrics.nees_over_time),
        },
    }


def figures(metrics: Metrics) -> dict[str, float | None]:
    """Return the four figures of the team alone."""
    return {name: figure(getattr(metrics, name)) for name in FIGURES}


def nees_as_json(nees: consistency.Nees) -> dict[str, Any]:
    """Return a NEES with the interval of an honest one and what it is worth."""
    return {
        "mean": figure(nees.mean),
        "interval": _interval(nees),
        "effective": figure(nees.effective),
    }


def ambiguity_as_json(ambiguity: Ambiguity | None) -> dict[str, Any] | None:
    """Return how honest and how large the regions of ambiguous nodes were; None without any."""
    if ambiguity is None:
        return None
    held = ambiguity.coverage
    return {
        "looks": ambiguity.looks,
        "region_90_holds_truth": figure(held.share),
        "interval": [figure(held.low), figure(held.high)],
        "area_m2": figure(ambiguity.area_m2),
        "blind_area_m2": figure(ambiguity.blind_m2),
        "rings": figure(ambiguity.rings),
    }


def iso_as_json(iso: Assessment) -> dict[str, Any]:
    """Return the metrics of ISO/IEC 18305 in every frame, per node in the headline's."""
    return {
        "headline": None if iso.headline is None else str(iso.headline),
        "frames": {
            str(frame): _without("frame", iso.frames[frame]) if frame in iso.frames else None
            for frame in Frame
        },
        "nodes": [{"node": node, **_without("frame", one)} for node, one in iso.nodes.items()],
        "relative": plain(iso.relative),
        "coverage": figure(iso.coverage),
        "latency": latency_as_json(iso.latency),
    }


def latency_as_json(latency: Latency | None) -> dict[str, float | None] | None:
    """Return what an estimator waited; None where that was not seen.

    What it computed is left out: the same run and seed give the same numbers on every computer.
    """
    return None if latency is None else _without("computing_s", latency)


def vertical_as_json(found: Vertical | None) -> dict[str, Any] | None:
    """Return the figures of heights, floors and stairs; None where the truth has no height."""
    return None if found is None else plain(found)


def plain(value: Any) -> Any:
    """Return figures for JSON: dataclasses by their fields, arrays as lists, floats rounded."""
    if is_dataclass(value):
        return {one.name: plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list):
        return [plain(one) for one in value]
    return figure(value) if isinstance(value, float) else value


def _without(name: str, figures: Any) -> dict[str, Any]:
    return {key: value for key, value in plain(figures).items() if key != name}


def _interval(nees: consistency.Nees) -> list[float | None]:
    return [figure(nees.low), figure(nees.high)]


def no_metrics() -> dict[str, None]:
    """Return the same names where there is no truth to score against."""
    return dict.fromkeys(FIGURES)


def figure(value: float) -> float | None:
    """Round a figure to six decimals; None where it is not finite."""
    return round(value, 6) if math.isfinite(value) else None
