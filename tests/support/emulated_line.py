"""An emulated team as serial ports of this process, on its own clock: no test waits for it."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from relpos.emulator.team import EmulatedTeam
from relpos.emulator.xbee import line_time_us
from relpos.link.port import BAUD, READ_TIMEOUT_S
from relpos.protocol.messages import ResetCause

STEP_US = 2_000
BEGINS_UNIX_S = 1.8e9


class EmulatedLine:
    """The coordinator's port: reading from it lets the team's time go by."""

    port = "emulated"

    def __init__(self, team: EmulatedTeam) -> None:
        self.team = team
        self._waiting = bytearray()

    @property
    def in_waiting(self) -> int:
        return len(self._waiting)

    def read(self, size: int = 1) -> bytes:
        until_us = self.team.time_us + round(READ_TIMEOUT_S * 1e6)
        while not self._waiting and self.team.time_us < until_us:
            self._run()
        data = bytes(self._waiting[:size])
        del self._waiting[:size]
        return data

    def _run(self) -> None:
        for _, data in self.team.run(self.team.time_us + STEP_US):
            self._waiting += data

    def write(self, data: bytes) -> int:
        self.team.send(data)
        return len(data)

    def close(self) -> None:
        pass

    def clock_of(self, monkeypatch: pytest.MonkeyPatch, *modules: object) -> None:
        """Let the modules' ``time`` be the team's: what is sent, to the byte, hangs on no other."""

        def now_s() -> float:
            return self.team.time_us * 1e-6

        clock = SimpleNamespace(monotonic=now_s, time=lambda: BEGINS_UNIX_S + now_s())
        for module in modules:
            monkeypatch.setattr(module, "time", clock)


class EmulatedCable(EmulatedLine):
    """The USB port of one node: its switch takes the UART from the module; opening restarts it."""

    def __init__(self, team: EmulatedTeam, node: int) -> None:
        super().__init__(team)
        board = team.nodes[node]
        self._to_board = board.radio.on_serial
        self._free_us = team.time_us
        board.radio.on_serial = lambda _left_us, _data: None
        board.engine.on_transmit = self._sent
        board.restart(team.time_us, ResetCause.EXTERNAL)

    def _sent(self, left_us: int, data: bytes) -> None:
        at_us = max(left_us, self.team.time_us)
        self.team.clock.at(at_us, lambda _now_us: self._waiting.extend(data))

    def _run(self) -> None:
        self.team.run(self.team.time_us + STEP_US)

    def write(self, data: bytes) -> int:
        self._free_us = max(self._free_us, self.team.time_us) + line_time_us(len(data), BAUD)
        self._to_board(self._free_us, data)
        return len(data)
