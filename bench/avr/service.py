"""One simulated board in normal service: a walking member of a team, its radio and its commands.

Smaller than the emulated team: the other members are only distances and answers, so that nothing
but the board under measurement takes time.
"""

from __future__ import annotations

import heapq
import itertools
from collections import Counter
from collections.abc import Callable
from typing import Self

import numpy as np

from relpos.emulator.air import EXCHANGE_US
from relpos.emulator.ak8975 import ADDRESS as AK8975_ADDRESS
from relpos.emulator.ak8975 import Ak8963, Ak8975
from relpos.emulator.avr.board import BoardSpec
from relpos.emulator.avr.elf import Firmware
from relpos.emulator.avr.engine import QUANTUM_US, AvrEngine
from relpos.emulator.bus import I2cBus
from relpos.emulator.mpu9150 import ADDRESS as MPU9150_ADDRESS
from relpos.emulator.mpu9150 import Mpu9150
from relpos.emulator.mpu9250 import Mpu9250
from relpos.emulator.pozyx import Pozyx, RangeResult
from relpos.emulator.surroundings import (
    Surroundings,
    draw_inertial_errors,
    draw_magnetic_errors,
)
from relpos.emulator.xbee import DELIVERED, Transmission, XbeeModule, line_time_us
from relpos.link.beacon import BEACON_PERIOD_S, BeaconSchedule
from relpos.protocol import framing
from relpos.protocol import messages as wire
from relpos.simulation.team import make_team

POZYX_ADDRESS = 0x4B
NODE = 1
TEAM = 6
AIR_US = 15_000
RSS_DBM = -82
UWB_TIMEOUT_ERROR = 0x12
COMMANDS: tuple[tuple[wire.CommandCode, int], ...] = (
    (wire.CommandCode.SET_TEAM_SIZE, TEAM),
    (wire.CommandCode.SET_STEP_REPORTS, 1),
    (wire.CommandCode.SET_LEG_LENGTH_MM, 920),
    (wire.CommandCode.SET_LED, 1),
    (wire.CommandCode.PING, 0),
)
"""Sent in turn, so that every kind of work (storing, step reports) is part of what is measured."""
FIRST_COMMAND_US = 3_000_000
FIRST_BEACON_US = 2_500_000
COMMAND_PERIOD_US = 4_000_000


