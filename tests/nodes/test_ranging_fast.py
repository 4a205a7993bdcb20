"""Two nodes that range twice a second while their offsets are measured."""

from __future__ import annotations

import pytest

from relpos.errors import DeviceError
from relpos.nodes.antenna import FAST_PERIOD_MS, ranging_fast
from relpos.protocol.messages import CommandCode


class Nodes:
    """Nodes with ranging periods; ``silent`` does not answer."""

    def __init__(self) -> None:
        self.node = 0
        self.silent = 0
        self.periods_ms = {1: 1500, 2: 1000}

    def setting(self, code: CommandCode) -> int:
        return self.periods_ms[self.node]

    def demand(self, code: CommandCode, value: int) -> int:
        if self.node == self.silent:
            raise DeviceError(f"node {self.node} does not answer")
        self.periods_ms[self.node] = value
        return value


def test_a_node_gets_its_ranging_period_back_also_where_the_other_has_fallen_silent() -> None:
    nodes = Nodes()

    def measure() -> None:
        with ranging_fast(nodes, (1, 2)):  # type: ignore[arg-type]
            assert nodes.periods_ms == {1: FAST_PERIOD_MS, 2: FAST_PERIOD_MS}
            nodes.silent = 1

    with pytest.raises(DeviceError, match=r"--node 1 ranging-period 1\.5$"):
        measure()
    assert nodes.periods_ms == {1: FAST_PERIOD_MS, 2: 1000}
