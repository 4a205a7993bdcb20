"""Makes the faults of the vocabulary happen to an emulated team.

Every fault acts where it would in the field (a chip's answers, a line, the air, a board's supply)
through the hooks of those models; the firmware never knows. Random ones draw from streams of their
own, so that the same seed and SPECs give the same bytes.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from relpos.protocol import messages as wire
from relpos.protocol.messages import ResetCause
from relpos.simulation.world import FloatArray

from . import ak8975, mpu9150
from .bus import BusStatus, I2cBus, I2cDevice
from .engine import NodeClockError
from .faults import FaultError, FaultSpec
from .native import NativeEngine
from .pozyx import Pozyx, RangeResult
from .xbee import BROADCAST, DELIVERED, NO_ACKNOWLEDGEMENT, Air, XbeeModule

if TYPE_CHECKING:
    from .air import VirtualClock
    from .node import EmulatedNode, NodeErrors
    from .team import EmulatedTeam

NEVER_US = 1 << 50
WATCHDOG_US = 500_000
RESTART_XBEE_US = 100_000
STRANGERS_ADDRESS = 0x5A5A
STRANGERS_ID = 200

Draw = np.random.Generator
LineFault = Callable[[bytes, bool], bytes]
Spoil = Callable[[XbeeModule, XbeeModule, bytes, int], list[tuple[int, bytes]]]


def prepare_errors(errors: NodeErrors, node: int, specs: Sequence[FaultSpec]) -> NodeErrors:
    """The node's clock as faults want it: those that concern a board from its making on."""
    for spec in specs:
        if spec.fault.target != "clock" or spec.node not in (None, node):
            continue
        clock = errors.clock
        if spec.fault.behaviour == "wrong":
            clock = replace(clock, drift_ppm=spec.number("value"))
        elif spec.fault.behaviour == "wrap":
            since_us = (spec.from_us - errors.power_on_us) * (1.0 + clock.drift_ppm * 1e-6)
            clock = NodeClockError(clock.drift_ppm, (1 << 32) - round(since_us))
        errors = replace(errors, clock=clock)
    return errors


class FaultyChip(I2cDevice):
    """A chip between its bus and itself: not there, garbled, or not always there."""

    def __init__(self, chip: I2cDevice) -> None:
        self._chip = chip
        self._time_us = 0
        self._open = False
        self._gone = False
        self.absent: list[Callable[[int], bool]] = []
        """(time) -> whether it does not answer this transaction."""
        self.answers: list[Callable[[int, bytes], bytes]] = []
        """(time, bytes that it answers) -> what the board sees of them."""

    def _begin(self) -> bool:
        if not self._open:
            self._open = True
            self._gone = any(absent(self._time_us) for absent in self.absent)
        return not self._gone

    def _seen(self, data: bytes) -> bytes:
        for answer in self.answers:
            data = answer(self._time_us, data)
        return data

    def advance(self, time_us: int) -> None:
        """Both, to that time."""
        self._time_us = max(self._time_us, time_us)
        self._chip.advance(time_us)

    def start(self, read: bool) -> bool:
        """Acknowledged where the chip is there and does."""
        if not self._begin():
            return False
        acknowledged = self._chip.start(read)
        self.stretch_us, self._chip.stretch_us = self._chip.stretch_us, 0
        return acknowledged

    def write(self, byte: int) -> bool:
        """As the chip does."""
        return self._chip.write(byte)

    def read(self) -> int:
        """The chip's byte, as the board sees it."""
        return self._seen(bytes((self._chip.read(),)))[0]

    def stop(self) -> None:
        """End of the transaction."""
        self._open = False
        if not self._gone:
            self._chip.stop()

    def transfer(self, first: bytes, second: bytes, read_count: int) -> tuple[BusStatus, bytes]:
        """As the bytes would do."""
        there = self._begin()
        self._open = False
        if not there:
            return BusStatus.ADDRESS_NACK, b""
        status, data = self._chip.transfer(first, second, read_count)
        return status, self._seen(data)


