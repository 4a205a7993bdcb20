#include "dead_reckoning.h"

#include <math.h>
#include <string.h>

namespace relpos {
namespace {

const float kDegree = kPi / 180.0f;
const float kStandardGravity_m_s2 = 9.80665f;

// Start.
const float kStillStart_s = 3.0f;     // bias to 0.02 deg/s with the MPU-9150's noise
const float kShortStill_s = 0.5f;     // enough for the tilt; the bias then to 0.1 deg/s
const float kMovingStart_s = 1.0f;    // about two steps, over which horizontal force averages out
const float kTiltStill_rad = 1.0f * kDegree;
const float kTiltMoving_rad = 6.0f * kDegree;  // half a step's braking left in the average
const float kBiasLeast_rad_s = 0.05f * kDegree;  // noise and drift: what 3 s on a table leave
const float kSwayShare = 0.25f;       // of the rate's spread over three axes, left in an axis's mean
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
const float kFirstStepSigma = 0.3f;   // a walk's first step is anything from half a step
const float kLateralSigma_m = 0.06f;  // the torso sways 2 to 4 cm and feet are placed as wide
const float kVerticalSigma_m = 0.02f; // level floor: mid-stance heights repeat within 1 to 2 cm
const float kLost = 0.5f;             // of the pendulum's length: the inertial motion ran away
const float kTiltLost_rad = 2.0f * kDegree;  // added then: only a wrong tilt does that
const float kDoubt = 3.0f;            // sigmas beyond which a step is weighed down
const float kStraight_rad_s = 5.0f * kDegree;       // slower turns than this count as straight
const float kStraightSigma_rad_s = 1.5f * kDegree;
const float kStillSigma_m_s = 0.1f;   // sway of 2 cm/s that stays the same over several updates
const float kLooseSigma_m_s = 0.5f;   // moving without steps: shuffling, bending
const float kLooseNoise_m2_s = 0.1f;  // 0.3 m in a second may go unseen without a step
const float kPredict_s = 0.09f;       // every fifth tick; no visible loss

// Magnetometer.
const float kFieldLeast_ut = 20.0f, kFieldMost_ut = 75.0f;  // the Earth's: 22 to 67
const float kFieldNorm = 0.12f, kFieldVertical = 0.10f;     // of the norm
const float kFieldResidual_rad = 40.0f * kDegree;
const float kFieldSigma_rad = 25.0f * kDegree;  // indoors, and correlated over metres
const uint8_t kFieldReadings = 10;    // two seconds make the reference

const uint8_t kHoldTicks = 100;       // two seconds: a flag is seen by a report a second

bool finite(float value) { return value - value == 0.0f; }

void count(uint16_t* counter) {
  if (*counter < 65535u) ++*counter;
}

void clear(float vector[kAxes]) { vector[kX] = vector[kY] = vector[kZ] = 0.0f; }

float norm(const float v[kAxes]) { return sqrtf(dot(v, v)); }

}  // namespace

DeadReckoning::DeadReckoning() { reset(); }

void DeadReckoning::reset() {
  // All but the configuration starts at zero, cleared as one block: member by member it would be a
  // kilobyte of the Uno's flash. Every member is a number, an enum or an array of such.
  // The configuration is the first member and stays.
  memset(reinterpret_cast<uint8_t*>(this) + sizeof config_, 0, sizeof *this - sizeof config_);
  displacement_.quality_flags = kStarting | kForwardUnknown | kBiasUncertain;
  filter_.reset(kTiltMoving_rad, config_.gyro_bias_sigma_rad_s * config_.gyro_bias_sigma_rad_s,
                kSpeedUnknown_m_s);
  gait_.reset();
  forward_.reset();
  attitude_.set_identity();
  gravity_m_s2_ = kStandardGravity_m_s2;
  step_cosine_ = 1.0f;
}

bool DeadReckoning::refuse(const ImuSample& sample, float dt_s) {
  bool good = dt_s > 0.0f && dt_s <= 0.2f, saturated = false;
  for (uint8_t i = 0; i < kAxes; ++i) {
    const float force = fabsf(sample.acceleration_m_s2[i]);
    const float rate = fabsf(sample.angular_rate_rad_s[i]);
    good = good && finite(force + rate);
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
  if (good) return false;
  count(&counters_.refused_samples);
  hold_[kHoldInput] = kHoldTicks;
  return true;
}

void DeadReckoning::watch_quiet(float force, const float angle[kAxes], float dt_s) {
  if (ticks_ == 1) mean_force_m_s2_ = force;
  mean_force_m_s2_ += (force - mean_force_m_s2_) * (dt_s * (1.0f / kForceMean_s));
  const float most_rad = kQuietRate_rad_s * dt_s;
  if (fabsf(force - mean_force_m_s2_) >= kQuietForce_m_s2 ||
      dot(angle, angle) >= most_rad * most_rad) {
    quiet_s_ = 0.0f;
  } else if (quiet_s_ < 1000.0f) {
    quiet_s_ += dt_s;
  }
}

// Start: the attitude of the first sample is found from the mean force while the gyroscope already
// carries the frame along, so that walking directly after switching on loses nothing.
void DeadReckoning::gather(const ImuSample& sample, const float force[kAxes], float dt_s) {
  if (quiet_s_ == 0.0f) {
    // Movement after a quiet beginning ends the gathering before it spoils the mean.
    if (!moved_ && elapsed_s_ >= kShortStill_s) {
      initialise(true);
      return;
    }
    moved_ = true;
  }
  elapsed_s_ += dt_s;
  ++step_ticks_;
  for (uint8_t i = 0; i < kAxes; ++i) {
    velocity_m_s_[i] += force[i];
    position_m_[i] += sample.angular_rate_rad_s[i];
  }
  impulse_m_s_[kX] += dot(sample.angular_rate_rad_s, sample.angular_rate_rad_s);
  if (elapsed_s_ >= (moved_ ? kMovingStart_s : kStillStart_s)) initialise(!moved_);
}

void DeadReckoning::initialise(bool still) {
  const float share = 1.0f / step_ticks_;
  float variance = filter_.covariance(kBias, kBias);  // as reset() set it
  if (still) {
    gravity_m_s2_ = norm(velocity_m_s_) * share;
    // The mean rate is bias and what the body turned meanwhile. How much that may be, its spread
    // tells: 0.03 deg/s on a table, 0.8 standing quietly, 2 to 3 while getting ready, when the mean
    // was wrong by 1 to 2 deg/s (walk_chest) and turned the whole walk.
    const float noise =
        kBiasLeast_rad_s * kBiasLeast_rad_s +
        (impulse_m_s_[kX] - dot(position_m_, position_m_) * share) * share * kSwayShare;
    const float weight = variance / (variance + noise);
    for (uint8_t i = 0; i < kAxes; ++i) bias_rad_s_[i] = position_m_[i] * (share * weight);
    variance = noise * weight;
  }
  Attitude level;
  level.level(velocity_m_s_);
  float rotation[kAxes * kAxes];
  level.matrix(rotation);
  for (uint8_t i = 0; i < kAxes; ++i) heading_axis_[i] = rotation[i];
  if (still) {
    attitude_ = level;  // the turning gathered meanwhile was bias
  } else {
    attitude_.premultiply(level);
  }
  clear(velocity_m_s_);
  clear(position_m_);
  clear(impulse_m_s_);
  elapsed_s_ = 0.0f;
  step_ticks_ = 0;
  velocity_known_ = still;
  filter_.reset(still ? kTiltStill_rad : kTiltMoving_rad, variance,
                still ? kStillSigma_m_s : kSpeedUnknown_m_s);
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
  float angle[kAxes];
  for (uint8_t i = 0; i < kAxes; ++i) {
    angle[i] = (sample.angular_rate_rad_s[i] - bias_rad_s_[i]) * dt_s;
  }
  const float strength = norm(sample.acceleration_m_s2);
  watch_quiet(strength, angle, dt_s);
  attitude_.integrate(angle);
  float rotation[kAxes * kAxes], force[kAxes];
  attitude_.matrix(rotation);
  rotate(rotation, sample.acceleration_m_s2, force);

  Stance stance;
  if (!displacement_.initialised) {
    // Until the vertical is known the magnitude of the force stands for its vertical part.
    if (gait_.update(strength, dt_s, &stance)) on_stance(stance);
    gather(sample, force, dt_s);
    if (job_ != kIdle) {  // such a step has nothing to measure against: counted, placed ahead
      job_ = kIdle;
      step_directed_ = false;
      commit_step();
    }
    publish();
    return;
  }

  float ahead[kAxes];  // the heading axis
  rotate(rotation, heading_axis_, ahead);
  displacement_.heading_rad = atan2f(ahead[kY], ahead[kX]);
  heading_sum_rad_ += wrap_angle(displacement_.heading_rad - stance_heading_rad_[0]);
  if (step_ticks_ < 65535u) ++step_ticks_;

  gravity_m_s2_ += (force[kZ] - gravity_m_s2_) * (dt_s * (1.0f / kGravityTime_s));
  for (uint8_t i = 0; i < kAxes; ++i) {
    impulse_m_s_[i] += force[i] * dt_s;
    const float acceleration = i == kZ ? force[kZ] - gravity_m_s2_ : force[i];
    position_m_[i] += (velocity_m_s_[i] + 0.5f * acceleration * dt_s) * dt_s;
    velocity_m_s_[i] += acceleration * dt_s;
  }
  elapsed_s_ += dt_s;

  const bool at_stance = gait_.update(force[kZ], dt_s, &stance);
  // Into the heading frame. The heading axis is level but for the body's tilt, whose square is all
  // that is lost by not normalising it: both components alike, which the direction does not see.
  forward_.update(ahead[kX] * force[kX] + ahead[kY] * force[kY],
                  ahead[kX] * force[kY] - ahead[kY] * force[kX], gait_.vertical_velocity_m_s(),
                  dt_s);
  if (at_stance) {
    // A motion stage left over belongs before the mid-stance.
    const bool busy = motion_pending_;
    if (busy) filter_.predict_motion(span_impulse_m_s_, span_s_);
    motion_pending_ = false;
    on_stance(stance);
    if (!busy) work(rotation);
  } else {
    work(rotation);
  }
  publish();
}

void DeadReckoning::on_stance(const Stance& stance) {
  displacement_.last_step_tick = ticks_;
  const float heading = displacement_.heading_rad;
  const float mean =
      step_ticks_ > 0 && !stance.first
          ? stance_heading_rad_[0] + heading_sum_rad_ / static_cast<float>(step_ticks_)
          : heading;
  step_cosine_ = cosf(mean);
  step_sine_ = sinf(mean);
  step_length_m_ = pendulum_step_m(stance.excursion_m, config_.leg_length_m, config_.step_gain);
  step_sigma_m_ = (stance.first ? kFirstStepSigma : kStepSigma) * step_length_m_ + kStepSigma_m;
  step_speed_m_s_ = step_length_m_ / stance.interval_s;
  if (stance.first) stances_ = 0;
  if (stances_ < 255) ++stances_;
  // The yaw over two steps: left and right swing of the trunk cancel.
  step_straight_ = false;
  if (stances_ > 2) {
    step_rate_rad_s_ = wrap_angle(heading - stance_heading_rad_[1]) /
                       (stance.interval_s + stance_interval_s_);
    step_straight_ = fabsf(step_rate_rad_s_) < kStraight_rad_s;
  }
  stance_heading_rad_[1] = stance_heading_rad_[0];
  stance_heading_rad_[0] = heading;
  stance_interval_s_ = stance.interval_s;
  heading_sum_rad_ = 0.0f;
  step_ticks_ = displacement_.initialised ? 0 : step_ticks_;

  step_directed_ = forward_.found();
  for (uint8_t i = 0; i < kAxes; ++i) {
    stance_position_m_[i] = position_m_[i];
    if (displacement_.initialised) position_m_[i] = 0.0f;
  }
  if (displacement_.initialised) {
    capture_span();
    forward_.step();
  }
  walk_x_ = step_cosine_ * forward_.cosine() - step_sine_ * forward_.sine();
  walk_y_ = step_sine_ * forward_.cosine() + step_cosine_ * forward_.sine();
  job_ = kFlush;
}

void DeadReckoning::capture_span() {
  for (uint8_t i = 0; i < kAxes; ++i) {
    span_impulse_m_s_[i] = impulse_m_s_[i];
    impulse_m_s_[i] = 0.0f;
  }
  span_s_ = elapsed_s_;
  elapsed_s_ = 0.0f;
}

void DeadReckoning::predict_attitude(const float rotation[kAxes * kAxes]) {
  const float before = filter_.covariance(kAttitude + kZ, kAttitude + kZ);
  filter_.predict_attitude(rotation, span_s_);
  const float growth = filter_.covariance(kAttitude + kZ, kAttitude + kZ) - before;
  if (growth > 0.0f) displacement_.variance_heading_rad2 += growth;
  motion_pending_ = true;
}

void DeadReckoning::work(const float rotation[kAxes * kAxes]) {
  if (motion_pending_) {
    filter_.predict_motion(span_impulse_m_s_, span_s_);
    motion_pending_ = false;
    if (job_ == kIdle && (quiet_s_ >= kQuiet_s || !gait_.walking())) job_ = kStillX;
  } else if (job_ != kIdle) {
    run_job(rotation);
  } else if (elapsed_s_ >= kPredict_s) {
    capture_span();
    predict_attitude(rotation);
  } else if (magnetic_pending_) {
    apply_magnetic();
  }
}

void DeadReckoning::run_job(const float rotation[kAxes * kAxes]) {
  float direction[kAxes] = {0.0f, 0.0f, 0.0f};
  const Job job = job_;
  job_ = static_cast<Job>(job + 1);
  // The walking direction turns with the heading's error, so the step's measurements depend on that
  // too: turning heading, velocity and position together changes neither. Without these terms the
  // filter believed to observe the heading and lost it (18 deg/min on simulated walks, NEES 74).
  const float ahead = walk_x_ * stance_position_m_[kX] + walk_y_ * stance_position_m_[kY];
  const float aside = walk_x_ * stance_position_m_[kY] - walk_y_ * stance_position_m_[kX];
  switch (job) {
    case kFlush:
      predict_attitude(rotation);
      if (!velocity_known_) job_ = kVertical;
      if (!step_directed_) job_ = kVertical;
      break;
    case kForward: {
      direction[kX] = walk_x_;
      direction[kY] = walk_y_;
      const float innovation = step_length_m_ - ahead;
      float variance = step_sigma_m_ * step_sigma_m_;
      const float least = innovation * innovation * (1.0f / (kDoubt * kDoubt)) -
                          filter_.along(kPosition, walk_x_, walk_y_);
      if (least > variance) {  // weighed down to what makes it a three-sigma surprise
        variance = least;
        count(&counters_.doubtful_steps);
        hold_[kHoldDoubt] = kHoldTicks;
      }
      measure(kPosition, direction, innovation, variance, aside);
      break;
    }
    case kLateral:
      direction[kX] = -walk_y_;
      direction[kY] = walk_x_;
      measure(kPosition, direction, -aside, kLateralSigma_m * kLateralSigma_m, -ahead);
      break;
    case kVertical:
      direction[kZ] = 1.0f;
      measure(kPosition, direction, -stance_position_m_[kZ], kVerticalSigma_m * kVerticalSigma_m);
      if (!step_straight_) job_ = kCommit;
      break;
    case kDrift:
      for (uint8_t i = 0; i < kAxes; ++i) direction[i] = -rotation[3 * kZ + i];
      measure(kBias, direction, -step_rate_rad_s_, kStraightSigma_rad_s * kStraightSigma_rad_s);
      break;
    case kCommit:
      commit_step();
      job_ = kIdle;
      break;
    case kStillX:
    case kStillY:
    case kStillZ: {
      const uint8_t axis = job - kStillX;
      const float sigma = quiet_s_ >= kQuiet_s ? kStillSigma_m_s : kLooseSigma_m_s;
      direction[axis] = 1.0f;
      measure(kVelocity, direction, -velocity_m_s_[axis], sigma * sigma);
      break;
    }
    default:
      commit_still();
      job_ = kIdle;
      break;
  }
}

void DeadReckoning::measure(State group, const float direction[kAxes], float innovation,
                            float variance, float yaw) {
  float correction[kStates];
  filter_.update(group, direction, yaw, innovation, variance, correction);
  attitude_.correct(correction + kAttitude);
  // During a step's updates the covariance stands at its mid-stance, the state at the present.
  const bool stance = job_ > kFlush && job_ <= kCommit;
  for (uint8_t i = 0; i < kAxes; ++i) {
    bias_rad_s_[i] += correction[kBias + i];
    velocity_m_s_[i] += correction[kVelocity + i];
    if (stance) {
      stance_position_m_[i] += correction[kPosition + i];
      position_m_[i] += correction[kVelocity + i] * elapsed_s_;
    } else {
      position_m_[i] += correction[kPosition + i];
    }
  }
}

void DeadReckoning::to_wearer(const float n[kAxes], float* x_m, float* y_m) const {
  *x_m = forward_.cosine() * n[kX] + forward_.sine() * n[kY];
  *y_m = forward_.cosine() * n[kY] - forward_.sine() * n[kX];
}

void DeadReckoning::widen(float along_m2, float across_m2) {
  displacement_.variance_along_m2 += along_m2;
  displacement_.variance_across_m2 += across_m2;
}

void DeadReckoning::commit_step() {
  float x = step_length_m_ * step_cosine_, y = step_length_m_ * step_sine_;
  float length = step_length_m_;
  float along = step_sigma_m_ * step_sigma_m_, across = kLateralSigma_m * kLateralSigma_m;
  float inertial_x = x, inertial_y = y;
  if (step_directed_ && velocity_known_) {
    to_wearer(stance_position_m_, &inertial_x, &inertial_y);
    const float ahead = inertial_x * step_cosine_ + inertial_y * step_sine_;
    // A step half as long again as the pendulum's, or half of one backwards, even after the update:
    // the velocity starts anew from the pendulum, or a wrong tilt (switched on while walking, a
    // fall) would carry it away for ever: 423 m in 70 steps of one recording. Shorter steps stand:
    // shuffling lifts the torso more than it carries it.
    velocity_known_ = fabsf(ahead - 0.5f * step_length_m_) <
                      (0.5f + kLost) * step_length_m_ + step_sigma_m_;
    if (!velocity_known_) {
      count(&counters_.lost_steps);
      for (uint8_t i = kAttitude; i < kAttitude + kZ; ++i) {
        filter_.set_covariance(i, i, filter_.covariance(i, i) + kTiltLost_rad * kTiltLost_rad);
      }
    } else {
      length = fabsf(ahead);  // a step back is a way walked, too
    }
  }
  if (step_directed_ && velocity_known_) {
    x = inertial_x;
    y = inertial_y;
    along = filter_.along(kPosition, walk_x_, walk_y_);
    across = filter_.along(kPosition, -walk_y_, walk_x_);
  }
  widen(along + scale_variance_growth_m2(displacement_.path_m, length, config_.scale_sigma,
                                         config_.scale_correlation_m),
        across);
  displacement_.last_step_length_m = length;
  ++displacement_.steps;
  totals_.add(x, y);
  totals_.add_path(length);
  clear(stance_position_m_);
  filter_.restart(kPosition, 0.0f);
  if (displacement_.initialised && forward_.found() && !velocity_known_) {
    // Switched on while walking: the speed is first known when the forward axis is.
    velocity_m_s_[kX] = step_speed_m_s_ * walk_x_;
    velocity_m_s_[kY] = step_speed_m_s_ * walk_y_;
    velocity_m_s_[kZ] = 0.0f;
    filter_.restart(kVelocity, kSpeedFound_m_s);
    velocity_known_ = true;
  }
}

void DeadReckoning::commit_still() {
  const bool still = quiet_s_ >= kQuiet_s;
  if (still) velocity_known_ = true;
  if (still && forward_.found()) {
    // The half step into standing, as the inertial motion has it.
    float x, y;
    to_wearer(position_m_, &x, &y);
    totals_.add(x, y);
    const float variance = filter_.along(kPosition, 0.70710678f, 0.70710678f);
    widen(variance, variance);
  } else if (!still) {
    widen(kLooseNoise_m2_s * span_s_, kLooseNoise_m2_s * span_s_);
  }
  clear(position_m_);
  filter_.restart(kPosition, 0.0f);
}

void DeadReckoning::magnetometer(const float field_ut[kAxes]) {
  displacement_.magnetic_heading_valid = false;
  if (!displacement_.initialised) return;
  float rotation[kAxes * kAxes], field[kAxes];
  attitude_.matrix(rotation);
  rotate(rotation, field_ut, field);
  const float strength = norm(field);  // NaN fails every comparison below
  const float azimuth = atan2f(field[kY], field[kX]);
  bool plausible = strength > kFieldLeast_ut && strength < kFieldMost_ut;
  bool used = plausible;
  if (plausible && magnetic_count_ < kFieldReadings) {
    ++magnetic_count_;
    const float share = 1.0f / magnetic_count_;
    for (uint8_t i = 0; i < kAxes; ++i) {
      magnetic_reference_ut_[i] += (field[i] - magnetic_reference_ut_[i]) * share;
    }
  } else if (plausible) {
    const float reference = norm(magnetic_reference_ut_);
    plausible = fabsf(strength - reference) < kFieldNorm * reference &&
                fabsf(field[kZ] - magnetic_reference_ut_[kZ]) < kFieldVertical * reference;
    magnetic_residual_rad_ =
        wrap_angle(atan2f(magnetic_reference_ut_[kY], magnetic_reference_ut_[kX]) - azimuth);
    used = magnetic_pending_ = plausible && fabsf(magnetic_residual_rad_) < kFieldResidual_rad;
  }
  displacement_.magnetic_heading_valid = plausible;
  displacement_.magnetic_heading_rad = wrap_angle(displacement_.heading_rad - azimuth);
  displacement_.quality_flags &= static_cast<uint16_t>(~kMagneticDisturbed);
  if (!used) {
    displacement_.quality_flags |= kMagneticDisturbed;
    count(&counters_.rejected_magnetic);
  }
}

void DeadReckoning::apply_magnetic() {
  const float direction[kAxes] = {0.0f, 0.0f, 1.0f};
  measure(kAttitude, direction, magnetic_residual_rad_, kFieldSigma_rad * kFieldSigma_rad);
  magnetic_pending_ = false;
}

void DeadReckoning::publish() {
  Displacement& d = displacement_;
  float x = 0.0f, y = 0.0f;
  if (d.initialised && velocity_known_ && forward_.found()) {
    float since[kAxes];
    for (uint8_t i = 0; i < kAxes; ++i) since[i] = position_m_[i] + stance_position_m_[i];
    to_wearer(since, &x, &y);
  }
  d.x_m = totals_.x_m() + x;
  d.y_m = totals_.y_m() + y;
  d.path_m = totals_.path_m();
  d.moving = gait_.walking();
  const uint16_t rejected = gait_.take_rejected();
  if (rejected > 0) count(&counters_.rejected_steps);
  uint16_t flags = d.quality_flags & kMagneticDisturbed;
  if (hold_[kHoldAcceleration] > 0) flags |= kAccelerationSaturated;
  if (hold_[kHoldRate] > 0) flags |= kAngularRateSaturated;
  if (hold_[kHoldInput] > 0) flags |= kBadInput;
  if (hold_[kHoldDoubt] > 0) flags |= kStepDoubtful;
  if (!forward_.found()) flags |= kForwardUnknown;
  if (quiet_s_ >= kQuiet_s) flags |= kStanding;
  if (filter_.repairs() > 0) flags |= kCovarianceRepaired;
  if (!d.initialised) flags |= kStarting;
  if (!d.initialised ||
      filter_.covariance(kBias + kZ, kBias + kZ) > (0.3f * kDegree) * (0.3f * kDegree)) {
    flags |= kBiasUncertain;
  }
  d.quality_flags = flags;
}

}  // namespace relpos
