"""The team's key as the command line takes it, and a link that uses it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from relpos.link.authentication import SeenCounters
    from relpos.link.port import Link

KeyFile = Annotated[
    Path | None,
    typer.Option(
        "--key-file",
        metavar="FILE",
        envvar="RELPOS_KEY_FILE",
        help="The team's key. (default: the one that every new node has)",
    ),
]


def team_key(key_file: Path | None) -> bytes:
    """The key in the file, else the one that every new node has; DataError where it is none."""
    from relpos.link.authentication import read_key
    from relpos.protocol.messages import DEFAULT_KEY

    return DEFAULT_KEY if key_file is None else read_key(key_file)


def make_link(key_file: Path | None) -> tuple[Link, SeenCounters | None]:
    """A link under the team's key, and where a secret team's counters are kept between sessions.

    Save ``link.newest_counters()`` there now and then, and at the end.
    """
    from relpos.link.authentication import SeenCounters
    from relpos.link.port import Link

    if key_file is None:
        return Link(), None
    key = team_key(key_file)
    seen = SeenCounters.beside(key_file)
    return Link(key=key, newest_counters=seen.load()), seen
