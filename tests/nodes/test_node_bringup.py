"""Parts of `relpos node check` on a node that stops answering at a certain moment."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from relpos.cli import node_check
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


def test_a_self_test_that_is_not_answered_leaves_a_report_that_can_be_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    node = Node(lambda register, _transactions: register not in inertial.RATE_WORDS)
    figures: dict[str, object] = {}
    tests = inertial.self_tests(node, bus_of(node, monkeypatch), 0x71, figures)  # type: ignore[arg-type]
    assert [finding.right for finding in tests] == [False, False]
    node_check._write(tmp_path / "report.json", 1, [], figures)
    written = json.loads((tmp_path / "report.json").read_text())
    assert written["figures"]["self_test_over_factory"] == [0.0, 0.0, 0.0, None, None, None]
