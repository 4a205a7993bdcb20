"""``relpos node flash``: a board on USB becomes a node."""

from __future__ import annotations

import time
from contextlib import closing
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from relpos.cli import output
from relpos.cli.keys import KeyFile, team_key
from relpos.errors import DataError, DeviceError

if TYPE_CHECKING:
    from relpos.link.dialogue import NodeDialogue
    from relpos.nodes.cable import CablePort

HEARD_WITHIN_S = 20.0
"""An Arduino restarts when its port is opened, the boot loader waits two seconds at most, and the
first report comes a report period later."""


class ImuName(StrEnum):
    """An inertial sensor that the firmware is built for."""

    MPU9150 = "mpu9150"
    MPU9250 = "mpu9250"


class BoardName(StrEnum):
    """A board that the firmware is built for."""

    UNO = "uno"
    MEGA = "mega"


def flash(
    port: Annotated[
        str | None,
        typer.Argument(help="The board's. (default: the only board on USB)"),
    ] = None,
    board: Annotated[
        BoardName | None, typer.Option(help="Refuse any other. (default: the one that answers)")
    ] = None,
    imu: Annotated[
        ImuName, typer.Option(help="The inertial sensor wired to it; MPU-9255: mpu9250.")
    ] = ImuName.MPU9150,
    node_id: Annotated[
        int | None,
        typer.Option("--id", min=1, max=254, help="The node's number. (default: as it was)"),
    ] = None,
    key_file: KeyFile = None,
    new: Annotated[
        bool, typer.Option("--new", help="Make a new random key in the key's file first.")
    ] = False,
    old_key_file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="The key that the node has. (default: the new or the default one)"
        ),
    ] = None,
) -> None:
    """Write the firmware into a board, give it its number and key, and hear it answer.

    The XBee shield's switch in position USB (or the XBee out of its socket) until it is done.
    """
    from relpos.link.authentication import write_new_key
    from relpos.link.port import open_port
    from relpos.nodes import boards, upload

    if new and key_file is None:
        raise typer.BadParameter("say where: --key-file FILE", param_hint="--new")
    if new and key_file is not None:
        if key_file.exists():
            raise DataError(f"{key_file} exists already: a key is not overwritten")
        if not key_file.parent.is_dir():
            raise DataError(f"{key_file}: cannot be written: there is no folder {key_file.parent}")
        output.check_folder(key_file.parent)
    team_key(None if new else key_file), team_key(old_key_file)  # before anything is written
    found = port or boards.find_port()
    with closing(open_port(found, boards.BOOT_BAUD)) as device:
        kind = boards.check(device, None if board is None else str(board))
        warning = boards.warning(device, kind)
    typer.echo(f"{found}: Arduino {kind.name} ({kind.chip})")
    if warning is not None:
        typer.echo(f"{found}: {warning}", err=True)
    try:
        with output.working("building and writing the firmware"):
            size = upload.upload(kind, found, imu=str(imu))
    except KeyboardInterrupt:
        raise DeviceError(
            f"{found}: interrupted: the board may hold half of the firmware; flash it again"
        ) from None
    typer.echo("firmware written and verified" + (f" ({size} bytes)" if size else ""))
    if new and key_file is not None:
        write_new_key(key_file)
    _set_up(found, node_id, key_file, old_key_file)


def _set_up(
    port: str, node_id: int | None, key_file: Path | None, old_key_file: Path | None
) -> None:
    """Set key and number of the node over its cable."""
    from relpos.link.dialogue import NodeDialogue
    from relpos.link.port import Link
    from relpos.nodes.cable import CablePort
    from relpos.protocol import messages as wire

    key, old = team_key(key_file), team_key(old_key_file)
    with closing(CablePort(port)) as cable:
        link = Link(key=old)
        link.accept_keys(old, key)
        dialogue = NodeDialogue(cable, 0, link)
        with output.working("waiting for the node"):
            _hear(dialogue, cable, port)
        if key_file is not None or old_key_file is not None:
            changed = dialogue.set_key(key)
            words = "has been given the key" if changed else "had the key already"
            typer.echo(f"node {dialogue.node} {words}")
        if node_id is not None and node_id != dialogue.node:
            before = dialogue.node
            dialogue.set_node_id(node_id)
            typer.echo(f"node {before} is node {dialogue.node} now")
        dialogue.demand(wire.CommandCode.PING, 0)
        typer.echo(
            f"node {dialogue.node} answers over the cable. Now set the switch back to XBEE; its "
            f"module: relpos node radio --node {dialogue.node}"
        )


def _hear(dialogue: NodeDialogue, cable: CablePort, port: str) -> None:
    """Wait for the node and set the dialogue to its number."""
    from relpos.nodes.boards import SWITCH

    decoder = dialogue.link.decoder
    until_s = time.monotonic() + HEARD_WITHIN_S
    while not decoder.nodes:
        dialogue.listen()
        if time.monotonic() > until_s:
            if cable.heard:
                raise DeviceError(
                    f"{port}: the firmware is written and runs, but speaks under another key: give "
                    "the one that the node has with --old-key-file"
                )
            raise DeviceError(f"{port}: the firmware is written, but nothing is heard: {SWITCH}")
    dialogue.node = next(iter(decoder.nodes))
