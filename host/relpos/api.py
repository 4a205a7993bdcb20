"""The Python interface for research: load or simulate a run, estimate, evaluate, plot.

    import relpos

    run = relpos.load("recordings/basement")
    result = relpos.fuse(run, estimator="bank", seed=0)
    print(relpos.evaluate(result, run))
    relpos.plot(result, run).savefig("tracks.svg")

Everything here is also an attribute of :mod:`relpos`, loaded when it is first used. Units are SI
(m, rad, s), frames and signs those of the run format: world x east-like, y north-like, z up,
angles counter-clockwise; times are seconds from the run's start. Whatever is wrong with data,
settings or an estimator is a :class:`relpos.RelposError` of one line.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from relpos import sources
from relpos.errors import FusionInterrupted, RelposError
from relpos.evaluation.result import Result, read_result, result_of, run_estimator
from relpos.evaluation.scoring import Evaluation
from relpos.fusion.estimator import Estimate, Estimator, Progress
from relpos.measurements import Measurement, Prior, out_of_bounds
from relpos.runs import InitialPose, Run, save_run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from relpos.evaluation.bounds import Bound

T = TypeVar("T")

Given = str | Estimator | Callable[..., Estimator]
"""An estimator as ``fuse`` takes it: a name, an object, or a class or function that makes one."""


def load(path: Path | str) -> Run:
    """Read a run: a run directory (docs/run-format.md) or a recording.

    DataError names the file, line and column of the first fault.
    """
    return sources.load(path)


def save(run: Run, path: Path | str) -> None:
    """Write a run as a run directory that :func:`load` reads back to the same run."""
    _check_run(run)
    save_run(run, path)


def simulate(scenario: str = "paper", seed: int = 0, **settings: float | str) -> Run:
    """Simulate a run with its truth; the same arguments give the same run.

    ``scenario`` is one of ``relpos simulate`` (paper, lab, mission-base, building, ...),
    ``settings`` its keys. RelposError for an unknown one, or for a value out of range.
    """
    from relpos.simulation.scenarios import simulate_run

    return simulate_run(scenario, _whole(seed), settings)


def fuse(
    run: Run,
    estimator: Given = "bank",
    *,
    seed: int = 0,
    settings: Mapping[str, object] | None = None,
    smooth: bool = False,
    initial: str | Sequence[Prior] | None = None,
    measurements: Sequence[Measurement] | None = None,
    progress: Progress | None = None,
) -> Result:
    """Run an estimator over a whole run.

    ``estimator`` is ``"bank"``, ``"particle"``, ``"deadreckoning"``, a name that an installed
    package registers, ``"module:Class"`` or ``"file.py:Class"``; a class or function that makes
    an estimator (with those of ``priors``, ``seed``, ``nodes`` and ``settings`` that it names);
    or an object that is one. ``settings`` are the keys of ``--set``. ``smooth`` estimates from
    the whole run after its end. ``initial`` replaces the start that the run states:
    ``"unknown"``, ``"common"`` (all at one place with one heading), ``"truth"``, or priors.
    ``measurements`` are those of the run in order of arrival, where that is not by time.
    ``progress`` is called with a stage (``"compiling"``, once after an installation,
    ``"fusing"``, ``"finishing"``), the number of parts that are done, and their total.

    RelposError where the run has no motion (or no ranges, for an estimator that is named), where
    the estimator gives up, and where one from outside of relpos fails or breaks the interface
    (its own error is the ``__cause__``); ``result`` of the error holds the estimates so far.
    """
    name = name_of(estimator)
    _check_run(run)
    seed = _whole(seed)
    if not isinstance(settings, Mapping | None):
        raise RelposError(f"settings: {settings!r} is no mapping of keys to values")
    run.check_usable(needs_ranges=isinstance(estimator, str) and name != "deadreckoning")
    priors = priors_of(run, initial)
    if isinstance(estimator, str):
        _compile(estimator, settings, progress)
    made = _make(estimator, name, run, priors, settings, seed, smooth=smooth)
    arrived = run.measurements if measurements is None else tuple(measurements)
    estimator_run = run_estimator(made, arrived, progress)
    result = result_of(
        name, estimator_run, seed=seed, settings=settings, priors=priors, smoothed=smooth
    )
    if estimator_run.failure is not None:
        estimator_run.failure.result = result
        raise estimator_run.failure
    if estimator_run.interrupted:
        raise FusionInterrupted(result)
    return result


def evaluate(
    result: Result | Sequence[Estimate] | Path | str, run: Run, *, bound: bool = True
) -> Evaluation:
    """Score a result (or estimates, or a directory with ``estimate.csv``) against a run's truth.

    ``bound`` adds the Cramer-Rao bound of a simulated run. DataError where the run has no truth,
    or none at a time of an estimate.
    """
    from relpos.evaluation import scoring

    _check_run(run)
    scoring.check_truth(run)
    return scoring.evaluate(run, _result(result), bound=bound)


def plot(
    result: Result | Sequence[Estimate] | Path | str, run: Run, figure: str = "tracks"
) -> Figure:
    """Draw one of the report's figures, as a Matplotlib figure (``savefig`` writes it).

    ``figure`` is one of tracks, error, error-distribution, distances, consistency, status,
    detection, residuals, parameters, section, height and health. RelposError for another name,
    and where the run has nothing for it.
    """
    from relpos.evaluation import report as reports

    _check_run(run)
    return reports.draw(reports.gather(run, _result(result)), figure)


def report(
    result: Result | Sequence[Estimate] | Path | str,
    run: Run,
    out: Path | str,
    figures: Path | str | None = None,
) -> Path:
    """Write the page that ``relpos report`` writes; return its path.

    ``figures`` is a folder for every figure as SVG and PNG.
    """
    from relpos.evaluation import report as reports

    _check_run(run)
    return reports.write(reports.gather(run, _result(result)), out, figures)


def bound(run: Run) -> Bound | None:
    """Compute the Cramer-Rao bound of a simulated run with known starts, over time; else None.

    None of more than 50 people, too: it would take minutes and gigabytes.
    """
    from relpos.evaluation import scoring

    _check_run(run)
    return scoring.bound_of(run)


def name_of(estimator: Given) -> str:
    """Return what an estimator is called in tables: its name, or that of its class."""
    if isinstance(estimator, str):
        return estimator
    return getattr(estimator, "__name__", type(estimator).__name__)


def priors_of(run: Run, initial: str | Sequence[Prior] | None = None) -> tuple[Prior, ...]:
    """Return the starts that an estimator of a run begins with; see ``initial`` of :func:`fuse`."""
    if initial is None:
        return run.priors
    if not isinstance(initial, str):
        given = _listed("initial", initial, Prior)
        for prior in given:
            _check_prior(prior)
        return given
    words = {
        "unknown": InitialPose.UNKNOWN,
        "common": InitialPose.COMMON,
        "truth": InitialPose.FROM_TRUTH,
    }
    if initial not in words:
        raise RelposError(f"initial: '{initial}' is none of {', '.join(words)}")
    return run.priors_for(words[initial])


def _check_prior(prior: Prior) -> None:
    node = prior.node
    # An infinite sigma is one that is not known.
    sigma_m, sigma_rad = (0.0 if s == math.inf else s for s in (prior.sigma_m, prior.sigma_rad))
    try:
        if not 0 <= node == node // 1:
            raise RelposError(f"initial: {node!r} is no node id")
        if not all(map(math.isfinite, (prior.x_m, prior.y_m, prior.heading_rad))):
            raise RelposError(f"initial: the pose of node {node} is not finite")
        if not (sigma_m >= 0.0 and sigma_rad >= 0.0):
            raise RelposError(f"initial: a sigma of node {node} is negative")
        beyond = out_of_bounds(replace(prior, sigma_m=sigma_m, sigma_rad=sigma_rad))
    except TypeError:
        raise RelposError(f"initial: something else than a number in {prior}") from None
    if beyond is not None:
        raise RelposError(f"initial: {beyond} of node {node} is beyond its bounds")


def _listed(name: str, given: Iterable[T], kind: type[T]) -> tuple[T, ...]:
    """Return what may be a generator as a tuple; RelposError where anything else is in it."""
    listed = tuple(given) if isinstance(given, Iterable) else (given,)
    for one in listed:
        if not isinstance(one, kind):
            raise RelposError(f"{name}: {type(one).__name__}, not a relpos.{kind.__name__}")
    return listed


def _check_run(run: Run) -> None:
    """Refuse a path: it is loaded first."""
    if not isinstance(run, Run):
        raise RelposError(f"run: {type(run).__name__}, not a relpos.Run: relpos.load reads one")


def _whole(seed: int) -> int:
    """Refuse what numpy would take as no seed at all, and so as another one each time."""
    try:
        whole = operator.index(seed)
    except TypeError:
        whole = -1
    if whole < 0:
        raise RelposError(f"seed: {seed!r} is not a whole number from 0 on")
    return whole


def _compile(name: str, settings: Mapping[str, object] | None, progress: Progress | None) -> None:
    """Compile the kernels of an estimator where they are not in the cache."""
    from relpos import fusion

    fusion.check(name, settings)
    if not fusion.is_compiled(name):
        fusion.warm_up(name, progress)


def _make(
    estimator: Given,
    name: str,
    run: Run,
    priors: Sequence[Prior],
    settings: Mapping[str, object] | None,
    seed: int,
    *,
    smooth: bool,
) -> Estimator:
    from relpos import fusion
    from relpos.fusion import plugins
    from relpos.fusion.post import referring

    if isinstance(estimator, str):
        make = fusion.make_smoother if smooth else fusion.make
        return make(estimator, priors, settings, seed, run.nodes)
    if smooth:
        raise RelposError(
            f"{name}: smoothing begins from an estimator that is named, as 'module:Class'"
        )
    if isinstance(estimator, type) or not hasattr(estimator, "process"):
        if not callable(estimator):
            raise RelposError(f"estimator: {estimator!r} is no name, class, function or estimator")
        made = plugins.make(name, estimator, priors, settings, seed, run.nodes)
        return referring(made, run.nodes)
    if settings:
        raise RelposError(f"{name}: settings belong to a name or a class, not to an object")
    return referring(plugins.guard(name, estimator), run.nodes)


def _result(given: Result | Sequence[Estimate] | Path | str) -> Result:
    if isinstance(given, Result):
        return given
    if isinstance(given, str | Path):
        return read_result(given)
    return Result("estimates", _listed("result", given, Estimate))


__all__ = ["bound", "evaluate", "fuse", "load", "plot", "report", "save", "simulate"]
