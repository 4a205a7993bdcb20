"""What a wearer does, one activity after another, decided step by step before the torso moves.

A script is a sequence of `Activity`; `SCRIPTS` draws whole scripts by name. `make_itinerary` turns
a script into steps, turns, climbs and changes of posture over time; `motion.move` makes the
torso's motion of it.

Ranges are given beside each activity. Where no literature or recording supports one it is wide
and uniform, and its comment says "open".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from relpos.errors import DataError
from relpos.simulation.wearer import REFERENCE_CADENCE_HZ, REFERENCE_STEP_M, Wearer
from relpos.simulation.world import FloatArray

ACTIVITIES = (
    "stand",
    "walk",
    "turn",
    "side",
    "backward",
    "shuffle",
    "carry",
    "stairs_up",
    "stairs_down",
    "crawl",
    "bend",
    "fall",
    "remount",
)
"""Labels of the truth; the label array holds indices into this."""

FORWARD = ("walk", "shuffle", "carry", "stairs_up", "stairs_down")
"""Activities that follow one another without a stop."""

HIP_OF_STATURE = 0.53


@dataclass(frozen=True, slots=True)
class Activity:
    """One element of a script. What is 0 or None is drawn or does not apply.

    ``walk``, ``shuffle``, ``carry``: ``distance_m`` of way, turning by ``turn_rad`` in all (left
    positive) evenly over it. ``turn``: on the spot by ``turn_rad``. ``side``: ``distance_m``,
    to the left if positive. ``backward``, ``crawl``: ``distance_m``. ``stairs_up``,
    ``stairs_down``: ``count`` steps. ``bend``: ``count`` times. ``stand``: ``seconds``, looking
    about and reaching ``count`` times.
    ``fall``: falls, lies for ``seconds`` and gets up. ``remount``: the sensor is turned on the
    body, standing; where ``distance_m`` is given, it slips while walking that far.
    """

    kind: str
    distance_m: float = 0.0
    turn_rad: float = 0.0
    seconds: float = 0.0
    speed_m_s: float | None = None
    count: int = 0

    def __post_init__(self) -> None:
        if self.kind not in ACTIVITIES:
            raise DataError(f"unknown activity {self.kind!r}; known are {', '.join(ACTIVITIES)}")


@dataclass(slots=True)
class Changes:
    """A quantity that moves from value to value in smooth transitions."""

    begin_s: list[float] = field(default_factory=list)
    last_s: list[float] = field(default_factory=list)
    delta: list[float] = field(default_factory=list)
    final: float = 0.0

    def to(self, value: float, begin_s: float, last_s: float) -> None:
        """Go to ``value`` within ``last_s`` seconds."""
        self.begin_s.append(begin_s)
        self.last_s.append(max(last_s, 1e-3))
        self.delta.append(value - self.final)
        self.final = value

    def at(self, time_s: FloatArray) -> FloatArray:
        """Value (n,): each transition is the quintic with no velocity and force at its ends."""
        out = np.zeros_like(time_s)
        for begin, last, delta in zip(self.begin_s, self.last_s, self.delta, strict=True):
            if delta == 0.0:
                continue
            u = np.clip((time_s - begin) / last, 0.0, 1.0)
            out += delta * (u**3 * (10.0 - 15.0 * u + 6.0 * u**2))
        return out


@dataclass(frozen=True, slots=True)
class Slip:
    """The sensor turns on the body by ``angle_rad`` about ``axis`` (body) and moves."""

    begin_s: float
    last_s: float
    axis: FloatArray
    angle_rad: float
    shift_m: FloatArray


@dataclass(frozen=True, slots=True)
class Impact:
    """A blow to the torso: peak acceleration along world-fixed directions of the body."""

    time_s: float
    up_m_s2: float
    level_m_s2: float
    resonance_hz: float


STEP_FIELDS = ("rise_m", "pace", "surge", "sway", "trunk", "length_m", "shock")
"""Per step: excursion; speed over 1.2 m/s for shocks and trunk; fore-aft fluctuation; scale of
the lateral sway; scale of the trunk's rotations; signed size; scale of the shock."""


