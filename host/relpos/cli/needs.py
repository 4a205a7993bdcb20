"""What options need to have an effect: one that is given without it is refused.

Whoever gives an option relies on it; a smoothed report that is not smoothed would be believed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from typer.core import TyperCommand

from relpos.errors import RelposError

Given = Mapping[str, Any]
"""The command's parameters by name; paths are still text with old versions of Typer."""


@dataclass(frozen=True)
class Need:
    """``options``: names of parameters. ``words``: what they need, if it is not ``met``."""

    options: str
    words: str
    met: Callable[[Given], bool]


class Source(StrEnum):
    """What a source is, of which a command's options depend."""

    PORT = "port"
    FILE = "file"
    FOLDER = "folder"
    MISSING = "missing"
    """An error of its own, which comes later: it counts as whatever an option needs."""


def _source(given: Given) -> Source:
    from relpos import sources

    path = Path(given["source"])
    if sources.is_port(given["source"]):
        return Source.PORT
    return Source.FOLDER if path.is_dir() else Source.FILE if path.exists() else Source.MISSING


def _is_watched(given: Given) -> bool:
    return any(given[name] not in (None, False) for name in ("view", "terminal", "cot", "foxglove"))


def _is_shown(given: Given) -> bool:
    return _is_watched(given) or given["record"] is not None


def _has_page(given: Given) -> bool:
    if _source(given) is Source.PORT:
        return bool(given["view"]) and not given["json"]
    return not _is_shown(given)


PAGE = Need(
    "view_listen https open_browser", "no page is served without --view", lambda g: g["view"]
)
NEEDS = {
    "demo": (PAGE,),
    "fuse": (
        PAGE,
        Need("me", "it is a node of --terminal", lambda g: g["terminal"]),
        Need("pins", "nothing is placed on a map without --cot", lambda g: g["cot"] is not None),
        Need(
            "seconds",
            "it ends a session: of a port, --view, --terminal, --cot, --foxglove or --record",
            lambda g: _is_shown(g) or _source(g) in (Source.PORT, Source.MISSING),
        ),
        Need(
            "speed",
            "it is that of a recording or run, not of a port",
            lambda g: _source(g) is not Source.PORT,
        ),
        Need(
            "speed",
            "nothing is played without --view, --terminal, --cot or --foxglove",
            lambda g: _is_watched(g) or _source(g) is Source.MISSING,
        ),
        Need(
            "key_file",
            "it is the key of a port or a recording, and a run directory has none",
            lambda g: _source(g) is not Source.FOLDER,
        ),
        Need(
            "teach",
            "only the nodes of a port can be taught",
            lambda g: _source(g) in (Source.PORT, Source.MISSING),
        ),
        Need(
            "report",
            "a session has its page only on a port, with --view and without --json; "
            "relpos report writes one",
            _has_page,
        ),
    ),
    "replay": (
        Need(
            "view_listen open_browser seconds",
            "no page is served with --log",
            lambda g: g["log"] is None,
        ),
        Need(
            "pins",
            "places are written by --log FILE.kml alone",
            lambda g: g["log"] is not None and Path(g["log"]).suffix.lower() == ".kml",
        ),
    ),
    "report": (
        Need(
            "estimator settings seed smooth",
            "nothing is estimated where --estimate gives an estimate",
            lambda g: g["estimate"] is None,
        ),
    ),
}
"""By command. An option that switches something off needs nothing."""


class Command(TyperCommand):
    """A command that refuses options without effect."""

    def invoke(self, ctx: Any) -> Any:
        """Run it; RelposError where an option of the command line has no effect."""
        flags = {param.name: param.opts[0] for param in self.params}
        for need in NEEDS.get(self.name or "", ()):
            if need.met(ctx.params):
                continue
            for name in need.options.split():
                source = ctx.get_parameter_source(name)
                # Keys of the environment stand there for every command.
                given = source is not None and source.name == "COMMANDLINE"
                if given and ctx.params[name] is not False:
                    raise RelposError(f"{flags[name]}: {need.words}")
        return super().invoke(ctx)
