"""Every figure and table of the paper's evaluation (sects. V and VI), computed anew."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from relpos.evaluation.figures import curves, detection, over_time, running_time, tracks
from relpos.evaluation.figures.sheet import Sheet, Work, save

FIGURES: Mapping[str, Callable[[Work], Sheet]] = {
    "tracks-simulation": tracks.simulation,
    "range-noise": curves.range_noise,
    "over-time-simulation": over_time.simulation,
    "particles": curves.particles,
    "wrong-start": curves.wrong_start,
    "running-time": running_time.table,
    "tracks-lab": tracks.laboratory,
    "over-time-lab": over_time.laboratory,
    "detection": detection.laboratory,
}
"""Name -> what makes it, in the order of the paper."""

__all__ = ["FIGURES", "Sheet", "Work", "save"]
