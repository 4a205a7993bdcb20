"""One wearer out of a wide population, for whom the inertial filter was not made.

`walker.make_person` draws the healthy adults of the team scenarios. This draws from as wide a
range as the literature and the recordings leave open, and says where nothing supports a figure:
such traits are drawn uniformly from a wide range, so that no filter can be tuned to their mean.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from relpos.simulation.torso import rotation
from relpos.simulation.walker import Person
from relpos.simulation.world import FloatArray

PLACES = ("chest", "lower_back", "upper_back", "side")
"""Where on the torso the sensor may sit."""

REFERENCE_STEP_M = 0.59
REFERENCE_CADENCE_HZ = 1.82
"""The mean walk of walk_lowerback_20m, at which `Wearer.excursion_m` holds."""


@dataclass(frozen=True, slots=True)
class Wearer(Person):
    """A `Person` with everything that may differ on the torso. Metres, radians, hertz.

    The vertical excursion of the pelvis in a step of length s at cadence f is
    ``excursion_m (s / 0.59 m)^excursion_by_length (f / 1.82 Hz)^excursion_by_cadence`` rather than
    the pendulum's ``h(s)``: within people of walk_lowerback_20m the regression gives exponents 0.6
    and 1.1 with 5.7 % left over from walk to walk, the pendulum says 2 and 0; each wearer is
    drawn between and a little beyond.
    """

    place: str
    arm_m: tuple[float, float, float]
    """Sensor from the trunk's turning point (between the hips): forward, left, up."""
    axes: tuple[float, ...]
    """Sensor axes in body axes (forward, left, up): nine numbers of a rotation, by rows."""
    excursion_m: float
    excursion_by_length: float
    excursion_by_cadence: float
    excursion_walk_sd: float
    """Relative change of the excursion from one walk of the person to the next."""
    irregularity: float
    """Scale of the step to step variation; 1 is a healthy adult."""
    limp: float
    """Share by which the steps of one side are shorter, quicker and lower; 0 for none."""
    surge: float
    """Fore-aft fluctuation of the speed within a step at 1.2 m/s, as a share of it."""
    pitch_phase_rad: float
    """Decides whether the trunk's pitch adds to the rise before the trunk or takes from it; no
    recording has chest and back at once, so it is wide."""
    jolt_m_s2: float
    """Size of the short jolt at heel strike that holds what is above 12 Hz."""
    jolt_hz: float
    tissue_hz: float
    """Resonance of the soft tissue or the strap that carries the sensor; 0: rigid."""
    tissue_damping: float
    tissue_tilt_rad_m: float
    """How far the sensor tips for every metre that it lags behind the trunk."""
    loose_rad: float
    """Standard deviation of the sensor's slow wander on the body."""

    @property
    def axes_matrix(self) -> FloatArray:
        """``axes`` as (3, 3): columns are the sensor's axes in body axes."""
        return np.array(self.axes).reshape(3, 3)


