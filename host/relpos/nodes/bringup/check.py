"""The walk through a node's parts."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator, Mapping
from contextlib import suppress

from relpos.calibration.sensors import SensorCalibration
from relpos.errors import DeviceError
from relpos.link.dialogue import NodeDialogue
from relpos.measurements import Status
from relpos.nodes.bringup import compass, inertial, radio, ranging
from relpos.nodes.bringup.bus import (
    BYPASS,
    COMPASS_IDENTITY,
    DIVIDER_IN_USE,
    IMU_ADDRESS,
    IMU_NAMES,
    PIN_CONFIG,
    POZYX_IDENTITY,
    SAMPLE_DIVIDER,
    BusFindings,
    bus_findings,
    chip_finding,
    probe,
)
from relpos.nodes.bringup.bus_access import BusAccess
from relpos.nodes.bringup.finding import (
    BUS,
    COMPASS,
    IMU,
    LOOP,
    POZYX,
    RADIO,
    RANGING,
    SAMPLES,
    SUPPLY,
    Finding,
)
from relpos.nodes.health import BATTERY_YELLOW_V, MIN_STACK_BYTES
from relpos.nodes.monitor import reset_cause
from relpos.protocol import messages as wire

STATUS_MARGIN_S = 3.0
MOST_SUPPLY_V = 5.5
MOST_TICK_S = 0.009
"""45 % of the 20 ms between two ticks, the firmware's own limit."""
MOST_MISSED = 2
"""Samples of some 1500: one of a chip that delays them hid the delay."""
UNKNOWN_STACK = 0xFFFF
MARK_REGISTER, MARK = 0x63, 0x5A
"""A register of the inertial sensor that the firmware never writes; lost with its supply."""
RAW_REPORTS = 3000
"""While it reports raw samples a node ranges with nobody by itself."""


