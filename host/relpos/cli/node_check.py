"""``relpos node check``: a freshly wired node, part by part."""

from __future__ import annotations

import json
import textwrap
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from relpos.cli.keys import KeyFile
from relpos.cli.node_dialogue import Cable, Node, Port, connect
from relpos.errors import DeviceError
from relpos.files import write_output

if TYPE_CHECKING:
    from relpos.nodes.bringup import Finding

_UNDER: dict[str, Any] = {"initial_indent": " " * 24, "subsequent_indent": " " * 27}
_WORDS = {True: "right", False: "WRONG", None: "-"}


def check(
    port: Port,
    node: Node = None,
    peer: Annotated[
        int | None,
        typer.Option(min=1, max=254, help="A second node to range with. (default: another heard)"),
    ] = None,
    distance: Annotated[
        float | None, typer.Option(min=0.1, max=100.0, help="How far away it lies, in metres.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write what was measured, as JSON.")
    ] = None,
    key_file: KeyFile = None,
    cable: Cable = False,
) -> None:
    """Check a freshly wired node part by part: each line right or wrong, and what to do.

    The node lies still meanwhile, for a minute; then it restarts. Exit status 1 where something is
    wrong. Nobody has measured every part yet: please send a report (--report) to the project.
    """
    from relpos.nodes.bringup import NodeCheck

    findings: list[Finding] = []
    with connect(port, node, key_file, cable=cable) as dialogue:
        walk = NodeCheck(dialogue, cable=cable, peer=peer, distance_m=distance)
        try:
            # Ctrl-C while a line is shown: the node restarts before its port closes.
            with closing(walk.findings()) as made:
                for finding in made:
                    findings.append(finding)
                    _show(finding)
        finally:
            if report is not None:
                _write(report, dialogue.node, findings, walk.figures)
    wrong = [finding for finding in findings if finding.right is False]
    if wrong:
        raise DeviceError(f"node {dialogue.node}: {len(wrong)} of {len(findings)} lines are wrong")
    typer.echo(f"node {dialogue.node} is ready")


def _show(finding: Finding) -> None:
    typer.echo(f"{_WORDS[finding.right]:6} {finding.part:16} {finding.found}")
    if finding.right is False:
        typer.echo(textwrap.fill(f"-> {finding.remedy}", 96, **_UNDER))


def _write(path: Path, node: int, findings: list[Finding], figures: dict[str, object]) -> None:
    from relpos.version import __version__

    lines = [{"part": f.part, "right": f.right, "found": f.found} for f in findings]
    document = {"relpos": __version__, "node": node, "findings": lines, "figures": figures}
    try:
        write_output(path, json.dumps(document, indent=2, allow_nan=False) + "\n")
    except OSError as error:
        raise DeviceError(f"{path}: cannot be written: {error.strerror}") from error
