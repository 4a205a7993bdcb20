"""The error against the filter's parameters and against a wrong start (paper, fig. 5 a to c)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from relpos.evaluation.figures.sheet import (
    COLOURS,
    GREY,
    IMU_SCALES,
    Sheet,
    Work,
    beside,
    bound_level,
    curve,
    legend_beside,
    level,
    own_colour,
    printed,
)
from relpos.evaluation.study import Case, Statistic

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIGMA_R_M = (0.5, 1.0, 2.0, 4.0, 8.0)
PARTICLES = (50, 100, 200, 500, 1000)
ALPHAS = (0.0, 0.01, 0.05, 0.1, 0.2)
SHIFTS_M = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0)

RECKONED = Case("IMU alone", estimator="deadreckoning")
BANK = Case("bank", estimator="bank")

_COLUMNS = ("distance_rmse_m", "half_width_95_m", "aligned_rmse_m", "seeds")


def _numbers(figure: Statistic, aligned: Statistic) -> tuple[float, float, float, int]:
    return figure.mean, figure.half_width, aligned.mean, figure.count


def range_noise(work: Work) -> Sheet:
    """Error against the assumed sigma_r for the five scales of IMU noise."""
    scales = IMU_SCALES[1:]
    cases = [
        Case("", settings={"sigma_r_m": r, "sigma_d": d, "sigma_theta": t})
        for d, t in scales
        for r in SIGMA_R_M
    ]
    outcomes = work.outcomes([*cases, RECKONED, BANK, *work.own_cases()])
    swept, (reckoned, bank, *own) = outcomes[: len(cases)], outcomes[len(cases) :]
    [bound] = work.bounds([RECKONED])
    by_scale = {
        scale: swept[k * len(SIGMA_R_M) : (k + 1) * len(SIGMA_R_M)]
        for k, scale in enumerate(scales)
    }
    rows: list[Sequence[float | int | str]] = [
        ("particle", d, t, r, *_numbers(o.distance_m, o.aligned_m))
        for (d, t), outcomes in by_scale.items()
        for r, o in zip(SIGMA_R_M, outcomes, strict=True)
    ]
    rows += [
        ("IMU alone", 0.0, 0.0, "", *_numbers(reckoned.distance_m, reckoned.aligned_m)),
        ("bank", "", "", "", *_numbers(bank.distance_m, bank.aligned_m)),
        *((o.case.label, "", "", "", *_numbers(o.distance_m, o.aligned_m)) for o in own),
        ("bound", "", "", "", bound.filtering_distance_m, "", bound.filtering_position_m, ""),
    ]

    def draw(canvas: Figure) -> None:
        axes = canvas.add_subplot()
        level(axes, reckoned.distance_m, "0, 0 (IMU alone)", GREY)
        for k, (scale, outcomes) in enumerate(by_scale.items()):
            label = f"{scale[0]:g}, {scale[1]:g}"
            curve(axes, k, SIGMA_R_M, [o.distance_m for o in outcomes], label)
        level(axes, bank.distance_m, "bank", COLOURS[5])
        for k, o in enumerate(own):
            level(axes, o.distance_m, o.case.label, own_colour(k), "--")
        bound_level(axes, bound.filtering_distance_m)
        printed(axes, [2.0, 2.0], [2.1, 10.0])
        _log_ticks(axes, SIGMA_R_M)
        axes.set(xlabel=r"assumed range noise $\sigma_r$ (m)", ylabel="relative distance RMSE (m)")
        axes.set_ylim(bottom=0.0)
        legend_beside(axes, r"$\sigma_d$, $\sigma_\theta$")

    at_2 = by_scale[0.2, 0.1][SIGMA_R_M.index(2.0)]
    return Sheet(
        "range-noise",
        "Error against the range noise that is assumed, for five scales of IMU noise",
        "Simulation, M 500, alpha .01 (paper, fig. 5a). Too small a sigma_r loses the truth, too "
        "large a one wastes the ranges. The bank knows no noise level and depends on no sigma_r.",
        ("estimator", "sigma_d", "sigma_theta", "sigma_r_m", *_COLUMNS),
        rows,
        draw,
        (
            beside("IMU alone", "10", reckoned.distance_m),
            beside("sigma_r 2, sigma_d .2, sigma_theta .1", "2.1", at_2.distance_m),
        ),
        (7.4, 4.2),
    )


def particles(work: Work) -> Sheet:
    """Error against the number of particles for several shares of dual particles."""
    cases = [
        Case("", settings={"particles": m, "alpha": alpha}) for alpha in ALPHAS for m in PARTICLES
    ]
    outcomes = work.outcomes([*cases, BANK, *work.own_cases()])
    swept, (bank, *own) = outcomes[: len(cases)], outcomes[len(cases) :]
    [bound] = work.bounds([BANK])
    by_alpha = {
        alpha: swept[k * len(PARTICLES) : (k + 1) * len(PARTICLES)]
        for k, alpha in enumerate(ALPHAS)
    }
    rows: list[Sequence[float | int | str]] = [
        ("particle", alpha, m, *_numbers(o.distance_m, o.aligned_m))
        for alpha, outcomes in by_alpha.items()
        for m, o in zip(PARTICLES, outcomes, strict=True)
    ]
    rows += [
        ("bank", "", "", *_numbers(bank.distance_m, bank.aligned_m)),
        *((o.case.label, "", "", *_numbers(o.distance_m, o.aligned_m)) for o in own),
        ("bound", "", "", bound.filtering_distance_m, "", bound.filtering_position_m, ""),
    ]

    def draw(canvas: Figure) -> None:
        axes = canvas.add_subplot()
        for k, (alpha, outcomes) in enumerate(by_alpha.items()):
            curve(axes, k, PARTICLES, [o.distance_m for o in outcomes], f"{alpha:g}")
        level(axes, bank.distance_m, "bank", COLOURS[5])
        for k, o in enumerate(own):
            level(axes, o.distance_m, o.case.label, own_colour(k), "--")
        bound_level(axes, bound.filtering_distance_m)
        printed(axes, [500.0, 500.0], [1.8, 2.0])
        _log_ticks(axes, PARTICLES)
        axes.set(xlabel="particles per user M", ylabel="relative distance RMSE (m)")
        axes.set_ylim(bottom=0.0)
        legend_beside(axes, r"share of dual particles $\alpha$")

    at_500 = PARTICLES.index(500)
    return Sheet(
        "particles",
        "Error against the number of particles and the share of dual particles",
        "Simulation, sigma_r 2, sigma_d .2, sigma_theta .1, known starts (paper, fig. 5b).",
        ("estimator", "alpha", "particles", *_COLUMNS),
        rows,
        draw,
        (
            beside("M 500, alpha .01", "1.8", by_alpha[0.01][at_500].distance_m),
            beside("M 500, alpha 0", "2.0", by_alpha[0.0][at_500].distance_m),
        ),
        (7.4, 4.2),
    )


def wrong_start(work: Work) -> Sheet:
    """Error against how far from the truth every user is believed to start."""
    kinds: Mapping[str, Case] = {
        r"particle, $\alpha$ 0": Case("", settings={"alpha": 0}),
        r"particle, $\alpha$ .01": Case(""),
        "bank": BANK,
        **{case.label: case for case in work.own_cases()},
    }
    cases = [
        Case("", "paper", {"start_shift_m": shift}, kind.estimator, kind.settings)
        for kind in kinds.values()
        for shift in SHIFTS_M
    ]
    swept = work.outcomes(cases)
    bounds = work.bounds(cases[: len(SHIFTS_M)])
    by_kind = {
        label: swept[k * len(SHIFTS_M) : (k + 1) * len(SHIFTS_M)] for k, label in enumerate(kinds)
    }
    rows: list[Sequence[float | int | str]] = [
        (label.replace(r"$\alpha$", "alpha"), shift, *_numbers(o.distance_m, o.aligned_m))
        for label, outcomes in by_kind.items()
        for shift, o in zip(SHIFTS_M, outcomes, strict=True)
    ]
    rows += [
        ("bound", shift, b.filtering_distance_m, "", b.filtering_position_m, "")
        for shift, b in zip(SHIFTS_M, bounds, strict=True)
    ]

    def draw(canvas: Figure) -> None:
        axes = canvas.add_subplot()
        for k, (label, outcomes) in enumerate(by_kind.items()):
            curve(axes, k, SHIFTS_M, [o.distance_m for o in outcomes], label)
        axes.plot(
            SHIFTS_M, [b.filtering_distance_m for b in bounds], color="#222222",
            linestyle=(0, (2, 2)), linewidth=1.2, label="bound, shift's size known",
        )  # fmt: skip
        printed(axes, [4.0, 4.0], [2.6, 4.5])
        axes.set(
            xlabel="distance of the assumed start from the true one (m)",
            ylabel="relative distance RMSE (m)",
        )
        axes.set_ylim(bottom=0.0)
        legend_beside(axes)

    at_4 = SHIFTS_M.index(4.0)
    without, with_dual, *_ = by_kind.values()
    return Sheet(
        "wrong-start",
        "Error against a wrong start, with and without dual particles",
        "Simulation, every user's start shifted into a random direction, unknown (paper, fig. 5c).",
        ("estimator", "shift_m", *_COLUMNS),
        rows,
        draw,
        (
            beside("4 m, alpha .01", "2.6", with_dual[at_4].distance_m),
            beside("4 m, alpha 0", "4.5", without[at_4].distance_m),
        ),
        (7.4, 4.2),
    )


def _log_ticks(axes: object, values: Sequence[float]) -> None:
    from matplotlib.axes import Axes
    from matplotlib.ticker import NullFormatter, NullLocator

    assert isinstance(axes, Axes)
    axes.set_xscale("log")
    axes.set_xticks(list(values), [f"{v:g}" for v in values])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())
