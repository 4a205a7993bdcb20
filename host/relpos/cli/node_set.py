"""``relpos node set`` and ``relpos node reboot``: a node's settings, read back and shown."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from relpos.cli import output
from relpos.cli.keys import KeyFile, team_key
from relpos.cli.node_dialogue import Cable, Node, Port, connect, open_device
from relpos.errors import DeviceError

if TYPE_CHECKING:
    from relpos.link.dialogue import NodeDialogue
    from relpos.nodes.settings import Change

KEY, ID, DEFAULTS = "key", "id", "defaults"


def set_node(
    port: Port,
    settings: Annotated[
        list[str] | None,
        typer.Argument(
            help="NAME VALUE, repeated; without any, what is set is shown. Names: id, "
            "report-period, ranging-period, status-period (s), leg-length, stature, "
            "range-offset (m), step-gain, team-size, step-reports (off, on), "
            "led (off, on, health); without a value: key, defaults.",
        ),
    ] = None,
    node: Node = None,
    key_file: KeyFile = None,
    new: Annotated[
        bool, typer.Option("--new", help="key: make a new random team key in FILE first.")
    ] = False,
    old_key_file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="key: the team's until now. (default: none, which needs --cable)"
        ),
    ] = None,
    cable: Cable = False,
) -> None:
    """Show or change a node's settings, without reflashing it.

    `relpos node set PORT --node 3 stature 1.78 led off`

    `relpos node set PORT key --key-file new.key --new --old-key-file team.key` (every node heard)
    """
    from relpos.nodes.settings import parse_changes

    rest = list(settings or [])
    if rest[:1] == [KEY]:
        if rest[1:] or key_file is None:
            raise typer.BadParameter("give the key's file, and nothing else", param_hint=KEY)
        _set_key(port, node, key_file, new, old_key_file, cable)
        return
    if new or old_key_file is not None:
        raise typer.BadParameter("only with `key`", param_hint="--new, --old-key-file")
    try:
        number = _take_id(rest)
        defaults = DEFAULTS in rest
        if defaults:
            rest.remove(DEFAULTS)
        changes = parse_changes(rest)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="NAME VALUE") from None
    with connect(port, node, key_file, cable=cable, number=number) as dialogue:
        if not changes and number is None and not defaults:
            _show(dialogue)
            return
        rows = _restore(dialogue) if defaults else []
        rows += _apply(dialogue, changes)
        if number is not None:
            before = dialogue.node
            dialogue.set_node_id(number)
            rows.append((ID, str(before), str(dialogue.node)))
        _print(f"Node {dialogue.node}", ("setting", "before", "now"), rows)
        if number is not None and not cable:
            typer.echo(
                f"its XBee module still has the address of its old number: relpos node radio "
                f"--node {number}"
            )


def _take_id(words: list[str]) -> int | None:
    """Take ``id N`` or ``id=N`` out of the words. ValueError where it is no node's number."""
    for position, word in enumerate(words):
        name, equals, value = word.partition("=")
        if name.lower() != ID:
            continue
        if not equals:
            if position + 1 == len(words):
                raise ValueError(f"{ID}: no value given")
            value = words.pop(position + 1)
        words.pop(position)
        if not (value.isascii() and value.isdigit() and 1 <= int(value) <= 254):
            raise ValueError(f"{ID} '{value}': between 1 and 254")
        return int(value)
    return None


def _show(dialogue: NodeDialogue) -> None:
    from relpos.nodes.settings import SETTINGS

    rows = [
        (setting.name, setting.shown(dialogue.setting(setting.code)), setting.meaning)
        for setting in SETTINGS
    ]
    _print(f"Node {dialogue.node}", ("setting", "value", "meaning"), rows)


def _apply(dialogue: NodeDialogue, changes: Sequence[Change]) -> list[tuple[str, str, str]]:
    rows = []
    for change in changes:
        setting = change.setting
        before = dialogue.setting(setting.code)
        dialogue.demand(setting.code, change.raw)
        # Read the value in force, which may differ from the one that was sent.
        after = dialogue.setting(setting.code)
        if after != change.raw:
            raise DeviceError(
                f"node {dialogue.node}: {setting.name} is {setting.shown(after)} instead of "
                f"{setting.shown(change.raw)}"
            )
        rows.append((setting.name, setting.shown(before), setting.shown(after)))
    return rows


def _restore(dialogue: NodeDialogue) -> list[tuple[str, str, str]]:
    from relpos.nodes.settings import SETTINGS

    before = [dialogue.setting(setting.code) for setting in SETTINGS]
    dialogue.restore_defaults()
    after = [dialogue.setting(setting.code) for setting in SETTINGS]
    return [
        (setting.name, setting.shown(old), setting.shown(new))
        for setting, old, new in zip(SETTINGS, before, after, strict=True)
    ]


def _set_key(
    port: str,
    node: int | None,
    key_file: Path,
    new: bool,
    old_key_file: Path | None,
    cable: bool,
) -> None:
    from relpos.link.authentication import read_key, write_new_key
    from relpos.link.dialogue import NEEDS_CABLE, NodeDialogue, open_dialogue
    from relpos.link.port import Link
    from relpos.protocol import messages as wire

    old = team_key(old_key_file)
    if new and old == wire.DEFAULT_KEY and not cable:
        raise DeviceError(NEEDS_CABLE.format(node="N" if node is None else node))
    if old_key_file is not None and not cable:
        output.remark(
            f"who holds {old_key_file} and listens can read the new keys: after a theft of that "
            "file give them by cable (--cable); a stolen node does not hold it"
        )
    device = open_device(port, cable)
    try:
        key = write_new_key(key_file) if new else read_key(key_file)
        link = Link(key=old)
        # A node that already has the new key is received, too.
        link.accept_keys(old, key)
        if node is not None or cable:
            dialogue = open_dialogue(device, node, link)
            nodes = [dialogue.node]
        else:
            dialogue = NodeDialogue(device, 0, link)
            nodes = dialogue.heard()
        failed: list[str] = []
        for dialogue.node in nodes:
            link.accept_keys(old, key)
            try:
                changed = dialogue.set_key(key)
            except DeviceError as error:
                failed.append(str(error))
                continue
            typer.echo(
                f"node {dialogue.node} {'now has' if changed else 'had'} a key of {key_file}"
                + (" and answers under it" if changed else " already")
            )
        if failed or not nodes:
            raise DeviceError("\n".join(failed) or f"{port}: no node is heard")
    finally:
        device.close()


def reboot(port: Port, node: Node = None, key_file: KeyFile = None) -> None:
    """Restart a node, and wait until it is heard again."""
    with connect(port, node, key_file) as dialogue:
        started_s = time.monotonic()
        boot = dialogue.restart()
        typer.echo(
            f"node {dialogue.node} has restarted in {time.monotonic() - started_s:.1f} s "
            f"(start {boot})"
        )


def _print(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    table = output.table(columns, columns, title=title)
    for row in rows:
        table.add_row(*row)
    output.console().print(table)
