"""What step models reach when the foot contacts are given: the floor under any filter.

A step is the interval between two annotated contacts, the first one from the trial's start; where a
foot repeats, the contact in between was not annotated and the interval is two steps. Each model's
constants are fitted on the other people (leave one person out); a calibration walk replaces them by
one scale a person. Sources: Zijlstra and Hof, Gait Posture 6 (1997), pendulum, 0.1 Hz high-pass;
Gonzalez et al., EMBC 2007, pendulum plus a constant way in double support; Weinberg, Analog
Devices AN-602 (2002), fourth root of the acceleration's range; Kim et al., J. GPS 3 (2004), cube
root of its mean; Sekiya et al. (1997), walk ratio.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import replay
from numpy.typing import NDArray
from replay import RATE_HZ, Array, Recording
from scipy.signal import butter, sosfiltfilt

TRUE_M = 20.0
TILT_TIME_S = 3.0  # of the attitude that gives the vertical: over a stride, under a turn
STEP_BAND_HZ = (0.7, 3.5)
IMPACT_M_S2 = 0.3  # smallest oscillation of the vertical force that counts as a step's
DEAD = 0.15  # of the walk's level: below it nothing moves
LAG_S = 0.12  # a contact's impact further off than this from the run's usual delay is displaced


@dataclass(frozen=True)
class Walk:
    """A recording with its vertical acceleration and its steps."""

    recording: Recording
    up: Array  # (n, 3) unit vector in sensor axes
    vertical_m_s2: Array  # (n,)
    steps_s: list[tuple[float, float]]

    @property
    def person(self) -> str:
        """Number of the person, as the folder's name has it."""
        return self.recording.name.split("-")[0]

    def sample(self, span_s: tuple[float, float]) -> slice:
        """Samples within a step."""
        return slice(*np.searchsorted(self.recording.time_s, span_s))


def upwards(recording: Recording) -> Array:
    """The vertical (n, 3) in sensor axes: the gyroscope carries it, gravity corrects it."""
    force, rate = recording.imu[:, :3], recording.imu[:, 3:]
    up = force[:25].mean(axis=0)
    up /= np.linalg.norm(up)
    out = np.empty_like(force)
    axes = np.cross(np.eye(3), rate[:, None, :])  # (n, 3, 3): axes @ up is the cross product
    turns = np.eye(3) - axes / RATE_HZ
    share = 1.0 / (RATE_HZ * TILT_TIME_S)
    for i, turn in enumerate(turns):
        up = (1.0 - share) * (turn @ up) + share * force[i] / 9.81
        up /= math.sqrt(up @ up)
        out[i] = up
    return out


def steps_of(recording: Recording) -> list[tuple[float, float]]:
    """Begin and end of every step in seconds."""
    contacts = [(t, foot) for t, name, foot in recording.events if name == "foot_contact"]
    spans = []
    before, foot_before = float(recording.times_of("trial_start")[0]), ""
    for time, foot in contacts:
        if foot == foot_before:
            middle = 0.5 * (before + time)
            spans += [(before, middle), (middle, time)]
        else:
            spans.append((before, time))
        before, foot_before = time, foot
    return spans


def prepare(recording: Recording, *, steps: bool = True) -> Walk:
    """Recording with what all models need; without ``steps`` it may have no contacts."""
    up = upwards(recording)
    vertical = np.sum(recording.imu[:, :3] * up, axis=1)
    return Walk(recording, up, vertical - vertical.mean(), steps_of(recording) if steps else [])


# --- how far the torso rises in each step --------------------------------------------------------


def rise_in_step_m(walk: Walk) -> Array:
    """Double integration over each step alone, velocity and height back where they were."""
    rises = []
    for span in walk.steps_s:
        a = walk.vertical_m_s2[walk.sample(span)]
        if len(a) < 4:
            rises.append(0.0)
            continue
        velocity = np.cumsum(a - a.mean()) / RATE_HZ
        height = np.cumsum(velocity - velocity.mean()) / RATE_HZ
        rises.append(float(np.ptp(height)))
    return np.array(rises)