@dataclass(slots=True)
class Itinerary:
    """Steps, turns, climbs and postures over time. The phase is whole in double support."""

    knot_time_s: list[float] = field(default_factory=lambda: [-1e3, 0.0])
    knot_phase: list[float] = field(default_factory=lambda: [0.0, 0.0])
    knot_way_m: list[float] = field(default_factory=lambda: [0.0, 0.0])
    knot_turn_rad: list[float] = field(default_factory=lambda: [0.0, 0.0])
    knot_ground_m: list[float] = field(default_factory=lambda: [0.0, 0.0])
    steps: list[tuple[float, ...]] = field(default_factory=list)
    """One row of `STEP_FIELDS` a step."""
    bends: list[tuple[float, float, float]] = field(default_factory=list)
    """Way at which a bend begins, its length and its angle."""
    pitch: Changes = field(default_factory=Changes)
    roll: Changes = field(default_factory=Changes)
    drop: Changes = field(default_factory=Changes)
    """How far the hips are below where they are in standing."""
    offset: Changes = field(default_factory=Changes)
    """Direction of the way from where the body faces."""
    twist: Changes = field(default_factory=Changes)
    """Turns of the body without steps."""
    slide: Changes = field(default_factory=Changes)
    """Way without steps."""
    slips: list[Slip] = field(default_factory=list)
    impacts: list[Impact] = field(default_factory=list)
    intervals: list[tuple[float, float, str]] = field(default_factory=list)
    """Begin, end and label of each activity."""

    @property
    def end_s(self) -> float:
        """When the last activity ends."""
        return self.knot_time_s[-1]


