"""Ranges between two nodes at rest, and the two nodes' range offsets."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from relpos.errors import DeviceError
from relpos.link.dialogue import NodeDialogue
from relpos.measurements import Range
from relpos.protocol.messages import CommandCode

FAST_PERIOD_MS = 500
SILENT_S = 15.0
"""Silence after which no range is expected."""


def read_offsets_mm(dialogue: NodeDialogue, pair: tuple[int, int]) -> tuple[int, int]:
    """Read both nodes' range offsets; the link's decoder subtracts them from then on."""
    first, second = (_read(dialogue, node, CommandCode.SET_RANGE_OFFSET_MM) for node in pair)
    _subtract(dialogue, pair, (first, second))
    return first, second


def store_offsets_mm(
    dialogue: NodeDialogue, pair: tuple[int, int], offsets_mm: tuple[int, int]
) -> None:
    """Set both nodes' range offsets; DeviceError where one reads back otherwise."""
    for node, offset_mm in zip(pair, offsets_mm, strict=True):
        dialogue.node = node
        dialogue.demand(CommandCode.SET_RANGE_OFFSET_MM, offset_mm)
        stored_mm = dialogue.setting(CommandCode.SET_RANGE_OFFSET_MM)
        if stored_mm != offset_mm:
            raise DeviceError(
                f"node {node} has stored an offset of {stored_mm} mm instead of {offset_mm} mm"
            )
    _subtract(dialogue, pair, offsets_mm)


def _read(dialogue: NodeDialogue, node: int, code: CommandCode) -> int:
    dialogue.node = node
    return dialogue.setting(code)


def _subtract(dialogue: NodeDialogue, pair: tuple[int, int], offsets_mm: tuple[int, int]) -> None:
    """Set the decoder's offsets at once, without waiting for the next status."""
    for node, offset_mm in zip(pair, offsets_mm, strict=True):
        dialogue.link.decoder.range_offsets_m[node] = offset_mm / 1000.0
    dialogue.observations.clear()


@contextmanager
def ranging_fast(dialogue: NodeDialogue, pair: tuple[int, int]) -> Iterator[None]:
    """Let both nodes range twice a second meanwhile; restore their own periods at the end.

    DeviceError where one does not take its own period back; the other does.
    """
    periods_ms = {node: _read(dialogue, node, CommandCode.SET_RANGING_PERIOD_MS) for node in pair}
    try:
        for node in pair:
            dialogue.node = node
            dialogue.demand(CommandCode.SET_RANGING_PERIOD_MS, FAST_PERIOD_MS)
        yield
    finally:
        by_hand: list[str] = []
        for node, period_ms in periods_ms.items():
            dialogue.node = node
            try:
                dialogue.demand(CommandCode.SET_RANGING_PERIOD_MS, period_ms)
            except DeviceError as error:
                period = f"{period_ms / 1000:g}" if period_ms else "off"
                by_hand.append(
                    f"{error}\nnode {node} may still range every {FAST_PERIOD_MS} ms: "
                    f"relpos node set PORT --node {node} ranging-period {period}"
                )
        if by_hand:
            raise DeviceError("\n".join(by_hand))


def collect(dialogue: NodeDialogue, pair: tuple[int, int], count: int) -> Iterator[float]:
    """Yield the next ``count`` ranges in metres between the two, in both directions.

    Ends early where none arrives for :data:`SILENT_S`.
    """
    # Reports on their way may still be from before.
    dialogue.pause(0.2)
    dialogue.observations.clear()
    collected = 0
    heard_s = time.monotonic()
    while collected < count and time.monotonic() - heard_s < SILENT_S:
        dialogue.listen()
        while dialogue.observations and collected < count:
            observation = dialogue.observations.popleft()
            if isinstance(observation, Range) and {observation.node, observation.peer} == set(pair):
                heard_s = time.monotonic()
                collected += 1
                yield observation.range_m
