"""Dead reckoning of recorded inertial data by the firmware: what ``relpos deadreckon`` runs.

The recording becomes what the MPU-9150 and the AK8975 measure; the production driver configures
range, filter and rate, the chip quantises accordingly, and what the firmware reports comes back on
the recording's clock. Nothing but its samples is used of the recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from relpos.calibration.steps import (
    LEG_OF_STATURE,
    MAX_CHANGE,
    POPULATION_GAIN_PERMILLE,
    posterior_scale,
    scaled_gain_permille,
)
from relpos.errors import DataError, DeviceError
from relpos.link.decoder import Decoder
from relpos.measurements import Height, Motion, Step
from relpos.protocol import framing
from relpos.protocol import messages as wire
from relpos.runs import NodeInfo, Run
from relpos.runs.imu import ImuRecording
from relpos.simulation.world import World

from .air import Action, UwbAir, VirtualClock
from .node import BoardKind, EmulatedNode, NodeErrors
from .surroundings import FloatArray, Surroundings
from .xbee import DELIVERED, Transmission, XbeeModule

GRID_HZ = 200.0
"""The recording is brought to this uniform rate before the chip's filter processes it."""
FAST_GRID_HZ = 1000.0
"""The same for a recording that is faster than the usual grid: the chip's own filter is to take the
vibration out, which sampling it at 200 Hz would fold into the walk."""
LEAD_S = 0.3
"""From power-on to the first sample: the board boots, configures its sensor and gets its settings.
The first sample is held meanwhile; the node sees the last tenth of a second of it."""
COMMAND_ATTEMPTS_US = (20_000, 180_000, 500_000, 1_000_000, 2_000_000)
"""A board that is still starting misses the first; a token that is repeated has no effect twice."""
COMMAND_PERIOD_US = 40_000
TAIL_S = 2.5
"""Behind the last sample: the report that is then under way still comes out."""
MOST_ROWS = 86_400 * 200
"""A day at the usual rate: 2.2 GB of memory."""
GAP_PERIODS = 3.5
LEAST_GAP_S = 0.1
"""Samples further apart than both (in median periods, in seconds) are a gap, not a slow sensor."""
LEAST_RATE_HZ = 20.0
"""Of a recording that still shows steps: the strides' harmonics reach 8 Hz."""
STANDARD_PRESSURE_PA = 101_325.0


@dataclass(frozen=True)
class WearerSettings:
    """The node's settings while the recording is played; None leaves the firmware's default."""

    leg_length_m: float | None = None
    step_gain_permille: int | None = None


@dataclass(frozen=True)
class FirmwareOutput:
    """What one node reported, on the recording's clock; ``counts`` are the frames by name.

    ``heights`` are empty where the recording has no pressure. ``clipped`` samples of the recording
    were beyond the range that the firmware had configured.
    """

    motions: tuple[Motion, ...]
    steps: tuple[Step, ...]
    counts: Mapping[str, int]
    heights: tuple[Height, ...] = ()
    clipped: int = 0

    @property
    def distance_m(self) -> float:
        """Sum of the step lengths."""
        return sum(step.length_m for step in self.steps)


@dataclass(frozen=True)
class NodeResult:
    """One node's part of a run: what it reported, with which settings."""

    output: FirmwareOutput
    settings: WearerSettings
    samples: int
    repeated: int
    """Samples at the time of the one before, which were left out."""
    rate_hz: float
    calibration: Calibration | None = None


