"""Two nodes whose range offsets are read, measured and stored."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace

import pytest

from relpos.errors import DeviceError
from relpos.measurements import Range
from relpos.nodes import antenna
from relpos.nodes.antenna import FAST_PERIOD_MS, ranging_fast, read_offsets_mm, store_offsets_mm
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


def test_offsets_are_subtracted_from_the_next_range_on_once_they_are_read_or_stored() -> None:
    class Calibrated(Nodes):
        """Nodes of which node 2 stores nothing beyond a metre."""

        def __init__(self) -> None:
            super().__init__()
            self.link = SimpleNamespace(decoder=SimpleNamespace(range_offsets_m={}))
            self.observations = deque(["a range before"])

        def demand(self, code: CommandCode, value: int) -> int:
            return super().demand(code, min(value, 1000) if self.node == 2 else value)

    nodes = Calibrated()
    told: dict[int, float] = nodes.link.decoder.range_offsets_m
    assert read_offsets_mm(nodes, (1, 2)) == (1500, 1000)  # type: ignore[arg-type]
    assert told == {1: 1.5, 2: 1.0}
    assert not nodes.observations
    store_offsets_mm(nodes, (1, 2), (-20, 30))  # type: ignore[arg-type]
    assert told == {1: -0.02, 2: 0.03}
    with pytest.raises(DeviceError, match="node 2 has stored an offset of 1000 mm instead of 1500"):
        store_offsets_mm(nodes, (1, 2), (0, 1500))  # type: ignore[arg-type]


@pytest.mark.parametrize(("wanted", "come"), [(4, 4), (10, 6)])
def test_ranges_are_collected_from_now_on_until_enough_or_none_comes(
    monkeypatch: pytest.MonkeyPatch, wanted: int, come: int
) -> None:
    class Ranging:
        """Two nodes that range in both directions for three seconds, beside a third."""

        now_s = 0.0

        def __init__(self) -> None:
            self.observations: deque[Range] = deque()

        def pause(self, _seconds: float) -> None:
            self.observations.append(Range(0.0, 1, 2, 99.0))

        def listen(self) -> None:
            self.now_s += 1.0
            if self.now_s <= 3.0:
                pairs = ((1, 2), (2, 1), (1, 3))
                self.observations += [Range(self.now_s, *pair, 5.0 * pair[1]) for pair in pairs]

    ranging = Ranging()
    monkeypatch.setattr(antenna, "time", SimpleNamespace(monotonic=lambda: ranging.now_s))
    found = list(antenna.collect(ranging, (1, 2), wanted))  # type: ignore[arg-type]
    assert found == [10.0, 5.0] * (come // 2)
    assert ranging.now_s < 20.0
