"""Faults of the chips on a node's I2C bus, and of the bus."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from relpos.emulator import ak8975, mpu9150, pozyx
from relpos.emulator.bus import BusStatus, I2cBus
from relpos.emulator.node import EmulatedNode
from relpos.simulation.world import FloatArray

from .hooks import NEVER_US, Hooks, Rng
from .spec import FaultSpec


def _any_chip(hooks: Hooks, spec: FaultSpec, rng: Rng, node: EmulatedNode, address: int) -> bool:
    """Install a behaviour that every chip can have; whether this was one."""
    behaviour = spec.fault.behaviour
    if behaviour == "garbage":
        hooks.chip(node, address).answers.append(_garbage(spec, rng))
    elif behaviour == "intermittent":
        rate = spec.number("rate")
        hooks.chip(node, address).absent.append(
            lambda time_us: spec.active(time_us) and rng.random() < rate
        )
    elif behaviour == "off":
        hooks.chip(node, address).absent.append(spec.active)
    else:
        return False
    return True


def _garbage(spec: FaultSpec, rng: Rng) -> Callable[[int, bytes], bytes]:
    word = spec.choice("value")

    def garble(time_us: int, data: bytes) -> bytes:
        if not data or not spec.active(time_us):
            return data
        if word == "random":
            return rng.bytes(len(data))
        return (b"\0" if word == "zeros" else b"\xff") * len(data)

    return garble


def imu(hooks: Hooks, spec: FaultSpec, rng: Rng, node: EmulatedNode) -> None:
    """Install a fault of the MPU-9150's accelerometer and gyroscope."""

    def power_cycle(now_us: int) -> None:
        node.mpu.power_cycle(now_us)
        node.magnetometer.power_cycle(now_us)

    if spec.fault.behaviour == "brownout":
        hooks.clock.at(spec.from_us, power_cycle)
        return
    if _any_chip(hooks, spec, rng, node, mpu9150.ADDRESS):
        if spec.fault.behaviour == "off":
            hooks.chip(node, ak8975.ADDRESS).absent.append(spec.active)
            hooks.at_end(spec, power_cycle)
        return
    spoil = _sample_fault(spec, node.mpu)
    before = node.mpu.spoil

    def both(data: bytes, time_us: int) -> bytes | None:
        shown = before(data, time_us)
        return None if shown is None else spoil(shown, time_us)

    node.mpu.spoil = both


def _sample_fault(spec: FaultSpec, chip: mpu9150.Mpu9150) -> Callable[[bytes, int], bytes | None]:
    """(sample, time) -> the sample that the chip shows instead, None: no new one."""
    held: deque[tuple[int, bytes]] = deque()
    due = [0.0]

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
        due[0] += spec.number("rate")
        if due[0] < 1.0:
            return None
        due[0] -= 1.0
        return data

    def delayed(data: bytes, time_us: int) -> bytes | None:
        held.append((time_us, data))
        shown = None
        while held and held[0][0] <= time_us - round(spec.number("value") * 1e3):
            shown = held.popleft()[1]
        return shown

    behaviours = {"stuck": stuck, "wrong": wrong, "slow": slow, "delayed": delayed}
    spoil = behaviours[spec.fault.behaviour]

    def while_active(data: bytes, time_us: int) -> bytes | None:
        if spec.active(time_us):
            return spoil(data, time_us)
        held.clear()
        return data

    return while_active


