"""``relpos node calibrate``: a node's sensors, its wearer's steps, two nodes' antennas."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from relpos import extras
from relpos.cli import output
from relpos.cli.keys import KeyFile
from relpos.cli.node_dialogue import Node, Port, connect
from relpos.errors import DataError, DeviceError
from relpos.files import write_output

if TYPE_CHECKING:
    from relpos.calibration.antenna import RangeFit
    from relpos.calibration.guide import Progress, Result
    from relpos.link.dialogue import NodeDialogue
    from relpos.measurements import RawSample

HEARD_WITHIN_S = 6.0
STOOD_S = 5.0
"""Time without a step after which the walk counts as finished."""
WALK_WITHIN_S = 900.0
DEFAULT = "sensors"
_FLAGS = ("--yes", "-y", "--magnetometer", "--no-magnetometer", "--help")


class CalibrateGroup(TyperGroup):
    """`calibrate PORT` is `calibrate sensors PORT`; a command's name may stand behind options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the command's name, or the default one, in front."""
        position = self._first_word(args)
        if position is not None:
            word = args[position]
            rest = args[:position] + args[position + 1 :]
            args = [word, *rest] if word in self.commands else [DEFAULT, *args]
        return super().parse_args(ctx, args)

    @staticmethod
    def _first_word(args: list[str]) -> int | None:
        """Where the first argument stands that is neither an option nor an option's value."""
        position = 0
        while position < len(args):
            word = args[position]
            if not word.startswith("-"):
                return position
            position += 1 if word in _FLAGS or "=" in word else 2
        return None


app = typer.Typer(
    cls=CalibrateGroup,
    no_args_is_help=True,
    help="Calibrate a node and store that on it: its sensors (`calibrate PORT` for short), its "
    "wearer's steps, the antennas of two nodes.",
)

Yes = Annotated[bool, typer.Option("--yes", "-y", help="Store without asking.")]


@app.command()
def sensors(
    port: Port,
    node: Node = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write the picture and the figures there.")
    ] = None,
    seconds: Annotated[
        float, typer.Option(min=20.0, max=600.0, help="Longest time for moving the node.")
    ] = 300.0,
    magnetometer: Annotated[bool, typer.Option(help="Calibrate the magnetometer, too.")] = True,
    yes: Yes = False,
    key_file: KeyFile = None,
) -> None:
    """Calibrate gyroscope, accelerometer and magnetometer; `calibrate PORT` for short."""
    if out is not None:
        output.check_folder(out)
        if magnetometer:
            extras.require("report")
    with connect(port, node, key_file) as dialogue:
        _sensors(dialogue, seconds, magnetometer, out, yes)


@app.command()
def walk(
    port: Port,
    distance: Annotated[
        float, typer.Option(metavar="M", min=5.0, help="The length that is walked.")
    ],
    node: Node = None,
    stature: Annotated[
        float | None,
        typer.Option(metavar="M", min=1.0, max=2.4, help="The wearer's height, if new."),
    ] = None,
    yes: Yes = False,
    key_file: KeyFile = None,
) -> None:
    """Set the step gain by a straight walk of known length."""
    with connect(port, node, key_file) as dialogue:
        _walk(dialogue, distance, stature, yes)


@app.command()
def antenna(
    port: Port,
    nodes: Annotated[
        str, typer.Option(metavar="A,B", help="The two nodes; they lie still, in sight.")
    ],
    distance: Annotated[
        float, typer.Option(metavar="M", min=1.0, max=100.0, help="Between their tags.")
    ],
    reference: Annotated[
        int | None,
        typer.Option(metavar="A", help="This one keeps its share, the other takes all."),
    ] = None,
    ranges: Annotated[int, typer.Option(min=20, max=2000, help="How many to measure.")] = 100,
    yes: Yes = False,
    key_file: KeyFile = None,
) -> None:
    """Calibrate the antenna delays of two nodes at a known distance."""
    try:
        first, second = (int(word) for word in nodes.split(","))
    except ValueError:
        raise typer.BadParameter(f"'{nodes}' is not A,B", param_hint="--nodes") from None
    if not (1 <= first <= 254 and 1 <= second <= 254 and first != second):
        raise typer.BadParameter("two different nodes, 1 to 254", param_hint="--nodes")
    if reference not in (None, first, second):
        raise typer.BadParameter("one of the two nodes", param_hint="--reference")
    with connect(port, first, key_file) as dialogue:
        _antenna(dialogue, (first, second), distance, reference, ranges, yes)


def _confirmed(yes: bool) -> bool:
    if yes or not sys.stdin.isatty():
        return True
    return typer.confirm("Store this on the node?", default=True)


# -- sensors ---------------------------------------------------------------------------------------


