#include "dead_reckoning.h"
#include "inertial/calls.h"

#include <math.h>
#include <string.h>

#if defined(__AVR__)
#include <avr/pgmspace.h>
#else
#define PROGMEM
#define memcpy_P memcpy
#endif

namespace relpos {
namespace {

const float kDefaults[] PROGMEM = {
    0.93f,          // 0.53 of the stature (Zijlstra and Hof 1997); here of 1.75 m
    2.14f,          // all people of docs/walkers.md
    kPopulationScale,
    39.0f,          // just under 4 g
    17.4f,          // just under 1000 deg/s
    kPi / 180.0f,   // 1 deg/s: what a warmed-up, once zeroed MPU-9150 keeps
};

const float kDegree = kPi / 180.0f;
const float kStandardGravity_m_s2 = 9.80665f;
const float kTicks_s = 50.0f;

// Start.
const float kStillStart_s = 10.0f;    // at most; a step ends it before
const float kShortStill_s = 0.5f;     // enough for the tilt; the bias then to 0.1 deg/s
const float kMovingStart_s = 1.0f;    // about two steps, over which horizontal force averages out
const float kTiltStill_rad = 1.0f * kDegree;
const float kTiltMoving_rad = 6.0f * kDegree;  // half a step's braking left in the average
// What a mean rate says of the bias: a body that stands turns to and fro by 1.2 degrees, whatever the
// time; one that gets ready spreads its rates, of which a quarter is left in the mean of an axis.
const float kSway_rad = 1.7f * kDegree;
const float kSwayShare = 0.25f;
// Prior of a start at rest, where the bias can be measured: a new chip may be off by twice what is
// configured (its data sheet says 20 deg/s). Not of a start while walking.
const float kStandingPrior = 4.0f;
const float kSpeedUnknown_m_s = 1.0f;
const float kSpeedFound_m_s = 0.3f;   // step length over interval, at mid-stance

// Quiet: change of the force's magnitude and rate of turn that breathing and sway stay under.
const float kQuietForce_m_s2 = 0.35f;
const float kQuietRate_rad_s = 0.2f;
const float kQuiet_s = 0.3f;
const float kForceMean_s = 0.5f;
const float kGravityTime_s = 10.0f;   // long against a step, short against warm-up

// Measurements.
const float kStepSigma = 0.08f;       // random part of the pendulum's length, relative
const float kStepSigma_m = 0.02f;
const float kFirstStep = 0.6f;        // a walk's first step, from both feet to over one of them
const float kOddStepSigma = 0.3f;     // that one, and what the walk ratio shortened
const float kTurnSigma_m = 0.2f;      // of a step on the spot
// Longest step for its time, length times duration: people walk at 0.30 to 0.42 m s at any speed
// (walk ratio; Sekiya and Nagasaki 1998). A long slow arc is bending, lifting or shuffling.
const float kWalkRatio_m_s = 0.45f;
const float kLongStep = 1.3f;         // times that: a step that asks for more is flagged
const float kIrregular = 0.35f;       // share left by turning under which a step is flagged
// A limp: rises of left and right differ by this share of their sum, over the last ten steps. Who vaults
// over one leg or hikes a hip rises more than the legs' arcs do (walk_treadmill_stroke_lumbar; 0.05 in
// healthy people), so that its steps are shorter by kLimpShare times the limp.
const float kLimp = 0.1f;
const float kLimpGain = 0.1f;
const float kLimpShare = 1.0f;
// Stairs: a step that ends so much higher or lower; more is a lost vertical. Its length is that of
// comfortable stairs, two rises and one tread 0.63 m (Blondel 1675). From 0.05 m on level walks are hit.
const float kClimb_m = 0.08f, kHighest_m = 0.22f;
const float kBlondel_m = 0.63f;
// Relative scale error of flagged steps: shuffling, turning on the spot, steps aside and lifting look
// alike on the torso (docs/walkers.md: walks under 0.6 m/s).
const float kIrregularScale = 0.25f;
const float kLateralSigma_m = 0.06f;  // the torso sways 2 to 4 cm and feet are placed as wide
const float kVerticalSigma_m = 0.02f; // level floor: mid-stance heights repeat within 1 to 2 cm
const float kLost = 0.5f;             // of the pendulum's length: the inertial motion ran away
const float kTiltLost_rad = 2.0f * kDegree;  // added then: only a wrong tilt does that
const float kDoubt = 3.0f;            // sigmas beyond which a step is weighed down
// Straight walking: over eight steps, left and right swings cancel, the heading of a straight walk
// changes by 3 degrees (walk_lowerback_20m). One measurement, not eight: taken step by step slow
// curves were learned as bias (70 deg/min on walk_handheld_waypoints).
// A turn in the two steps behind it or the two before it spoils a stretch: it may have begun inside.
const uint8_t kStraightFrom = 3, kStraightTo = kStraightFrom + 8, kStraightSure = kStraightTo + 2;
const float kStraight_rad = 12.0f * kDegree;    // two steps that turn more are a turn
const float kStraightGate = 9.0f;               // innovation squared over its variance
const float kStraightSigma_rad_s = 0.6f * kDegree;
const float kSettled_s = 1.0f, kStill_s = 5.0f;  // standing, of which 5 s make a measurement
// Standing is certain: what contradicts the bias makes it doubtful, by this share of the square (1/16
// and 1/64 find a bias of 2 deg/s as well). Else one that moved with temperature is never found again.
const float kStoodDoubt = 1.0f / 32;
const float kStillSigma_m_s = 0.1f;   // sway of 2 cm/s that stays the same over several updates
const float kLooseSigma_m_s = 0.5f;   // moving without steps: shuffling, bending
const float kLooseNoise_m2_s = 0.05f;  // 0.2 m in a second may go unseen without a step
// Every fifth tick; no visible loss. Every sixth, 0.8 % of a tick cheaper, the slow bouts of
// walk_daily_lowerback err by 25.0 % each instead of 22.0.
const float kPredict_s = 0.09f;

// Magnetometer. Indoors the direction is off by 9 degrees in the middle of 70 walks and 15 in a tenth
// of them (walk_handheld_waypoints against its good gyroscopes), much the same for three seconds: one
// reading every five steps counts, none while standing. The reference is the direction met so far;
// it is learned while the heading is known better and corrects the heading when that has drifted.
const float kFieldLeast_ut = 20.0f, kFieldMost_ut = 75.0f;  // the Earth's: 22 to 67
const float kFieldNorm = 0.12f, kFieldVertical = 0.10f;     // of the norm
const float kFieldSigma_rad = 12.0f * kDegree;
const float kFieldShare = 0.02f;      // norm and vertical part follow within 10 s
const uint8_t kFieldReadings = 10;    // two seconds make the first reference
const uint8_t kFieldSteps = 5;

// The sensor on the body. An axis that leans so far (sine) shows no heading; and a forward axis that
// stays elsewhere for so many steps, once it had settled, is a sensor that was turned on the body.
const float kSteep = 0.5f;
const float kBent_s = 5.0f;  // longer is no bending
const uint8_t kSettledSteps = 10, kDoubtedSteps = 8, kTurnedSteps = 22;
const float kTurned_rad = 35.0f * kDegree;

// Of the measurements, by what is measured.
enum Sigma : uint8_t {
  kOfLateral, kOfVertical, kOfStraight, kOfStood, kOfField, kOfStill, kOfLoose,
  kOfStep  // a step's own
};
const float kSigmas[] PROGMEM = {
    kLateralSigma_m,  kVerticalSigma_m, kStraightSigma_rad_s, kSway_rad / kStill_s,
    kFieldSigma_rad,  kStillSigma_m_s,  kLooseSigma_m_s,
};

const uint8_t kHoldTicks = 100;       // two seconds: a flag is seen by a report a second

void count(uint16_t* counter) {
  if (*counter < 65535u) ++*counter;
}

void clear(float vector[kAxes]) { memset(vector, 0, kAxes * sizeof *vector); }

}  // namespace

InertialConfig::InertialConfig() {
  static_assert(sizeof kDefaults == sizeof *this, "one default a member");
  memcpy_P(static_cast<void*>(this), kDefaults, sizeof kDefaults);
}

DeadReckoning::DeadReckoning() : bias_rad_s_() { reset(); }

void DeadReckoning::reset() {
  // All but what is known of the wearer and the sensor starts at zero, cleared as one block: member by
  // member it would be a kilobyte of the Uno's flash. Every member is a number, an enum or an array of
  // such. The configuration and the bias are the first members and stay.
  static_assert(__is_standard_layout(DeadReckoning), "the configuration is at its start");
  const size_t kept = sizeof config_ + sizeof bias_rad_s_;
  memset(reinterpret_cast<uint8_t*>(this) + kept, 0, sizeof *this - kept);
  displacement_.quality_flags = kForwardUnknown;
  filter_.reset(kTiltMoving_rad * kTiltMoving_rad,
                config_.gyro_bias_sigma_rad_s * config_.gyro_bias_sigma_rad_s,
                kSpeedUnknown_m_s * kSpeedUnknown_m_s);
  gait_.reset();
  forward_.reset();
  attitude_.set_identity();
  gravity_m_s2_ = kStandardGravity_m_s2;
  step_heading_[kX] = 1.0f;
}

RELPOS_APART bool DeadReckoning::refuse(const ImuSample& sample, float dt_s) {
  bool saturated = false;
  float sum = dt_s;  // of numbers not negative: finite if they all are
  for (uint8_t i = 0; i < kAxes; ++i) {
    const float force = fabsf(sample.acceleration_m_s2[i]);
    const float rate = fabsf(sample.angular_rate_rad_s[i]);
    sum += force + rate;
    if (force > config_.acceleration_limit_m_s2) {
      hold_[kHoldAcceleration] = kHoldTicks;
      saturated = true;
    }
    if (rate > config_.angular_rate_limit_rad_s) {
      hold_[kHoldRate] = kHoldTicks;
      saturated = true;
    }
  }
  if (saturated) count(&counters_.saturated_samples);
  if (isfinite(sum) && dt_s > 0.0f && dt_s <= 0.2f) return false;
  count(&counters_.refused_samples);
  hold_[kHoldInput] = kHoldTicks;
  return true;
}

void DeadReckoning::watch_quiet(float force, const float angle[kAxes], float dt_s) {
  if (ticks_ == 1) mean_force_m_s2_ = force;
  follow(&mean_force_m_s2_, force, dt_s * (1.0f / kForceMean_s));
  const float most_rad = kQuietRate_rad_s * dt_s;
  if (fabsf(force - mean_force_m_s2_) >= kQuietForce_m_s2 ||
      dot(angle, angle) >= most_rad * most_rad) {
    quiet_s_ = 0.0f;
  } else {
    add(&quiet_s_, dt_s);
  }
}

// Start: the attitude of the first sample is found from the mean force while the gyroscope already
// carries the frame along, so that walking directly after switching on loses nothing.
void DeadReckoning::gather(const ImuSample& sample, const float force[kAxes], float dt_s) {
  if (quiet_s_ == 0.0f) {
    // Movement after a quiet beginning ends the gathering before it spoils the mean.
    if (!moved_ && since_.time_s >= kShortStill_s) {
      initialise(true);
      return;
    }
    moved_ = true;
  }
  add(&since_.time_s, dt_s);
  ++step_ticks_;
  add_scaled(velocity_m_s_, force, 1.0f, kAxes);
  add_scaled(position_m_, sample.angular_rate_rad_s, 1.0f, kAxes);
  add(since_.impulse_m_s, dot(sample.angular_rate_rad_s, sample.angular_rate_rad_s));
  if (since_.time_s >= (moved_ ? kMovingStart_s : kStillStart_s)) initialise(!moved_);
}

RELPOS_APART void DeadReckoning::initialise(bool still) {
  const float share = 1.0f / step_ticks_;
  float variance = filter_.covariance(kBias, kBias);  // as reset() set it
  if (still) {
    gravity_m_s2_ = norm(velocity_m_s_) * share;
    // The mean rate is bias and what the body turned meanwhile. The spread shows how much:
    // 0.03 deg/s on a table, 0.8 standing quietly, 2 to 3 while getting ready, when the mean
    // was wrong by 1 to 2 deg/s (walk_chest) and turned the whole walk.
    const float noise =
        kSway_rad * kSway_rad / (since_.time_s * since_.time_s) +
        (since_.impulse_m_s[kX] - dot(position_m_, position_m_) * share) * share * kSwayShare;
    variance *= kStandingPrior;
    const float weight = variance / (variance + noise);
    // From what was known of the bias, nothing at first, towards the mean.
    add_scaled(bias_rad_s_, bias_rad_s_, -weight, kAxes);
    add_scaled(bias_rad_s_, position_m_, share * weight, kAxes);
    variance = noise * weight;
  }
  Attitude level;
  level.level(velocity_m_s_);
  level.matrix(rotation_);
  memcpy(heading_axis_, rotation_, sizeof heading_axis_);
  if (still) attitude_.set_identity();  // the turning gathered meanwhile was bias
  attitude_.premultiply(level);
  clear(velocity_m_s_);
  clear(position_m_);
  since_ = Span();
  step_ticks_ = 0;
  velocity_known_ = still;
  filter_.reset(still ? kTiltStill_rad * kTiltStill_rad : kTiltMoving_rad * kTiltMoving_rad, variance,
                still ? kStillSigma_m_s * kStillSigma_m_s : kSpeedUnknown_m_s * kSpeedUnknown_m_s);
  displacement_.initialised = true;
}

void DeadReckoning::update(const ImuSample& sample, float dt_s) {
  ++ticks_;
  for (uint8_t i = 0; i < kHolds; ++i) {
    if (hold_[i] > 0) --hold_[i];
  }
  if (refuse(sample, dt_s)) {
    publish();
    return;
  }
  const bool reckoning = displacement_.initialised;
  Stance stance;
  const bool at_stance = advance(sample, dt_s, &stance);
  if (reckoning) {
    // A motion stage left over belongs before the mid-stance, and is work enough for this tick.
    const bool before = at_stance && motion_pending_;
    if (before) work();
    if (at_stance) on_stance(stance);
    if (!before) work();
  }
  publish();
}

// Moves the nominal state by one sample. True at a mid-stance that the filter can use.
RELPOS_APART bool DeadReckoning::advance(const ImuSample& sample, float dt_s, Stance* stance) {
  const float strength = norm(sample.acceleration_m_s2);
  {
    float angle[kAxes];
    for (uint8_t i = 0; i < kAxes; ++i) {
      angle[i] = (sample.angular_rate_rad_s[i] - bias_rad_s_[i]) * dt_s;
    }
    watch_quiet(strength, angle, dt_s);
    attitude_.integrate(angle);
  }
  float force[kAxes];
  attitude_.matrix(rotation_);
  rotate(rotation_, sample.acceleration_m_s2, force);

  if (!displacement_.initialised) {
    // Until the vertical is known the magnitude of the force stands for its vertical part.
    if (gait_.update(strength, dt_s, stance)) on_stance(*stance);
    gather(sample, force, dt_s);
    if (job_ != kIdle) {  // such a step has nothing to measure against: counted, placed ahead
      job_ = kIdle;
      commit_step();
    }
    return false;
  }

  float ahead[kAxes];  // the heading axis
  rotate(rotation_, heading_axis_, ahead);
  if (fabsf(ahead[kZ]) > kSteep) {
    // Bent: the heading goes on by the turn about the vertical, and the axis is as good as before when
    // it comes up again. Crawling or lying, another axis takes over.
    add(&steep_s_, dt_s);
    const float* up = rotation_ + kAxes * kZ;  // in the body
    const float rate_rad_s = dot(up, sample.angular_rate_rad_s) - dot(up, bias_rad_s_);
    displacement_.heading_rad = wrap_angle(displacement_.heading_rad + rate_rad_s * dt_s);
    if (steep_s_ > kBent_s) aim(displacement_.heading_rad);
    direct(displacement_.heading_rad, ahead);
  } else {
    steep_s_ = 0.0f;
    displacement_.heading_rad = bearing(ahead);
  }
  add(&heading_sum_rad_, turn_between(stance_heading_rad_, displacement_.heading_rad));
  ++step_ticks_;

  if (quiet_s_ >= kSettled_s) {
    if (quiet_s_ < kSettled_s + dt_s) begin_straight();
    add(&straight_s_, dt_s);
    if (straight_s_ >= kStill_s) {
      straight_rate_rad_s_ = turn_between(straight_heading_rad_, displacement_.heading_rad) / straight_s_;
      still_pending_ = true;
      begin_straight();
    }
  }
  const bool at_stance = gait_.update(force[kZ], dt_s, stance);
  // Into the heading frame. The heading axis is level but for the body's tilt, whose square is all
  // that is lost by not normalising it: both components alike, which the direction does not see.
  float level[2];
  resolve(ahead, force, level);
  forward_.update(level, gait_.vertical_velocity_m_s(), dt_s);

  add(&since_.time_s, dt_s);
  add_scaled(since_.impulse_m_s, force, dt_s, kAxes);
  follow(&gravity_m_s2_, force[kZ], dt_s * (1.0f / kGravityTime_s));
  force[kZ] -= gravity_m_s2_;  // from here on the acceleration
  add_scaled(position_m_, velocity_m_s_, dt_s, kAxes);
  add_scaled(position_m_, force, 0.5f * dt_s * dt_s, kAxes);
  add_scaled(velocity_m_s_, force, dt_s, kAxes);

  return at_stance;
}

RELPOS_APART void DeadReckoning::on_stance(const Stance& stance) {
  const float age_ticks = stance.age_s * kTicks_s;
  displacement_.last_step_tick = ticks_ - static_cast<uint16_t>(age_ticks);
  // Samples are so far apart that the step before is still being worked off.
  if (job_ > kIdle && job_ <= kCommit) commit_step();
  if (stance.last) {
    displacement_.last_step_length_m = closing_m_;
    ++displacement_.steps;
    return;
  }
  closing_m_ = 0.0f;
  const float heading = displacement_.heading_rad;
  float mean = heading, turn = 0.0f, stride_turn = 0.0f;
  if (!stance.first) {
    mean = stance_heading_rad_ + heading_sum_rad_ / static_cast<float>(step_ticks_);
    turn = turn_between(stance_heading_rad_, displacement_.heading_rad);
    stride_turn = turn + turn_rad_;
  }
  stance_heading_rad_ = heading;
  heading_sum_rad_ = 0.0f;
  direct(mean, step_heading_);

  const float share = turning_share(stride_turn);
  const float interval_s = stance.interval_s;
  float length =
      share * pendulum_step_m(stance.excursion_m, config_.leg_length_m, config_.step_gain);
  float sigma = kStepSigma;
  if (stance.first) {
    length *= kFirstStep;
    sigma = kOddStepSigma;
  }
  bool irregular = stance.weak || share < kIrregular || stance.excursion_m < kSmallRise_m;
  if (stance.first) {
    limp_ = 0.0f;
    rise_m_ = stance.excursion_m;
  }
  const float unlike = (stance.excursion_m - rise_m_) / (stance.excursion_m + rise_m_);
  rise_m_ = stance.excursion_m;
  limp_ = -limp_;  // the other foot
  follow(&limp_, unlike, kLimpGain);
  const float limp = fabsf(limp_);
  if (limp > kLimp) {
    length *= 1.0f - kLimpShare * limp;
    irregular = true;
  }
  step_speed_m_s_ = length / interval_s;
  float most_m = kWalkRatio_m_s / interval_s;
  if (length > kLongStep * most_m) irregular = true;
  const float climb_m = fabsf(position_m_[kZ]);
  if (velocity_known_ && climb_m > kClimb_m && climb_m < kHighest_m) {
    irregular = true;
    most_m = kBlondel_m - 2.0f * climb_m;
  }
  if (length > most_m) {
    length = most_m;
    sigma = kOddStepSigma;
  }
  step_irregular_ = irregular;
  if (irregular) hold_[kHoldDoubt] = kHoldTicks;
  step_length_m_ = length;
  step_sigma_m_ = sigma * length + kStepSigma_m + kTurnSigma_m * (1.0f - share);

  if (stance.first || fabsf(stride_turn) > kStraight_rad) straight_steps_ = 0;
  turn_rad_ = turn;
  add(&straight_s_, interval_s);
  ++straight_steps_;
  if (straight_steps_ == kStraightFrom) {
    begin_straight();
  } else if (straight_steps_ == kStraightTo) {
    straight_rate_rad_s_ = turn_between(straight_heading_rad_, displacement_.heading_rad) / straight_s_;
  }
  step_straight_ = straight_steps_ == kStraightSure;
  if (step_straight_) straight_steps_ = 2;
  if (magnetic_steps_ < 255) ++magnetic_steps_;
  step_ticks_ = displacement_.initialised ? 0 : step_ticks_;

  if (stance.first && !forward_.found()) forward_.reset();  // what came before was no walking
  step_directed_ = forward_.found();
  memcpy(stance_position_m_, position_m_, sizeof stance_position_m_);
  if (displacement_.initialised) {
    clear(position_m_);
    capture_span();
    forward_.step();
    watch_mounting();
  }
  compose(step_heading_, forward_.axis(), walk_);
  job_ = kFlush;
}

// Makes the body vector that points to `heading_rad` now the heading axis.
void DeadReckoning::aim(float heading_rad) {
  float heading[2];
  direct(heading_rad, heading);
  clear(heading_axis_);
  for (uint8_t i = 0; i < kZ; ++i) add_scaled(heading_axis_, rotation_ + 3 * i, heading[i], kAxes);
}

// A sensor turned on the body turns the heading axis one way and the forward axis the other: both are
// turned back, so that the wearer's heading is what it was.
void DeadReckoning::watch_mounting() {
  const float turned_rad = turn_between(mounting_rad_, forward_.offset_rad());
  if (settled_steps_ < kSettledSteps) {
    if (forward_.found()) ++settled_steps_;
    mounting_rad_ = forward_.offset_rad();
  } else if (fabsf(turned_rad) < kTurned_rad) {
    turned_steps_ = 0;
  } else if (++turned_steps_ == kDoubtedSteps) {
    forward_.forget();  // the mean of before and after would be neither
  } else if (turned_steps_ == kTurnedSteps) {
    turned_steps_ = 0;
    aim(displacement_.heading_rad + turned_rad);
    displacement_.heading_rad = wrap_angle(displacement_.heading_rad + turned_rad);
    stance_heading_rad_ = displacement_.heading_rad;
    forward_.turn(-turned_rad);
    straight_steps_ = 0;
    count(&counters_.turned_sensors);
  }
}

RELPOS_APART void DeadReckoning::capture_span() {
  span_ = since_;
  since_ = Span();
}

RELPOS_APART void DeadReckoning::predict_attitude() {
  // What the heading loses while it turns, never what a compass gives back: totals only grow.
  attitude_.normalise();
  const float growth = filter_.predict_attitude(rotation_, span_.time_s);
  if (growth > 0.0f) displacement_.variance_heading_rad2 += growth;
  motion_pending_ = true;
}

void DeadReckoning::work() {
  if (motion_pending_) {
    filter_.predict_motion(span_.impulse_m_s, span_.time_s);
    motion_pending_ = false;
    if (job_ == kIdle && (quiet() || !gait_.walking())) job_ = kStillX;
    if (job_ != kIdle) filter_.settle();  // a measurement is next, which is work enough for its tick
    return;
  }
  Job job = job_;
  if (job != kIdle) {
    job_ = static_cast<Job>(job + 1);
  } else if (still_pending_) {  // before the prediction, or standing would leave it no tick
    still_pending_ = false;
    job = kStood;
  } else if (magnetic_pending_) {
    magnetic_pending_ = false;
    magnetic_steps_ = 0;
    job = kMagnetic;
  } else {
    if (since_.time_s >= kPredict_s) {
      capture_span();
      predict_attitude();
    }
    return;
  }
  run(job);
}

void DeadReckoning::run(Job job) {
  State group = kPosition;
  uint8_t axis = kZ;
  if (job >= kStillX && job <= kStillZ) axis = static_cast<uint8_t>(job - kStillX);
  float direction[kAxes] = {0.0f, 0.0f, 0.0f};
  direction[axis] = 1.0f;
  const float* state;  // what is measured, less what it should be
  uint8_t which = kOfStep;
  float yaw = 0.0f;
  // The walking direction turns with the heading's error, so the step's measurements depend on that
  // too: turning heading, velocity and position together changes neither. Without these terms the
  // filter believed to observe the heading and lost it (18 deg/min on simulated walks, NEES 74).
  float way[2];  // ahead and to the left
  resolve(walk_, stance_position_m_, way);
  switch (job) {
    case kFlush:
      predict_attitude();
      if (!velocity_known_ || !step_directed_) job_ = kVertical;
      return;
    case kForward:
      memcpy(direction, walk_, sizeof walk_);
      direction[kZ] = 0.0f;
      yaw = way[kY];
      add(&way[kX], -step_length_m_);
      state = &way[kX];
      break;
    case kLateral:
      left_of(walk_, direction);
      direction[kZ] = 0.0f;
      yaw = -way[kX];
      state = &way[kY];
      which = kOfLateral;
      break;
    case kVertical:
      state = &stance_position_m_[kZ];
      which = kOfVertical;
      if (!step_straight_) job_ = kCommit;
      break;
    case kDrift:
    case kStood:
      state = &straight_rate_rad_s_;
      which = job == kDrift ? kOfStraight : kOfStood;
      group = kBias;
      break;
    case kMagnetic:
      state = &magnetic_excess_rad_;
      which = kOfField;
      group = kAttitude;
      break;
    case kCommit:
      commit_step();
      // Until the forward axis is known a step says nothing of the horizontal; the limit of walking
      // speed has to hold the tilt, which ran away with the gyroscope's bias.
      job_ = forward_.found() ? kIdle : kStillX;
      return;
    case kStillX:
    case kStillY:
    case kStillZ:
      state = &velocity_m_s_[axis];
      which = quiet() ? kOfStill : kOfLoose;
      group = kVelocity;
      break;
    default:
      commit_still();
      job_ = kIdle;
      return;
  }
  const float excess = *state;
  const float square = excess * excess;
  float sigma;
  if (which == kOfStep) {
    sigma = step_sigma_m_;
  } else {
    memcpy_P(&sigma, &kSigmas[which], sizeof sigma);
  }
  float variance = sigma * sigma;
  if (group == kBias && square > kStraightGate * rate_variance(variance, direction)) {
    if (job == kStood) filter_.widen(kBias, square * kStoodDoubt, kAxes);
    return;
  }
  // Errors of rate and field have long tails: the further off, the less a reading says.
  if (group <= kBias) variance += square;
  if (job == kForward) {
    const float least = square * (1.0f / (kDoubt * kDoubt)) - filter_.along(kPosition, walk_);
    if (least > variance) {  // weighed down to what makes it a three-sigma surprise
      variance = least;
      count(&counters_.doubtful_steps);
      hold_[kHoldDoubt] = kHoldTicks;
    }
  }
  measure(group, direction, -excess, variance, yaw);
}

RELPOS_APART void DeadReckoning::measure(State group, const float direction[kAxes], float innovation,
                            float variance, float yaw) {
  float correction[kStates + 1];
  filter_.settle();
  filter_.update(group, direction, yaw, innovation, variance, correction);
  if (group <= kBias) magnetic_azimuth_rad_ += correction[kReference];
  // During a step's updates the covariance stands at its mid-stance, the state at the present.
  float* position = position_m_;
  if (job_ > kFlush && job_ <= kCommit) {
    position = stance_position_m_;
    add_scaled(position_m_, correction + kVelocity, since_.time_s, kAxes);
  }
  add_scaled(position, correction + kPosition, 1.0f, kAxes);
  add_scaled(velocity_m_s_, correction + kVelocity, 1.0f, kAxes);
  add_scaled(bias_rad_s_, correction + kBias, 1.0f, kAxes);
  attitude_.correct(correction + kAttitude, correction + kBias);  // the rest has been used
}

RELPOS_APART bool DeadReckoning::quiet() const { return quiet_s_ >= kQuiet_s; }

RELPOS_APART void DeadReckoning::begin_straight() {
  straight_heading_rad_ = displacement_.heading_rad;
  straight_s_ = 0.0f;
}

// What is expected of a rate measured about the vertical with that variance; fills in its direction.
float DeadReckoning::rate_variance(float variance, float direction[kAxes]) {
  float expected = variance;
  for (uint8_t i = 0; i < kAxes; ++i) {
    direction[i] = -rotation_[3 * kZ + i];
    expected += direction[i] * direction[i] * filter_.covariance(kBias + i, kBias + i);
  }
  return expected;
}

RELPOS_SHARED void DeadReckoning::widen(float along_m2, float across_m2) {
  add(&displacement_.variance_along_m2, along_m2);
  add(&displacement_.variance_across_m2, across_m2);
}

RELPOS_APART void DeadReckoning::commit_step() {
  float length = step_length_m_;
  float way[2] = {0.0f, 0.0f};
  add_scaled(way, step_heading_, length, 2);
  float along = step_sigma_m_ * step_sigma_m_, across = kLateralSigma_m * kLateralSigma_m;
  if (step_directed_ && velocity_known_) {
    float inertial[2], step[2];
    resolve(forward_.axis(), stance_position_m_, inertial);
    resolve(step_heading_, inertial, step);
    // A step half as long again as the pendulum's, or half of one backwards, even after the update:
    // the velocity starts anew from the pendulum, or a wrong tilt (switched on while walking, a
    // fall) would carry it away for ever: 423 m in 70 steps of one recording. Shorter steps stand:
    // shuffling lifts the torso more than it carries it.
    velocity_known_ =
        fabsf(step[kX] - 0.5f * length) < (0.5f + kLost) * length + step_sigma_m_;
    if (!velocity_known_) {
      count(&counters_.lost_steps);
      filter_.widen(kAttitude, kTiltLost_rad * kTiltLost_rad, kZ);
    } else {
      length = fabsf(step[kX]);  // a step back is a way walked, too
      memcpy(way, inertial, sizeof way);
      along = filter_.along(kPosition, walk_);
      left_of(walk_, step);
      across = filter_.along(kPosition, step);
    }
  }
  widen(along, across);
  displacement_.scale_error_m += length * (step_irregular_ ? kIrregularScale : config_.scale_sigma);
  displacement_.last_step_length_m = length;
  ++displacement_.steps;
  totals_.add(way, length);
  clear(stance_position_m_);
  filter_.restart(kPosition, 0.0f);
  if (forward_.found() && !velocity_known_) {
    // Switched on while walking: the speed is first known when the forward axis is.
    clear(velocity_m_s_);
    add_scaled(velocity_m_s_, walk_, step_speed_m_s_, 2);
    filter_.restart(kVelocity, kSpeedFound_m_s * kSpeedFound_m_s);
    velocity_known_ = true;
  }
}

RELPOS_APART void DeadReckoning::commit_still() {
  const bool still = quiet();
  if (still) velocity_known_ = true;
  if (still && forward_.found()) {
    // The half step into standing, as the inertial motion has it.
    float way[2], step[2];
    resolve(forward_.axis(), position_m_, way);
    resolve(step_heading_, way, step);
    float ahead = 0.0f;
    if (gait_.walking() && step[kX] > 0.0f) ahead = step[kX];
    add(&closing_m_, ahead);
    totals_.add(way, ahead);
    const float diagonal[2] = {0.70710678f, 0.70710678f};
    const float variance = filter_.along(kPosition, diagonal);
    widen(variance, variance);
  } else if (!still) {
    widen(kLooseNoise_m2_s * span_.time_s, kLooseNoise_m2_s * span_.time_s);
  }
  clear(position_m_);
  filter_.restart(kPosition, 0.0f);
}

RELPOS_APART void DeadReckoning::magnetometer(const float field_ut[kAxes]) {
  if (!displacement_.initialised) return;
  float field[kAxes];
  attitude_.matrix(rotation_);
  rotate(rotation_, field_ut, field);
  float strength = norm(field);
  if (!isfinite(strength)) {
    clear(field);
    strength = 0.0f;
  }
  const float azimuth = bearing(field);
  bool plausible = strength > kFieldLeast_ut && strength < kFieldMost_ut;
  magnetic_excess_rad_ = turn_between(magnetic_azimuth_rad_, azimuth);
  if (plausible) {
    float share = kFieldShare;
    if (magnetic_count_ < kFieldReadings) {
      share = 1.0f / ++magnetic_count_;
      magnetic_azimuth_rad_ = wrap_angle(magnetic_azimuth_rad_ + magnetic_excess_rad_ * share);
      filter_.set_reference(kFieldSigma_rad * kFieldSigma_rad);
    } else {
      plausible = fabsf(strength - magnetic_norm_ut_) < kFieldNorm * magnetic_norm_ut_ &&
                  fabsf(field[kZ] - magnetic_vertical_ut_) < kFieldVertical * magnetic_norm_ut_;
      magnetic_pending_ = plausible && magnetic_steps_ >= kFieldSteps;
    }
    follow(&magnetic_norm_ut_, strength, share);
    follow(&magnetic_vertical_ut_, field[kZ], share);
  }
  displacement_.magnetic_heading_valid = plausible;
  displacement_.magnetic_heading_rad = turn_between(azimuth, displacement_.heading_rad);
  displacement_.quality_flags &= static_cast<uint16_t>(~kMagneticDisturbed);
  if (!plausible) {
    displacement_.quality_flags |= kMagneticDisturbed;
    count(&counters_.rejected_magnetic);
  }
}

RELPOS_APART void DeadReckoning::publish() {
  Displacement& d = displacement_;
  totals_.tell(Totals::kAlongX, &d.x_m);
  totals_.tell(Totals::kAlongY, &d.y_m);
  totals_.tell(Totals::kPath, &d.path_m);
  if (velocity_known_ && forward_.found()) {
    float since[2], way[2];
    memcpy(since, position_m_, sizeof since);
    add_scaled(since, stance_position_m_, 1.0f, 2);
    resolve(forward_.axis(), since, way);
    add(&d.x_m, way[kX]);
    add(&d.y_m, way[kY]);
  }
  d.moving = gait_.walking();
  uint16_t flags = d.quality_flags & kMagneticDisturbed;
  if (hold_[kHoldAcceleration] > 0) flags |= kAccelerationSaturated;
  if (hold_[kHoldRate] > 0) flags |= kAngularRateSaturated;
  if (hold_[kHoldInput] > 0) flags |= kBadInput;
  if (hold_[kHoldDoubt] > 0) flags |= kStepDoubtful;
  if (!forward_.found()) flags |= kForwardUnknown;
  d.quality_flags = flags;
}

}  // namespace relpos
