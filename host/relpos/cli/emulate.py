"""``relpos emulate``: the emulated team behind a pseudo-terminal."""

from __future__ import annotations

from typing import Annotated

import typer

from relpos.cli import output
from relpos.cli.demo import Board, Faults, Scenario, check_faults
from relpos.cli.keys import KeyFile, team_key
from relpos.cli.node_flash import ImuName


def emulate(
    nodes: Annotated[int, typer.Option(min=1, max=20, help="How many people.")],
    board: Annotated[Board, typer.Option(help="What runs the firmware.")] = Board.NATIVE,
    scenario: Scenario = "paper",
    speed: Annotated[
        float, typer.Option(min=0.0, help="1 is real time; 0 is as fast as possible.")
    ] = 1.0,
    seconds: Annotated[
        float | None,
        typer.Option(min=1.0, help="End after so many seconds. (default: Ctrl-C ends)"),
    ] = None,
    imu: Annotated[
        ImuName, typer.Option(help="The inertial sensor, and what the firmware is built for.")
    ] = ImuName.MPU9150,
    fault: Faults = None,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same bytes.")] = 0,
    key_file: KeyFile = None,
) -> None:
    """Offer an emulated team on a pseudo-terminal that speaks as an XBee coordinator.

    Prints the pseudo-terminal's path, which `relpos fuse` takes as its SOURCE.
    """
    from relpos.emulator.serving import UNLIMITED_S, serve_team
    from relpos.emulator.team import TeamConfig

    config = TeamConfig(
        scenario,
        nodes,
        UNLIMITED_S if seconds is None else seconds,
        seed,
        str(board),
        check_faults(fault, nodes),
        key=team_key(key_file),
        imu=str(imu),
    )
    output.remark(f"starting {nodes} emulated people; the first time their firmware is built")

    def announce(path: str) -> None:
        typer.echo(path)
        output.remark(f"in another terminal: relpos fuse {path} --view; Ctrl-C ends")

    serve_team(config, speed, announce)
