"""Options of the node commands, and a dialogue with one node."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from relpos.cli.keys import make_link

if TYPE_CHECKING:
    from relpos.link.dialogue import NodeDialogue
    from relpos.link.port import Link

Port = Annotated[str, typer.Argument(metavar="PORT", help="The coordinator's port.")]
Node = Annotated[
    int | None,
    typer.Option(min=1, max=254, help="Which node. (default: the only one that is heard)"),
]
Cable = Annotated[
    bool,
    typer.Option("--cable", help="PORT is the node's own USB cable, its switch in position USB."),
]


@contextmanager
def link_of(key_file: Path | None) -> Iterator[Link]:
    """A link under that key, which rejects frames that earlier sessions have seen."""
    link, seen = make_link(key_file)
    try:
        yield link
    finally:
        if seen is not None:
            lowered = link.decoder.brought_back
            seen.save(link.newest_counters(), 0.0, at_once=True, lowered=lowered)


def open_device(port: str, cable: bool) -> Any:
    """The coordinator's port, or a node's cable in its place."""
    if cable:
        from relpos.nodes.cable import CablePort

        return CablePort(port)
    from relpos.link.port import open_port

    return open_port(port)


@contextmanager
def connect(
    port: str,
    node: int | None,
    key_file: Path | None = None,
    *,
    cable: bool = False,
    number: int | None = None,
) -> Iterator[NodeDialogue]:
    """A dialogue with the node, or with the only one that is heard.

    ``number`` is the one that it gets: it may have that one's key already.
    """
    from relpos.link.dialogue import open_dialogue

    with link_of(key_file) as link:
        if node is not None and number is not None:
            link.decoder.extra_keys[node] = (link.key_of(number),)
        device = open_device(port, cable)
        try:
            yield open_dialogue(device, node, link)
        finally:
            device.close()
