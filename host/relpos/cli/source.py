"""What ``relpos fuse`` is given: a run directory, a recording or a port."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from relpos.cli import output
from relpos.cli.keys import make_link
from relpos.errors import DataError

if TYPE_CHECKING:
    from relpos.fusion.estimator import Estimate
    from relpos.measurements import Observation


def is_port(source: str) -> bool:
    """Tell whether the source can only be a serial port: a device, a pyserial URL, a COM name."""
    if "://" in source or (source.upper().startswith("COM") and source[3:].isdigit()):
        return True
    path = Path(source)
    return path.is_char_device() or (not path.exists() and path.is_relative_to("/dev"))


def check_recording(source: str) -> Path:
    """Return the run directory that the source names; DataError says what it is instead."""
    path = Path(source)
    if path.is_dir():
        return path
    if path.exists():
        raise DataError(f"{source}: a file; recordings other than run directories are not read yet")
    raise DataError(f"{source}: no such run directory or port")


class Port:
    """A live team behind a serial port, as one stream of observations; it is sent beacons.

    What an estimator learns of the wearers' steps goes back to the nodes by ``learn``, unless
    ``teach`` is off.

    ``counters`` are the link's: frames, losses, rejections. ``DeviceError`` from the iteration
    says that the port does not exist or has vanished; what came before has been yielded.
    """

    def __init__(
        self,
        port: str,
        seconds: float | None = None,
        key_file: Path | None = None,
        *,
        teach: bool = True,
    ) -> None:
        from relpos.link import live
        from relpos.link.step_scale import StepScaleSender

        self._link, self._seen = make_link(key_file)
        self._device = live.open_port(port)
        self._seconds = seconds
        self._scales = StepScaleSender(self._link) if teach else None

    @property
    def counters(self) -> Mapping[str, float]:
        """Counts of the whole link so far."""
        sent = {"step_scales_sent": self._scales.sent} if self._scales else {}
        return {**self._link.summary(), **sent}

    def learn(self, estimate: Estimate) -> None:
        """Tell the nodes what the newest estimate has learned of their wearers' steps."""
        if self._scales is not None:
            for p in estimate.parameters:
                if p.name == "step_scale":
                    self._scales.learn(p.node, p.value, p.sigma, p.time_s)

    def __iter__(self) -> Iterator[Observation]:
        """Yield observations until the seconds are over, or for ever."""
        from relpos.link import live
        from relpos.link.beacon import HostBeacons

        started = time.monotonic()
        beacons = HostBeacons(self._link)
        told = 0

        def clock() -> float:
            return time.monotonic() - started

        try:
            for batch in live.observe(self._device, self._link, clock):
                live.send(self._device, beacons.due(clock()))
                self._talk_of_steps(clock())
                while told < len(self._link.decoder.remarks):
                    output.remark(self._link.decoder.remarks[told])
                    told += 1
                if self._seen is not None:
                    self._seen.save(self._link.newest_counters(), time.monotonic())
                yield from batch
                if self._seconds is not None and clock() > self._seconds:
                    return
        finally:
            self._device.close()
            if self._seen is not None:
                self._seen.save(self._link.newest_counters(), time.monotonic(), at_once=True)

    def _talk_of_steps(self, now_s: float) -> None:
        from relpos.link import live

        if self._scales is None:
            return
        answers = self._link.decoder.acknowledged
        while answers:
            self._scales.take(answers.popleft())
        live.send(self._device, self._scales.due(now_s))
        self._link.decoder.remarks += self._scales.remarks
        self._scales.remarks.clear()
