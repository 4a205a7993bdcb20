"""Who walks, where along, and with which steps: everything decided before the torso moves."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import scipy

from relpos.errors import DataError
from relpos.simulation.world import FloatArray

RATE_HZ = 200.0


@dataclass(frozen=True, slots=True)
class Person:
    """Body and habits of one wearer. Lengths in metres, angles in radians.

    ``walk_ratio_m_s`` is step length over step frequency, which people keep nearly constant over
    speed (Sekiya and Nagasaki 1998: 0.0065 m per step/min, which is 0.39; walk_lowerback_20m:
    0.33). ``pendulum_gain`` is the factor by which the plain pendulum of the leg falls short of
    this person's step length (Zijlstra and Hof 1997: 1.25; from the sensor's own rise it is 1.14
    give or take 0.08 in walk_lowerback_20m, where arm and shock add to the rise). ``speed_m_s``
    is the mean speed on the route, corners included, pauses not.
    """

    stature_m: float
    leg_length_m: float
    sensor_height_m: float
    speed_m_s: float
    walk_ratio_m_s: float
    pendulum_gain: float
    turn_length_m: float
    asymmetry: float
    lateral_scale: float
    sway_scale: float
    impact_scale: float
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    lean_rad: float
    mount_rad: tuple[float, float, float]
    """Mounting error about the body's forward, left and up axis."""


def make_person(
    rng: np.random.Generator, speed_range_m_s: tuple[float, float], mount_sd_rad: float
) -> Person:
    """Draw an adult. Leg length is 0.53 of stature (Winter) give or take 2.5 %."""
    stature = float(np.clip(rng.normal(1.72, 0.09), 1.50, 2.00))
    return Person(
        stature_m=stature,
        leg_length_m=0.53 * stature * float(np.clip(rng.normal(1.0, 0.025), 0.94, 1.06)),
        sensor_height_m=0.73 * stature,
        speed_m_s=float(rng.uniform(*speed_range_m_s)),
        walk_ratio_m_s=0.36 * stature / 1.72 * math.exp(rng.normal(0.0, 0.08)),
        pendulum_gain=float(np.clip(rng.normal(1.22, 0.07), 1.0, 1.45)),
        turn_length_m=float(rng.uniform(1.2, 2.4)),
        asymmetry=float(rng.normal(0.0, 0.03)),
        lateral_scale=math.exp(rng.normal(0.0, 0.15)),
        sway_scale=math.exp(rng.normal(0.0, 0.25)),
        impact_scale=math.exp(rng.normal(0.0, 0.2)),
        roll_rad=math.radians(1.5) * math.exp(rng.normal(0.0, 0.25)),
        pitch_rad=math.radians(1.3) * math.exp(rng.normal(0.0, 0.25)),
        yaw_rad=math.radians(2.0) * math.exp(rng.normal(0.0, 0.3)),
        lean_rad=math.radians(float(rng.normal(3.0, 1.5))),
        mount_rad=(
            float(rng.normal(0.0, mount_sd_rad)),
            # A sensor on the breastbone leans back with the chest's slope.
            float(rng.normal(-math.radians(8.0), mount_sd_rad)),
            float(rng.normal(0.0, mount_sd_rad)),
        ),
    )


@dataclass(frozen=True, slots=True)
class StepTruth:
    """Mid-stance times (k,) and the path length since the previous mid-stance (k,), in metres.

    The first step after standing counts from where the person stood, so the lengths up to a
    mid-stance sum to the path length walked until then.
    """

    time_s: FloatArray
    length_m: FloatArray


@dataclass(frozen=True, slots=True)
class Flight:
    """When somebody climbs stairs by so many storeys, below 0 down."""

    begin_s: float
    end_s: float
    storeys: int


@dataclass(frozen=True, slots=True)
class WalkerTruth:
    """Physical truth of one wearer at 200 Hz, noise-free; what the emulated chips sample.

    World frame z up, origin at the start corner on the floor. ``position_m`` is the sensor's and
    the tag's, ``heading_rad`` the torso's yaw, unwrapped. Specific force, angular rate and
    magnetic field are in the sensor's axes: x up, y left, z backward but for the mounting error;
    ``attitude`` (n, 3, 3) turns sensor axes into world axes.
    """

    node: int
    person: Person
    time_s: FloatArray
    position_m: FloatArray
    velocity_m_s: FloatArray
    heading_rad: FloatArray
    attitude: FloatArray
    specific_force_m_s2: FloatArray
    angular_rate_rad_s: FloatArray
    magnetic_field_ut: FloatArray
    pressure_pa: FloatArray
    steps: StepTruth
    walk_start_s: float
    flights: tuple[Flight, ...] = field(default=(), kw_only=True)

    def position_at(self, time_s: float) -> FloatArray:
        """Position (3,) at any time, held at the ends: exact to 0.1 mm between samples."""
        place = min(max(time_s * RATE_HZ, 0.0), len(self.time_s) - 1.0)
        low = min(int(place), len(self.time_s) - 2)
        fraction = place - low
        between = (1.0 - fraction) * self.position_m[low] + fraction * self.position_m[low + 1]
        return np.asarray(between, dtype=np.float64)