@contextmanager
def _shown() -> Iterator[Any]:
    """A function that shows a Progress, as bars on a terminal, else as lines."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bars

    from relpos.calibration import guide, inertial

    console = Console(stderr=True)
    if not console.is_terminal:
        reported_s = time.monotonic()

        def say(now: Progress) -> None:
            nonlocal reported_s
            if time.monotonic() - reported_s > output.PLAIN_PROGRESS_EVERY_S:
                reported_s = time.monotonic()
                output.remark(
                    f"still {now.still_s:.0f} s, {now.attitudes} sides, "
                    f"{100 * now.coverage:.0f} % of the directions"
                )

        yield say
        return
    columns = (
        TextColumn("{task.description:32}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
    )
    with Bars(*columns, console=console, transient=True) as bars:
        still = bars.add_task("lying still", total=guide.STILL_S)
        sides = bars.add_task("each side down once", total=inertial.POSES_FOR_SCALE)
        turned = bars.add_task("turned in all directions", total=guide.COVERAGE)

        def show(now: Progress) -> None:
            bars.update(still, completed=min(now.still_s, guide.STILL_S))
            bars.update(sides, completed=min(now.attitudes, inertial.POSES_FOR_SCALE))
            bars.update(
                turned, completed=min(now.coverage, now.readings / guide.READINGS * guide.COVERAGE)
            )

        yield show


def _sensors(
    dialogue: NodeDialogue, seconds: float, magnetic: bool, out: Path | None, yes: bool
) -> None:
    from relpos.calibration import guide

    output.remark(
        f"node {dialogue.node}: away from steel and from your phone,\n"
        "  1. lay it on a firm surface and do not touch it for ten seconds,\n"
        "  2. lay it on each of its six sides, three seconds each,\n"
        "  3. turn it slowly on the spot in all directions, until the last bar is full.\n"
        "In any order; Ctrl-C ends the collection."
    )
    samples: list[RawSample] = []
    # After Ctrl-C the fits report what is missing.
    with _shown() as show, suppress(KeyboardInterrupt):
        for sample in dialogue.raw_samples(seconds):
            if sample is None:
                continue
            samples.append(sample)
            if len(samples) % 5 == 0:
                now = guide.progress(samples)
                show(now)
                if now.done(with_magnetometer=magnetic):
                    break
    before = dialogue.read_calibration()
    result = guide.solve(samples, before, with_magnetometer=magnetic)
    for words in result.remarks:
        output.remark(words)
    _print_result(dialogue.node, result)
    if out is not None:
        _write(out, dialogue.node, result)
    if not _confirmed(yes):
        raise DataError(f"node {dialogue.node} keeps what it had")
    dialogue.write_calibration(result.calibration)
    again = "again" if before.gyro_bias_sigma_rad_s > 0.0 else "for the first time"
    typer.echo(f"node {dialogue.node} is calibrated {again}: stored, restarted and read back")


def _triple(values: Any, factor: float = 1.0, digits: int = 2) -> str:
    return "  ".join(f"{factor * float(v):+.{digits}f}" for v in values)


def _rows(result: Result) -> list[tuple[str, str]]:
    degree = 180.0 / math.pi
    rows = [
        ("gyroscope bias / deg/s", _triple(result.gyro.bias_rad_s, degree, 3)),
        ("  standard deviation in use / deg/s", f"{degree * result.gyro.sigma_rad_s:.2f}"),
    ]
    if (a := result.accelerometer) is not None:
        rows += [
            ("accelerometer bias / m/s2", _triple(a.bias_m_s2, 1.0, 3)),
            ("  scale / %", "not observable" if a.partial else _triple(a.scale, 100.0)),
            (
                "  |force| - g, before and after / m/s2",
                f"{a.residual_before_m_s2:.3f}  {a.residual_m_s2:.3f}",
            ),
        ]
    if (m := result.magnetometer) is not None:
        rows += [
            ("hard iron / uT", _triple(m.offset_ut, 1.0, 1)),
            ("  strength of the field / uT", f"{m.radius_ut:.1f}"),
            (
                "  its spread, before and after / %",
                f"{100 * m.residual_before:.1f}  {100 * m.residual:.2f}",
            ),
            ("  directions seen / %", f"{100 * m.coverage:.0f}"),
        ]
        if m.dip_rad is not None:
            rows.append(("  dip below the horizon / deg", f"{degree * m.dip_rad:.1f}"))
    return rows


def _print_result(node: int, result: Result) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"Node {node}", show_header=False)
    table.add_column()
    table.add_column(justify="right")
    for row in _rows(result):
        table.add_row(*row)
    Console().print(table)


def _write(out: Path, node: int, result: Result) -> None:
    out.mkdir(parents=True, exist_ok=True)
    if result.magnetometer is not None:
        from relpos.calibration.picture import draw

        path = out / f"node-{node}-magnetometer.png"
        draw(result.magnetometer, result.fields_ut, path)
        typer.echo(f"picture: {path}")
    lines = [f"{name.strip()}: {value}\n" for name, value in _rows(result)]
    write_output(out / f"node-{node}-calibration.txt", "".join(lines))


# -- steps -----------------------------------------------------------------------------------------


def _walk(dialogue: NodeDialogue, distance_m: float, stature_m: float | None, yes: bool) -> None:
    from relpos.calibration import steps
    from relpos.protocol import messages as wire

    if stature_m is not None:
        leg_mm = round(1000.0 * (steps.LEG_OF_STATURE * stature_m))
        dialogue.demand(wire.CommandCode.SET_LEG_LENGTH_MM, leg_mm)
        typer.echo(f"leg length: {leg_mm / 1000:.3f} m")
    gain = dialogue.setting(wire.CommandCode.SET_STEP_GAIN_PERMILLE)
    before = _motion(dialogue)
    output.remark(
        f"node {dialogue.node}: walk {distance_m:g} m straight at your usual pace, "
        f"then stand for {STOOD_S:g} seconds"
    )
    newest = before
    stepped_s = time.monotonic()
    until_s = stepped_s + WALK_WITHIN_S
    while time.monotonic() < until_s:
        dialogue.listen()
        totals = _motion(dialogue)
        if totals["steps"] != newest["steps"]:
            stepped_s = time.monotonic()
        newest = totals
        walked = (newest["steps"] - before["steps"]) % 65536
        if walked >= steps.MIN_STEPS and time.monotonic() - stepped_s > STOOD_S:
            break
    walked = (newest["steps"] - before["steps"]) % 65536
    fit = steps.fit_walk(gain, walked, newest["path_m"] - before["path_m"], distance_m)
    typer.echo(
        f"{fit.steps} steps: the node measured {fit.measured_m:.2f} m, true {fit.true_m:g} m "
        f"({100 * (fit.scale - 1):+.1f} %)"
    )
    change = fit.gain_permille / fit.gain_before_permille - 1.0
    typer.echo(
        f"step gain {fit.gain_before_permille / 1000:.3f} -> {fit.gain_permille / 1000:.3f} "
        f"({100 * change:+.1f} %: one walk, weighted against the population)"
    )
    if not _confirmed(yes):
        raise DataError(f"node {dialogue.node} keeps its step gain")
    dialogue.set_step_gain(fit.gain_permille)
    typer.echo(f"node {dialogue.node} has stored it")


def _motion(dialogue: NodeDialogue) -> dict[str, Any]:
    """Return the node's newest running totals; wait for the first."""
    until_s = time.monotonic() + HEARD_WITHIN_S
    while (totals := dialogue.totals()) is None:
        if time.monotonic() > until_s:
            raise DeviceError(f"node {dialogue.node} reports no motion")
        dialogue.listen()
    return dict(totals)


