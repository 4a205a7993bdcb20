"""Faults of a board: its clock, its supply, its EEPROM."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from relpos.emulator.air import VirtualClock
from relpos.emulator.engine import NodeClockError
from relpos.emulator.native import NativeEngine
from relpos.emulator.node import EmulatedNode, NodeErrors
from relpos.protocol.messages import ResetCause

from .hooks import NEVER_US, Hooks, Rng
from .spec import FaultSpec

WATCHDOG_US = 1_000_000


def faulty_clock(errors: NodeErrors, node: int, specs: Sequence[FaultSpec]) -> NodeErrors:
    """``errors`` with the clock faults that a board has from its making on."""
    for spec in specs:
        if spec.fault.target != "clock" or spec.node not in (None, node):
            continue
        if spec.fault.behaviour in _MADE_WITH:
            errors = replace(errors, clock=_MADE_WITH[spec.fault.behaviour](errors, spec))
    return errors


def _wrong(errors: NodeErrors, spec: FaultSpec) -> NodeClockError:
    return replace(errors.clock, drift_ppm=spec.number("value"))


def _wrap(errors: NodeErrors, spec: FaultSpec) -> NodeClockError:
    drift_ppm = errors.clock.drift_ppm
    since_us = (spec.from_us - errors.power_on_us) * (1.0 + drift_ppm * 1e-6)
    return NodeClockError(drift_ppm, (1 << 32) - round(since_us))


_MADE_WITH = {"wrong": _wrong, "wrap": _wrap}


def _power_cycle(node: EmulatedNode, now_us: int) -> None:
    node.mpu.power_cycle(now_us)
    node.magnetometer.power_cycle(now_us)
    node.tag.power_cycle(now_us)


def clock(hooks: Hooks, spec: FaultSpec, rng: Rng, node: EmulatedNode) -> None:
    """Install an oscillator that stops; other clock faults are in :func:`faulty_clock`."""

    def halt(now_us: int) -> None:
        until_us = NEVER_US if spec.to_us is None else spec.to_us
        node.stop(now_us, until_us)
        if until_us - now_us > WATCHDOG_US:
            hooks.clock.at(until_us, lambda at: node.restart(at, ResetCause.WATCHDOG))

    def pause(now_us: int) -> None:
        stand_us = round(spec.number("value") * 1e3)
        if spec.active(now_us):
            node.stop(now_us, now_us + stand_us)
            hooks.clock.at(now_us + stand_us + 1_000_000, pause)

    if spec.fault.behaviour not in _MADE_WITH:
        hooks.clock.at(spec.from_us, {"off": halt, "intermittent": pause}[spec.fault.behaviour])


def supply(hooks: Hooks, spec: FaultSpec, rng: Rng, node: EmulatedNode) -> None:
    """Install a fault of the whole node's supply."""
    node.hold_frames = True
    until_us = NEVER_US if spec.to_us is None else spec.to_us

    def dip(now_us: int) -> None:
        node.restart(now_us, ResetCause.BROWN_OUT)
        if spec.choice("chips") == "reset":
            _power_cycle(node, now_us)

    def switch_off(now_us: int) -> None:
        node.stop(now_us, until_us)
        node.tag.power_cycle(until_us)
        if until_us < NEVER_US:
            hooks.clock.at(until_us, switch_on)

    def switch_on(now_us: int) -> None:
        node.restart(now_us, ResetCause.POWER_ON)
        _power_cycle(node, now_us)
        node.radio.restart(now_us)

    hooks.clock.at(spec.from_us, {"brownout": dip, "off": switch_off}[spec.fault.behaviour])
    if spec.fault.behaviour == "off":
        hooks.silence(node.radio, spec.active)


def eeprom(hooks: Hooks, spec: FaultSpec, rng: Rng, node: EmulatedNode) -> None:
    """Install a cut of the supply in the middle of a write to the EEPROM."""
    node.hold_frames = True
    left = spec.choice("left")
    wanted = round(spec.number("write"))

    def remains(at: int, value: int) -> int:
        old = node.eeprom[at]
        return {"erased": 0xFF, "old": old, "garbage": int(rng.integers(256))}[left]

    cut = cut_native if isinstance(node.engine, NativeEngine) else _cut_avr
    {"cut": cut}[spec.fault.behaviour](node, hooks.clock, spec.from_us, wanted, remains)


def cut_native(
    node: EmulatedNode,
    clock: VirtualClock,
    from_us: int,
    wanted: int,
    remains: Callable[[int, int], int],
) -> None:
    """Cut the supply at the ``wanted``-th byte written after ``from_us``; later ones are lost too.

    ``remains(address, value)`` is what the cut leaves of that byte.
    """
    engine = node.engine
    assert isinstance(engine, NativeEngine)
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
    """The same on a simulated AVR: look every millisecond, a write takes 3.4 ms."""
    # Only here: the simulator's library is needed by AVR boards alone.
    from relpos.emulator.avr.engine import AvrEngine

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
