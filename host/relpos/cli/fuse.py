"""``relpos fuse``: from a run directory or a port to where everybody is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from relpos.cli import live, output
from relpos.cli.estimators import BANK, DEADRECKONING, EstimatorName
from relpos.cli.keys import KeyFile, team_key
from relpos.errors import DataError, DeviceError, RelposError

if TYPE_CHECKING:
    from relpos.evaluation.bounds import Bound
    from relpos.evaluation.report import Baseline
    from relpos.evaluation.result import Passage, Result
    from relpos.evaluation.scoring import Evaluation
    from relpos.fusion.estimator import Estimate, Estimator
    from relpos.live.inputs import Input
    from relpos.measurements import Measurement, Prior
    from relpos.runs import Description, NodeInfo, Run


class Initial(StrEnum):
    """Where the nodes start, as the user says."""

    UNKNOWN = "unknown"
    COMMON = "common"
    TRUTH = "truth"


class FuseCommand(TyperCommand):
    """The command with the estimators' settings below its help, read from the estimators."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Let --foxglove stand without a value, too, which Typer's options cannot."""
        return super().parse_args(ctx, live.with_default_address(args))

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help, then every key of ``--set`` with its default."""
        super().format_help(ctx, formatter)
        from relpos import fusion

        for name in fusion.SETTINGS:
            infos = fusion.settings_of(name)
            typer.echo(f" Settings of {name} (--set KEY=VALUE):" if infos else "", nl=bool(infos))
            for info in infos:
                typer.echo(f"   {info.key} {info.default:g}".ljust(28) + f"  {info.text}")
        typer.echo()


def fuse(
    context: typer.Context,
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE", help="Run directory, recording (.mcap), serial port or pyserial URL."
        ),
    ],
    estimator: EstimatorName = BANK,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A setting of the estimator; see below."),
    ] = None,
    initial: Annotated[
        Initial | None,
        typer.Option(help="Where the nodes start. (default: what the run says, else unknown)"),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the estimator's randomness.")] = 0,
    smooth: Annotated[bool, typer.Option("--smooth", help="Smooth over the whole run.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Where the output goes. (default: out/NAME, of a port with the time)",
        ),
    ] = None,
    record: live.Record = None,
    foxglove: live.Foxglove = None,
    view: live.View = False,
    view_listen: live.ViewListen = None,
    https: live.Https = False,
    open_browser: live.OpenBrowser = None,
    terminal: live.Terminal = False,
    me: live.Me = None,
    cot: live.Cot = None,
    pins: live.Pins = None,
    seconds: Annotated[
        float | None,
        typer.Option(min=0.0, help="Listen to a port, or show a recording, this long, then end."),
    ] = None,
    speed: Annotated[
        float,
        typer.Option(min=0.0, help="Of a recording that is shown: 2 is twice as fast as it was."),
    ] = 1.0,
    teach: Annotated[
        bool,
        typer.Option(
            "--teach/--no-teach",
            help="Send the step lengths that the ranges teach to the nodes of a port.",
        ),
    ] = True,
    key_file: KeyFile = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
    report: Annotated[
        bool | None,
        typer.Option(
            "--report/--no-report",
            help="Write the page index.html with pictures and numbers. (default: unless --json)",
        ),
    ] = None,
) -> None:
    """Fuse motion and ranges into relative positions; score them where there is truth.

    With --smooth the estimates come when all is over, each from the whole run: the best track.

    Writes estimate.csv, pairs.csv and parameters.csv, and of a run the page index.html with its
    pictures (`relpos report` makes it of anything). From a port, what was received is kept too, as
    a run directory under received/; Ctrl-C ends it. With --view, or anything else that shows or
    records it, a port that vanishes is waited for, and a recording is played at the pace at which
    it was made (--speed).
    """
    from relpos import sources

    chosen = output.parse_settings(settings or [])
    sinks: list[live.MakeSink] = []
    if terminal and json:
        raise typer.BadParameter("draws where --json prints", param_hint="--terminal")
    if terminal:
        sinks.append(live.terminal_sink(me))
    if cot is not None:
        replayed = not sources.is_port(source)
        sinks.append(live.cot_sink(cot, pins or (), replayed=replayed))
    options = live.Options(
        view,
        view_listen,
        https,
        open_browser,
        seconds,
        speed,
        sinks,
        screen=terminal,
        record=record,
        foxglove=foxglove,
    )
    options.check()
    job = Job(source, estimator, chosen, seed, out or _default_out(source), smooth=smooth)
    if sources.is_port(source):
        _fuse_port(job, initial, options, key_file, teach=teach, as_json=json)
    elif sources.is_recording(source):
        sources_of = {name: context.get_parameter_source(name) for name in context.params}
        given = {name for name, how in sources_of.items() if how and how.name != "DEFAULT"}
        _fuse_mcap(job, given, initial, options, key_file, as_json=json, report=report)
    elif options.shown:
        _replay_run(job, initial, options, as_json=json)
    else:
        _fuse_run(job, initial, as_json=json, report=not json if report is None else report)


