"""``relpos fuse``: relative positions from a run directory, a recording or a port."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from relpos import extras
from relpos.cli import live, output
from relpos.cli.estimators import BANK, DEADRECKONING, EstimatorName
from relpos.cli.keys import KeyFile, team_key
from relpos.cli.needs import Command
from relpos.errors import DataError, DeviceError, FusionInterrupted, RelposError

if TYPE_CHECKING:
    from relpos.evaluation.report import Baseline
    from relpos.evaluation.scoring import Evaluation
    from relpos.fusion.estimator import Estimate, Estimator
    from relpos.live.assembly import MakeSink
    from relpos.live.inputs import Input
    from relpos.live.session import Outcome
    from relpos.measurements import Measurement, Prior
    from relpos.runs import Description, NodeInfo, Run


class Initial(StrEnum):
    """Start of the nodes, as given by the user."""

    UNKNOWN = "unknown"
    COMMON = "common"
    TRUTH = "truth"


class FuseCommand(Command):
    """The command whose help ends with the settings of every estimator."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Allow --foxglove without a value, which Typer's options cannot."""
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
        typer.Option(help="Where the nodes start. (default: the start in the run, else unknown)"),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the estimator's randomness.")] = 0,
    smooth: Annotated[bool, typer.Option("--smooth", help="Smooth over the whole run.")] = False,
    post: live.Post = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Output directory. (default: out/NAME; of a port, with the time)",
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
        typer.Option(min=0.0, help="End after so many seconds of a port or a shown recording."),
    ] = None,
    speed: Annotated[
        float,
        typer.Option(min=0.0, help="Speed of a shown recording: 2 is twice as fast as recorded."),
    ] = 1.0,
    teach: Annotated[
        bool,
        typer.Option(
            "--teach/--no-teach",
            help="Send step lengths learned from ranges to the nodes of a port.",
        ),
    ] = True,
    key_file: KeyFile = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
    report: Annotated[
        bool | None,
        typer.Option(
            "--report/--no-report",
            help="Write the page index.html with figures and numbers. (default: unless --json)",
        ),
    ] = None,
) -> None:
    """Fuse motion and ranges into relative positions; score them where there is truth.

    With --smooth every estimate uses the whole run and is written at the end: the best track.

    Writes estimate.csv, pairs.csv and parameters.csv, and for a run the page index.html with
    figures (`relpos report` writes it for any estimate). For a port, received data is stored as a
    run directory under received/; Ctrl-C ends the session. With --view, or another option that
    shows or records the session, relpos waits for a port that vanishes, and plays a recording at
    its original speed (--speed).
    """
    from relpos import sources

    chosen = output.parse_settings(settings or [])
    sinks: list[MakeSink] = []
    if terminal and json:
        raise typer.BadParameter("cannot be combined with --json", param_hint="--terminal")
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
        debrief=report is not False,
    )
    options.check()
    job = Job(source, estimator, chosen, seed, out or _default_out(source), smooth, post)
    output.check_folder(job.out)
    if sources.is_port(source):
        _fuse_port(job, initial, options, key_file, teach=teach, as_json=json)
    elif sources.is_recording(source):
        sources_of = {name: context.get_parameter_source(name) for name in context.params}
        given = {name for name, how in sources_of.items() if how and how.name != "DEFAULT"}
        _fuse_mcap(job, given, initial, options, key_file, as_json=json, report=report)
    elif options.shown:
        replay_run(job, initial, options, as_json=json)
    else:
        _fuse_run(job, initial, as_json=json, report=_is_wanted(report, as_json=json))