class _FaultyAir:
    """The air as a module with a fault reaches it."""

    def __init__(self, air: Air, spec: FaultSpec, clock: VirtualClock) -> None:
        self._air = air
        self._spec = spec
        self._clock = clock

    def send(
        self,
        sender: XbeeModule,
        destination: int,
        long: bool,
        data: bytes,
        time_us: int,
        report: Callable[[int, int], None],
    ) -> None:
        """See :class:`relpos.emulator.xbee.Air`."""
        spec = self._spec
        if not spec.active(time_us):
            self._air.send(sender, destination, long, data, time_us, report)
            return
        behaviour = spec.fault.behaviour
        if behaviour == "delayed":
            held_us = round(spec.number("value") * 1e6)
            self._clock.at(
                time_us + held_us,
                lambda now_us: self._air.send(
                    sender, destination, long, data, now_us, lambda _time_us, _status: None
                ),
            )
            report(time_us, DELIVERED)
        elif behaviour == "slow":
            late_us = round(spec.number("value") * 1e3)
            self._air.send(
                sender, destination, long, data, time_us,
                lambda at_us, status: self._clock.at(
                    at_us + late_us, lambda now_us: report(now_us, status)
                ),
            )  # fmt: skip
        else:
            self._air.send(
                sender, destination, long, data, time_us,
                lambda at_us, _status: report(at_us, NO_ACKNOWLEDGEMENT),
            )  # fmt: skip