@dataclass(frozen=True)
class Job:
    """What is to be done, as the command line said it."""

    source: str
    estimator: str
    settings: dict[str, str]
    seed: int
    out: Path
    smooth: bool = False

    def make(
        self, priors: Sequence[Prior], nodes: Mapping[int, NodeInfo] | None = None
    ) -> Estimator:
        """Make the wanted estimator; RelposError where a setting does not fit it."""
        from relpos import fusion

        make = fusion.make_smoother if self.smooth else fusion.make
        return make(self.estimator, priors, self.settings, self.seed, nodes)

    def prepare(self, priors: Sequence[Prior] = ()) -> None:
        """Have the estimator's kernels compiled, telling it the first time, when it takes long.

        RelposError, at once, where a setting does not fit it, or it cannot start from such priors.
        """
        from relpos import fusion

        fusion.check_name(self.estimator)
        fusion.check_settings(self.estimator, self.settings)
        with output.working("preparing the estimator (compiled at the first start)"):
            # Before anything is made: what this process compiled would be compiled twice.
            fusion.warm_up(self.estimator)
            self.make(priors)


def _default_out(source: str) -> Path:
    """Of a port a new folder each time: a mission must not overwrite the one before."""
    from relpos import sources

    name = _base_name(source)
    if sources.is_port(source):
        name += f"-{datetime.now().astimezone():%Y-%m-%d-%H%M%S}"
    return Path("out") / name


def _base_name(source: str) -> str:
    return Path(source).resolve().name or "run" if "://" not in source else "live"


def _fuse_run(job: Job, initial: Initial | None, *, as_json: bool, report: bool) -> None:
    from relpos import sources

    run = sources.load(job.source)
    fuse_recording(job, run, _priors(run, initial), as_json=as_json, report=report)


def _replay_run(job: Job, initial: Initial | None, options: live.Options, *, as_json: bool) -> None:
    """Show a run directory as if it happened now."""
    from relpos import sources
    from relpos.live.inputs import PacedInput, run_items

    run = sources.load(job.source)
    _check_usable(run, job.estimator)
    priors = _priors(run, initial)
    job.prepare(priors)
    fuse_live(
        job,
        PacedInput(job.source, run_items(run), speed=options.pace),
        options,
        description=run.description,
        priors=priors,
        as_json=as_json,
    )


def _fuse_mcap(
    job: Job,
    given: Set[str],
    initial: Initial | None,
    options: live.Options,
    key_file: Path | None,
    *,
    as_json: bool,
    report: bool | None,
) -> None:
    """Repeat a recorded session, with its own settings where the command line gives none."""
    from relpos.live.fusion_thread import common_start
    from relpos.live.inputs import PacedInput
    from relpos.measurements import Heading, Height, Motion, Range
    from relpos.recording import open_recording
    from relpos.recording.replay import Replay

    recording = open_recording(job.source)
    about = recording.about
    if about is not None:
        estimator = job.estimator if "estimator" in given else about.estimator
        if "estimator" not in given and ":" in estimator:
            # A file must not choose what code is run.
            raise RelposError(
                f"{job.source}: recorded with the estimator {estimator}: give it by --estimator"
            )
        recorded = about.settings if estimator == about.estimator else {}
        job = replace(
            job,
            estimator=estimator,
            settings={**recorded, **job.settings},
            seed=job.seed if "seed" in given else about.seed,
        )
    has_key = key_file is not None or about is None or not about.own_key
    key = team_key(key_file) if has_key else None
    replay = Replay(recording, key)
    for words in (*recording.remarks, *replay.remarks):
        output.remark(words)
    observations = replay.observations()
    run = recording.run_of(observations)
    _check_usable(run, job.estimator)
    if initial is None and about is not None and about.initial == Initial.COMMON:
        priors: Sequence[Prior] = common_start(observations)
    else:
        priors = _priors(run, initial)
    if options.shown:
        job.prepare(priors)
        again = Replay(recording, key)
        source = PacedInput(job.source, again, speed=options.pace, link=again.link)
        fuse_live(job, source, options, description=run.description, priors=priors, as_json=as_json)
        return
    counted = {name: round(count) for name, count in replay.counters().items()}
    fuse_recording(
        job,
        replace(run, counters={**run.counters, **counted}),
        priors,
        as_json=as_json,
        report=not as_json if report is None else report,
        measurements=[o for o in observations if isinstance(o, Motion | Range | Height | Heading)],
    )