@dataclass(frozen=True)
class Job:
    """The request of the command line."""

    source: str
    estimator: str
    settings: dict[str, str]
    seed: int
    out: Path
    smooth: bool = False
    post: int | None = None

    def described(self, run: Run) -> Run:
        """Return a run whose description says what the command line says of its nodes."""
        if self.post is not None and self.post not in run.node_ids:
            known = ", ".join(map(str, run.node_ids))
            raise DataError(f"--post {self.post}: no such node in {self.source}: {known}")
        return replace(run, description=run.description.with_post(self.post))

    def make(
        self, priors: Sequence[Prior], nodes: Mapping[int, NodeInfo] | None = None
    ) -> Estimator:
        """Make the wanted estimator; RelposError where a setting does not fit it."""
        from relpos import fusion

        make = fusion.make_smoother if self.smooth else fusion.make
        return make(self.estimator, priors, self.settings, self.seed, nodes)

    def prepare(self, priors: Sequence[Prior] = ()) -> None:
        """Load the estimator's kernels, and compile them where they are not in the cache.

        RelposError where a setting does not fit the estimator, or it cannot start from the priors.
        """
        from relpos import fusion

        fusion.check(self.estimator, self.settings)
        with output.progress(output.STAGES) as progress:
            # Before anything is made: what this process compiled would be compiled twice.
            fusion.warm_up(self.estimator, progress)
        self.make(priors)


def _default_out(source: str) -> Path:
    """Return a new folder for each session of a port: it must not overwrite the last one."""
    from relpos import sources

    name = _base_name(source)
    if sources.is_port(source):
        name += f"-{datetime.now().astimezone():%Y-%m-%d-%H%M%S}"
    return Path("out") / name


def _base_name(source: str) -> str:
    return Path(source).resolve().name or "run" if "://" not in source else "live"


def _fuse_run(job: Job, initial: Initial | None, *, as_json: bool, report: bool) -> None:
    from relpos import api

    run = job.described(api.load(job.source))
    fuse_recording(job, run, initial, as_json=as_json, report=report)