class FaultInjector:
    """Installs ``specs`` in a team that has just been made."""

    def __init__(self, team: EmulatedTeam, specs: Sequence[FaultSpec], seed: int) -> None:
        self._team = team
        self._clock = team.clock
        self._chips: dict[tuple[int, int], FaultyChip] = {}
        self._radio_spoils: list[Spoil] = []
        self._lines: dict[XbeeModule, list[LineFault]] = {}
        for place, spec in enumerate(specs):
            rng = np.random.default_rng([seed, place, 0xFA17])
            install = getattr(self, f"_{spec.fault.target}_on", None)
            if install is None:
                raise FaultError(f"{spec.fault.name} cannot be injected")
            if spec.fault.team or spec.fault.target == "radio":
                install(spec, rng)
                continue
            if spec.fault.target == "xbee":
                for module in self._modules(spec):
                    self._xbee_on(spec, rng.spawn(1)[0], module)
                continue
            for node in team.nodes.values():
                if spec.node in (None, node.node):
                    install(spec, rng.spawn(1)[0], node)

    # -- helpers ----------------------------------------------------------------------------------

    def _modules(self, spec: FaultSpec) -> list[XbeeModule]:
        if spec.node == 0:
            return [self._team.coordinator]
        return [n.radio for n in self._team.nodes.values() if spec.node in (None, n.node)]

    def _chip(self, node: EmulatedNode, address: int) -> FaultyChip:
        chip = self._chips.get((node.node, address))
        if chip is None:
            chip = FaultyChip(node.bus.devices[address])
            self._chips[node.node, address] = chip
            node.bus.devices[address] = chip
        return chip

    def _at_end(self, spec: FaultSpec, action: Callable[[int], None]) -> None:
        if spec.to_us is not None:
            self._clock.at(spec.to_us, action)

    def _simple_chip(self, spec: FaultSpec, rng: Draw, node: EmulatedNode, address: int) -> bool:
        """The behaviours that every chip can have; whether this was one."""
        behaviour = spec.fault.behaviour
        if behaviour == "garbage":
            self._chip(node, address).answers.append(_garbler(spec, rng))
        elif behaviour == "intermittent":
            rate = spec.number("rate")
            self._chip(node, address).absent.append(
                lambda time_us: spec.active(time_us) and rng.random() < rate
            )
        elif behaviour == "off":
            self._chip(node, address).absent.append(spec.active)
        else:
            return False
        return True

    # -- chips ------------------------------------------------------------------------------------

    def _imu_on(self, spec: FaultSpec, rng: Draw, node: EmulatedNode) -> None:
        def power_cycle(now_us: int) -> None:
            node.mpu.power_cycle(now_us)
            node.magnetometer.power_cycle(now_us)

        behaviour = spec.fault.behaviour
        if behaviour == "brownout":
            self._clock.at(spec.from_us, power_cycle)
            return
        if self._simple_chip(spec, rng, node, mpu9150.ADDRESS):
            if behaviour == "off":
                self._chip(node, ak8975.ADDRESS).absent.append(spec.active)
                self._at_end(spec, power_cycle)
            return
        spoil = _imu_spoiler(spec, node.mpu)
        before = node.mpu.spoil

        def both(data: bytes, time_us: int) -> bytes | None:
            shown = data if before is None else before(data, time_us)
            return shown if shown is None else spoil(shown, time_us)

        node.mpu.spoil = both

    def _magnetometer_on(self, spec: FaultSpec, rng: Draw, node: EmulatedNode) -> None:
        chip = node.magnetometer
        if self._simple_chip(spec, rng, node, ak8975.ADDRESS):
            if spec.fault.behaviour == "off":
                self._at_end(spec, chip.power_cycle)
            return
        if spec.fault.behaviour == "slow":
            slow_us = round(spec.number("value") * 1e3)

            def set_conversion(conversion_us: int) -> Callable[[int], None]:
                def change(_now_us: int) -> None:
                    chip.conversion_us = conversion_us

                return change

            self._clock.at(spec.from_us, set_conversion(slow_us))
            self._at_end(spec, set_conversion(chip.conversion_us))
            return
        before = chip.spoil
        held: list[FloatArray] = []

        def spoil(field: FloatArray) -> FloatArray:
            field = field if before is None else before(field)
            if not spec.active(chip.time_us):
                held.clear()
                return field
            if spec.fault.behaviour == "wrong":
                return np.asarray(field + spec.number("value"))
            if not held:
                held.append(field)
            return held[0]

        chip.spoil = spoil

    def _pozyx_on(self, spec: FaultSpec, rng: Draw, node: EmulatedNode) -> None:
        tag = node.tag
        behaviour = spec.fault.behaviour
        if behaviour == "brownout":
            self._clock.at(spec.from_us, tag.power_cycle)
            return
        if behaviour == "off":

            def switch_off(now_us: int) -> None:
                tag.power_cycle(NEVER_US if spec.to_us is None else spec.to_us)

            self._clock.at(spec.from_us, switch_off)
            return
        if self._simple_chip(spec, rng, node, _POZYX):
            return
        if behaviour == "stuck":
            tag.frozen = spec.active
            return
        before = tag.intercept or _finish(tag)

        def intercept(peer: int, result: RangeResult | None, error: int, time_us: int) -> None:
            if not spec.active(time_us):
                before(peer, result, error, time_us)
            elif behaviour == "slow":
                self._clock.at(
                    time_us + round(spec.number("value") * 1e3),
                    lambda now_us: before(peer, result, error, now_us),
                )
            elif behaviour == "delayed":
                tag.ranging = False
                self._clock.at(
                    time_us + round(spec.number("value") * 1e3),
                    lambda now_us: tag.complete(peer, result, error, now_us),
                )
            elif behaviour == "wrong":
                if result is not None:
                    off_mm = result.distance_mm + round(spec.number("value") * 1e3)
                    result = replace(result, distance_mm=max(off_mm, 0))
                before(peer, result, error, time_us)
            else:
                tag.ranging = False
                tag.complete(peer, result, error, time_us, inverted=True)

        tag.intercept = intercept

    # -- radio ------------------------------------------------------------------------------------

    def _line(self, module: XbeeModule, fault: LineFault) -> None:
        faults = self._lines.setdefault(module, [])
        faults.append(fault)

        def all_of_them(data: bytes, to_module: bool) -> bytes:
            for one in faults:
                data = one(data, to_module)
            return data

        module.line_fault = all_of_them

    def _spoil_radio(self, spoil: Spoil) -> None:
        spoils = self._radio_spoils
        spoils.append(spoil)

        def all_of_them(
            sender: XbeeModule, receiver: XbeeModule, data: bytes, arrival_us: int
        ) -> list[tuple[int, bytes]]:
            frames = [(arrival_us, data)]
            for one in spoils:
                frames = [
                    came for at_us, frame in frames for came in one(sender, receiver, frame, at_us)
                ]
            return frames

        self._team.radio.spoil = all_of_them

    def _xbee_on(self, spec: FaultSpec, rng: Draw, module: XbeeModule) -> None:
        behaviour = spec.fault.behaviour
        if behaviour in ("wrong", "slow", "delayed"):
            module.air = _FaultyAir(module.air, spec, self._clock)
            return
        gone = spec.active
        if behaviour == "brownout":
            until_us = spec.from_us + RESTART_XBEE_US
            gone = replace(spec, to_s=until_us * 1e-6).active
            self._clock.at(until_us, module.restart)
        elif behaviour == "off":
            self._at_end(spec, module.restart)
        if behaviour in ("off", "brownout"):
            self._line(module, lambda data, _to: b"" if gone(self._clock.now_us) else data)
            self._spoil_radio(
                lambda sender, receiver, data, at_us: (
                    []
                    if module in (sender, receiver) and gone(self._clock.now_us)
                    else [(at_us, data)]
                )
            )
            return
        damage = _line_damage(spec, rng)
        self._line(
            module,
            lambda data, to_module: (
                damage(data, to_module) if spec.active(self._clock.now_us) else data
            ),
        )

    def _radio_on(self, spec: FaultSpec, rng: Draw) -> None:
        if spec.fault.behaviour == "foreign":
            self._stranger(spec, rng)
            return
        damage = _air_damage(spec, rng)

        def spoil(
            sender: XbeeModule, receiver: XbeeModule, data: bytes, arrival_us: int
        ) -> list[tuple[int, bytes]]:
            concerned = spec.node is None or spec.node in (sender.address, receiver.address)
            if concerned and spec.active(self._clock.now_us):
                return damage(data, arrival_us)
            return [(arrival_us, data)]

        self._spoil_radio(spoil)

    def _stranger(self, spec: FaultSpec, rng: Draw) -> None:
        """A module of nobody's in the middle. With the team's key it is a node left switched on."""
        team = self._team
        module = XbeeModule(
            STRANGERS_ADDRESS, 0x40000000 + STRANGERS_ADDRESS, team.radio, lambda _time, _data: None
        )
        right = spec.choice("key") == "right"
        key = team.key if right else rng.bytes(wire.KEY_BYTES)
        sent = [0]

        def send(now_us: int) -> None:
            if spec.to_us is not None and now_us >= spec.to_us:
                return
            ids = [STRANGERS_ID] if right else list(team.nodes)
            data = _strangers_frame(sent[0], ids[sent[0] % len(ids)], now_us, right, key)
            sent[0] += 1
            team.radio.send(module, BROADCAST, False, data, now_us, lambda _time, _status: None)
            self._clock.at(now_us + round(1e6 / spec.number("rate")), send)

        self._clock.at(spec.from_us, send)

    def _uwb_on(self, spec: FaultSpec, rng: Draw) -> None:
        before = self._team.uwb.spoil
        exchange_us = self._team.uwb.model.exchange_us  # of strangers too
        strangers: deque[int] = deque()
        next_us = [float(spec.from_us)]
        rate = spec.number("rate")

        def met(begin_us: int, end_us: int) -> bool:
            """Whether an exchange of strangers, at random times, overlaps."""
            while next_us[0] < end_us and rate > 0.0:
                strangers.append(round(next_us[0]))
                next_us[0] += 1e6 * float(rng.exponential(1.0 / rate))
            while strangers and strangers[0] + exchange_us <= begin_us:
                strangers.popleft()
            return bool(strangers) and strangers[0] < end_us

        def spoil(
            initiator: Pozyx, measured_m: float | None, end_us: int
        ) -> tuple[float | None, bool]:
            collided = False
            if before is not None:
                measured_m, collided = before(initiator, measured_m, end_us)
            now_us = self._clock.now_us
            if not spec.active(now_us):
                return measured_m, collided
            if spec.fault.behaviour == "collisions":
                return measured_m, met(now_us, end_us) or collided
            if rng.random() < rate and measured_m is not None:
                if spec.fault.behaviour == "loss":
                    return None, collided
                measured_m += float(rng.uniform(0.0, spec.number("value")))
            return measured_m, collided

        self._team.uwb.spoil = spoil

    def _host_on(self, spec: FaultSpec, rng: Draw) -> None:
        before = self._team.host_fault

        def due_us(time_us: int) -> int | None:
            at_us = time_us if before is None else before(time_us)
            if at_us is None or not spec.active(at_us):
                return at_us
            return None if spec.fault.behaviour == "gone" else spec.to_us

        self._team.host_fault = due_us

    # -- boards -----------------------------------------------------------------------------------

    def _bus_on(self, spec: FaultSpec, rng: Draw, node: EmulatedNode) -> None:
        bus: I2cBus = node.bus
        before = bus.fault
        freed: list[int] = []
        line = spec.choice("line") if spec.fault.behaviour == "stuck" else ""
        part = spec.choice("part") if spec.fault.behaviour == "nack" else ""
        status = {"address": BusStatus.ADDRESS_NACK, "data": BusStatus.DATA_NACK}.get(part)

        def fault(address: int, number: int) -> BusStatus | None:
            failed = None if before is None else before(address, number)
            if failed or not spec.active(bus.time_us):
                return failed
            if status is not None:
                return status if rng.random() < spec.number("rate") else None
            if line == "sda":
                if freed:
                    return None
                freed.append(number)
            return BusStatus.TIMEOUT

        bus.fault = fault

    def _clock_on(self, spec: FaultSpec, rng: Draw, node: EmulatedNode) -> None:
        if spec.fault.behaviour == "off":

            def halt(now_us: int) -> None:
                until_us = NEVER_US if spec.to_us is None else spec.to_us
                node.stop(now_us, until_us)
                if until_us - now_us > WATCHDOG_US:
                    self._clock.at(until_us, lambda at: node.restart(at, ResetCause.WATCHDOG))

            self._clock.at(spec.from_us, halt)
        elif spec.fault.behaviour == "intermittent":
            stand_us = round(spec.number("value") * 1e3)

            def pause(now_us: int) -> None:
                if spec.active(now_us):
                    node.stop(now_us, now_us + stand_us)
                    self._clock.at(now_us + stand_us + 1_000_000, pause)

            self._clock.at(spec.from_us, pause)

    def _node_on(self, spec: FaultSpec, rng: Draw, node: EmulatedNode) -> None:
        node.hold_frames = True
        if spec.fault.behaviour == "brownout":
            chips = spec.choice("chips") == "reset"

            def dip(now_us: int) -> None:
                node.restart(now_us, ResetCause.BROWN_OUT)
                if chips:
                    _power_cycle(node, now_us)

            self._clock.at(spec.from_us, dip)
            return
        until_us = NEVER_US if spec.to_us is None else spec.to_us

        def switch_off(now_us: int) -> None:
            node.stop(now_us, until_us)
            node.tag.power_cycle(until_us)
            if until_us < NEVER_US:
                self._clock.at(until_us, switch_on)

        def switch_on(now_us: int) -> None:
            node.restart(now_us, ResetCause.POWER_ON)
            _power_cycle(node, now_us)
            node.radio.restart(now_us)

        self._clock.at(spec.from_us, switch_off)
        gone = spec.active
        module = node.radio
        self._line(module, lambda data, _to: b"" if gone(self._clock.now_us) else data)
        self._spoil_radio(
            lambda sender, receiver, data, at_us: (
                [] if module in (sender, receiver) and gone(self._clock.now_us) else [(at_us, data)]
            )
        )

    def _eeprom_on(self, spec: FaultSpec, rng: Draw, node: EmulatedNode) -> None:
        node.hold_frames = True
        left = spec.choice("left")
        wanted = round(spec.number("write"))

        def remains(at: int, value: int) -> int:
            old = node.eeprom[at]
            return {"erased": 0xFF, "old": old, "garbage": int(rng.integers(256))}[left]

        if isinstance(node.engine, NativeEngine):
            cut_native(node, node.engine, self._clock, spec.from_us, wanted, remains)
        else:
            _cut_avr(node, self._clock, spec.from_us, wanted, remains)


