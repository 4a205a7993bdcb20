"""One emulated node: chips on a bus, a board that runs the firmware, and its radio module."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from relpos.protocol import framing
from relpos.protocol import messages as wire

from . import ak8975, mpu9150, pozyx
from .air import VirtualClock
from .bus import I2cBus
from .engine import Engine, NodeClockError
from .mpu9250 import Mpu9250
from .native import EEPROM_BYTES, NativeEngine, build
from .pozyx import PressureErrors, UwbMedium
from .surroundings import (
    InertialErrors,
    MagneticErrors,
    Surroundings,
    draw_inertial_errors,
    draw_magnetic_errors,
)
from .xbee import Air, XbeeModule, line_time_us


class ImuKind(StrEnum):
    """Inertial sensor and compass: what is wired, or what the firmware is built for."""

    MPU9150 = "mpu9150"
    MPU9250 = "mpu9250"


class BoardKind(StrEnum):
    """What executes the firmware: this computer, or a simulated AVR."""

    NATIVE = "native"
    UNO = "uno"
    MEGA = "mega"


@dataclass(frozen=True)
class Hardware:
    """What a node is made of; ``built_for``: the sensor that its firmware expects (default: it)."""

    board: BoardKind
    imu: ImuKind = ImuKind.MPU9150
    built_for: ImuKind | None = None


@dataclass(frozen=True)
class NodeErrors:
    """How one node's chips and clock differ from the ideal; the default is ideal."""

    inertial: InertialErrors = field(default_factory=InertialErrors)
    magnetic: MagneticErrors = field(default_factory=MagneticErrors)
    pressure: PressureErrors = field(default_factory=PressureErrors)
    clock: NodeClockError = field(default_factory=NodeClockError)
    power_on_us: int = 0
    antenna_delay_m: float = 0.0
    """What this node's tag makes every range too long by."""


def draw_node_errors(seed: int, node: int) -> NodeErrors:
    """One node from the shelf; the same arguments give the same node.

    The boards' ceramic resonators are specified to +-0.5 % (Arduino's parts list), drawn with sd
    0.15 %. Pressure: 50 Pa offset between pieces and 2 Pa noise (MPL3115A2 class, from memory).
    People switch on within a second of each other.
    """
    rng = np.random.default_rng([seed, node, 0xE44])
    return NodeErrors(
        inertial=draw_inertial_errors(rng),
        magnetic=draw_magnetic_errors(rng),
        pressure=PressureErrors(
            offset_pa=50.0 * float(rng.standard_normal()),
            noise_pa=2.0,
            seed=int(rng.integers(1 << 62)),
        ),
        clock=NodeClockError(
            drift_ppm=float(np.clip(1500.0 * rng.standard_normal(), -5000.0, 5000.0))
        ),
        power_on_us=int(rng.integers(1_000_000)),
    )


def draw_uncalibrated_errors(seed: int, node: int) -> NodeErrors:
    """One node as it comes from the bench, a battery and screws beside its magnetometer.

    As from the shelf (:func:`draw_node_errors`), and hard iron with sd 25 uT an axis, soft iron and
    misalignment with sd 7 % an element. Assumed: tens of microtesla beside batteries and speakers
    are usual for body-worn devices. Antenna delay with sd 0.2 m (uncalibrated DW1000 modules are
    off by some decimetres).
    """
    errors = draw_node_errors(seed, node)
    rng = np.random.default_rng([seed, node, 0xCA1])
    iron = np.eye(3) + 0.07 * rng.standard_normal((3, 3))
    bias = errors.magnetic.bias_ut + 25.0 * rng.standard_normal(3)
    magnetic = replace(errors.magnetic, bias_ut=bias, soft_iron=iron)
    return replace(
        errors, magnetic=magnetic, antenna_delay_m=0.1 + 0.2 * float(rng.standard_normal())
    )


def prepared_eeprom(node: int) -> bytearray:
    """A board's EEPROM as it is handed out: the node's id and its complement, else blank.

    The layout is ``firmware/lib/node/settings.h``'s StorageAddress.
    """
    eeprom = bytearray(b"\xff" * EEPROM_BYTES)
    eeprom[0:2] = bytes((node, node ^ 0xFF))
    return eeprom