def surroundings_of(recording: ImuRecording) -> Surroundings:
    """What the chips measure while the recording is played, ``LEAD_S`` after power-on.

    Samples are joined by shape-preserving cubics; no sample is made inside a gap. DataError where
    there is no motion to play.
    """
    time_s, rows = _increasing(recording)
    if len(time_s) < 2:
        raise DataError("an inertial recording with fewer than two times cannot be played")
    period_s = float(np.median(np.diff(time_s)))
    grid_hz = GRID_HZ if period_s > 0.9 / GRID_HZ else FAST_GRID_HZ
    if (time_s[-1] - time_s[0]) * grid_hz > MOST_ROWS:
        raise DataError(
            f"an inertial recording of {time_s[-1] - time_s[0]:g} s is more than the "
            f"{MOST_ROWS / grid_hz:g} s that can be played at its rate"
        )
    if period_s < 0.9 / FAST_GRID_HZ:
        time_s, rows = _averaged(time_s, rows, 1.0 / FAST_GRID_HZ)
        period_s = float(np.median(np.diff(time_s)))
    time_s = time_s - time_s[0] + LEAD_S
    grid_s = np.arange(int((time_s[-1] + TAIL_S) * grid_hz) + 1) / grid_hz
    inside = np.clip(grid_s, time_s[0], time_s[-1])
    inertial: FloatArray = scipy.interpolate.PchipInterpolator(time_s, rows[:, :6])(inside)
    step_s = np.diff(time_s)
    gaps = np.flatnonzero(step_s > max(GAP_PERIODS * period_s, LEAST_GAP_S))
    silent = [(float(time_s[k]) + period_s, float(time_s[k + 1])) for k in gaps]
    silent.append((float(time_s[-1]) + period_s, float(grid_s[-1]) + 3600.0))
    magnetic = np.full((len(grid_s), 3), np.nan)
    known = np.isfinite(rows[:, 6:9]).all(axis=1)
    if known.any():
        for axis in range(3):
            magnetic[:, axis] = np.interp(inside, time_s[known], rows[known, 6 + axis])
    pressure_pa = np.full(len(grid_s), STANDARD_PRESSURE_PA)
    known = np.isfinite(rows[:, 9])
    if known.any():
        pressure_pa = np.interp(inside, time_s[known], rows[known, 9])
    return Surroundings(
        rate_hz=grid_hz,
        specific_force_m_s2=inertial[:, :3],
        angular_rate_rad_s=inertial[:, 3:],
        magnetic_field_ut=magnetic,
        pressure_pa=pressure_pa,
        silent_us=tuple((round(a * 1e6), round(b * 1e6)) for a, b in silent),
    )


def _increasing(recording: ImuRecording) -> tuple[FloatArray, FloatArray]:
    """Times and (n, 10) rows, of samples at the same time the first."""
    keep = np.concatenate(([True], np.diff(recording.time_s) > 1e-6))
    pressure_pa = recording.pressure_pa
    if pressure_pa is None:
        pressure_pa = np.full(len(keep), np.nan)
    rows = np.concatenate(
        (
            recording.acceleration_m_s2,
            recording.angular_rate_rad_s,
            recording.magnetic_field_ut,
            pressure_pa[:, None],
        ),
        axis=1,
    )
    return recording.time_s[keep], rows[keep]


def _averaged(time_s: FloatArray, rows: FloatArray, bin_s: float) -> tuple[FloatArray, FloatArray]:
    """Means over bins of ``bin_s``; bins without a sample are left out."""
    bins = np.floor((time_s - time_s[0]) / bin_s)
    begins = np.flatnonzero(np.diff(bins, prepend=-1.0))
    counts = np.diff(begins, append=len(time_s))
    mean_s = np.add.reduceat(time_s, begins) / counts
    return mean_s, np.add.reduceat(rows, begins, axis=0) / counts[:, None]


class _Recorder:
    """The radio's other end: everything arrives, at once, and is decoded."""

    def __init__(self) -> None:
        self.decoder = Decoder()
        self.motions: list[Motion] = []
        self.heights: list[Height] = []
        self.steps: list[Step] = []

    def send(self, sent: Transmission) -> None:
        """See :class:`relpos.emulator.xbee.Air`."""
        try:
            frame = framing.decode(sent.data)
        except framing.FrameError:
            arrival_s = sent.time_us * 1e-6
        else:
            # The node's clock is the recording's: as if the frame had arrived when it was stamped.
            arrival_s = float(frame.values.get("time_s", sent.time_us * 1e-6))
        for observation in self.decoder.feed(sent.data, arrival_s):
            if isinstance(observation, Motion):
                self.motions.append(observation)
            elif isinstance(observation, Height):
                self.heights.append(observation)
            elif isinstance(observation, Step):
                self.steps.append(observation)
        sent.report(sent.time_us, DELIVERED)