def _strangers_frame(count: int, node: int, now_us: int, right: bool, key: bytes) -> bytes:
    """One after the other of what would do harm if it were believed."""
    time_s = now_us * 1e-6
    far = dict.fromkeys(wire.MOTION.field, 0) | {
        "time_s": time_s, "x_m": 50.0 * count, "path_m": 50.0 * count, "state": 2,
    }  # fmt: skip
    entry = {"peer": 1 + node % 3, "range_m": 0.5, "rss_dbm": -80, "age_s": 0.0, "quality": 0}
    up = (
        (wire.MOTION, node, far),
        (wire.RANGES, node, {"time_s": time_s, "ranges": [entry]}),
    )
    command = {"token": 0x7000 + count % 0x1000, "command": wire.CommandCode.REBOOT, "value": 0}
    beacon = {"phase_s": 0.5, "period_s": 0.3, "round": 7, "nodes": [{"node": 77}]}
    down = (
        (wire.COMMAND, wire.BROADCAST, command),
        (wire.BEACON, wire.BROADCAST, beacon),
    )
    choices = up if right else up + down
    message, about, values = choices[count % len(choices)]
    return wire.encode(message, about, 0, 0x40000000 + count, values, key)


_POZYX = 0x4B


def _finish(tag: Pozyx) -> Callable[[int, RangeResult | None, int, int], None]:
    def finish(peer: int, result: RangeResult | None, error: int, time_us: int) -> None:
        tag.ranging = False
        tag.complete(peer, result, error, time_us)

    return finish