class EmulatedNode:
    """Chips, board and radio module of one node, on a virtual clock.

    The chips are public, so that tests and faults can reach them; the firmware is reached through
    its bus and its UART alone.
    """

    def __init__(
        self,
        node: int,
        hardware: Hardware | BoardKind | str,
        surroundings: Surroundings,
        errors: NodeErrors,
        clock: VirtualClock,
        medium: UwbMedium,
        air: Air,
    ) -> None:
        if not isinstance(hardware, Hardware):
            hardware = Hardware(BoardKind(hardware))
        self.node = node
        self.surroundings = surroundings
        self.errors = errors
        self.eeprom = prepared_eeprom(node)
        self.bus = I2cBus()
        auxiliary: dict[int, ak8975.Ak8975] = {}
        successor = hardware.imu is ImuKind.MPU9250
        sensor = Mpu9250 if successor else mpu9150.Mpu9150
        compass = ak8975.Ak8963 if successor else ak8975.Ak8975
        self.mpu = sensor(surroundings, errors.inertial, auxiliary)
        self.magnetometer = compass(surroundings, errors.magnetic, self.mpu.bypassed)
        auxiliary[ak8975.ADDRESS] = self.magnetometer
        self.tag = pozyx.Pozyx(
            node, medium, surroundings, errors.pressure, power_on_us=errors.power_on_us
        )
        self.tag.antenna_delay_m = errors.antenna_delay_m
        self.bus.attach(mpu9150.ADDRESS, self.mpu)
        self.bus.attach(ak8975.ADDRESS, self.magnetometer.host_side())
        self.bus.attach(pozyx.ADDRESS, self.tag)
        self.radio = XbeeModule(node, 0x40000000 + node, air, self._from_radio)
        self.engine = make_engine(hardware, self.bus, self.eeprom, node, errors)
        self.engine.on_transmit = self._to_radio
        self.hold_frames = False
        """Whether bytes of the native board go to the radio as they leave, so that a restart can
        cut a frame; else frame by frame."""
        self._leaving: list[tuple[int, bytes]] = []
        self._stopped_until_us = 0
        self._paced_by_engine = hardware.board is not BoardKind.NATIVE
        self._clock = clock
        self._due_us = max(self.engine.next_due_us, clock.now_us)
        clock.at(self._due_us, self._run)

    def _run(self, now_us: int) -> int | None:
        if now_us != self._due_us:
            return None  # another pass was asked for in between
        engine = self.engine
        engine.run(now_us)
        self._due_us = engine.next_due_us
        return self._due_us

    def _from_radio(self, left_us: int, data: bytes) -> None:
        # An AVR's engine paces the bytes on its line itself, from the first one on.
        begin_us = left_us - line_time_us(len(data), self.radio.baud)
        self._clock.at(
            begin_us if self._paced_by_engine else left_us, lambda now_us: self._hear(data, now_us)
        )

    def _to_radio(self, left_us: int, data: bytes) -> None:
        if not self.hold_frames or self._paced_by_engine:
            self.radio.from_serial(left_us, data)
            return
        self._leaving.append((left_us, data))
        self._clock.at(left_us, self._left)

    def _left(self, now_us: int) -> None:
        while self._leaving and self._leaving[0][0] <= now_us:
            self.radio.from_serial(*self._leaving.pop(0))

    def restart(self, now_us: int, cause: wire.ResetCause) -> None:
        """Reset the board: its RAM is lost, of a frame being sent the rest does not leave."""
        for left_us, data in self._leaving:
            missing = -(-(left_us - now_us) * self.radio.baud // 10_000_000)
            if missing < len(data):
                self.radio.from_serial(now_us, data[: len(data) - missing])
        self._leaving.clear()
        self.engine.reset(now_us, cause)

    def stop(self, now_us: int, until_us: int) -> None:
        """The board executes nothing and hears nothing from now until then."""
        self.engine.stall(now_us, until_us)
        self._stopped_until_us = until_us

    def _hear(self, data: bytes, now_us: int) -> None:
        if now_us < max(self.errors.power_on_us, self._stopped_until_us):
            return
        if not self.engine.executes(now_us):
            return
        self.engine.receive(data)
        if not self._paced_by_engine and now_us < self._due_us:
            self.engine.next_due_us = self._due_us = now_us
            self._clock.at(now_us, self._run)

    def command(
        self,
        coordinator: XbeeModule,
        code: wire.CommandCode,
        value: int,
        token: int,
        at_us: int,
        key: bytes = wire.DEFAULT_KEY,
    ) -> None:
        """Hand the node a command as its radio module would, without loss: set up beforehand."""
        values = {"token": token, "command": int(code), "value": value}
        key = framing.node_key(key, self.node)
        data = framing.encode(wire.COMMAND, self.node, 0, token, values, key)
        self.hand(coordinator, data, at_us)

    def set_key(self, key: bytes, token: int, at_us: int) -> None:
        """Give a node without a key those of the team's ``key`` over its cable, likewise."""
        keys = framing.node_key(key, self.node) + framing.node_key(key, wire.BROADCAST)
        values = framing.masked_keys(wire.DEFAULT_KEY, token, token, keys)
        data = framing.encode(wire.NEW_KEY, self.node, 0, token, values)
        self._clock.at(at_us, lambda now_us: self.radio.deliver_by_cable(data, now_us))

    def hand(self, coordinator: XbeeModule, data: bytes, at_us: int) -> None:
        """Let the node's radio module deliver ``data`` as if it came from the coordinator."""
        self._clock.at(
            at_us, lambda now_us: self.radio.deliver(coordinator, -40, data, False, now_us)
        )

    def close(self) -> None:
        """Free the board."""
        self.engine.close()


def make_engine(
    hardware: Hardware, bus: I2cBus, eeprom: bytearray, node: int, errors: NodeErrors
) -> Engine:
    """Return the board; DeviceError or SimulatorError where what it needs is not there."""
    board, imu = hardware.board, hardware.built_for or hardware.imu
    if board is BoardKind.NATIVE:
        return NativeEngine(
            bus,
            eeprom,
            node,
            clock=errors.clock,
            power_on_us=errors.power_on_us,
            library=build(imu=str(imu)),
            stored_id=True,
        )
    # Only here: the simulator's library is needed by AVR boards alone.
    from .avr import BOARDS, AvrEngine, read_firmware
    from .avr.elf import default_build_folder, find_firmware

    name = f"{board}-mpu9250" if imu is ImuKind.MPU9250 else str(board)
    firmware = read_firmware(find_firmware(name, default_build_folder()))
    return AvrEngine(
        BOARDS[str(board)],
        firmware,
        bus,
        eeprom,
        node,
        clock=errors.clock,
        power_on_us=errors.power_on_us,
    )
