"""``relpos deadreckon``: raw inertial data through the emulated chip and the firmware."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from relpos.cli import output
from relpos.cli.demo import Board
from relpos.errors import DataError


def deadreckon(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run directory with imu.csv.")],
    board: Annotated[Board, typer.Option(help="What runs the firmware.")] = Board.NATIVE,
    stature: Annotated[
        float | None,
        typer.Option(metavar="M", min=0.5, max=2.5, help="The wearer's height in metres."),
    ] = None,
    calibrate_from: Annotated[
        Path | None,
        typer.Option(metavar="RUN2", help="A walk of the same wearer with true_distance_m."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write motion.csv and steps.csv there.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Play imu.csv into the emulated sensor chip, run the firmware, print the walked path."""
    from dataclasses import replace

    from relpos.emulator.replay import replay_imu
    from relpos.runs import Run, load_run, save_run

    recording = load_run(run)
    if not recording.load_imu():
        raise DataError(f"{run}: no inertial data in this run (imu.csv)")
    if calibrate_from is not None:
        walk = load_run(calibrate_from)
        if walk.description.true_distance_m is None:
            raise DataError(
                f"{calibrate_from}: run.toml gives no true_distance_m to calibrate with"
            )
        if not walk.load_imu():
            raise DataError(f"{calibrate_from}: no inertial data in this run (imu.csv)")
    else:
        walk = None
    with output.working("running the firmware over the recording"):
        motions, steps = replay_imu(
            recording, board=str(board), stature_m=stature, calibration=walk
        )

    nodes = {
        node: {
            "distance_m": round(sum(s.length_m for s in steps if s.node == node), 4),
            "steps": sum(s.node == node for s in steps),
            "turn_rad": round(sum(m.dtheta_rad for m in motions if m.node == node), 5),
        }
        for node in sorted({m.node for m in motions} | {s.node for s in steps})
    }
    if out is not None:
        played = Run(
            name=recording.name,
            description=replace(recording.description, source=f"relpos deadreckon {run}"),
            measurements=tuple(sorted(motions, key=lambda motion: motion.time_s)),
            steps=tuple(sorted(steps, key=lambda step: step.time_s)),
        )
        save_run(played, out)
    if json:
        output.print_json({"nodes": {str(node): figures for node, figures in nodes.items()}})
        return
    for node, figures in nodes.items():
        typer.echo(
            f"node {node}: {figures['distance_m']:.2f} m in {figures['steps']} steps, "
            f"turned {math.degrees(figures['turn_rad']):.0f} degrees"
        )
    if out is not None:
        output.remark(f"written to {out}")
