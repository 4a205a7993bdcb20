"""The emulated team: walkers, their boards, the two airs and the coordinator, on one clock.

The same arguments give the same bytes at the coordinator's serial port, at the same virtual times.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from relpos.calibration.steps import LEG_OF_STATURE
from relpos.errors import DataError
from relpos.link import xbee as api
from relpos.link.beacon import BEACON_PERIOD_S, BeaconSchedule
from relpos.measurements import Event, Prior, Truth
from relpos.protocol import framing
from relpos.protocol import messages as wire
from relpos.simulation.team import Scenario, make_team
from relpos.simulation.walker import RATE_HZ, WalkerTruth
from relpos.simulation.world import FloatArray

from .air import STEP_US, RadioAir, UwbAir, VirtualClock
from .faults import FaultSpec, parse_faults
from .faults.boards import faulty_clock
from .faults.injection import inject
from .node import (
    BoardKind,
    EmulatedNode,
    Hardware,
    ImuKind,
    NodeErrors,
    draw_node_errors,
    draw_uncalibrated_errors,
)
from .pozyx import Pozyx
from .surroundings import Surroundings
from .xbee import XbeeModule, line_time_us

SET_UP_AFTER_US = 1_500_000
"""After power-on: the boards have booted and their tags, too."""
BEACONS_FROM_US = 4_000_000
"""All nodes have been switched on and set up: a beacon under a key not known yet is refused."""
TRUTH_PERIOD_S = 0.2
PRIOR_SIGMA_M = 0.1
PRIOR_SIGMA_RAD = 0.1
"""How well the start is known where a scenario has a common one: feet on a mark, facing a wall."""
BYTES_PER_SAMPLE = 280.0
"""Of a prepared walk (27 numbers of truth, 6 once more for the chip); measured, 20 walkers, 2 h."""


@dataclass(frozen=True)
class TeamConfig:
    """Who is emulated, and how.

    ``nodes`` is a count or the node numbers. ``faults`` are SPECs of :mod:`relpos.emulator.faults`.
    ``beacons``: the coordinator sends them by itself, as a host would in real time. All nodes get
    the team's ``key``. ``configured`` nodes know the team's size and the wearer's leg length from
    the stature, as after ``relpos node set``; others run on the firmware's defaults.
    ``node_errors`` is (seed, node) -> errors of its chips and clock; None draws usual ones, in
    the scenarios "turntable" and "bench" those of uncalibrated nodes.
    """

    scenario: str | Scenario = "paper"
    nodes: int | Sequence[int] = 6
    seconds: float = 300.0
    seed: int = 0
    board: BoardKind | str = BoardKind.NATIVE
    faults: Sequence[str | FaultSpec] = ()
    beacons: bool = False
    key: bytes = wire.DEFAULT_KEY
    collisions: bool = True
    configured: bool = True
    node_errors: Callable[[int, int], NodeErrors] | None = None
    imu: ImuKind | str = ImuKind.MPU9150
    built_for: ImuKind | str | None = None
    """The sensor that the firmware is built for, where that is not ``imu``."""

    def errors_of(self, node: int) -> NodeErrors:
        """How the node's chips and clock differ from the ideal."""
        if self.node_errors is not None:
            return self.node_errors(self.seed, node)
        uncalibrated = self.scenario in ("turntable", "bench")
        return (draw_uncalibrated_errors if uncalibrated else draw_node_errors)(self.seed, node)


