"""An emulated team as a serial port of this process, on its own clock: no test waits for it."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from relpos.emulator.team import EmulatedTeam
from relpos.link.port import READ_TIMEOUT_S

STEP_US = 2_000


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
            for _, data in self.team.run(self.team.time_us + STEP_US):
                self._waiting += data
        data = bytes(self._waiting[:size])
        del self._waiting[:size]
        return data

    def write(self, data: bytes) -> int:
        self.team.send(data)
        return len(data)

    def close(self) -> None:
        pass

    def clock_of(self, monkeypatch: pytest.MonkeyPatch, *modules: object) -> None:
        """Let the modules' ``time`` be the team's."""

        def now_s() -> float:
            return self.team.time_us * 1e-6

        for module in modules:
            monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=now_s, time=now_s))
