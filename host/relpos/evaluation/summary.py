"""Metrics as plain JSON values: what ``--json`` prints and a script reads."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from relpos.evaluation import consistency
from relpos.evaluation.iso18305 import Accuracy, Assessment, Frame, Latency, Magnitudes
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
            {
                "node": node,
                "peer": peer,
                "epochs": pair.epochs,
                "distance_rmse_m": figure(pair.distance_rmse_m),
                "distance_error_mean_m": figure(pair.distance_error_mean_m),
                "distance_error_max_m": figure(pair.distance_error_max_m),
                "body_frame_rmse_m": figure(pair.body_frame_rmse_m),
                "nees_distance": figure(pair.nees_distance),
            }
            for (node, peer), pair in metrics.pairs.items()
        ],
        "over_time": {
            "time_s": _series(metrics.time_s.tolist()),
            "relative_distance_rmse_m": _series(metrics.distance_rmse_over_time_m.tolist()),
            "relative_position_rmse_m": _series(metrics.position_rmse_over_time_m.tolist()),
            "body_frame_rmse_m": _series(metrics.body_frame_rmse_over_time_m.tolist()),
            "nees_distance": _series(metrics.nees_over_time.tolist()),
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
            str(frame): _accuracy(iso.frames[frame]) if frame in iso.frames else None
            for frame in Frame
        },
        "nodes": [{"node": node, **_accuracy(one)} for node, one in iso.nodes.items()],
        "relative": _magnitudes(iso.relative),
        "coverage": figure(iso.coverage),
        "latency": latency_as_json(iso.latency),
    }


def latency_as_json(latency: Latency | None) -> dict[str, float | None] | None:
    """Return what an estimator waited; None where that was not seen.

    What it computed is left out: the same run and seed give the same numbers on every computer.
    """
    if latency is None:
        return None
    return {
        name: figure(getattr(latency, name)) for name in latency.__slots__ if name != "computing_s"
    }


def vertical_as_json(found: Vertical | None) -> dict[str, Any] | None:
    """Return the figures of heights, floors and stairs; None where the truth has no height."""
    if found is None:
        return None
    values = {name: getattr(found, name) for name in found.__slots__}
    return {
        name: figure(value) if isinstance(value, float) else value for name, value in values.items()
    }


def _accuracy(accuracy: Accuracy) -> dict[str, Any]:
    return {
        "mean_error_m": _series(accuracy.mean_error_m.tolist()),
        "absolute_mean_m": figure(accuracy.absolute_mean_m),
        "covariance_m2": [_series(row) for row in accuracy.covariance_m2.tolist()],
        "horizontal": _magnitudes(accuracy.horizontal),
        "vertical": _magnitudes(accuracy.vertical),
        "spherical": _magnitudes(accuracy.spherical),
    }


def _magnitudes(kind: Magnitudes) -> dict[str, float | None]:
    return {
        "count": kind.count,
        **{name: figure(getattr(kind, name)) for name in kind.__slots__[1:]},
    }


def _interval(nees: consistency.Nees) -> list[float | None]:
    return [figure(nees.low), figure(nees.high)]


def no_metrics() -> dict[str, None]:
    """Return the same names where there is no truth to score against."""
    return dict.fromkeys(FIGURES)


def figure(value: float) -> float | None:
    """Round a figure to six decimals; None where it is not finite."""
    return round(value, 6) if math.isfinite(value) else None


def _series(values: Iterable[float]) -> list[float | None]:
    return [figure(value) for value in values]