def random_rotation(rng: np.random.Generator) -> FloatArray:
    """Rotation (3, 3), uniform over all of them: from a uniform unit quaternion."""
    w, x, y, z = (q := rng.standard_normal(4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _arm_m(rng: np.random.Generator, place: str, stature_m: float) -> tuple[float, float, float]:
    # Heights as shares of the stature above the hips (0.53): breastbone 0.72 to 0.76, fifth
    # lumbar vertebra 0.58 to 0.61 (Winter's segments); depth and width of a trunk in clothes.
    if place == "chest":
        return (
            float(rng.uniform(0.07, 0.14)),
            float(rng.uniform(-0.08, 0.08)),
            stature_m * float(rng.uniform(0.16, 0.23)),
        )
    if place == "lower_back":
        return (
            float(rng.uniform(-0.13, -0.07)),
            float(rng.uniform(-0.03, 0.03)),
            stature_m * float(rng.uniform(0.03, 0.09)),
        )
    if place == "upper_back":
        return (
            float(rng.uniform(-0.16, -0.09)),
            float(rng.uniform(-0.06, 0.06)),
            stature_m * float(rng.uniform(0.16, 0.25)),
        )
    side = float(rng.choice((-1.0, 1.0)))
    return (
        float(rng.uniform(-0.05, 0.08)),
        side * float(rng.uniform(0.12, 0.19)),
        stature_m * float(rng.uniform(0.03, 0.20)),
    )


def _axes(rng: np.random.Generator, place: str) -> FloatArray:
    """Half of all: x up, y left, z backward, turned with the place; the others in any way."""
    if rng.random() < 0.5:
        return random_rotation(rng)
    ideal = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    facing = {"chest": 0.0, "lower_back": math.pi, "upper_back": math.pi, "side": math.pi / 2}
    roll, pitch, yaw = np.radians(rng.normal(0.0, (5.0, 8.0, 10.0)))
    if place in ("chest", "upper_back"):
        pitch -= math.radians(8.0)
    turn = (np.array([roll]), np.array([pitch]), np.array([facing[place] + yaw]))
    return np.asarray(rotation(*turn)[0] @ ideal, dtype=np.float64)


def make_wearer(
    rng: np.random.Generator,
    *,
    speed_m_s: float | None = None,
    place: str | None = None,
    rigid: bool | None = None,
    limping: bool | None = None,
) -> Wearer:
    """Draw a wearer; what is given is held.

    Supported: stature (mean 1.70, sd 0.10 over women and men), leg 0.53 of it (Winter). Walk
    ratio (0.34 m/Hz, 11 % between people), excursion (34.5 mm of the hips at the reference step,
    7.5 %) and their changes from walk to walk were set so that sensors on the lower back show
    what walk_lowerback_20m shows: errors of a constant step, of one gain and of a gain a person
    (docs/gait.md). Without support, hence wide: irregularity, limp, surge, phase of the pitch,
    soft tissue, strap, trunk oscillation.
    """
    stature = float(np.clip(rng.normal(1.70, 0.10), 1.45, 2.05))
    leg = 0.53 * stature * float(np.clip(rng.normal(1.0, 0.03), 0.92, 1.08))
    where = str(rng.choice(PLACES, p=(0.4, 0.3, 0.1, 0.2)))
    where = where if place is None else place
    # One in eight limps unless ``limping`` is given.
    limps = (rng.random() < 0.125) if limping is None else limping
    limp = float(rng.uniform(0.1, 0.35)) if limps else 0.0
    carrier = rng.random()
    firm = (carrier < 0.3) if rigid is None else rigid
    loose = not firm and carrier > 0.8
    by_length = float(rng.uniform(0.5, 2.0))
    speed = float(rng.uniform(0.3, 1.8))
    arm = _arm_m(rng, where, stature)
    return Wearer(
        stature_m=stature,
        leg_length_m=leg,
        sensor_height_m=0.53 * stature + arm[2],
        speed_m_s=speed if speed_m_s is None else speed_m_s,
        walk_ratio_m_s=0.34 * stature / 1.70 * math.exp(rng.normal(0.0, 0.11)),
        pendulum_gain=math.nan,
        turn_length_m=float(rng.uniform(0.8, 2.6)),
        asymmetry=float(rng.normal(0.0, 0.03)),
        lateral_scale=math.exp(rng.normal(0.0, 0.25)),
        sway_scale=math.exp(rng.normal(0.0, 0.35)),
        impact_scale=math.exp(rng.normal(0.0, 0.35)),
        roll_rad=math.radians(1.8) * math.exp(rng.normal(0.0, 0.4)),
        pitch_rad=math.radians(1.3) * math.exp(rng.normal(0.0, 0.4)),
        yaw_rad=math.radians(2.5) * math.exp(rng.normal(0.0, 0.45)),
        lean_rad=math.radians(float(rng.normal(3.0, 3.0))),
        mount_rad=(0.0, 0.0, 0.0),
        place=where,
        arm_m=arm,
        axes=tuple(float(a) for a in _axes(rng, where).ravel()),
        excursion_m=0.0345 * math.exp(rng.normal(0.0, 0.075)),
        excursion_by_length=by_length,
        # Orendurff 2004: 27 mm at 0.7 m/s, 48 at 1.6: 1.4 in all at a constant walk ratio;
        # within people of walk_lowerback_20m 1.7.
        excursion_by_cadence=float(rng.uniform(1.1, 2.0)) - by_length,
        excursion_walk_sd=0.06,
        irregularity=float(rng.uniform(0.7, 2.0)),
        limp=limp,
        surge=float(rng.uniform(0.06, 0.16)),
        pitch_phase_rad=float(rng.normal(0.0, 1.0)),
        # Recorded: 6 to 8 % of the vertical rms above 15 Hz on chests, 9 to 42 % on backs.
        jolt_m_s2=float(rng.uniform(0.5, 12.0)) * (1.0 if where in ("lower_back", "side") else 0.4),
        jolt_hz=float(rng.uniform(6.0, 18.0)),
        tissue_hz=0.0 if firm else float(rng.uniform(3.5, 7.0) if loose else rng.uniform(7.0, 16)),
        tissue_damping=float(rng.uniform(0.15, 0.35) if loose else rng.uniform(0.25, 0.6)),
        tissue_tilt_rad_m=float(rng.uniform(2.0, 12.0) if loose else rng.uniform(0.0, 4.0)),
        loose_rad=math.radians(float(rng.uniform(1.5, 6.0) if loose else rng.uniform(0.0, 1.0))),
    )