def replay_run(
    job: Job, initial: Initial | None, options: live.Options, *, as_json: bool
) -> Outcome:
    """Show a run directory as if it happened now."""
    from relpos import api
    from relpos.live.inputs import PacedInput, run_items

    run = job.described(api.load(job.source))
    run.check_usable(needs_ranges=job.estimator != DEADRECKONING)
    for words in run.remarks:
        output.remark(words)
    priors = api.priors_of(run, initial)
    job.prepare(priors)
    return fuse_live(
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
    """Repeat a recorded session; the command line replaces its settings."""
    from relpos import api
    from relpos.live.fusion_thread import common_start
    from relpos.live.inputs import PacedInput
    from relpos.measurements import Measurement
    from relpos.recording import open_recording

    recording = open_recording(job.source)
    from relpos.recording.replay import Replay  # it needs what opening has looked for

    about = recording.about
    if about is not None:
        estimator = job.estimator if "estimator" in given else about.estimator
        if "estimator" not in given and ":" in estimator:
            # A file must not choose the code that runs.
            raise RelposError(
                f"{job.source}: recorded with the estimator {estimator}: name it with --estimator"
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
    run = job.described(recording.run_of(observations))
    start: str | Sequence[Prior] | None = initial
    if initial is None and about is not None and about.initial == Initial.COMMON:
        start = common_start(observations)
    if options.shown:
        run.check_usable(needs_ranges=job.estimator != DEADRECKONING)
        priors = api.priors_of(run, start)
        job.prepare(priors)
        again = Replay(recording, key)
        began_ns = recording.started_unix_ns
        source = PacedInput(
            job.source,
            again,
            speed=options.pace,
            link=again.link,
            recorded_unix_s=None if began_ns is None else began_ns * 1e-9,
        )
        fuse_live(job, source, options, description=run.description, priors=priors, as_json=as_json)
        return
    counted = {name: round(count) for name, count in replay.counters().items()}
    fuse_recording(
        job,
        replace(run, counters={**run.counters, **counted}),
        start,
        [o for o in observations if isinstance(o, Measurement)],
        as_json=as_json,
        report=_is_wanted(report, as_json=as_json),
    )


def _is_wanted(report: bool | None, *, as_json: bool) -> bool:
    """Whether to write the report; RelposError where it is asked for and its extra is missing."""
    if report:
        extras.require("report")
    if report is not None or as_json:
        return bool(report)
    return can_report()


def can_report() -> bool:
    """Whether the extra for reports is installed; a remark says how to install it."""
    lacking = extras.missing("report")
    if lacking:
        output.remark(
            f"no report is written; this installs what it needs: {extras.install_line(lacking)}"
        )
    return not lacking


def fuse_recording(
    job: Job,
    run: Run,
    initial: str | Sequence[Prior] | None = None,
    measurements: Sequence[Measurement] | None = None,
    *,
    as_json: bool,
    report: bool,
) -> None:
    """Fuse a whole run, write the output files and the report, print the result.

    ``initial`` and ``measurements`` are those of :func:`relpos.fuse`.
    """
    from relpos import api
    from relpos.evaluation import report as reports
    from relpos.runs import drop_page

    try:
        with output.progress(output.STAGES) as progress:
            result = api.fuse(
                run,
                job.estimator,
                seed=job.seed,
                settings=job.settings,
                smooth=job.smooth,
                initial=initial,
                measurements=measurements,
                progress=progress,
            )
    except (RelposError, FusionInterrupted) as error:
        if error.result is not None:
            drop_page(job.out)
            error.result.save(job.out, run.steps)
        if isinstance(error, FusionInterrupted):
            raise RelposError(f"interrupted; the estimates so far are in {job.out}") from None
        raise
    drop_page(job.out)
    result.save(job.out, run.steps)
    evaluation, baseline = None, None
    if run.truth:
        # The truth may be at no time of an estimate.
        with suppress(DataError):
            evaluation = api.evaluate(result, run)
            baseline = reports.reckon(run, result)
    if report:
        with output.working("drawing"):
            content = reports.gather(run, result, evaluation=evaluation, baseline=baseline)
            reports.write(content, job.out / "index.html")
    counters = {**run.counters, **result.counters}
    estimates = result.estimates
    outcome = FusionSummary(run.name, counters, estimates, len(estimates), run.remarks)
    _print_outcome(job, outcome, evaluation, baseline, as_json=as_json)


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
    from relpos.measurements import common_priors
    from relpos.runs import Description
    from relpos.runs.run import RECEIVED, holds_run

    if initial is Initial.TRUTH:
        raise DataError(f"{job.source}: a port has no truth to start from")
    check_port(job.source)
    team_key(key_file)  # for its errors, before minutes of preparing
    received = job.out / RECEIVED
    if holds_run(received):
        raise DataError(f"{received}: holds what an earlier session received: choose another --out")
    # Before the port is open, because nothing reads it meanwhile. The nodes that start at one
    # place are received later; two stand for them here.
    some = common_priors((1, 2))
    job.prepare(some if initial is Initial.COMMON else ())
    port = live.open_port(job.source, key_file, teach=teach, reopen=options.shown)
    if not as_json:
        output.remark(f"listening to {job.source}; Ctrl-C ends")
    how = "under the team's key" if key_file else "without a team key: anybody could have sent it"
    fuse_live(
        job,
        port,
        options,
        description=Description(name=_base_name(job.source), source=f"received {how}").with_post(
            job.post
        ),
        common=initial is Initial.COMMON,
        as_json=as_json,
    )


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
) -> Outcome:
    """Fuse measurements of ``source`` as they arrive; write, show and print the result.

    ``emulated`` returns whether the walk of an emulated team is over, which ends its port.
    """
    from relpos.live.assembly import SessionPlan
    from relpos.runs import Description

    description = description or Description(name=_base_name(job.source))
    nodes = description.nodes
    name = description.name or _base_name(job.source)
    # A port's name ("6") says nothing to who looks at the page.
    unnamed = source.is_now and emulated is None and name == _base_name(job.source)
    plan = SessionPlan(
        f"{datetime.now().astimezone():%Y-%m-%d %H:%M}" if unnamed else name,
        job.out,
        description,
        lambda known: job.make(known, nodes),
        job.estimator,
        job.settings,
        job.seed,
        tuple(priors),
        common=common,
        emulated=emulated is not None,
        seconds=options.seconds,
        lasts=options.watched or (options.shown and source.is_now),
        mission=options.mission,
    )
    session = live.run(source, plan, options)
    failure = session.failure
    # Only a port that has vanished asks whether the walk is over, which may take seconds.
    walk_is_over = isinstance(failure, DeviceError) and emulated is not None and emulated()
    if failure is not None and not walk_is_over:
        if isinstance(failure, DeviceError):
            raise DeviceError(f"{failure}; what was received is in {job.out}")
        raise failure
    last = [session.last] if session.last is not None else []
    _print_outcome(
        job, FusionSummary(name, session.counters, last, session.estimates), as_json=as_json
    )
    wanted = options.view and options.debrief and not as_json
    if wanted and source.is_now and session.estimates and can_report():
        _debrief(job, options)
    return session


def _debrief(job: Job, options: live.Options) -> None:
    """Write the page of a session that was shown, its log included, and open it on a desktop."""
    from relpos import api
    from relpos.errors import RelposError
    from relpos.evaluation import report as reports
    from relpos.evaluation.result import read_result
    from relpos.runs.log import read_log
    from relpos.runs.run import RECEIVED

    page = job.out / "index.html"
    try:
        with output.working("writing the debrief (Ctrl-C: not now)"):
            run, result = api.load(job.out / RECEIVED), read_result(job.out)
            reports.write(reports.gather(run, result, log=read_log(job.out)), page)
    except RelposError as error:
        output.remark(f"no debrief page: {error}")
        return
    except KeyboardInterrupt:
        output.remark(f"for the debrief: relpos report {job.out / RECEIVED} --estimate {job.out}")
        return
    output.remark(f"debrief: {page}")
    live.open_browser(options, page.resolve().as_uri())


@dataclass(frozen=True)
class FusionSummary:
    """The printed result of a run or session: ``estimates`` are all ``count``, or the last."""

    name: str
    counters: Mapping[str, Any]
    estimates: Sequence[Estimate]
    count: int
    remarks: Sequence[str] = ()


def _print_outcome(
    job: Job,
    outcome: FusionSummary,
    evaluation: Evaluation | None = None,
    baseline: Baseline | None = None,
    *,
    as_json: bool,
) -> None:
    from relpos.evaluation import summary
    from relpos.fusion.clocks import time_offsets

    reckoned = baseline.metrics if baseline else None
    if as_json:
        bound = evaluation.bound if evaluation else None
        output.print_json(
            {
                "run": outcome.name,
                "estimator": job.estimator,
                "seed": job.seed,
                "out": str(job.out),
                "estimates": outcome.count,
                "counters": outcome.counters,
                "remarks": outcome.remarks,
                **(summary.as_json(evaluation.metrics) if evaluation else summary.no_metrics()),
                "iso_18305": summary.iso_as_json(evaluation.iso) if evaluation else None,
                "dead_reckoning": summary.figures(reckoned) if reckoned else None,
                "bound": asdict(bound) if bound else None,
            }
        )
        return
    seconds = [] if evaluation is None else evaluation.metrics.time_s.tolist()
    output.print_last_pairs(
        f"{outcome.name}: {job.estimator}",
        outcome.estimates,
        seconds[-1] if seconds else None,
    )
    if evaluation is not None:
        output.print_metrics(f"{outcome.name}: scored", evaluation.metrics, reckoned)
        output.print_iso(evaluation.iso)
        if evaluation.vertical is not None and evaluation.vertical.has_floors:
            output.print_vertical(evaluation.vertical)
        if evaluation.bound is not None:
            output.print_bound(evaluation.bound)
    for text in time_offsets(outcome.estimates[-1]) if outcome.estimates else ():
        output.remark(f"{text}; this is taken into account")
    for words in outcome.remarks:
        output.remark(words)
    noted = {key: value for key, value in outcome.counters.items() if value}
    if noted:
        output.remark("counted: " + ", ".join(f"{k} {v:g}" for k, v in sorted(noted.items())))
    output.remark(f"written to {job.out}")