class Service:
    """The board and everything around it; call ``run`` with rising virtual times."""

    def __init__(
        self,
        kind: BoardSpec,
        firmware: Firmware,
        seconds: float,
        seed: int,
        *,
        successor: bool = False,
    ) -> None:
        """The same arguments give the same run to the byte. ``successor``: with an MPU-9250."""
        self._team, self._world = make_team("lab", TEAM, seconds + 1.0, seed)
        surroundings = Surroundings.of(self._team[0])
        rng = np.random.default_rng([seed, 0xA7])
        self._air_rng = np.random.default_rng([seed, 0xA8])
        magnetometer = Ak8963 if successor else Ak8975
        sensor = Mpu9250 if successor else Mpu9150
        compass = magnetometer(surroundings, draw_magnetic_errors(rng), lambda: inertial.bypassed())
        inertial = sensor(surroundings, draw_inertial_errors(rng), {AK8975_ADDRESS: compass})
        bus = I2cBus()
        bus.attach(MPU9150_ADDRESS, inertial)
        bus.attach(AK8975_ADDRESS, compass.host_side())
        self.pozyx = Pozyx(NODE, self, surroundings)
        bus.attach(POZYX_ADDRESS, self.pozyx)
        self.bus = bus
        self.eeprom = bytearray(b"\xff" * 1024)
        self.engine = AvrEngine(kind, firmware, bus, self.eeprom, NODE)
        self.radio = XbeeModule(NODE, NODE, self, self._to_board)
        self.coordinator = XbeeModule(wire.COORDINATOR, 0x1000, self, lambda _time, _data: None)
        self.engine.on_transmit = self.radio.from_serial
        self.frames: list[framing.Frame] = []
        self.counts: Counter[str] = Counter()
        self._events: list[tuple[int, int, Callable[[int], None]]] = []
        self._order = itertools.count()
        self._now_us = 0
        self._seconds = seconds
        self._commands = itertools.cycle(COMMANDS)
        self._counter = 0
        self._beacons = BeaconSchedule(range(1, TEAM + 1))
        self._beacon_counter = 0
        self._at(FIRST_COMMAND_US, self._command)
        self._at(FIRST_BEACON_US, self._beacon)

    def _at(self, time_us: int, action: Callable[[int], None]) -> None:
        heapq.heappush(self._events, (max(time_us, self._now_us), next(self._order), action))

    def run(self, until_us: int) -> None:
        """Advance everything to ``until_us``."""
        while self._now_us < until_us:
            due = self._events[0][0] if self._events else until_us
            step = min(until_us, self._now_us + QUANTUM_US, max(due, self._now_us))
            self.engine.run(step)
            self._now_us = step
            while self._events and self._events[0][0] <= step:
                _, _, action = heapq.heappop(self._events)
                action(step)

    # -- the air between tags (UwbMedium) -------------------------------------------------------

    def begin_exchange(self, initiator: Pozyx, destination: int, time_us: int) -> None:
        """Answer after the time of an exchange with what the channel lets through."""

        def end(now_us: int) -> None:
            result = None
            if 1 <= destination <= TEAM:
                here = self._team[0].position_at(now_us * 1e-6)
                there = self._team[destination - 1].position_at(now_us * 1e-6)
                measured = self._world.measure_range(self._air_rng, here, there)
                if measured is not None:
                    result = RangeResult(round(measured * 1000), RSS_DBM)
            self.counts["exchanges"] += 1
            initiator.finish_ranging(destination, result, UWB_TIMEOUT_ERROR, now_us, started=True)

        self._at(time_us + EXCHANGE_US, end)

    # -- the radio (Air) ------------------------------------------------------------------------

    def send(self, sent: Transmission) -> None:
        """Deliver everything; what the node sends is decoded and stored."""

        def arrive(now_us: int) -> None:
            sent.report(now_us, DELIVERED)
            try:
                self.frames.append(framing.decode(sent.data))
            except framing.FrameError as error:
                self.counts[type(error).__name__] += 1

        self._at(sent.time_us + AIR_US, arrive)

    def _command(self, now_us: int) -> None:
        code, value = next(self._commands)
        self._counter += 1
        data = framing.encode(
            wire.COMMAND,
            NODE,
            0,
            self._counter,
            {"token": self._counter, "command": code, "value": value},
        )
        self.radio.deliver(self.coordinator, -60, data, False, now_us)
        self._at(now_us + COMMAND_PERIOD_US, self._command)

    def _beacon(self, now_us: int) -> None:
        self._beacon_counter += 1
        data = framing.encode(
            wire.BEACON,
            wire.BROADCAST,
            0,
            self._beacon_counter,
            self._beacons.values(now_us * 1e-6),
        )
        self.radio.deliver(self.coordinator, -60, data, True, now_us)
        self._at(now_us + round(BEACON_PERIOD_S * 1e6), self._beacon)

    def _to_board(self, left_us: int, data: bytes) -> None:
        # The engine paces the bytes itself, from the first one on.
        begins_us = left_us - line_time_us(len(data), self.radio.baud)
        self._at(begins_us, lambda _: self.engine.receive(data))

    # -- what came of it ------------------------------------------------------------------------

    def work_done(self) -> tuple[str, tuple[str, ...]]:
        """What the firmware did, in words, and everything that it should have done but did not."""
        kinds = Counter(frame.message.name for frame in self.frames)
        ranges = sum(
            len(frame.values["ranges"]) for frame in self.frames if frame.message is wire.RANGES
        )
        motions = [frame for frame in self.frames if frame.message is wire.MOTION]
        path_m = motions[-1].values["path_m"] if motions else 0.0
        begin, end = np.searchsorted(self._team[0].steps.time_s, (0.0, self._seconds))
        true_m = float(self._team[0].steps.length_m[begin:end].sum())
        counters = self.engine.board.counters()
        refused = (
            sum(count for name, count in self.counts.items() if name.endswith("Error"))
            + self.counts["unknown_requests"]
        )
        words = (
            f"{kinds['motion']} motions ({path_m:.1f} m walked, truly {true_m:.1f} m), "
            f"{ranges} ranges of {self.counts['exchanges']} exchanges, {kinds['status']} status, "
            f"{kinds['steps']} step reports, {kinds['acknowledgement']} of {self._counter} "
            f"commands acknowledged"
        )
        wanted = [
            (kinds["motion"] >= 0.9 * (self._seconds - 5.0), "it sent too few motions"),
            (0.5 * true_m <= path_m <= 1.5 * true_m, f"it saw {path_m:.1f} of {true_m:.1f} m"),
            (ranges >= 0.2 * (self._seconds - 5.0), "it reported too few ranges"),
            (kinds["status"] >= int((self._seconds - 3.0) / 10.0), "it sent too few status"),
            (kinds["acknowledgement"] >= self._counter - 1, "it left commands unacknowledged"),
            (refused == 0, f"{refused} of its frames were refused"),
            (counters.resets == 0, f"it was reset {counters.resets} times"),
            (counters.uart_overruns == 0, f"it lost {counters.uart_overruns} received bytes"),
            (counters.uart_deaf == 0, f"{counters.uart_deaf} bytes came while it did not listen"),
        ]
        return words, tuple(text for holds, text in wanted if not holds)

    def close(self) -> None:
        """Free the board."""
        self.engine.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