def _unless_answered(
    emulated: EmulatedNode,
    coordinator: XbeeModule,
    recorder: _Recorder,
    code: wire.CommandCode,
    value: int,
    token: int,
) -> Action:
    def send(now_us: int) -> None:
        if all(answer.token != token for answer in recorder.decoder.acknowledged):
            emulated.command(coordinator, code, value, token, now_us)

    return send


def play(
    node: int,
    recording: ImuRecording,
    settings: WearerSettings,
    board: BoardKind | str = BoardKind.NATIVE,
) -> FirmwareOutput:
    """Run the firmware over one node's recording.

    DataError where a setting is refused, DeviceError where the node does not answer.
    """
    surroundings = surroundings_of(recording)
    clock = VirtualClock()
    recorder = _Recorder()
    nowhere = UwbAir(clock, World(), lambda tag, time: np.zeros(3), np.random.default_rng(0))
    # A wire node id is 1 to 254; what the recording calls its node is put back below.
    emulated = EmulatedNode(1, board, surroundings, NodeErrors(), clock, nowhere, recorder)
    try:
        nowhere.tags.append(emulated.tag)
        coordinator = XbeeModule(wire.COORDINATOR, 0x40000000, recorder, lambda time, data: None)
        commands = [(wire.CommandCode.SET_STEP_REPORTS, 1)]
        if settings.leg_length_m is not None:
            commands.append(
                (wire.CommandCode.SET_LEG_LENGTH_MM, round(settings.leg_length_m * 1000.0))
            )
        if settings.step_gain_permille is not None:
            commands.append((wire.CommandCode.SET_STEP_GAIN_PERMILLE, settings.step_gain_permille))
        for k, (code, value) in enumerate(commands):
            for attempt_us in COMMAND_ATTEMPTS_US:
                clock.at(
                    attempt_us + COMMAND_PERIOD_US * k,
                    _unless_answered(emulated, coordinator, recorder, code, value, k + 1),
                )
        clock.run(round((len(surroundings.pressure_pa) - 1) / surroundings.rate_hz * 1e6))
        most_force, most_rate = emulated.mpu.full_scale
    finally:
        emulated.close()
    answers = {answer.token: answer for answer in recorder.decoder.acknowledged}
    for k, (code, value) in enumerate(commands):
        answer = answers.get(k + 1)
        if answer is None:
            raise DeviceError(f"node {node}: the firmware did not answer {code.name}")
        if answer.result != wire.CommandResult.DONE:
            raise DataError(
                f"node {node}: the firmware refuses {code.name} {value}: "
                "look at stature_m and leg_length_m of the run"
            )
    beyond = (np.abs(recording.acceleration_m_s2) > most_force).any(axis=1) | (
        np.abs(recording.angular_rate_rad_s) > most_rate
    ).any(axis=1)
    shift_s = float(recording.time_s[0]) - LEAD_S

    def at(time_s: float) -> float:
        return round(time_s + shift_s, 6)

    motions = tuple(
        replace(motion, node=node, time_s=at(motion.time_s))
        for motion in recorder.motions
        if motion.time_s > LEAD_S or motion.dx_m or motion.dy_m or motion.dtheta_rad
    )
    steps = tuple(replace(step, node=node, time_s=at(step.time_s)) for step in recorder.steps)
    heights = tuple(
        replace(height, node=node, time_s=at(height.time_s))
        for height in recorder.heights
        if recording.pressure_pa is not None and height.time_s > LEAD_S
    )
    counts = dict(recorder.decoder.counts)
    for track in recorder.decoder.nodes.values():
        counts.update(track.counts)
    return FirmwareOutput(motions, steps, counts, heights, int(beyond.sum()))


@dataclass(frozen=True)
class Calibration:
    """A step gain from walks of known length; ``measured_m`` is what the node made of them."""

    gain_permille: int
    scale: float
    measured_m: tuple[float, ...]