class _Planner:
    def __init__(self, rng: np.random.Generator, wearer: Wearer) -> None:
        self.rng, self.wearer = rng, wearer
        self.time, self.phase, self.way, self.turned, self.ground = 0.0, 0.0, 0.0, 0.0, 0.0
        self.planned_way = 0.0
        self.wander = 0.0
        self.drift = 0.0
        self.walk_effect = math.exp(rng.normal(0.0, wearer.rise_walk_sd))
        # Step length given cadence changes from walk to walk (4.6 % in walk_lowerback_20m).
        self.walk_ratio = wearer.walk_ratio_m_s * math.exp(rng.normal(0.0, 0.045))
        self.since_stand = 0
        self.out = Itinerary()

    # -- elements -----------------------------------------------------------------------------

    def _knot(self) -> None:
        out = self.out
        out.knot_time_s.append(self.time)
        out.knot_phase.append(self.phase)
        out.knot_way_m.append(self.way)
        out.knot_turn_rad.append(self.turned)
        out.knot_ground_m.append(self.ground)

    def stay(self, seconds: float) -> None:
        """No step for so long."""
        self.time += seconds
        self.since_stand = 0
        self._knot()

    def step(
        self,
        length: float,
        duration: float,
        rise: float,
        pace: float,
        *,
        turn: float = 0.0,
        climb: float = 0.0,
        surge: float = 0.1,
        sway: float = 1.0,
        trunk: float = 1.0,
        shock: float = 1.0,
    ) -> None:
        self.time += duration
        self.way += length
        self.turned += turn
        self.ground += climb
        self.phase += 1.0
        self.since_stand += 1
        self.out.steps.append((min(max(rise, 0.0), 0.1), pace, surge, sway, trunk, length, shock))
        self._knot()

    @property
    def foot(self) -> float:
        return 1.0 if int(self.phase) % 2 == 0 else -1.0

    def variation(self, speed: float) -> float:
        """Relative sd of a step's length and duration.

        2 % in brisk walking (Hausdorff 1996), growing as people slow down (Beauchet 2009);
        walk_lowerback_20m has 3 % at 1.2 m/s and 5.6 % at 0.87 in duration, asymmetry included.
        """
        slow = max(0.0, (1.2 - speed) / 0.9)
        return self.wearer.irregularity * (0.02 + 0.06 * slow * math.sqrt(slow))

    def rise(self, length: float, cadence: float) -> float:
        """Excursion of a forward step, with what changes from step to step."""
        w = self.wearer
        self.drift = 0.95 * self.drift + 0.025 * math.sqrt(1 - 0.95**2) * self.rng.standard_normal()
        size = (length / REFERENCE_STEP_M) ** w.rise_by_length
        size *= (cadence / REFERENCE_CADENCE_HZ) ** w.rise_by_cadence
        own = math.exp(self.drift + 0.06 * w.irregularity * self.rng.standard_normal())
        return float(w.rise_m * size * self.walk_effect * own)

    def face(self, offset_rad: float) -> None:
        """Stand for a moment, then go in another direction relative to the body."""
        if self.out.offset.final == offset_rad:
            return
        pause = float(self.rng.uniform(0.7, 1.2))
        self.out.offset.to(offset_rad, self.time + 0.3 * pause, 0.4 * pause)
        self.stay(pause)

    # -- activities ---------------------------------------------------------------------------

    def forward(
        self,
        distance: float,
        turn: float,
        speed: float,
        last: bool,
        *,
        ratio: float = 1.0,
        rise: float = 1.0,
        trunk: float = 1.0,
        shock: float = 1.0,
        surge: float = 1.0,
    ) -> None:
        """Walk ``distance`` turning evenly by ``turn``; ``last`` shortens the last step."""
        rng, w = self.rng, self.wearer
        begin = self.planned_way
        end = begin + distance
        self.planned_way = end
        if turn != 0.0:
            self.out.bends.append((begin, distance, turn))
        bend = abs(turn) / max(distance, 0.1)
        slow = 0.3 * min(bend * 0.6, 1.0)
        while True:
            self.wander = 0.9 * self.wander + 0.04 * math.sqrt(1 - 0.9**2) * rng.standard_normal()
            pace_m_s = speed * (1.0 - slow) * math.exp(self.wander)
            cadence = math.sqrt(pace_m_s / (self.walk_ratio * ratio))
            side = self.foot
            uneven = w.asymmetry + w.limp
            vary = self.variation(pace_m_s)
            length = pace_m_s / cadence * math.exp(vary * rng.standard_normal())
            length *= 1.0 + side * uneven
            duration = math.exp(0.8 * vary * rng.standard_normal()) / cadence
            duration *= 1.0 - side * 0.6 * uneven
            left = end - self.way
            if left < 0.5 * length:
                break
            final = last and left < 1.5 * length
            if final:
                length = left
            if self.since_stand == 0:
                length *= 0.65
                duration *= 1.1
            h = self.rise(max(length, 0.05), cadence) * rise * (1.0 + side * 1.2 * uneven)
            self.step(
                length,
                duration,
                h,
                pace_m_s / 1.2,
                surge=surge * min(w.surge * math.sqrt(1.2 / pace_m_s), 0.5),
                trunk=trunk * (1.0 + w.limp),
                shock=shock * (1.0 + side * uneven),
            )
            if final:
                break

    def walk(self, a: Activity, last: bool) -> None:
        speed = a.speed_m_s if a.speed_m_s is not None else self.wearer.speed_m_s
        self.forward(a.distance_m, a.turn_rad, speed, last)

    def carry(self, a: Activity, last: bool) -> None:
        # Open but for the direction: loads damp the trunk's motion (LaFiandra 2003).
        rng = self.rng
        speed = a.speed_m_s if a.speed_m_s is not None else self.wearer.speed_m_s
        self.out.pitch.to(math.radians(float(rng.uniform(-8.0, 12.0))), self.time, 0.8)
        self.forward(
            a.distance_m,
            a.turn_rad,
            speed * float(rng.uniform(0.75, 1.0)),
            last,
            ratio=float(rng.uniform(0.8, 1.0)),
            rise=float(rng.uniform(0.45, 0.9)),
            trunk=float(rng.uniform(0.2, 0.6)),
            shock=float(rng.uniform(0.6, 1.1)),
            surge=float(rng.uniform(0.6, 1.2)),
        )
        self.out.pitch.to(0.0, self.time, 0.8)

    def shuffle(self, a: Activity, last: bool) -> None:
        # Short steps whose lift has little to do with their length. The slow bouts of
        # walk_daily_lowerback (one person) have steps of 0.2 to 0.4 m in 0.3 to 2.9 s that lift
        # the back by 17 to 29 mm with 0.8 to 1.5 m/s2 rms; feet that slide lift it less (open).
        rng, w = self.rng, self.wearer
        stride = float(rng.uniform(0.08, 0.42))
        cadence = float(rng.uniform(0.9, 2.2))
        lift = float(rng.uniform(0.004, 0.036))
        trunk = float(rng.uniform(0.3, 3.0))
        surge = float(rng.uniform(0.2, 0.9))
        hesitate = float(rng.uniform(0.0, 0.2))
        uneven = float(rng.uniform(0.1, 0.4))
        swerve = float(rng.uniform(0.0, 0.2))
        shock = float(rng.uniform(0.5, 2.5))
        begin = self.planned_way
        end = begin + a.distance_m
        self.planned_way = end
        if a.turn_rad:
            self.out.bends.append((begin, a.distance_m, a.turn_rad))
        while (left := end - self.way) > 0.5 * stride:
            if rng.random() < hesitate:
                self.stay(float(rng.uniform(0.2, 1.5)))
            length = stride * math.exp(uneven * rng.standard_normal())
            length = min(length, left) if last else length
            self.step(
                length,
                math.exp(0.12 * w.irregularity * rng.standard_normal()) / cadence,
                lift * math.exp(0.25 * rng.standard_normal()),
                length * cadence / 1.2,
                turn=swerve * float(rng.standard_normal()),
                shock=shock,
                surge=surge,
                sway=float(rng.uniform(0.6, 1.4)),
                trunk=trunk,
            )

    def turn(self, a: Activity) -> None:
        # Open but for the size of the turns: 25 to 70 degrees a step.
        rng = self.rng
        count = max(2, round(abs(a.turn_rad) / math.radians(float(rng.uniform(25.0, 70.0)))))
        cadence = float(rng.uniform(0.9, 2.2))
        lift = float(rng.uniform(0.003, 0.022))
        creep = float(rng.uniform(0.0, 0.06))
        self.face(float(rng.uniform(-math.pi, math.pi)) if creep > 0.02 else 0.0)
        share = np.exp(0.3 * rng.standard_normal(count))
        share /= share.sum()
        for k in range(count):
            self.step(
                creep * float(rng.uniform(0.0, 1.0)),
                math.exp(0.15 * rng.standard_normal()) / cadence,
                lift * math.exp(0.3 * rng.standard_normal()),
                float(rng.uniform(0.1, 0.35)),
                turn=a.turn_rad * float(share[k]),
                surge=0.3,
                sway=float(rng.uniform(0.5, 1.3)),
                trunk=float(rng.uniform(0.5, 2.0)),
            )
        self.face(0.0)
        self.planned_way = self.way

    def side(self, a: Activity) -> None:
        # Open: one foot steps, the other closes; the trunk goes by fits and starts.
        rng = self.rng
        self.face(math.copysign(math.pi / 2, a.distance_m))
        pair = float(rng.uniform(0.25, 0.6))
        lift = float(rng.uniform(0.004, 0.03))
        cadence = float(rng.uniform(1.0, 2.2))
        lead = float(rng.uniform(0.5, 0.75))
        surge = float(rng.uniform(0.3, 0.9))
        count = max(1, round(abs(a.distance_m) / pair))
        for k in range(2 * count):
            share = lead if k % 2 == 0 else 1.0 - lead
            self.step(
                abs(a.distance_m) / count * share,
                math.exp(0.08 * rng.standard_normal()) / cadence,
                lift * math.exp(0.2 * rng.standard_normal()),
                pair * cadence / 2.4,
                surge=surge,
                sway=float(rng.uniform(0.2, 0.6)),
                trunk=float(rng.uniform(0.4, 1.5)),
            )
        self.face(0.0)
        self.planned_way = self.way

    def backward(self, a: Activity) -> None:
        # Shorter steps at a higher cadence (Winter 1989); how much lift is open.
        rng = self.rng
        self.face(math.pi)
        speed = float(rng.uniform(0.3, 0.9)) if a.speed_m_s is None else a.speed_m_s
        self.planned_way = self.way
        self.forward(
            a.distance_m,
            0.0,
            speed,
            True,
            ratio=float(rng.uniform(0.6, 0.9)),
            rise=float(rng.uniform(0.6, 1.2)),
            shock=float(rng.uniform(0.4, 0.9)),
            surge=float(rng.uniform(0.8, 2.0)),
        )
        self.face(0.0)
        self.planned_way = self.way

    def stairs(self, a: Activity, up: bool) -> None:
        # Riser and tread as built (0.17 m and 0.29 m usual), cadence as Riener, Rabuffetti and
        # Frigo 2002 (0.4 to 0.6 m/s along the tread); the bounce beside the climb is open.
        rng = self.rng
        count = a.count or int(rng.integers(8, 22))
        riser = float(rng.uniform(0.15, 0.20))
        tread = float(rng.uniform(0.25, 0.32))
        cadence = float(rng.uniform(1.1, 1.9) if up else rng.uniform(1.2, 2.1))
        bounce = float(rng.uniform(0.008, 0.045))
        shock = float(rng.uniform(0.4, 0.9) if up else rng.uniform(0.9, 1.8))
        surge = float(rng.uniform(0.1, 0.5))
        lean = rng.uniform(4.0, 16.0) if up else rng.uniform(-3.0, 8.0)
        self.out.pitch.to(math.radians(float(lean)), self.time, 0.8)
        vary = 0.03 * self.wearer.irregularity
        for _ in range(count):
            self.step(
                tread,
                math.exp(vary * rng.standard_normal()) / cadence,
                bounce * math.exp(0.12 * rng.standard_normal()),
                tread * cadence / 1.2 * (1.0 if up else 1.3),
                climb=riser if up else -riser,
                surge=surge,
                shock=shock,
                trunk=1.3,
            )
        self.out.pitch.to(0.0, self.time, 0.8)
        self.planned_way = self.way

    def crawl(self, a: Activity) -> None:
        # On hands and knees: hips a thigh's length (0.245 of stature, Winter) above the floor.
        # Speed, lift and roll are open.
        rng, w = self.rng, self.wearer
        down, up = (float(rng.uniform(1.8, 3.5)) for _ in range(2))
        level = math.radians(float(rng.uniform(70.0, 95.0)))
        drop = (HIP_OF_STATURE - 0.245) * w.stature_m - float(rng.uniform(0.0, 0.06))
        begin = self.time
        self.out.pitch.to(level, begin, down)
        self.out.drop.to(drop, begin + 0.1, down)
        self.stay(down + 0.5)
        stride = float(rng.uniform(0.18, 0.45))
        cadence = float(rng.uniform(0.7, 1.6))
        lift = float(rng.uniform(0.003, 0.02))
        count = max(1, round(a.distance_m / stride))
        for _ in range(count):
            self.step(
                a.distance_m / count * math.exp(0.08 * rng.standard_normal()),
                math.exp(0.08 * rng.standard_normal()) / cadence,
                lift * math.exp(0.25 * rng.standard_normal()),
                stride * cadence / 1.2,
                surge=float(rng.uniform(0.1, 0.6)),
                sway=float(rng.uniform(0.4, 1.0)),
                trunk=float(rng.uniform(2.0, 4.5)),
                shock=float(rng.uniform(0.3, 1.5)),
            )
        self.stay(0.5)
        self.out.pitch.to(0.0, self.time + 0.2, up)
        self.out.drop.to(0.0, self.time, up)
        self.stay(up + 0.6)
        self.planned_way = self.way

    def stand(self, a: Activity) -> None:
        # Looking about and reaching: turns of the trunk and leans over the feet (open).
        rng = self.rng
        end = self.time + (a.seconds or float(rng.uniform(1.5, 5.0)))
        facing = self.out.twist.final
        for _ in range(a.count):
            span = float(rng.uniform(0.5, 1.5))
            if self.time + 2 * span > end:
                break
            aside = math.radians(float(rng.normal(0.0, 25.0)))
            lean = math.radians(float(rng.normal(5.0, 10.0)))
            self.out.twist.to(facing + aside, self.time, span)
            self.out.pitch.to(lean, self.time, span)
            self.stay(span + float(rng.uniform(0.0, 1.0)))
        self.out.twist.to(facing, self.time, 0.8)
        self.out.pitch.to(0.0, self.time, 0.8)
        self.stay(max(end - self.time, 0.9))

    def bend(self, a: Activity) -> None:
        # From a nod at a table to the floor, stooping or squatting (open).
        rng = self.rng
        for _ in range(a.count or 1):
            down, hold, up = rng.uniform((0.7, 0.2, 0.8), (2.0, 3.0, 2.2))
            begin = self.time + 0.2
            self.out.pitch.to(math.radians(float(rng.uniform(25.0, 95.0))), begin, float(down))
            self.out.drop.to(float(rng.uniform(0.02, 0.5)), begin, float(down))
            facing = self.out.twist.final
            aside = math.radians(float(rng.normal(0.0, 15.0)))
            self.out.twist.to(facing + aside, begin, float(down))
            rising = begin + float(down + hold)
            self.out.pitch.to(0.0, rising, float(up))
            self.out.drop.to(0.0, rising, float(up))
            self.out.twist.to(facing, rising, float(up))
            self.stay(0.2 + float(down + hold + up) + float(rng.uniform(0.2, 1.5)))

    def fall(self, a: Activity) -> None:
        # From standing height the trunk is down in 0.6 to 1.1 s (free fall of the hip: 0.45 s);
        # blows of 3 to 10 g at the waist (Kangas 2008), most of them past the chip's range.
        rng, w, out = self.rng, self.wearer, self.out
        side = str(rng.choice(("front", "back", "left", "right")))
        last = float(rng.uniform(0.6, 1.1))
        level = math.radians(float(rng.uniform(70.0, 95.0)))
        # The hips lie as high as the body is deep, or half as wide.
        lying = float(
            rng.uniform(0.13, 0.22) if side in ("front", "back") else rng.uniform(0.2, 0.28)
        )
        hip = HIP_OF_STATURE * w.stature_m - lying
        direction = {"front": 0.0, "back": math.pi, "left": math.pi / 2, "right": -math.pi / 2}
        if out.offset.final != direction[side]:
            out.offset.to(direction[side], self.time, 0.4)
        self.stay(0.6)
        begin = self.time
        if side in ("front", "back"):
            out.pitch.to(level if side == "front" else -level, begin, last)
        else:
            # A roll to the right side lifts the left: positive about the forward axis.
            out.roll.to(level if side == "right" else -level, begin, last)
        out.drop.to(hip, begin, last)
        out.slide.to(out.slide.final + float(rng.uniform(0.2, 0.8)), begin, last)
        out.impacts.append(
            Impact(
                begin + 0.85 * last,
                float(rng.uniform(25.0, 100.0)),
                float(rng.uniform(-30.0, 30.0)),
                float(rng.uniform(4.0, 9.0)),
            )
        )
        self.stay(last + (a.seconds or float(rng.uniform(2.0, 12.0))))
        # Up over hands and knees.
        first, second = (float(rng.uniform(1.2, 3.0)) for _ in range(2))
        out.pitch.to(math.radians(float(rng.uniform(40.0, 80.0))), self.time, first)
        out.roll.to(0.0, self.time, first)
        out.drop.to(0.24 * w.stature_m, self.time, first)
        turn = math.radians(float(rng.normal(0.0, 40.0)))
        out.twist.to(out.twist.final + turn, self.time, first)
        self.stay(first + float(rng.uniform(0.1, 1.5)))
        out.pitch.to(0.0, self.time, second)
        out.drop.to(0.0, self.time, second)
        self.stay(second + float(rng.uniform(0.6, 2.0)))
        self.face(0.0)

    def slip(self, begin: float, last: float, angle_deg: tuple[float, float]) -> None:
        axis = self.rng.standard_normal(3)
        self.out.slips.append(
            Slip(
                begin,
                last,
                axis / np.linalg.norm(axis),
                math.radians(float(self.rng.uniform(*angle_deg))),
                self.rng.normal(0.0, 0.03, 3),
            )
        )

    def remount(self, a: Activity, last: bool) -> None:
        rng = self.rng
        if a.distance_m > 0.0:
            self.slip(self.time + 3.0, float(rng.uniform(0.2, 0.8)), (10.0, 70.0))
            self.walk(a, last)
            return
        self.stay(1.0)
        span = float(rng.uniform(0.6, 2.5))
        self.slip(self.time, span, (20.0, 180.0))
        self.stay(span + (a.seconds or float(rng.uniform(1.0, 5.0))))


