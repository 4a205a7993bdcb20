"""``relpos doctor``: whether this computer, and the coordinator at it, are fit for a team."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from relpos.cli import output
from relpos.cli.keys import KeyFile

if TYPE_CHECKING:
    from relpos.doctor.finding import Finding


def doctor(
    port: Annotated[
        str | None,
        typer.Argument(help="Port of the coordinator, whose XBee settings are checked."),
    ] = None,
    key_file: KeyFile = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where recordings will go.")] = Path(
        "out"
    ),
    prepare: Annotated[
        bool, typer.Option("--prepare", help="Compile the estimators first, for a quick start.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Check installation, tools, ports, permissions and the coordinator; print remedies.

    Changes nothing. Exit status 1 where something is wrong, else 0; hints do not count.
    """
    from relpos.doctor import devices, installation
    from relpos.doctor.computer import Computer
    from relpos.doctor.finding import State

    if prepare:
        with output.progress(output.STAGES) as progress:
            installation.prepare(progress)
    computer = Computer()
    looked = chain(installation.look(computer, key_file, out), devices.look(computer, port))
    findings = list(looked if json else _printed(looked))
    wrong = sum(finding.state is State.WRONG for finding in findings)
    if json:
        document = {"well": not wrong, "findings": [asdict(f) for f in findings]}
        output.print_json(document)
    else:
        hints = sum(finding.state is State.HINT for finding in findings)
        typer.echo(f"{wrong or 'nothing'} wrong, {hints or 'no'} hint{'s' * (hints != 1)}")
    if wrong:
        raise typer.Exit(1)


def _printed(findings: Iterator[Finding]) -> Iterator[Finding]:
    """Print each finding as it comes, because some take seconds."""
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False, soft_wrap=True)
    styles = {"well": "green", "hint": "yellow", "wrong": "bold red"}
    for finding in findings:
        line = Text(f"{finding.state:5}  ", styles[finding.state])
        line.append(f"{finding.name}: ", "bold").append(finding.words, "default")
        console.print(line)
        if finding.remedy:
            console.print(Text(f"       -> {finding.remedy}"))
        yield finding
