"""The magnetometer's ellipsoid before and after, to be looked at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from relpos.calibration.magnetometer import MagnetometerFit

FloatArray = NDArray[np.float64]

BEFORE, AFTER, SPHERE = "#D55E00", "#0072B2", "#7f7f7f"
"""Okabe and Ito's orange and blue, which colour-blind people can distinguish."""
_PLANES = ((0, 1), (0, 2), (1, 2))


def draw(fit: MagnetometerFit, fields_ut: FloatArray, path: Path) -> None:
    """Write a PNG: readings (n, 3) seen along each axis, before and after, and their strength."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 9.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2)
    after = fit.correct(fields_ut)
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    for (i, j), ax in zip(_PLANES, axes.flat, strict=False):
        ax.plot(fields_ut[:, i], fields_ut[:, j], ".", ms=3, color=BEFORE, label="before")
        ax.plot(after[:, i], after[:, j], ".", ms=3, color=AFTER, label="after")
        ax.plot(
            fit.radius_ut * np.cos(angle),
            fit.radius_ut * np.sin(angle),
            color=SPHERE,
            lw=1,
            label=f"sphere of {fit.radius_ut:.1f} uT",
        )
        ax.plot(*fit.offset_ut[[i, j]], "+", ms=12, color=BEFORE)
        ax.plot(0.0, 0.0, "+", ms=12, color=AFTER)
        ax.set_xlabel(f"{'xyz'[i]} / uT")
        ax.set_ylabel(f"{'xyz'[j]} / uT")
        ax.set_aspect("equal", adjustable="datalim")
        ax.grid(alpha=0.3)
    axes[0, 0].legend(loc="upper right", fontsize="small")
    strength = axes[1, 1]
    for field, colour, spread, label in (
        (fields_ut, BEFORE, fit.residual_before, "before"),
        (after, AFTER, fit.residual, "after"),
    ):
        strength.plot(
            np.linalg.norm(field, axis=1),
            ".",
            ms=3,
            color=colour,
            label=f"{label}: spread {100 * spread:.1f} %",
        )
    strength.axhline(fit.radius_ut, color=SPHERE, lw=1)
    strength.set_xlabel("reading")
    strength.set_ylabel("strength of the field / uT")
    strength.legend(loc="upper right", fontsize="small")
    strength.grid(alpha=0.3)
    figure.suptitle(
        f"{fit.readings} readings, {100 * fit.coverage:.0f} % of the directions, "
        f"hard iron {np.linalg.norm(fit.offset_ut):.1f} uT"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