def make_itinerary(
    rng: np.random.Generator, wearer: Wearer, script: Sequence[Activity]
) -> Itinerary:
    """Decide every step of ``script`` for ``wearer``."""
    p = _Planner(rng, wearer)
    for k, a in enumerate(script):
        begin = p.time
        following = script[k + 1].kind if k + 1 < len(script) else "stand"
        slips_on = following == "remount" and script[k + 1].distance_m > 0
        last = following not in FORWARD and not slips_on
        if a.kind in FORWARD:
            p.face(0.0)
        if a.kind == "stand":
            if a.count:
                p.stand(a)
            else:
                p.stay(a.seconds or float(rng.uniform(1.5, 5.0)))
        elif a.kind == "walk":
            p.walk(a, last)
        elif a.kind == "carry":
            p.carry(a, last)
        elif a.kind == "shuffle":
            p.shuffle(a, last)
        elif a.kind == "turn":
            p.turn(a)
        elif a.kind == "side":
            p.side(a)
        elif a.kind == "backward":
            p.backward(a)
        elif a.kind in ("stairs_up", "stairs_down"):
            p.stairs(a, a.kind == "stairs_up")
        elif a.kind == "crawl":
            p.crawl(a)
        elif a.kind == "bend":
            p.bend(a)
        elif a.kind == "fall":
            p.fall(a)
        else:
            p.remount(a, last)
        if p.time > begin:
            p.out.intervals.append((begin, p.time, a.kind))
    return p.out


