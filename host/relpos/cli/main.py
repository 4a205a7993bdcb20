"""``relpos``: the commands, and how a failure is printed.

Every command lives in its own file and imports what is heavy inside its body, so that
``relpos --help`` answers at once. Exit status: 0 done, 1 the data or device failed (one clear
line on stderr), 2 wrong usage.
"""

from __future__ import annotations

import os
import re
import sys
from io import TextIOWrapper
from typing import Any

import typer
from typer.core import TyperGroup

from relpos.cli import (
    convert,
    deadreckon,
    demo,
    doctor,
    emulate,
    evaluate,
    figures,
    fuse,
    mission,
    needs,
    node,
    recordings,
    replay,
    report,
    simulate,
)
from relpos.emulator.faults import help_text
from relpos.errors import RelposError, words_of
from relpos.version import __version__


class Commands(TyperGroup):
    """The group of commands; turns what a user can cause into one line and exit status 1."""

    def make_context(self, info_name: Any, args: list[str], parent: Any = None, **more: Any) -> Any:
        """Read the command line; Typer would end without a word at Ctrl-C here."""
        try:
            # As of --out "$DIR" without a DIR: it would be the folder where one happens to be.
            if any(not word or re.fullmatch("--[a-z-]+=", word) for word in args):
                raise typer.BadParameter("an argument is empty: a variable without a value?")
            return super().make_context(info_name, args, parent, **more)
        except KeyboardInterrupt:
            _fail("interrupted")

    def invoke(self, ctx: Any) -> Any:
        """Run the command; never let an expected failure become a traceback."""
        if isinstance(sys.stdout, TextIOWrapper) and sys.stdout.errors == "strict":
            # As stderr is: names of files need not be text.
            sys.stdout.reconfigure(errors="backslashreplace")
        try:
            return super().invoke(ctx)
        except RelposError as error:
            _fail(str(error))
        except BrokenPipeError:
            # The reader of our output has gone; a second error at exit would only confuse.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(1) from None
        except KeyboardInterrupt:
            _fail("interrupted")
        except OSError as error:
            _fail(words_of(error))
        except RuntimeError as error:  # of pathlib, before Python 3.13
            if not str(error).startswith("Symlink loop"):
                raise
            _fail(str(error))
        except MemoryError:
            _fail("not enough memory: a shorter run, or fewer nodes")


def _fail(words: str) -> None:
    typer.echo(f"relpos: {' '.join(words.split())}", err=True)
    raise typer.Exit(1)


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Where everybody is, relative to each other: IMU and UWB, no anchors, no map.",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"relpos {__version__}")
        raise typer.Exit


@app.callback()
def main(
    version: bool = typer.Option(
        False, "--version", callback=_print_version, is_eager=True, help="Print the version."
    ),
) -> None:
    """Where everybody is, relative to each other: IMU and UWB, no anchors, no map."""


app.command("demo", epilog=help_text(), cls=needs.Command)(demo.demo)
app.command("emulate", epilog=help_text())(emulate.emulate)
app.command("fuse", cls=fuse.FuseCommand)(fuse.fuse)
app.command("mission")(mission.mission)
app.command("replay", cls=needs.Command)(replay.replay)
app.command("simulate")(simulate.simulate)
app.command("evaluate")(evaluate.evaluate)
app.command("convert")(convert.convert)
app.command("figures")(figures.figures)
app.command("report", cls=needs.Command)(report.report)
app.command("deadreckon")(deadreckon.deadreckon)
app.command("doctor")(doctor.doctor)
app.add_typer(node.app, name="node")
app.add_typer(recordings.app, name="recordings")


if __name__ == "__main__":
    app()