class EmulatedTeam:
    """People and everything they wear, with a coordinator whose serial port a host can use.

    FaultError where a fault makes no sense, DataError where the walk does not fit into memory.
    The truth methods are for evaluation alone.
    """

    def __init__(self, config: TeamConfig) -> None:
        nodes, seed = config.nodes, config.seed
        _check_memory(nodes if isinstance(nodes, int) else len(nodes), config.seconds)
        walkers, self.world = make_team(config.scenario, nodes, config.seconds, seed)
        self.walkers: dict[int, WalkerTruth] = {walker.node: walker for walker in walkers}
        self.seconds = config.seconds
        self.key = config.key
        self.end_us = round(config.seconds * 1e6)
        self.clock = VirtualClock()
        uwb_rng, radio_rng = (np.random.default_rng([seed, k, 0xA17]) for k in (1, 2))
        self.uwb = UwbAir(self.clock, self.world, self._tag_position_m, uwb_rng, config.collisions)
        self.radio = RadioAir(self.clock, self.world, self._module_distance_m, radio_rng)
        self._output: list[tuple[int, bytes]] = []
        self.host_fault: Callable[[int], int | None] = lambda time_us: time_us
        """Fault: time at which something leaves the port -> when the host gets it, None: never."""
        self.coordinator = XbeeModule(
            wire.COORDINATOR, 0x40000000, self.radio, self._from_coordinator
        )
        self.radio.modules.append(self.coordinator)
        self.nodes: dict[int, EmulatedNode] = {}
        self._walker_of_tag: dict[Pozyx, WalkerTruth] = {}
        self._walker_of_module: dict[XbeeModule, WalkerTruth] = {}
        specs = parse_faults(config.faults, list(self.walkers))
        try:
            for walker in walkers:
                errors = faulty_clock(config.errors_of(walker.node), walker.node, specs)
                self._add(walker, config, errors)
            inject(self, specs, seed)
            if config.beacons:
                self._beacons = BeaconSchedule(self.walkers)
                self._beacon_counter = 0
                self.clock.at(BEACONS_FROM_US, self._send_beacon)
        except BaseException:
            self.close()
            raise

    def _add(self, walker: WalkerTruth, config: TeamConfig, errors: NodeErrors) -> None:
        surroundings = Surroundings.of(walker)
        built_for = None if config.built_for is None else ImuKind(config.built_for)
        hardware = Hardware(BoardKind(config.board), ImuKind(config.imu), built_for)
        node = EmulatedNode(
            walker.node, hardware, surroundings, errors, self.clock, self.uwb, self.radio
        )
        self.nodes[walker.node] = node
        self.uwb.tags.append(node.tag)
        self.radio.modules.append(node.radio)
        self._walker_of_tag[node.tag] = walker
        self._walker_of_module[node.radio] = walker
        if self.key != wire.DEFAULT_KEY:
            at_us = errors.power_on_us + SET_UP_AFTER_US - 200_000
            node.set_key(self.key, 0xFE00, at_us)
        if config.configured:
            at_us = errors.power_on_us + SET_UP_AFTER_US
            leg_mm = round(LEG_OF_STATURE * walker.person.stature_m * 1000.0)
            settings = (
                (wire.CommandCode.SET_TEAM_SIZE, len(self.walkers)),
                (wire.CommandCode.SET_LEG_LENGTH_MM, leg_mm),
            )
            for k, (code, value) in enumerate(settings):
                node.command(
                    self.coordinator, code, value, 0xFF00 + k, at_us + 100_000 * k, self.key
                )

    # -- the coordinator's serial port ----------------------------------------------------------

    @property
    def time_us(self) -> int:
        """Virtual time."""
        return self.clock.now_us

    def run(self, until_us: int) -> list[tuple[int, bytes]]:
        """Advance to ``until_us``; (time in microseconds, bytes) that left the serial port."""
        self.clock.run(until_us)
        output, self._output = self._output, []
        return output

    def send(self, data: bytes) -> None:
        """Bytes from the host begin to arrive now at the coordinator's serial port."""
        if not self.host_listens(self.clock.now_us):
            return
        arrived_us = self.clock.now_us + line_time_us(len(data), self.coordinator.baud)
        self.clock.at(arrived_us, lambda now_us: self.coordinator.from_serial(now_us, data))

    def _send_beacon(self, now_us: int) -> None:
        """Send one as a host would. They have counters of their own: they disturb no command."""
        self.clock.at(now_us + round(BEACON_PERIOD_S * 1e6), self._send_beacon)
        self._beacon_counter += 1
        values = self._beacons.values(now_us * 1e-6)
        key = framing.node_key(self.key, wire.BROADCAST)
        data = framing.encode(wire.BEACON, wire.BROADCAST, 0, self._beacon_counter, values, key)
        self.send(api.encode(api.Transmit16(0, api.BROADCAST_16, data)))

    def stream(self) -> Iterator[tuple[int, bytes]]:
        """Everything that leaves the serial port until the walk ends; ``send`` in between."""
        while self.clock.now_us < self.end_us:
            yield from self.run(min(self.clock.now_us + STEP_US, self.end_us))

    def _from_coordinator(self, left_us: int, data: bytes) -> None:
        self.clock.at(left_us, lambda now_us: self._to_host(now_us, data))

    def _to_host(self, now_us: int, data: bytes) -> None:
        at_us = self.host_fault(now_us)
        if at_us == now_us:
            self._output.append((now_us, data))
        elif at_us is not None:
            self.clock.at(at_us, lambda later_us: self._output.append((later_us, data)))

    def host_listens(self, time_us: int) -> bool:
        """Whether a host is at the port: what it would send then is sent."""
        return self.host_fault(time_us) == time_us

    def close(self) -> None:
        """Free the boards."""
        for node in self.nodes.values():
            node.close()

    def __enter__(self) -> EmulatedTeam:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- truth ------------------------------------------------------------------------------------

    def position_m(self, node: int, time_s: float) -> FloatArray:
        """True position (3,) of a node's tag in the world frame."""
        return self.walkers[node].position_at(time_s)

    def heading_rad(self, node: int, time_s: float) -> float:
        """True heading of a node's wearer, unwrapped."""
        walker = self.walkers[node]
        return float(np.interp(time_s * RATE_HZ, np.arange(len(walker.heading_rad)),
                               walker.heading_rad))  # fmt: skip

    def truth(self, period_s: float = TRUTH_PERIOD_S) -> list[Truth]:
        """True poses of all nodes, by time; in a building heights over the start's."""
        rows = []
        indoors = self.world.building is not None
        stride = max(round(period_s * RATE_HZ), 1)
        for node, walker in self.walkers.items():
            rows += [
                Truth(
                    float(walker.time_s[k]),
                    node,
                    float(walker.position_m[k, 0]),
                    float(walker.position_m[k, 1]),
                    math.remainder(float(walker.heading_rad[k]), 2.0 * math.pi),
                    float(walker.position_m[k, 2])
                    - (walker.person.sensor_height_m if indoors else 0.0),
                )
                for k in range(0, len(walker.time_s), stride)
            ]
        return sorted(rows, key=lambda row: row.time_s)

    def episodes(self) -> list[Event]:
        """What everybody truly does, by time; empty where there are no stairs."""
        rows = []
        for node, walker in self.walkers.items() if self.world.building is not None else ():
            rows.append(Event(0.0, node, "episode", "level"))
            for flight in walker.flights:
                word = "up" if flight.storeys > 0 else "down"
                rows.append(Event(flight.begin_s, node, "episode", word))
                rows.append(Event(flight.end_s, node, "episode", "level"))
        return sorted(rows, key=lambda row: row.time_s)

    def priors(self) -> list[Prior]:
        """What the team knows of its start."""
        return [
            Prior(
                node,
                float(walker.position_m[0, 0]),
                float(walker.position_m[0, 1]),
                math.remainder(float(walker.heading_rad[0]), 2.0 * math.pi),
                PRIOR_SIGMA_M,
                PRIOR_SIGMA_RAD,
            )
            for node, walker in self.walkers.items()
        ]

    def _tag_position_m(self, tag: Pozyx, time_us: int) -> FloatArray:
        return self._walker_of_tag[tag].position_at(time_us * 1e-6)

    def _module_distance_m(self, one: XbeeModule, other: XbeeModule, time_us: int) -> float:
        return math.dist(
            self._module_position_m(one, time_us), self._module_position_m(other, time_us)
        )

    def _module_position_m(self, module: XbeeModule, time_us: int) -> FloatArray:
        walker = self._walker_of_module.get(module)
        if walker is None:  # the coordinator lies on a table in the middle
            return np.array((self.world.size_m[0] / 2.0, self.world.size_m[1] / 2.0, 1.0))
        return walker.position_at(time_us * 1e-6)


def _check_memory(nodes: int, seconds: float) -> None:
    """Refuse what would end in swapping: the walk is prepared in full beforehand."""
    needed_gb = 1e-9 * BYTES_PER_SAMPLE * RATE_HZ * nodes * seconds
    here_gb = physical_memory_gb()
    if needed_gb > 0.8 * here_gb:
        raise DataError(
            f"a walk of {nodes} people for {seconds:g} s takes {needed_gb:.1f} GB of memory, "
            f"of {here_gb:.1f} GB here: fewer people or seconds"
        )


def physical_memory_gb() -> float:
    """Size of this computer's memory; infinite where it is unknown."""
    try:
        return 1e-9 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return math.inf
