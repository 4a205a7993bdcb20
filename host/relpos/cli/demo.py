"""``relpos demo``: an emulated team through a serial port into the fusion, shown."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from relpos.cli import fuse, live, output
from relpos.cli.estimators import BANK

if TYPE_CHECKING:
    from relpos.emulator.team import TeamConfig
    from relpos.live.session import Outcome


class Board(StrEnum):
    """Target that runs the firmware: this computer, or a simulated board."""

    NATIVE = "native"
    UNO = "uno"
    MEGA = "mega"


def check_faults(faults: list[str] | None, nodes: int) -> tuple[str, ...]:
    """Return the SPECs as given; print a line and exit with status 2 where one is invalid."""
    from relpos.emulator.faults import FaultError, parse_faults

    try:
        parse_faults(faults or (), range(1, nodes + 1))
    except FaultError as error:
        typer.echo(f"relpos: {error}", err=True)
        raise typer.Exit(2) from None
    return tuple(faults or ())


Faults = Annotated[
    list[str] | None,
    typer.Option(
        "--fault", metavar="SPEC", help="A fault to inject; repeatable. See the list below."
    ),
]
Scenario = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="paper, lab, building, straight (walks); bench, turntable (tests).",
    ),
]


def demo(
    board: Annotated[Board, typer.Option(help="What runs the firmware.")] = Board.NATIVE,
    nodes: Annotated[int, typer.Option(min=2, max=20, help="How many people.")] = 6,
    seconds: Annotated[float, typer.Option(min=10.0, help="How long they walk.")] = 300.0,
    scenario: Scenario = "paper",
    fault: Faults = None,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same walk.")] = 0,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the report goes.")] = Path(
        "out/demo"
    ),
    view: live.View = False,
    view_listen: live.ViewListen = None,
    https: live.Https = False,
    open_browser: live.OpenBrowser = None,
    terminal: live.Terminal = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Run the production firmware of an emulated team and show the estimated positions.

    With --view the team walks in real time behind the live page, with --terminal in this
    terminal; Ctrl-C ends it.
    """
    from relpos.emulator.team import TeamConfig
    from relpos.runs import save_run

    faults = check_faults(fault, nodes)
    output.check_folder(out)
    shown = view or terminal
    job = fuse.Job("emulated" if shown else str(out / "run"), BANK, {}, seed, out)
    config = TeamConfig(scenario, nodes, seconds, seed, str(board), faults)
    if shown:
        options = live.Options(
            view,
            view_listen,
            https,
            open_browser,
            sinks=[live.terminal_sink(None)] if terminal else [],
            screen=terminal,
        )
        options.check()
        fuse_emulated(config, job, options, as_json=json)
        return
    from relpos.emulator.serving import record_team

    with output.working(f"emulating {nodes} nodes for {seconds:g} s"):
        run = record_team(config)
    save_run(run, out / "run")
    fuse.fuse_recording(job, run, as_json=json, report=fuse.can_report())


def fuse_emulated(
    config: TeamConfig, job: fuse.Job, options: live.Options, *, as_json: bool
) -> Outcome:
    """Emulate a team in real time and fuse what its port sends, as from a real one."""
    from relpos.emulator.process import EmulatorProcess
    from relpos.runs import Description

    with output.working(f"preparing the walk of {config.nodes} people"):
        emulator = EmulatorProcess(config)
    with emulator:
        job.prepare(emulator.priors)
        return fuse.fuse_live(
            job,
            live.open_port(emulator.port, None, teach=True, reopen=False),
            options,
            description=Description(
                name=f"{config.scenario}-{config.board}-{config.seed}",
                source=f"relpos demo --view --nodes {config.nodes} --seed {config.seed}",
                priors=emulator.priors,
            ),
            priors=emulator.priors,
            as_json=as_json,
            emulated=emulator.over,
        )