# -- scripts ----------------------------------------------------------------------------------

_RIGHT_ANGLE = math.pi / 2


def _laps(
    rng: np.random.Generator, wearer: Wearer, sides_m: tuple[float, float], total_m: float
) -> list[Activity]:
    """Counter-clockwise laps of a rectangle whose corners are rounded, ``total_m`` of way."""
    bend = wearer.turn_length_m
    # A corner of raised-cosine curvature takes this much off each side that it joins.
    u = np.linspace(0.0, 1.0, 1001)
    profile = u - np.sin(2 * np.pi * u) / (2 * np.pi)
    chord = abs(np.trapezoid(np.exp(1j * _RIGHT_ANGLE * profile), u)) * bend
    tangent = float(chord) / math.sqrt(2.0)
    out, left, side = [], total_m, 0
    while left > 0.5:
        straight = min(sides_m[side % 2] - 2 * tangent, left)
        out.append(Activity("walk", straight))
        left -= straight
        if left > bend:
            out.append(Activity("walk", bend, _RIGHT_ANGLE))
            left -= bend
        side += 1
    return out


def _stand(rng: np.random.Generator) -> Activity:
    return Activity("stand", seconds=float(rng.uniform(4.0, 8.0)))


def _paper310(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    return [Activity("stand", seconds=5.0), *_laps(rng, wearer, (23.0, 13.0), 310.0)]


def _paper310_open(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    """310 m that do not close: corridors of 8 to 40 m, turns left and right."""
    out, left = [Activity("stand", seconds=5.0)], 310.0
    while left > 0.0:
        straight = float(rng.uniform(8.0, 40.0))
        if left - straight < wearer.turn_length_m + 2.0:
            straight = left
        out.append(Activity("walk", straight))
        left -= straight
        if left > 0.0:
            angle = math.radians(float(rng.choice((90.0, 90.0, 45.0, 30.0))) * rng.choice((-1, 1)))
            out.append(Activity("walk", wearer.turn_length_m, float(angle)))
            left -= wearer.turn_length_m
    return out


def _speeds(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    """Straights of 12 m at 0.3 to 1.8 m/s, a turn on the spot between."""
    out = [_stand(rng)]
    for speed in rng.permutation(np.linspace(0.3, 1.8, 7)):
        out.append(Activity("walk", 12.0, speed_m_s=float(speed)))
        out.append(Activity("turn", turn_rad=float(rng.choice((-np.pi, np.pi)))))
    return out


def _bout(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    """A few metres at home: slow, curved, ended by standing or a turn on the spot."""
    length = float(rng.uniform(1.2, 6.0))
    kind = str(rng.choice(("walk", "shuffle", "shuffle")))
    turn = float(rng.normal(0.0, 0.9))
    speed = float(rng.uniform(0.3, 1.0))
    return [Activity(kind, length, turn, speed_m_s=speed)]


def _daily(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    """Some three minutes of slow indoor activity: bouts, turns, side steps, bending, standing."""
    out = [_stand(rng)]
    for _ in range(14):
        kind = str(
            rng.choice(("bout", "turn", "side", "bend", "stand"), p=(0.4, 0.2, 0.1, 0.1, 0.2))
        )
        if kind == "bout":
            out += _bout(rng, wearer)
        elif kind == "turn":
            out.append(Activity("turn", turn_rad=float(rng.uniform(-np.pi, np.pi))))
        elif kind == "side":
            out.append(Activity("side", float(rng.uniform(0.4, 1.5) * rng.choice((-1, 1)))))
        elif kind == "bend":
            out.append(Activity("bend", count=1))
        else:
            seconds, looks = float(rng.uniform(1.0, 12.0)), int(rng.integers(0, 5))
            out.append(Activity("stand", seconds=seconds, count=looks))
    return out


def _mixed(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    """Every activity once, in any order, 8 to 20 m of walking between."""
    out = [_stand(rng)]
    kinds = [k for k in ACTIVITIES if k not in ("stand", "walk")]
    for kind in rng.permutation(kinds):
        out.append(Activity("walk", float(rng.uniform(8.0, 20.0)), float(rng.normal(0.0, 0.5))))
        out += _one(str(kind), rng)
    out.append(Activity("walk", 10.0))
    return out


def _one(kind: str, rng: np.random.Generator) -> list[Activity]:
    """One stretch of an activity, of a usual size."""
    if kind == "turn":
        return [Activity("turn", turn_rad=float(rng.uniform(1.0, 2 * np.pi) * rng.choice((-1, 1))))]
    if kind == "side":
        return [Activity("side", float(rng.uniform(1.5, 4.0) * rng.choice((-1, 1))))]
    if kind in ("stairs_up", "stairs_down"):
        return [Activity(kind, count=int(rng.integers(8, 20)))]
    if kind == "bend":
        return [Activity("bend", count=int(rng.integers(1, 4)))]
    if kind in ("fall", "remount", "stand"):
        return [Activity(kind)]
    return [Activity(kind, float(rng.uniform(3.0, 10.0)))]


def _only(kind: str, repeats: int) -> Callable[[np.random.Generator, Wearer], list[Activity]]:
    """Build a script: stand, walk 15 m, then the activity ``repeats`` times."""

    def script(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
        out = [_stand(rng), Activity("walk", 15.0)]
        for _ in range(repeats):
            out += [*_one(kind, rng), Activity("stand", seconds=float(rng.uniform(1.0, 3.0)))]
        return out

    return script


def _pauses(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    out = [_stand(rng)]
    for _ in range(12):
        out.append(Activity("walk", float(rng.uniform(2.0, 15.0)), float(rng.normal(0.0, 0.4))))
        out.append(Activity("stand", seconds=float(rng.uniform(0.5, 6.0))))
    return out


def _slip(rng: np.random.Generator, wearer: Wearer) -> list[Activity]:
    """The sensor slips while walking, twice."""
    one = [Activity("walk", 20.0), Activity("remount", 20.0)]
    return [_stand(rng), *one, *one, Activity("walk", 20.0)]


SCRIPTS: Mapping[str, Callable[[np.random.Generator, Wearer], list[Activity]]] = {
    "paper310": _paper310,
    "paper310_open": _paper310_open,
    "straight": lambda rng, wearer: [_stand(rng), Activity("walk", 60.0)],
    "speeds": _speeds,
    "daily": _daily,
    "mixed": _mixed,
    "pauses": _pauses,
    "standing": lambda rng, wearer: [Activity("stand", seconds=60.0)],
    "turning": _only("turn", 6),
    "side": _only("side", 5),
    "backward": _only("backward", 4),
    "shuffle": _only("shuffle", 5),
    "carry": _only("carry", 4),
    "stairs_up": _only("stairs_up", 3),
    "stairs_down": _only("stairs_down", 3),
    "crawl": _only("crawl", 3),
    "bend": _only("bend", 4),
    "fall": lambda rng, wearer: [
        _stand(rng),
        Activity("walk", 15.0),
        Activity("fall"),
        Activity("walk", 20.0),
    ],
    "remount": lambda rng, wearer: [
        _stand(rng),
        Activity("walk", 15.0),
        Activity("remount"),
        Activity("walk", 30.0),
    ],
    "slip": _slip,
}
"""Scripts by name; each call draws another one."""