def calibrate(
    node: int,
    recordings: Sequence[ImuRecording],
    true_m: Sequence[float],
    leg_length_m: float | None,
    board: BoardKind | str = BoardKind.NATIVE,
) -> Calibration:
    """Step gain after walks of one wearer, weighted by `steps.posterior_scale`.

    A walk's length goes with the gain: 5 % more of it makes the recorded walks 5.03 % longer at the
    median. So one pass suffices; several may run into a step that is found with one gain and not
    with the next (2.7 for 2.1 m in one walk). DataError where no step is
    found, a distance is not positive, or a walk's length contradicts the one stated.
    """
    for distance_m in true_m:
        if not distance_m > 0.0:
            raise DataError(
                f"the calibration walk's true_distance_m is {distance_m:g}: it must be positive"
            )
    settings = WearerSettings(leg_length_m, POPULATION_GAIN_PERMILLE)
    played = [play(node, part, settings, board) for part in recordings]
    measured_m = tuple(walk.distance_m for walk in played)
    if min(measured_m) <= 0.0:
        raise DataError(f"node {node}: no step is found in the calibration walk")
    asked = [true / measured for true, measured in zip(true_m, measured_m, strict=True)]
    for scale, true, measured in zip(asked, true_m, measured_m, strict=True):
        if not 1.0 / MAX_CHANGE <= scale <= MAX_CHANGE:
            raise DataError(
                f"node {node}: the calibration walk comes out as {measured:.2f} m and not as "
                f"{true:g} m: is true_distance_m right?"
            )
    scale = posterior_scale(asked, [len(walk.steps) for walk in played])
    return Calibration(scaled_gain_permille(POPULATION_GAIN_PERMILLE, scale), scale, measured_m)


def reckon_run(
    run: Run,
    *,
    board: BoardKind | str = BoardKind.NATIVE,
    stature_m: float | None = None,
    calibration: Sequence[Run] = (),
) -> dict[int, NodeResult]:
    """What the firmware reports while the run's ``imu.csv`` is played, for every node in it.

    The leg length is the run's own, or 0.53 of ``stature_m`` or of the run's stature. With
    ``calibration``, walks of the same wearer with ``true_distance_m``, the step gain comes from
    them. DataError or DeviceError where that cannot be done.
    """
    recordings = run.load_imu()
    if not recordings:
        raise DataError(f"{run.name}: no inertial data (imu.csv)")
    walks = [(walk, walk.load_imu()) for walk in calibration]
    played: dict[int, NodeResult] = {}
    for node, recording in recordings.items():
        leg_m = leg_length_m(run, node, stature_m)
        calibrated = None
        if walks:
            own, lengths_m = [], []
            for walk, parts in walks:
                part = parts.get(node) or (next(iter(parts.values())) if len(parts) == 1 else None)
                distance_m = walk.description.true_distance_m
                if part is None or distance_m is None:
                    raise DataError(
                        f"{walk.name}: no walk of node {node} with true_distance_m in it"
                    )
                own.append(part)
                lengths_m.append(distance_m)
            # A calibration walk's own leg length would put another gain beside this one.
            calibrated = calibrate(node, own, lengths_m, leg_m, board)
        settings = WearerSettings(leg_m, None if calibrated is None else calibrated.gain_permille)
        try:
            output = play(node, recording, settings, board)
        except DataError as error:
            raise DataError(f"{run.name}: {error}") from error
        time_s, _ = _increasing(recording)
        played[node] = NodeResult(
            output,
            settings,
            samples=len(recording.time_s),
            repeated=len(recording.time_s) - len(time_s),
            rate_hz=float(1.0 / np.median(np.diff(time_s))),
            calibration=calibrated,
        )
    return played


def leg_length_m(run: Run, node: int, stature_m: float | None = None) -> float | None:
    """The run's own, or 0.53 of ``stature_m`` or of its stature; None where nothing is known."""
    if stature_m is None:
        # The node's own, then that of a run of one node.
        for known in (run.description.nodes.get(node, NodeInfo()), run.description):
            if known.leg_length_m is not None:
                return known.leg_length_m
            if known.stature_m is not None:
                stature_m = known.stature_m
                break
    return None if stature_m is None else LEG_OF_STATURE * stature_m