# -- antennas --------------------------------------------------------------------------------------


def _antenna(
    dialogue: NodeDialogue,
    pair: tuple[int, int],
    distance_m: float,
    reference: int | None,
    count: int,
    yes: bool,
) -> None:
    from relpos.calibration import antenna as fits
    from relpos.nodes import antenna as measuring

    offsets_mm = measuring.read_offsets_mm(dialogue, pair)
    output.remark(
        f"nodes {pair[0]} and {pair[1]}: keep them still, {distance_m:g} m apart and in sight of "
        f"each other, until {count} ranges are in"
    )
    with measuring.ranging_fast(dialogue, pair):
        found = fits.fit_ranges(_ranges(dialogue, pair, count), distance_m)
        _print_ranges("before", found)
        new_mm = fits.new_offsets_mm(
            found.bias_m, offsets_mm, None if reference is None else pair.index(reference)
        )
        if not _confirmed(yes):
            raise DataError(f"nodes {pair[0]} and {pair[1]} keep their range offsets")
        measuring.store_offsets_mm(dialogue, pair, new_mm)
        for node, old, new in zip(pair, offsets_mm, new_mm, strict=True):
            typer.echo(f"node {node}: range offset {old / 1000:+.3f} -> {new / 1000:+.3f} m")
        left = fits.fit_ranges(_ranges(dialogue, pair, count), distance_m)
    _print_ranges("after", left)
    # Both fits err; three times the deviation of their difference, and a millimetre of rounding.
    most_m = 3.0 * math.hypot(found.sigma_m, left.sigma_m) + 0.001
    if abs(left.bias_m) > most_m:
        raise DeviceError(
            f"stored, but the ranges are still {left.bias_m:+.3f} m off, more than {most_m:.3f} m: "
            "has something moved? Calibrate again"
        )
    typer.echo(f"nodes {pair[0]} and {pair[1]} have stored it; verified by measuring again")


def _print_ranges(when: str, fit: RangeFit) -> None:
    typer.echo(
        f"{when}: {fit.count} ranges, {fit.bias_m:+.3f} m off (+-{fit.sigma_m:.3f}), "
        f"each spreads by {fit.spread_m:.3f} m"
    )


def _ranges(dialogue: NodeDialogue, pair: tuple[int, int], count: int) -> list[float]:
    from relpos.nodes.antenna import collect

    ranges_m: list[float] = []
    with output.progress() as show:
        for range_m in collect(dialogue, pair, count):
            show("ranges", len(ranges_m), count)
            ranges_m.append(range_m)
    return ranges_m