def _power_cycle(node: EmulatedNode, now_us: int) -> None:
    node.mpu.power_cycle(now_us)
    node.magnetometer.power_cycle(now_us)
    node.tag.power_cycle(now_us)


def _garbler(spec: FaultSpec, rng: Draw) -> Callable[[int, bytes], bytes]:
    word = spec.choice("value")

    def garble(time_us: int, data: bytes) -> bytes:
        if not data or not spec.active(time_us):
            return data
        if word == "random":
            return rng.bytes(len(data))
        return (b"\0" if word == "zeros" else b"\xff") * len(data)

    return garble


def _imu_spoiler(spec: FaultSpec, chip: mpu9150.Mpu9150) -> Callable[[bytes, int], bytes | None]:
    behaviour = spec.fault.behaviour
    held: deque[tuple[int, bytes]] = deque()
    share = [0.0]

    def stuck(data: bytes, time_us: int) -> bytes:
        if not held:
            held.append((time_us, data))
        return held[0][1]

    def wrong(data: bytes, time_us: int) -> bytes:
        words = np.frombuffer(data, ">i2").astype(np.int64)
        _, most_rad_s = chip.full_scale
        words[4:] += round(math.radians(spec.number("value")) / most_rad_s * 32768.0)
        return np.clip(words, -32768, 32767).astype(">i2").tobytes()

    def slow(data: bytes, time_us: int) -> bytes | None:
        share[0] += spec.number("rate")
        if share[0] < 1.0:
            return None
        share[0] -= 1.0
        return data

    def delayed(data: bytes, time_us: int) -> bytes | None:
        held.append((time_us, data))
        shown = None
        while held and held[0][0] <= time_us - round(spec.number("value") * 1e3):
            shown = held.popleft()[1]
        return shown

    spoil = {"stuck": stuck, "wrong": wrong, "slow": slow, "delayed": delayed}[behaviour]

    def while_active(data: bytes, time_us: int) -> bytes | None:
        if spec.active(time_us):
            return spoil(data, time_us)
        held.clear()
        return data

    return while_active


