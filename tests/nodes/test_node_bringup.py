"""Parts of `relpos node check` on a node that stops answering at a certain moment."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import pytest

from relpos.link.decoder import Acknowledged
from relpos.nodes.bringup import bus_access, inertial
from relpos.nodes.bringup.bus_access import BusAccess
from relpos.protocol import messages as wire

WORD = 0x1010
COMMAND_S = 0.05


class Node:
    """A node whose chip answers a read while ``answers`` is true of (register, transactions)."""

    node = 1

    def __init__(self, answers: Callable[[int, int], bool]) -> None:
        self.answers = answers
        self.time_s = 0.0
        self.transactions = 0

    def pause(self, seconds: float) -> None:
        self.time_s += seconds

    def command(self, code: wire.CommandCode, value: int) -> Acknowledged:
        self.time_s += COMMAND_S
        self.transactions += 1
        assert self.transactions < 10_000, "it never ends"
        register, written = value >> 8 & 0xFF, value >> 24 & 0xF
        right = written == 2 or self.answers(register, self.transactions)
        result = wire.CommandResult.DONE if right else wire.CommandResult.NO_ANSWER
        return Acknowledged(self.node, 1, code, result, WORD)


def bus_of(node: Node, monkeypatch: pytest.MonkeyPatch) -> BusAccess:
    monkeypatch.setattr(bus_access, "time", SimpleNamespace(monotonic=lambda: node.time_s))
    return BusAccess(node)  # type: ignore[arg-type]


def test_a_sensor_that_stops_answering_in_its_self_test_does_not_hold_the_check_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    node = Node(lambda _register, transactions: transactions < 3)
    bus = bus_of(node, monkeypatch)
    assert inertial._lag_s(node, bus, 1000.0) == 0.0  # type: ignore[arg-type]
    assert node.time_s < 10.0