def fuse_recording(
    job: Job,
    run: Run,
    priors: Sequence[Prior],
    *,
    as_json: bool,
    report: bool,
    measurements: Sequence[Measurement] | None = None,
) -> None:
    """Fuse a whole run, write the output files and the report, print the result.

    ``measurements``: those of the run in the order in which they came, if not by time.
    """
    from relpos.runs import write_estimates

    passage = _pass_through(job, run, priors, measurements)
    write_estimates(job.out, passage.estimates, steps=run.steps)
    if passage.failure is not None:
        raise passage.failure
    if passage.interrupted:
        raise RelposError(f"interrupted; the estimates so far are in {job.out}")
    result = _result(job, passage, priors)
    scored = _score(run, result) if run.truth else None
    if report:
        with output.working("drawing"):
            write_page(run, result, job.out / "index.html", scored)
    counters = {**run.counters, **result.counters}
    _tell(job, run.name, counters, result.estimates, scored, as_json=as_json)


def fused(run: Run, estimator: str, settings: dict[str, str], seed: int, *, smooth: bool) -> Result:
    """Fuse a whole run as ``relpos fuse`` does, and write nothing."""
    job = Job(run.name, estimator, settings, seed, Path(), smooth=smooth)
    passage = _pass_through(job, run, run.priors)
    if passage.failure is not None:
        raise passage.failure
    if passage.interrupted:
        raise KeyboardInterrupt
    return _result(job, passage, run.priors)


def _pass_through(
    job: Job,
    run: Run,
    priors: Sequence[Prior],
    measurements: Sequence[Measurement] | None = None,
) -> Passage:
    from relpos.evaluation.result import pass_through

    _check_usable(run, job.estimator)
    given = run.measurements if measurements is None else measurements
    job.prepare(priors)
    return pass_through(
        job.make(priors, run.nodes),
        output.with_progress(given, len(given), "fusing"),
        output.working("finishing"),
    )


def _result(job: Job, passage: Passage, priors: Sequence[Prior]) -> Result:
    from relpos.evaluation.result import result_of

    return result_of(
        job.estimator,
        passage,
        seed=job.seed,
        settings=job.settings,
        priors=priors,
        smoothed=job.smooth,
    )


def _check_usable(run: Run, estimator: str) -> None:
    """Refuse a run nothing can be concluded from, before anything is computed."""
    if not run.motions:
        raise DataError(
            f"{run.directory or run.name}: no motion in this run (motion.csv): nothing to fuse"
        )
    if estimator == DEADRECKONING:
        return
    if not run.ranges:
        raise DataError(
            f"{run.directory or run.name}: no ranges in this run (ranges.csv): nothing to fuse"
        )
    if all(measured.range_m <= 0.0 for measured in run.ranges):
        raise DataError(
            f"{run.directory or run.name}: all {len(run.ranges)} ranges are 0, which marks a "
            "failed measurement: nothing to fuse"
        )


def _priors(run: Run, initial: Initial | None) -> tuple[Prior, ...]:
    from relpos.runs import InitialPose

    if initial is None:
        return run.priors
    words = {
        Initial.UNKNOWN: InitialPose.UNKNOWN,
        Initial.COMMON: InitialPose.COMMON,
        Initial.TRUTH: InitialPose.FROM_TRUTH,
    }
    return run.priors_for(words[initial])


@dataclass(frozen=True)
class _Scored:
    """The fusion's score, beside that of dead reckoning over the same run."""

    evaluation: Evaluation
    baseline: Baseline | None
    bound: Bound | None