def magnetometer(hooks: Hooks, spec: FaultSpec, rng: Rng, node: EmulatedNode) -> None:
    """Install a fault of the AK8975."""
    chip = node.magnetometer
    if _any_chip(hooks, spec, rng, node, ak8975.ADDRESS):
        if spec.fault.behaviour == "off":
            hooks.at_end(spec, chip.power_cycle)
        return
    if spec.fault.behaviour == "slow":

        def set_conversion(conversion_us: int) -> Callable[[int], None]:
            def change(_now_us: int) -> None:
                chip.conversion_us = conversion_us

            return change

        hooks.clock.at(spec.from_us, set_conversion(round(spec.number("value") * 1e3)))
        hooks.at_end(spec, set_conversion(chip.conversion_us))
        return
    before = chip.spoil
    held: list[FloatArray] = []

    def stuck(field: FloatArray) -> FloatArray:
        if not held:
            held.append(field)
        return held[0]

    def wrong(field: FloatArray) -> FloatArray:
        return np.asarray(field + spec.number("value"))

    spoil = {"stuck": stuck, "wrong": wrong}[spec.fault.behaviour]

    def while_active(field: FloatArray) -> FloatArray:
        field = before(field)
        if spec.active(chip.time_us):
            return spoil(field)
        held.clear()
        return field

    chip.spoil = while_active


def pozyx_tag(hooks: Hooks, spec: FaultSpec, rng: Rng, node: EmulatedNode) -> None:
    """Install a fault of the UWB tag."""
    tag = node.tag
    behaviour = spec.fault.behaviour
    if behaviour == "brownout":
        hooks.clock.at(spec.from_us, tag.power_cycle)
    elif behaviour == "off":
        until_us = NEVER_US if spec.to_us is None else spec.to_us
        hooks.clock.at(spec.from_us, lambda _now_us: tag.power_cycle(until_us))
    elif _any_chip(hooks, spec, rng, node, pozyx.ADDRESS):
        pass
    elif behaviour == "stuck":
        before = tag.frozen
        tag.frozen = lambda time_us: before(time_us) or spec.active(time_us)
    else:
        tag.intercept = _exchange_fault(hooks, spec, tag)


def _exchange_fault(hooks: Hooks, spec: FaultSpec, tag: pozyx.Pozyx) -> pozyx.Completion:
    before = tag.intercept

    def later_us(time_us: int) -> int:
        return time_us + round(spec.number("value") * 1e3)

    def slow(peer: int, result: pozyx.RangeResult | None, error: int, time_us: int) -> None:
        hooks.clock.at(later_us(time_us), lambda now_us: before(peer, result, error, now_us))

    def delayed(peer: int, result: pozyx.RangeResult | None, error: int, time_us: int) -> None:
        tag.ranging = False
        hooks.clock.at(later_us(time_us), lambda now_us: tag.complete(peer, result, error, now_us))

    def wrong(peer: int, result: pozyx.RangeResult | None, error: int, time_us: int) -> None:
        if result is not None:
            off_mm = result.distance_mm + round(spec.number("value") * 1e3)
            result = replace(result, distance_mm=max(off_mm, 0))
        before(peer, result, error, time_us)

    def inverted(peer: int, result: pozyx.RangeResult | None, error: int, time_us: int) -> None:
        tag.ranging = False
        tag.complete(peer, result, error, time_us, inverted=True)

    behaviours = {"slow": slow, "delayed": delayed, "wrong": wrong, "inverted": inverted}
    spoil = behaviours[spec.fault.behaviour]

    def intercept(peer: int, result: pozyx.RangeResult | None, error: int, time_us: int) -> None:
        (spoil if spec.active(time_us) else before)(peer, result, error, time_us)

    return intercept


def bus(hooks: Hooks, spec: FaultSpec, rng: Rng, node: EmulatedNode) -> None:
    """Install a fault of the I2C bus."""
    wires: I2cBus = node.bus
    before = wires.fault
    freed: list[int] = []

    def stuck(number: int) -> BusStatus | None:
        if spec.choice("line") == "sda":
            if freed:
                return None
            freed.append(number)
        return BusStatus.TIMEOUT

    def nack(_number: int) -> BusStatus | None:
        if rng.random() >= spec.number("rate"):
            return None
        return BusStatus.DATA_NACK if spec.choice("part") == "data" else BusStatus.ADDRESS_NACK

    fail = {"stuck": stuck, "nack": nack}[spec.fault.behaviour]

    def fault(address: int, number: int) -> BusStatus | None:
        failed = before(address, number)
        return failed if failed or not spec.active(wires.time_us) else fail(number)

    wires.fault = fault