def rise_high_passed_m(walk: Walk, cutoff_hz: float) -> Array:
    """Double integration over the walk, each integral high-passed without delay."""
    sos = butter(2, cutoff_hz / (RATE_HZ / 2.0), btype="high", output="sos")
    velocity = sosfiltfilt(sos, np.cumsum(walk.vertical_m_s2) / RATE_HZ)
    height = sosfiltfilt(sos, np.cumsum(velocity) / RATE_HZ)
    parts = [height[walk.sample(span)] for span in walk.steps_s]
    return np.array([np.ptp(part) if len(part) > 3 else 0.0 for part in parts])


def chord_m(rise_m: Array, leg_m: float) -> Array:
    """Chord of the leg's arc."""
    return 2.0 * np.sqrt(np.maximum(2.0 * leg_m * rise_m - rise_m**2, 0.0))


# --- models: what the distance is a linear combination of ----------------------------------------

Rise = Callable[[Walk], Array]
RISES: dict[str, Rise] = {
    "per step": rise_in_step_m,
    "high-pass 0.1 Hz": functools.partial(rise_high_passed_m, cutoff_hz=0.1),
    "high-pass 0.5 Hz": functools.partial(rise_high_passed_m, cutoff_hz=0.5),
}


def _leg(walk: Walk) -> float:
    return walk.recording.leg_length_m


def _each(walk: Walk, function: Callable[[Array], float]) -> float:
    parts = (walk.vertical_m_s2[walk.sample(span)] for span in walk.steps_s)
    return sum(function(part) for part in parts if len(part) > 3)


def _cadence_hz(walk: Walk) -> float:
    return float(1.0 / np.median([end - begin for begin, end in walk.steps_s]))


def _pendulum(walk: Walk, rise: Rise) -> list[float]:
    return [float(chord_m(rise(walk), _leg(walk)).sum())]


def _modified(walk: Walk, rise: Rise) -> list[float]:
    return [*_pendulum(walk, rise), len(walk.steps_s) * _leg(walk)]


def _cube_root(walk: Walk, rise: Rise) -> list[float]:
    return [float(np.cbrt(rise(walk) * _leg(walk) ** 2).sum())]


Features = Callable[[Walk], list[float]]
MODELS: dict[str, Features] = {
    "constant step": lambda w: [float(len(w.steps_s))],
    "constant share of the leg": lambda w: [len(w.steps_s) * _leg(w)],
    "share of the leg, linear in cadence": lambda w: [
        len(w.steps_s) * _leg(w),
        len(w.steps_s) * _leg(w) * _cadence_hz(w),
    ],
    "walk ratio": lambda w: [len(w.steps_s) * _cadence_hz(w)],
    "Weinberg, fourth root": lambda w: [_each(w, lambda a: float(np.ptp(a)) ** 0.25)],
    "Weinberg times leg": lambda w: [_leg(w) * _each(w, lambda a: float(np.ptp(a)) ** 0.25)],
    "Kim, cube root": lambda w: [_each(w, lambda a: float(np.cbrt(np.abs(a).mean())))],
    "Kim times leg": lambda w: [_leg(w) * _each(w, lambda a: float(np.cbrt(np.abs(a).mean())))],
}
for _name, _rise in RISES.items():
    MODELS[f"pendulum, {_name}"] = functools.partial(_pendulum, rise=_rise)
    MODELS[f"pendulum and double support, {_name}"] = functools.partial(_modified, rise=_rise)
    MODELS[f"cube root of the rise, {_name}"] = functools.partial(_cube_root, rise=_rise)
PENDULUMS = [name for name in MODELS if name.startswith("pendulum,")]


@dataclass(frozen=True)
class Floor:
    """Errors of a model, relative to 20 m: (n,) for the walks, (m,) for the ordered pairs."""

    constants: Array
    stature_alone: Array
    calibrated: Array
    even_people: Array


