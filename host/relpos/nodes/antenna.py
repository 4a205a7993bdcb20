"""Ranges between two nodes at rest, and their shares of the ranges' offset."""

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
"""Without a range for so long, none will come."""


def read_shares_mm(dialogue: NodeDialogue, pair: tuple[int, int]) -> tuple[int, int]:
    """Both nodes' shares, asked for; the link's decoder subtracts them from then on."""
    first, second = (_at(dialogue, node, CommandCode.SET_RANGE_OFFSET_MM) for node in pair)
    _subtract(dialogue, pair, (first, second))
    return first, second


def store_shares_mm(
    dialogue: NodeDialogue, pair: tuple[int, int], shares_mm: tuple[int, int]
) -> None:
    """Set both nodes' shares and read them back. DeviceError where a node has another one."""
    for node, share_mm in zip(pair, shares_mm, strict=True):
        dialogue.node = node
        dialogue.demand(CommandCode.SET_RANGE_OFFSET_MM, share_mm)
        stored_mm = dialogue.setting(CommandCode.SET_RANGE_OFFSET_MM)
        if stored_mm != share_mm:
            raise DeviceError(
                f"node {node} has stored an offset of {stored_mm} mm instead of {share_mm} mm"
            )
    _subtract(dialogue, pair, shares_mm)


def _at(dialogue: NodeDialogue, node: int, code: CommandCode) -> int:
    dialogue.node = node
    return dialogue.setting(code)


def _subtract(dialogue: NodeDialogue, pair: tuple[int, int], shares_mm: tuple[int, int]) -> None:
    """Do not wait for the next status to tell the decoder."""
    for node, share_mm in zip(pair, shares_mm, strict=True):
        dialogue.link.decoder.range_offsets_m[node] = share_mm / 1000.0
    dialogue.observations.clear()


@contextmanager
def ranging_fast(dialogue: NodeDialogue, pair: tuple[int, int]) -> Iterator[None]:
    """Both nodes range twice a second meanwhile; their own periods come back at the end."""
    periods_ms = {node: _at(dialogue, node, CommandCode.SET_RANGING_PERIOD_MS) for node in pair}
    try:
        for node in pair:
            dialogue.node = node
            dialogue.demand(CommandCode.SET_RANGING_PERIOD_MS, FAST_PERIOD_MS)
        yield
    finally:
        for node, period_ms in periods_ms.items():
            dialogue.node = node
            dialogue.demand(CommandCode.SET_RANGING_PERIOD_MS, period_ms)


def collect(dialogue: NodeDialogue, pair: tuple[int, int], count: int) -> Iterator[float]:
    """The next ``count`` ranges in metres between the two, whoever began them.

    Fewer where none comes for a while.
    """
    # What is under way may still be from before: a report waits for a second at most.
    until_s = time.monotonic() + 0.2
    while time.monotonic() < until_s:
        dialogue.listen()
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
