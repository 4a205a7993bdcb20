"""Faults of the XBee modules, of both airs, and of the host at the coordinator's port."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

from relpos.emulator.air import EXCHANGE_US, VirtualClock
from relpos.emulator.pozyx import Pozyx
from relpos.emulator.xbee import (
    BROADCAST,
    DELIVERED,
    NO_ACKNOWLEDGEMENT,
    Air,
    Transmission,
    XbeeModule,
)
from relpos.protocol import framing
from relpos.protocol import messages as wire

from .hooks import Hooks, LineFault, Rng
from .spec import FaultSpec

RESTART_XBEE_US = 100_000
FOREIGN_ADDRESS = 0x5A5A


class _FaultyAir:
    """The air as a module with a fault reaches it."""

    def __init__(self, air: Air, spec: FaultSpec, clock: VirtualClock) -> None:
        self._air = air
        self._spec = spec
        self._clock = clock

    def send(self, sent: Transmission) -> None:
        """See :class:`relpos.emulator.xbee.Air`."""
        spec, clock = self._spec, self._clock

        def send_late(now_us: int) -> None:
            self._air.send(replace(sent, time_us=now_us, report=lambda _time_us, _status: None))

        def report_late(at_us: int, status: int) -> None:
            late_us = round(spec.number("value") * 1e3)
            clock.at(at_us + late_us, lambda now_us: sent.report(now_us, status))

        def report_failure(at_us: int, _status: int) -> None:
            sent.report(at_us, NO_ACKNOWLEDGEMENT)

        if not spec.active(sent.time_us):
            self._air.send(sent)
        elif spec.fault.behaviour == "delayed":
            clock.at(sent.time_us + round(spec.number("value") * 1e6), send_late)
            sent.report(sent.time_us, DELIVERED)
        else:
            slow = spec.fault.behaviour == "slow"
            self._air.send(replace(sent, report=report_late if slow else report_failure))


def xbee(hooks: Hooks, spec: FaultSpec, rng: Rng, module: XbeeModule) -> None:
    """Install a fault of a radio module or of its serial line."""
    behaviour = spec.fault.behaviour
    if behaviour in ("wrong", "slow", "delayed"):
        module.air = _FaultyAir(module.air, spec, hooks.clock)
    elif behaviour == "brownout":
        until_us = spec.from_us + RESTART_XBEE_US
        hooks.clock.at(until_us, module.restart)
        hooks.silence(module, replace(spec, to_s=until_us * 1e-6).active)
    elif behaviour == "off":
        hooks.at_end(spec, module.restart)
        hooks.silence(module, spec.active)
    else:
        damage = _line_damage(spec, rng)
        hooks.line(
            module,
            lambda data, to_module: (
                damage(data, to_module) if spec.active(hooks.clock.now_us) else data
            ),
        )


def _line_damage(spec: FaultSpec, rng: Rng) -> LineFault:
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


def radio(hooks: Hooks, spec: FaultSpec, rng: Rng) -> None:
    """Install a fault of the air between the XBee modules."""
    if spec.fault.behaviour == "foreign":
        _foreign_sender(hooks, spec, rng)
        return
    damage = _air_damage(spec, rng)

    def spoil(
        sender: XbeeModule, receiver: XbeeModule, data: bytes, arrival_us: int
    ) -> list[tuple[int, bytes]]:
        concerned = spec.node is None or spec.node in (sender.address, receiver.address)
        if concerned and spec.active(hooks.clock.now_us):
            return damage(data, arrival_us)
        return [(arrival_us, data)]

    hooks.air(spoil)


def _air_damage(spec: FaultSpec, rng: Rng) -> Callable[[bytes, int], list[tuple[int, bytes]]]:
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


def _foreign_sender(hooks: Hooks, spec: FaultSpec, rng: Rng) -> None:
    """A module in the middle that has a key of its own, or all that a stolen node holds."""
    team = hooks.team
    module = XbeeModule(
        FOREIGN_ADDRESS, 0x40000000 + FOREIGN_ADDRESS, team.radio, lambda _time, _data: None
    )
    stolen = max(team.nodes) if spec.choice("key") == "stolen" else None
    own = rng.bytes(wire.KEY_BYTES) if stolen is None else framing.node_key(team.key, stolen)
    beacons = own if stolen is None else framing.node_key(team.key, wire.BROADCAST)
    others = [node for node in team.nodes if node != stolen]
    sent = [0]

    def send(now_us: int) -> None:
        if spec.to_us is not None and now_us >= spec.to_us:
            return
        count = sent[0]
        data = _foreign_frame(count, others[count % len(others)], now_us, own, beacons)
        sent[0] += 1
        team.radio.send(
            Transmission(module, BROADCAST, False, data, now_us, lambda _time, _status: None)
        )
        hooks.clock.at(now_us + round(1e6 / spec.number("rate")), send)

    hooks.clock.at(spec.from_us, send)


def _foreign_frame(count: int, node: int, now_us: int, own: bytes, beacons: bytes) -> bytes:
    """In turn each frame that would do harm if it were believed."""
    time_s = now_us * 1e-6
    far = dict.fromkeys(wire.MOTION.field, 0) | {
        "time_s": time_s, "x_m": 50.0 * count, "path_m": 50.0 * count, "state": 2,
    }  # fmt: skip
    entry = {"peer": 1 + node % 3, "range_m": 0.5, "rss_dbm": -80, "age_s": 0.0, "quality": 0}
    command = {"token": 0x7000 + count % 0x1000, "command": wire.CommandCode.REBOOT, "value": 0}
    beacon = {"phase_s": 0.5, "period_s": 0.3, "round": 7, "nodes": [{"node": 77}]}
    choices = (
        (wire.MOTION, node, far, own),
        (wire.RANGES, node, {"time_s": time_s, "ranges": [entry]}, own),
        (wire.COMMAND, node, command, own),
        (wire.COMMAND, wire.BROADCAST, command, beacons),
        (wire.BEACON, wire.BROADCAST, beacon, beacons),
    )
    message, about, values, key = choices[count % len(choices)]
    return framing.encode(message, about, 0, 0x40000000 + count, values, key)


def uwb(hooks: Hooks, spec: FaultSpec, rng: Rng) -> None:
    """Install a fault of the air between the tags."""
    air = hooks.team.uwb
    before = air.spoil
    foreign: deque[int] = deque()
    next_us = [float(spec.from_us)]
    rate = spec.number("rate")

    def met(begin_us: int, end_us: int) -> bool:
        """Whether an exchange of foreign tags, at random times, overlaps."""
        while next_us[0] < end_us and rate > 0.0:
            foreign.append(round(next_us[0]))
            next_us[0] += 1e6 * float(rng.exponential(1.0 / rate))
        while foreign and foreign[0] + EXCHANGE_US <= begin_us:
            foreign.popleft()
        return bool(foreign) and foreign[0] < end_us

    def spoil(initiator: Pozyx, measured_m: float | None, end_us: int) -> tuple[float | None, bool]:
        collided = False
        if before is not None:
            measured_m, collided = before(initiator, measured_m, end_us)
        now_us = hooks.clock.now_us
        if not spec.active(now_us):
            return measured_m, collided
        if spec.fault.behaviour == "collisions":
            return measured_m, met(now_us, end_us) or collided
        if rng.random() < rate and measured_m is not None:
            if spec.fault.behaviour == "loss":
                return None, collided
            measured_m += float(rng.uniform(0.0, spec.number("value")))
        return measured_m, collided

    air.spoil = spoil


def host(hooks: Hooks, spec: FaultSpec, rng: Rng) -> None:
    """Install a fault of the laptop at the coordinator's port."""
    before = hooks.team.host_fault

    def due_us(time_us: int) -> int | None:
        at_us = time_us if before is None else before(time_us)
        if at_us is None or not spec.active(at_us):
            return at_us
        return None if spec.fault.behaviour == "gone" else spec.to_us

    hooks.team.host_fault = due_us
