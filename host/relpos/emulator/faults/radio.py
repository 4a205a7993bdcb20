"""Faults of the XBee modules, and of the air between them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from relpos.emulator.air import VirtualClock
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

AirDamage = Callable[[bytes, int], list[tuple[int, bytes]]]
"""(frame, its arrival) -> what arrives instead."""


class _FaultyAir:
    """The air as a module with a fault reaches it."""

    def __init__(self, air: Air, spec: FaultSpec, clock: VirtualClock) -> None:
        self._air = air
        self._spec = spec
        self._clock = clock
        behaviours = {"delayed": self._delayed, "slow": self._slow, "wrong": self._wrong}
        self._spoil = behaviours[spec.fault.behaviour]

    def send(self, sent: Transmission) -> None:
        """See :class:`relpos.emulator.xbee.Air`."""
        (self._spoil if self._spec.active(sent.time_us) else self._air.send)(sent)

    def _delayed(self, sent: Transmission) -> None:
        def send_late(now_us: int) -> None:
            self._air.send(replace(sent, time_us=now_us, report=lambda _time_us, _status: None))

        self._clock.at(sent.time_us + round(self._spec.number("value") * 1e6), send_late)
        sent.report(sent.time_us, DELIVERED)

    def _slow(self, sent: Transmission) -> None:
        def report_late(at_us: int, status: int) -> None:
            late_us = round(self._spec.number("value") * 1e3)
            self._clock.at(at_us + late_us, lambda now_us: sent.report(now_us, status))

        self._air.send(replace(sent, report=report_late))

    def _wrong(self, sent: Transmission) -> None:
        def report_failure(at_us: int, _status: int) -> None:
            sent.report(at_us, NO_ACKNOWLEDGEMENT)

        self._air.send(replace(sent, report=report_failure))


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
    rate = spec.number("rate", otherwise=1.0)

    def struck_bytes(strike: Callable[[int], bytes]) -> LineFault:
        def damage(data: bytes, to_module: bool) -> bytes:
            struck = rng.random(len(data)) < rate
            return b"".join(
                strike(byte) if hit else bytes((byte,))
                for byte, hit in zip(data, struck, strict=True)
            )

        return damage

    behaviours: Mapping[str, LineFault] = {
        "stuck": lambda data, to_module: data if to_module else b"",
        "garbage": lambda data, _to_module: rng.bytes(len(data)),
        "intermittent": lambda data, _to_module: b"" if rng.random() < rate else data,
        "bitflip": struck_bytes(lambda byte: bytes((byte ^ 1 << int(rng.integers(8)),))),
        "truncate": struck_bytes(lambda _byte: b""),
        "duplicate": struck_bytes(lambda byte: bytes((byte, byte))),
    }
    return behaviours[spec.fault.behaviour]


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


def _air_damage(spec: FaultSpec, rng: Rng) -> AirDamage:
    rate = spec.number("rate", otherwise=1.0)
    later_us = round(spec.number("value", otherwise=0.0) * 1e6)

    def bitflip(data: bytes, at_us: int) -> list[tuple[int, bytes]]:
        spoilt = bytearray(data)
        spoilt[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        return [(at_us, bytes(spoilt))]

    behaviours: Mapping[str, AirDamage] = {
        "loss": lambda _data, _at_us: [],
        "bitflip": bitflip,
        "truncate": lambda data, at_us: [(at_us, data[: int(rng.integers(len(data)))])],
        "duplicate": lambda data, at_us: [(at_us, data), (at_us + 1000, data)],
        "replay": lambda data, at_us: [(at_us, data), (at_us + later_us, data)],
        "reorder": lambda data, at_us: [(at_us + later_us, data)],
        "delayed": lambda data, at_us: [(at_us + later_us, data)],
    }
    damage = behaviours[spec.fault.behaviour]
    return lambda data, at_us: damage(data, at_us) if rng.random() < rate else [(at_us, data)]


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