class NodeCheck:
    """One check of the node that ``dialogue`` talks to; it is restarted at the end.

    ``cable``: PORT is the node's own. ``peer``: the second node to range with (default: another
    that is heard), laid out ``distance_m`` away. ``figures`` holds what was measured.
    """

    def __init__(
        self,
        dialogue: NodeDialogue,
        *,
        cable: bool = False,
        peer: int | None = None,
        distance_m: float | None = None,
    ) -> None:
        self.figures: dict[str, object] = {}
        self._dialogue = dialogue
        self._bus = BusAccess(dialogue)
        self._cable = cable
        self._peer = peer
        self._distance_m = distance_m
        self._wrong: set[str] = set()

    def findings(self) -> Generator[Finding]:
        """Yield each finding as it is made. DeviceError where the node falls silent.

        Closed early, it restarts the node, too.
        """
        if not self._cable:
            yield from self._noted(radio.radio_findings(self._dialogue, self.figures))
            if RADIO in self._wrong:
                yield Finding(
                    IMU, None, "nor anything else: the radio first, or by cable (--cable)"
                )
                return
        else:
            yield Finding(RADIO, None, "has no part in it: the switch gives its line to the cable")
        try:
            yield from self._beyond_the_radio()
        except BaseException:  # also Ctrl-C: the chips are still in their self-tests
            with suppress(DeviceError):
                self._dialogue.restart()
            raise
        self._dialogue.restart()

    def _beyond_the_radio(self) -> Iterator[Finding]:
        first, heard = self._status(), self._heard()
        yield from self._noted(self._board(first))
        found = probe(self._bus)
        yield from self._noted(bus_findings(found, self.figures))
        if found.usable:
            yield from self._noted(self._chips(found))
        last = self._status(new=True)
        if not self._cable:
            yield from self._noted(radio.meanwhile(first, last, self._heard() - heard))
        if found.usable and IMU not in self._wrong:
            yield from self._noted(self._meanwhile(first, last))
            yield from self._noted(self._self_tests(found))

    def _noted(self, findings: Iterator[Finding]) -> Iterator[Finding]:
        for finding in findings:
            if finding.right is False:
                self._wrong.add(finding.part)
            yield finding

    # -- the board ----------------------------------------------------------------------------

    def _status(self, *, new: bool = False) -> Mapping[str, float]:
        """Return the newest status, or the next one."""
        observations = self._dialogue.observations
        if new:
            observations.clear()
        period_s = self._dialogue.setting(wire.CommandCode.SET_STATUS_PERIOD_MS) * 1e-3
        until_s = time.monotonic() + period_s + STATUS_MARGIN_S
        while True:
            values = {
                o.name: o.value
                for o in observations
                if isinstance(o, Status) and o.node == self._dialogue.node
            }
            if "health" in values or time.monotonic() > until_s:
                return values
            self._dialogue.listen()

    def _heard(self) -> int:
        return self._dialogue.link.decoder.nodes[self._dialogue.node].counts["received"]

    def _board(self, status: Mapping[str, float]) -> Iterator[Finding]:
        if not status:
            yield Finding(LOOP, False, "no status arrives", "flash it anew: relpos node flash")
            return
        version = ".".join(
            f"{status[f'firmware_{part}']:.0f}" for part in ("major", "minor", "patch")
        )
        cause = reset_cause(status["reset_cause"]).name.lower().replace("_", " ")
        self.figures |= {"firmware": version, "reset_cause": cause} | {
            name: status[name] for name in ("battery_v", "worst_tick_s", "free_stack_bytes")
        }
        volts = status["battery_v"]
        if volts:
            yield Finding(
                SUPPLY,
                BATTERY_YELLOW_V <= volts <= MOST_SUPPLY_V,
                f"{volts:.2f} V at the microcontroller, which measures to 10 %",
                "5 V are needed: another battery or cable; measure at the pin 5V",
            )
        tick_s, stack = status["worst_tick_s"], status["free_stack_bytes"]
        yield Finding(
            LOOP,
            tick_s < MOST_TICK_S and stack >= MIN_STACK_BYTES,
            f"firmware {version}, started by {cause}"
            + (f"; worst tick {1e3 * tick_s:.1f} of 20 ms" if tick_s else "")
            + (f", {stack:.0f} B of stack never used" if stack < UNKNOWN_STACK else ""),
            "a bus that is slow or fails takes the time; send this report in",
        )

    # -- the chips ----------------------------------------------------------------------------

    def _chips(self, found: BusFindings) -> Iterator[Finding]:
        imu = chip_finding(found.chips[IMU], IMU_NAMES, "its pin AD0 belongs on GND", self._bus)
        yield imu
        recording, calibration = inertial.Recording(()), SensorCalibration()
        if imu.right:
            if self._bus.byte(IMU_ADDRESS, SAMPLE_DIVIDER) != DIVIDER_IN_USE:
                name = IMU_NAMES[found.chips[IMU].identity or 0]
                imu_option = "mpu9150" if name == "MPU-9150" else "mpu9250"
                yield Finding(
                    IMU,
                    False,
                    f"the firmware does not use it: it is built for another sensor than an {name}",
                    f"relpos node flash --imu {imu_option}",
                )
            else:
                self._bus.write(IMU_ADDRESS, MARK_REGISTER, MARK)
                calibration = self._dialogue.read_calibration()
                recording = inertial.record(self._dialogue)
                yield from inertial.sample_findings(self._bus, recording, calibration, self.figures)
        yield from self._compass(found, recording, calibration)
        yield from self._pozyx(found)

    def _compass(
        self, found: BusFindings, recording: inertial.Recording, calibration: SensorCalibration
    ) -> Iterator[Finding]:
        if IMU in self._wrong or (recording.silent and SAMPLES in self._wrong):
            yield Finding(COMPASS, None, "it lies behind the inertial sensor: that one first")
            return
        if found.chips[COMPASS].identity is None and not BYPASS & (
            self._bus.byte(IMU_ADDRESS, PIN_CONFIG) or 0
        ):
            yield Finding(COMPASS, None, "the inertial sensor does not let it through")
            return
        kind = "AK8975" if found.chips[IMU].identity == inertial.MPU9150 else "AK8963"
        chip = chip_finding(found.chips[COMPASS], {COMPASS_IDENTITY: kind}, "", self._bus)
        yield chip
        if chip.right and recording.samples and not recording.silent:
            yield from compass.compass_findings(recording, calibration, self.figures)

    def _pozyx(self, found: BusFindings) -> Iterator[Finding]:
        chip = chip_finding(
            found.chips[POZYX],
            {POZYX_IDENTITY: "Pozyx"},
            "its address jumper belongs in the position for 0x4B",
            self._bus,
        )
        yield chip
        if not chip.right:
            return
        yield from ranging.pozyx_findings(self._bus, self.figures)
        others = set(self._dialogue.link.decoder.nodes) - {self._dialogue.node}
        peer = self._peer or min(others, default=None)
        if peer is None:
            heard = "none is heard by cable" if self._cable else "no second node is heard"
            yield Finding(RANGING, None, f"{heard}: switch one on and name it with --peer")
            return
        self._dialogue.demand(wire.CommandCode.SET_RAW_REPORTS, RAW_REPORTS)
        # The newest motion is a second old at most.
        uptime_s = float((self._dialogue.totals() or {"time_s": 0.0})["time_s"])
        yield from ranging.ranging_findings(
            self._bus, found, peer, self._distance_m, time.monotonic() - uptime_s, self.figures
        )
        self._dialogue.demand(wire.CommandCode.SET_RAW_REPORTS, 0)

    def _meanwhile(
        self, first: Mapping[str, float], last: Mapping[str, float]
    ) -> Iterator[Finding]:
        """What happened during the check that no part was asked for."""
        if not (first and last):
            return
        missed = int(last["missed_ticks"] - first["missed_ticks"]) & 0xFFFF
        if SAMPLES not in self._wrong:
            yield from self._restarted()
        if missed > MOST_MISSED and not self._wrong & {IMU, SAMPLES}:
            yield Finding(SAMPLES, False, f"{missed} are missing", "a loose contact")
        errors = int(last["bus_errors"] - first["bus_errors"]) & 0xFFFF
        if errors > self._bus.failed and not self._wrong & {IMU, COMPASS, POZYX, SAMPLES, RANGING}:
            yield Finding(
                BUS,
                False,
                f"{errors - self._bus.failed} transactions failed during the check",
                "SDA, SCL and GND: loose contacts, long wires; pull-ups (docs/hardware.md)",
            )

    def _restarted(self) -> Iterator[Finding]:
        if self._bus.byte(IMU_ADDRESS, MARK_REGISTER) != MARK:
            yield Finding(
                IMU,
                False,
                "has restarted during the check",
                "its supply dips: 3.3 V at its pins, contacts",
            )

    def _self_tests(self, found: BusFindings) -> Iterator[Finding]:
        if IMU in self._wrong:
            return
        identity = found.chips[IMU].identity or 0
        if SAMPLES not in self._wrong:
            tested = list(inertial.self_tests(self._dialogue, self._bus, identity, self.figures))
            yield from self._restarted()
            if IMU in self._wrong:  # what they gave is not the sensor's
                return
            yield from tested
        if not self._wrong & {COMPASS, SAMPLES}:
            yield compass.self_test(self._bus, identity, self.figures)