class Route:
    """A closed polygon walked for ever from its first corner, its corners rounded.

    In a corner the curvature rises and falls as a raised cosine over ``turn_length_m`` of path,
    so heading, turn rate and its rate are all smooth. The first corner is only rounded from the
    second lap on: the walk starts in it.
    """

    def __init__(self, corners_m: FloatArray, turn_length_m: float) -> None:
        sides = np.roll(corners_m, -1, axis=0) - corners_m
        side_m = np.hypot(sides[:, 0], sides[:, 1])
        direction = np.arctan2(sides[:, 1], sides[:, 0])
        turn = (np.roll(direction, -1) - direction + np.pi) % (2 * np.pi) - np.pi  # at k + 1
        if np.any(np.abs(turn) > np.radians(150)):
            raise DataError("a route's corner turns by more than 150 degrees")
        grid = np.linspace(0.0, 1.0, 2001)
        profile = grid - np.sin(2 * np.pi * grid) / (2 * np.pi)
        # Length of the tangent from the corner's point to where the rounding begins.
        chord = np.array(
            [abs(np.trapezoid(np.exp(1j * a * profile), grid)) * turn_length_m for a in turn]
        )
        tangent = chord / (2 * np.cos(turn / 2))  # of corner k + 1
        before = np.roll(tangent, 1)  # of corner k
        straight = side_m - tangent - before
        if np.any(straight <= 0.1):
            raise DataError("a route's sides are too short for the path that its corners need")
        starts = np.cumsum(straight + turn_length_m) - turn_length_m
        self._initial_m = float(before[0])
        self.lap_m = float(starts[-1] + turn_length_m)
        self.turn_rad = float(turn.sum())
        self._direction = float(direction[0])
        self._origin = corners_m[0]
        s = np.linspace(0.0, self.lap_m, math.ceil(self.lap_m / 0.01) + 1)
        heading = np.full_like(s, direction[0])
        bend = np.zeros_like(s)
        for begin, angle in zip(starts, turn, strict=True):
            u = np.clip((s - begin) / turn_length_m, 0.0, 1.0)
            heading += angle * (u - np.sin(2 * np.pi * u) / (2 * np.pi))
            bend += abs(angle) / turn_length_m * (1 - np.cos(2 * np.pi * u))
        first = corners_m[0] + self._initial_m * np.array(
            [math.cos(direction[0]), math.sin(direction[0])]
        )
        spline = scipy.interpolate.CubicSpline(s, heading)
        # Three-point Gauss between the nodes: exact far below the strapdown test's bound.
        mid, half = (s[1:] + s[:-1]) / 2, (s[1:] - s[:-1]) / 2
        integral = np.zeros(len(s) - 1, dtype=np.complex128)
        for node, weight in ((-math.sqrt(0.6), 5 / 9), (0.0, 8 / 9), (math.sqrt(0.6), 5 / 9)):
            integral += weight * half * np.exp(1j * spline(mid + node * half))
        place = np.concatenate([[0.0], np.cumsum(integral)])
        self._table = scipy.interpolate.CubicSpline(
            s, np.column_stack([first[0] + place.real, first[1] + place.imag, heading])
        )
        self._s, self._bend = s, bend

    def at(self, path_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Position (n, 2) and unwrapped heading (n,) after ``path_m`` of path from the start."""
        lap = np.maximum(np.floor((path_m - self._initial_m) / self.lap_m), 0.0)
        in_lap = path_m - self._initial_m - lap * self.lap_m
        table = np.asarray(self._table(np.maximum(in_lap, 0.0)), dtype=np.float64)
        first = np.minimum(in_lap, 0.0)
        position = table[:, :2] + first[:, None] * np.array(
            [math.cos(self._direction), math.sin(self._direction)]
        )
        return position, table[:, 2] + lap * self.turn_rad

    def curvature(self, path_m: float) -> float:
        """Absolute curvature in 1/m after ``path_m`` of path."""
        if path_m < self._initial_m:
            return 0.0
        return float(np.interp((path_m - self._initial_m) % self.lap_m, self._s, self._bend))


@dataclass(frozen=True, slots=True)
class Plan:
    """Steps as decided: knots of step phase, path length and ground over time.

    The phase grows by one a step and is an integer in the middle of double support; between knots
    all go on steadily, standing where none changes.
    """

    knot_time_s: FloatArray
    knot_phase: FloatArray
    knot_path_m: FloatArray
    step_strength: FloatArray
    """Vertical excursion of each step against what its length asks, about 1."""
    walk_start_s: float
    knot_ground_m: FloatArray
    """Height of the feet."""
    flights: tuple[Flight, ...] = ()


@dataclass(frozen=True, slots=True)
class RouteStairs:
    """Flights on a route, one storey each: up until the top floor, then down, and so on."""

    begins_m: tuple[float, ...]
    """Path lengths in the first lap at which they begin."""
    lap_m: float
    storeys: int
    storey_m: float
    risers: int
    tread_m: float

    def begin_m(self, count: int) -> float:
        """Path length at which the flight after ``count`` others begins."""
        laps, place = divmod(count, len(self.begins_m))
        return self.begins_m[place] + laps * self.lap_m

    def direction(self, count: int) -> int:
        """Whether that leads up or down."""
        top = self.storeys - 1
        return 1 if count % (2 * top) < top else -1


def make_plan(
    rng: np.random.Generator,
    person: Person,
    route: Route,
    walk_start_s: float,
    until_s: float,
    pause_every_s: float,
    distance_limit_m: float | None,
    stairs: RouteStairs | None = None,
) -> Plan:
    """Decide every step until ``until_s``.

    Speed wanders by 4 % over some ten steps and falls in bends; length and duration of a step
    vary by 2.5 % and 2 % beyond that (Hausdorff 1996 and many since: 2 to 4 % in the healthy).
    Gait starts and stops with a shortened step.
    """
    slow = 1.0 - 0.25 * np.minimum(route._bend * 0.7, 1.0)
    # Mean speed on a lap is what the person chose: the straights make up for the bends.
    straight_speed = person.speed_m_s * float(np.mean(1.0 / slow))
    time_s, phase, path, ground, wander = walk_start_s, 0.0, 0.0, 0.0, 0.0
    knots = [(-1e3, phase, path, ground), (time_s, phase, path, ground)]
    flights: list[Flight] = []
    strength: list[float] = []
    since_stand = 0

    def next_pause() -> float:
        if pause_every_s <= 0:
            return math.inf
        return time_s + 8.0 + float(rng.exponential(pause_every_s))

    pause_at = next_pause()
    while time_s < until_s:
        pausing = time_s >= pause_at
        finished = distance_limit_m is not None and path >= distance_limit_m
        if (pausing or finished) and since_stand > 0:
            time_s += 1e6 if finished else float(rng.uniform(1.5, 5.0))
            knots.append((time_s, phase, path, ground))
            pause_at = next_pause()
            since_stand = 0
            continue
        if stairs is not None and path >= stairs.begin_m(len(flights)):
            up = stairs.direction(len(flights))
            lasts_s, lift = _climb(rng, person, stairs)
            flights.append(Flight(time_s, time_s + float(lasts_s.sum()), up))
            for each_s in lasts_s.tolist():
                time_s, path, phase = time_s + each_s, path + stairs.tread_m, phase + 1.0
                ground += up * stairs.storey_m / stairs.risers
                knots.append((time_s, phase, path, ground))
            strength += [lift] * stairs.risers
            continue
        wander = 0.9 * wander + 0.04 * math.sqrt(1 - 0.9**2) * rng.standard_normal()
        bend = 0.25 * min(route.curvature(path + 0.3) * 0.7, 1.0)
        speed = straight_speed * (1.0 - bend) * math.exp(wander)
        cadence = math.sqrt(speed / person.walk_ratio_m_s)
        side = 1.0 if int(phase) % 2 == 0 else -1.0
        length = speed / cadence * math.exp(0.025 * rng.standard_normal())
        length *= 1.0 + side * person.asymmetry
        duration = math.exp(0.02 * rng.standard_normal()) / cadence
        duration *= 1.0 - side * 0.5 * person.asymmetry
        last = pausing or time_s + 1.5 * duration >= pause_at
        if since_stand == 0 or last:
            length *= 0.65
            duration *= 1.1
        time_s += duration
        path += length
        phase += 1.0
        since_stand += 1
        knots.append((time_s, phase, path, ground))
        strength.append(
            (1.0 + side * 2.0 * person.asymmetry) * math.exp(0.06 * rng.standard_normal())
        )
    times, phases, paths, grounds = np.array(knots).T
    return Plan(times, phases, paths, np.array(strength), walk_start_s, grounds, tuple(flights))


def _climb(
    rng: np.random.Generator, person: Person, stairs: RouteStairs
) -> tuple[FloatArray, float]:
    """Durations (k,) of a flight's steps, and their excursion against what their length asks.

    Cadence as Riener, Rabuffetti and Frigo 2002; the bounce beside the climb is open.
    """
    cadence, bounce_m = rng.uniform(1.1, 1.9), rng.uniform(0.008, 0.045)
    half = stairs.tread_m / (2.0 * person.pendulum_gain)
    asked_m = person.leg_length_m - math.sqrt(person.leg_length_m**2 - half**2)
    lasts_s = np.exp(0.03 * rng.standard_normal(stairs.risers)) / cadence
    return lasts_s, float(bounce_m / asked_m)