def _score(run: Run, result: Result) -> _Scored | None:
    from relpos.evaluation import report, scoring

    bound = scoring.bound_of(run)
    evaluation = scoring.evaluate_result(run, result, bound)
    if evaluation is None:
        return None
    return _Scored(evaluation, report.reckon(run, result), bound)


def write_page(run: Run, result: Result, path: Path, scored: _Scored | None = None) -> None:
    """Write the report of a run."""
    from relpos.evaluation import report

    content = report.gather(
        run,
        result,
        evaluation=None if scored is None else scored.evaluation,
        bound=None if scored is None else scored.bound,
        baseline=None if scored is None else scored.baseline,
    )
    report.write(content, path)


def _fuse_port(
    job: Job,
    initial: Initial | None,
    options: live.Options,
    key_file: Path | None,
    *,
    teach: bool,
    as_json: bool,
) -> None:
    from relpos.link.port import check_port
    from relpos.measurements import Prior

    if initial is Initial.TRUTH:
        raise DataError(f"{job.source}: a port brings no truth to start from")
    check_port(job.source)
    # Before the port is open: nobody takes in what arrives meanwhile. Who starts from one place is
    # heard later; that some do is known.
    some = [Prior(node, 0.0, 0.0, 0.0) for node in (1, 2)]
    job.prepare(some if initial is Initial.COMMON else ())
    port = live.open_port(job.source, key_file, teach=teach, reopen=options.shown)
    if not as_json:
        output.remark(f"listening to {job.source}; Ctrl-C ends")
    fuse_live(job, port, options, common=initial is Initial.COMMON, as_json=as_json)


def fuse_live(
    job: Job,
    source: Input,
    options: live.Options,
    *,
    description: Description | None = None,
    priors: Sequence[Prior] = (),
    common: bool = False,
    as_json: bool,
    emulated: Callable[[], bool] | None = None,
) -> None:
    """Fuse what comes from ``source`` as it comes; write, show, and tell the result.

    ``emulated`` tells of an emulated team whether its walk is over, which ends its port.
    """
    from relpos.live.fusion_thread import FusionThread
    from relpos.runs import Description

    description = description or Description(name=_base_name(job.source))
    name = description.name or _base_name(job.source)
    fused = live.Fused(str(job.estimator), job.settings, job.seed, tuple(priors), common=common)
    outcome = live.run(
        source,
        FusionThread(lambda known: job.make(known, description.nodes), priors, common=common),
        options,
        name=name,
        fused=fused,
        out=job.out,
        description=description,
        keep_received=source.is_now,
        emulated=emulated is not None,
    )
    failure = outcome.failure
    walk_is_over = emulated is not None and emulated() and isinstance(failure, DeviceError)
    if failure is not None and not walk_is_over:
        raise live.told(failure, job.out)
    last = [outcome.last] if outcome.last is not None else []
    _tell(job, name, outcome.counters, last, None, as_json=as_json, count=outcome.estimates)


def _tell(
    job: Job,
    name: str,
    counters: Mapping[str, Any],
    estimates: Sequence[Estimate],
    scored: _Scored | None,
    *,
    as_json: bool,
    count: int | None = None,
) -> None:
    """Print the result; ``count`` where ``estimates`` are not all there were."""
    from relpos.evaluation import summary

    baseline = scored.baseline.metrics if scored and scored.baseline else None
    bound = scored.evaluation.bound if scored else None
    if as_json:
        output.print_json(
            {
                "run": name,
                "estimator": job.estimator,
                "seed": job.seed,
                "out": str(job.out),
                "estimates": len(estimates) if count is None else count,
                "counters": counters,
                **(summary.as_json(scored.evaluation.metrics) if scored else summary.no_metrics()),
                "iso_18305": summary.iso_as_json(scored.evaluation.iso) if scored else None,
                "dead_reckoning": summary.figures(baseline) if baseline else None,
                "bound": asdict(bound) if bound else None,
            }
        )
        return
    output.print_last_pairs(f"{name}: {job.estimator}", estimates)
    if scored is not None:
        output.print_metrics(f"{name}: scored", scored.evaluation.metrics, baseline)
        output.print_iso(scored.evaluation.iso)
        if bound is not None:
            output.print_bound(bound)
    noted = {key: value for key, value in counters.items() if value}
    if noted:
        output.remark("counted: " + ", ".join(f"{k} {v:g}" for k, v in sorted(noted.items())))
    output.remark(f"written to {job.out}")