def _line_damage(spec: FaultSpec, rng: Draw) -> LineFault:
    behaviour = spec.fault.behaviour
    rate = spec.number("rate") if "rate" in spec.fault.key_names() else 1.0

    def damage(data: bytes, to_module: bool) -> bytes:
        if behaviour == "stuck":
            return data if to_module else b""
        if behaviour == "garbage":
            return rng.bytes(len(data))
        if behaviour == "intermittent":
            return b"" if rng.random() < rate else data
        out = bytearray()
        for byte, struck in zip(data, rng.random(len(data)) < rate, strict=True):
            if not struck:
                out.append(byte)
            elif behaviour == "bitflip":
                out.append(byte ^ 1 << int(rng.integers(8)))
            elif behaviour == "duplicate":
                out += bytes((byte, byte))
        return bytes(out)

    return damage


def _air_damage(spec: FaultSpec, rng: Draw) -> Callable[[bytes, int], list[tuple[int, bytes]]]:
    behaviour = spec.fault.behaviour
    rate = spec.number("rate") if "rate" in spec.fault.key_names() else 1.0
    later_us = round(spec.number("value") * 1e6) if "value" in spec.fault.key_names() else 0

    def damage(data: bytes, at_us: int) -> list[tuple[int, bytes]]:
        if rng.random() >= rate:
            return [(at_us, data)]
        if behaviour == "loss":
            return []
        if behaviour == "bitflip":
            spoilt = bytearray(data)
            spoilt[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
            return [(at_us, bytes(spoilt))]
        if behaviour == "truncate":
            return [(at_us, data[: int(rng.integers(len(data)))])]
        if behaviour == "duplicate":
            return [(at_us, data), (at_us + 1000, data)]
        if behaviour == "replay":
            return [(at_us, data), (at_us + later_us, data)]
        return [(at_us + later_us, data)]

    return damage


def cut_native(
    node: EmulatedNode,
    engine: NativeEngine,
    clock: VirtualClock,
    from_us: int,
    wanted: int,
    remains: Callable[[int, int], int],
) -> None:
    """Count the bytes written; at the wanted one the supply goes, and what is written after it."""
    plain = engine.store
    written = [0]
    dark = [False]

    def restart(now_us: int) -> None:
        dark[0] = False
        _power_cycle(node, now_us)
        node.restart(now_us, ResetCause.BROWN_OUT)

    def store(at: int, value: int) -> None:
        if dark[0]:
            return
        if clock.now_us >= from_us and written[0] < wanted:
            written[0] += 1
            if written[0] == wanted:
                plain(at, remains(at, value))
                dark[0] = True
                clock.at(clock.now_us, restart)
                return
        plain(at, value)

    engine.store = store


def _cut_avr(
    node: EmulatedNode,
    clock: VirtualClock,
    from_us: int,
    wanted: int,
    remains: Callable[[int, int], int],
) -> None:
    """Look every millisecond; in the middle of the wanted write (3.4 ms) the supply goes."""
    from .avr.engine import AvrEngine

    engine = node.engine
    assert isinstance(engine, AvrEngine)
    done_before = [0]

    def look(now_us: int) -> None:
        engine.run(now_us)
        if engine.eeprom_writing and engine.eeprom_writes - done_before[0] >= wanted - 1:
            before = bytes(node.eeprom)
            node.restart(now_us, ResetCause.BROWN_OUT)
            after = engine.board.eeprom()[: len(before)]
            changed = [k for k in range(len(before)) if before[k] != after[k]]
            spoilt = bytearray(after)
            node.eeprom[:] = before
            for at in changed:
                spoilt[at] = remains(at, before[at])
            engine.board.load_eeprom(bytes(spoilt))
            node.eeprom[:] = spoilt
            _power_cycle(node, now_us)
            return
        clock.at(now_us + 1000, look)

    def begin(now_us: int) -> None:
        engine.run(now_us)
        done_before[0] = engine.eeprom_writes
        look(now_us)

    clock.at(from_us, begin)
