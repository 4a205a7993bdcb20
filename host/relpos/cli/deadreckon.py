"""``relpos deadreckon``: raw inertial data through the emulated chip and the firmware."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from relpos.cli import output
from relpos.cli.demo import Board
from relpos.errors import DataError
from relpos.files import write_output

if TYPE_CHECKING:
    from relpos.emulator.deadreckoning import NodeResult
    from relpos.measurements import Measurement
    from relpos.runs import Run


def deadreckon(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run directory with imu.csv.")],
    board: Annotated[Board, typer.Option(help="What runs the firmware.")] = Board.NATIVE,
    stature: Annotated[
        float | None,
        typer.Option(metavar="M", min=0.5, max=2.5, help="The wearer's height in metres."),
    ] = None,
    calibrate_from: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RUN2",
            help="A walk of the same wearer with true_distance_m; may be given several times.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Write motion, steps, height and truth as CSV files and summary.json there.",
        ),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Play imu.csv into the emulated sensor chip, run the firmware, print the walked path."""
    from dataclasses import replace

    from relpos.emulator.deadreckoning import reckon_run
    from relpos.runs import Run, save_run
    from relpos.sources import load

    recording = load(run)
    if not recording.load_imu():
        raise DataError(f"{run}: no inertial data in this run (imu.csv)")
    walks = []
    for path in calibrate_from or ():
        walk = load(path)
        if walk.description.true_distance_m is None:
            raise DataError(f"{path}: run.toml gives no true_distance_m to calibrate with")
        if not walk.load_imu():
            raise DataError(f"{path}: no inertial data in this run (imu.csv)")
        walks.append(walk)
    if out is not None:
        output.keep_recording(out, "deadreckon", "dead-reckoned")
        output.check_folder(out)
    with output.working("running the firmware over the recording"):
        played = reckon_run(recording, board=str(board), stature_m=stature, calibration=walks)

    nodes = {str(node): _figures(part) for node, part in sorted(played.items())}
    if out is not None:
        parts = [part.output for part in played.values()]
        measured: list[Measurement] = []
        for reported in parts:
            measured += (*reported.motions, *reported.heights)
        save_run(
            Run(
                name=recording.name,
                description=replace(recording.description, source=f"relpos deadreckon {run}"),
                measurements=tuple(sorted(measured, key=lambda m: m.time_s)),
                steps=tuple(
                    sorted((s for part in parts for s in part.steps), key=lambda s: s.time_s)
                ),
                truth=recording.truth,
            ),
            out,
        )
        document = dumps({"nodes": nodes}, indent=2, allow_nan=False)
        write_output(out / "summary.json", document + "\n")
    for node, part in sorted(played.items()):
        _print_remarks(node, part, walks)
    if json:
        output.print_json({"nodes": nodes})
        return
    for name, figures in nodes.items():
        typer.echo(
            f"node {name}: {figures['distance_m']:.2f} m in {figures['steps']} steps, "
            f"turned {math.degrees(figures['turn_rad']):.0f} degrees, "
            f"ended {figures['x_m']:+.2f} m ahead and {figures['y_m']:+.2f} m to the left"
        )
    if out is not None:
        output.remark(f"written to {out}")


def _print_remarks(node: int, part: NodeResult, walks: Sequence[Run]) -> None:
    """Print what a user must know of one node: calibration, and faults of the recording."""
    from relpos.emulator.deadreckoning import LEAST_RATE_HZ

    if part.repeated:
        output.remark(
            f"node {node}: {part.repeated} of {part.samples} samples repeat a time: "
            "the first of each time is played"
        )
    if part.calibration is not None:
        for walk, measured_m in zip(walks, part.calibration.measured_m, strict=True):
            output.remark(
                f"node {node}: {walk.name} of {walk.description.true_distance_m:g} m comes out "
                f"as {measured_m:.2f} m before calibration"
            )
        output.remark(
            f"node {node}: step length x{part.calibration.scale:.3f} after calibration; one walk "
            "alone has partial weight, a walk that is far off little"
        )
    if part.rate_hz < LEAST_RATE_HZ:
        output.remark(
            f"node {node}: {part.rate_hz:.3g} samples a second are too few to see steps: "
            f"{LEAST_RATE_HZ:g} are needed"
        )
    if part.output.clipped:
        output.remark(
            f"node {node}: {part.output.clipped} of {part.samples} samples are beyond the "
            "range the firmware configures; the chip clips them"
        )


def _figures(part: NodeResult) -> dict[str, Any]:
    """Return the figures of one node; the end is in its heading frame at the start."""
    leg_m = part.settings.leg_length_m
    end, heading_rad = 0j, 0.0
    for motion in part.output.motions:
        end += complex(motion.dx_m, motion.dy_m) * cmath.exp(1j * heading_rad)
        heading_rad += motion.dtheta_rad
    return {
        "distance_m": round(part.output.distance_m, 4),
        "steps": len(part.output.steps),
        "turn_rad": round(heading_rad, 5),
        "x_m": round(end.real, 3),
        "y_m": round(end.imag, 3),
        "leg_length_m": None if leg_m is None else round(leg_m, 4),
        "step_gain_permille": part.settings.step_gain_permille,
        "step_scale": None if part.calibration is None else round(part.calibration.scale, 4),
        "samples": part.samples,
        "clipped_samples": part.output.clipped,
    }