def fit(features: Array, walks: NDArray[np.bool_]) -> Array:
    """Constants (p,) that make the chosen rows of ``features`` (n, p) 20 m, least squares."""
    chosen = features[walks]
    return np.asarray(np.linalg.lstsq(chosen, np.full(len(chosen), TRUE_M), rcond=None)[0])


def floor_of(model: Features, walks: Sequence[Walk], intact: NDArray[np.bool_]) -> Floor:
    """Cross-validated errors of a model; its constants come from intact walks only."""
    features = np.array([model(walk) for walk in walks])
    people = np.array([walk.person for walk in walks])
    alone = np.empty(len(walks))
    for person in np.unique(people):
        own = people == person
        alone[own] = features[own] @ fit(features, ~own & intact) / TRUE_M - 1.0
    odd = people.astype(int) % 2 == 1
    even_people = features[~odd] @ fit(features, odd & intact) / TRUE_M - 1.0
    constants = fit(features, intact)
    lengths = features @ constants
    calibrated = [
        lengths[j] / lengths[i] - 1.0
        for i in range(len(walks))
        for j in range(len(walks))
        if i != j and people[i] == people[j]
    ]
    return Floor(constants, alone, np.array(calibrated), even_people)


# --- what the signal still holds -----------------------------------------------------------------


@dataclass(frozen=True)
class Ceiling:
    """What detectors could find at best in a recording."""

    contacts: int
    dead: int  # contacts with no motion within 0.3 s
    every_bump: int  # contacts that pair with some maximum of the force, one offset a run
    oscillations: replay.StepScore  # each oscillation over IMPACT_M_S2 reported once
    lag_s: Array  # (contacts,) delay of the nearest impact against the run's usual one
    repeated: int  # contacts on the same foot as the one before


def ceiling_of(walk: Walk) -> Ceiling:
    """How many contacts the signal can show."""
    recording = walk.recording
    band = [edge / (RATE_HZ / 2.0) for edge in STEP_BAND_HZ]
    force = sosfiltfilt(butter(2, band, btype="band", output="sos"), walk.vertical_m_s2)
    peaks = 1 + np.flatnonzero((force[1:-1] >= force[:-2]) & (force[1:-1] > force[2:]))
    bumps_s = recording.time_s[peaks[force[peaks] > 0.05]]
    impacts_s = recording.time_s[peaks[force[peaks] > IMPACT_M_S2]]
    contacts = recording.contacts_s
    level = np.sqrt(np.convolve(force**2, np.ones(30) / 30, "same"))
    begin, end = recording.trial_s
    usual = np.median(level[(recording.time_s > begin + 2.0) & (recording.time_s < end - 4.0)])
    dead = 0
    for contact in contacts:
        near = np.abs(recording.time_s - contact) <= 0.3
        dead += not near.any() or level[near].max() < DEAD * usual
    every = max(
        replay.pairs_within(bumps_s + offset, contacts, 0.3)
        for offset in np.arange(-0.5, 0.505, 0.02)
    )
    nearest = impacts_s[np.abs(impacts_s[:, None] - contacts).argmin(axis=0)] - contacts
    usual_lag = np.median(nearest[: min(12, len(nearest))])
    feet = [foot for _, name, foot in recording.events if name == "foot_contact"]
    return Ceiling(
        len(contacts),
        dead,
        every,
        replay.score_steps(recording, impacts_s),
        nearest - usual_lag,
        sum(a == b for a, b in itertools.pairwise(feet)),
    )


def is_intact(walk: Walk, ceiling: Ceiling) -> bool:
    """Whether the contacts keep their delay to the impacts until the end.

    Where the sensor lost samples, the rest of the walk moves to earlier times: over a quarter of
    the contacts on the way back (without the last two, which often show no impact) are displaced.
    """
    back = float(walk.recording.times_of("uturn_end")[0]) + 0.5
    late = ceiling.lag_s[walk.recording.contacts_s > back][:-2]
    return bool(len(late) == 0 or np.mean(np.abs(late) > LAG_S) < 0.25)
