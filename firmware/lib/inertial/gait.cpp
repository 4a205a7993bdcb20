#include "gait.h"

#include <math.h>
#include <string.h>

#include "attitude.h"
#include "inertial/calls.h"

namespace relpos {
namespace {

// All chosen on the people with odd numbers of walk_lowerback_20m, in their walks without lost
// samples (bench/inertial/evaluate.py), by steps found less steps too many.
// Mean of the vertical acceleration, and leak of both its integrals: long enough for steps of 0.8 Hz,
// short enough to be over a start or a turn a step later.
const float kMeanTime_s = 0.5f;
const float kLeakTime_s = 0.4f;
const float kShortestStep_s = 0.28f;   // 3.6 steps/s: faster than anybody walks (running 3.2)
const float kSmallestSwing_m = 0.005f;
const float kSmallestRange_m_s2 = 0.6f;
const float kPause_s = 1.5f;       // longest time between steps of one walk
const float kFirstPeriod_s = 0.6f; // 100 steps a minute, until two steps are known
const float kPeriodGain = 0.3f;    // the rhythm of the last three steps
const float kLongestPeriod_s = 1.0f;   // longer is a step that was missed, or hesitation
const float kEarly = 0.6f;         // of the period: what comes sooner is a shock of the same step
// A step that comes when it is due needs a push of the foot, but no arc.
const float kDueFrom = 0.8f, kDueUntil = 1.4f;  // of the period
const float kDueRange_m_s2 = 1.0f;
const uint8_t kWalk = 3;           // steps that make a walk, whose end is a footfall

const float kTurn_rad = 1.3f;      // see turning_share

const float kForwardMemory_s = 12.0f;  // about twenty steps: a body-fixed axis, yet free to move
const uint8_t kForwardSteps = 4;       // two strides: the sway of left and right cancels
// Squared coherence of the horizontal acceleration with the downward velocity, chosen by judgement
// and measured afterwards. Median over each of the 99 recorded walks: 0.02 to 0.38, typically 0.23;
// four lie below this threshold and find the axis late. White noise: under 0.005. Sensors at rest
// reach 0.9, so it means nothing without the steps asked for above.
const float kForwardCoherence = 0.06f;

RELPOS_SHARED void integrate(float* sum, float rate, float dt_s) {
  *sum = multiply_add(multiply_add(*sum, -1.0f / kLeakTime_s, rate), dt_s, *sum);
}

RELPOS_SHARED void lower(float* least, float value) {
  if (value < *least) *least = value;
}

}  // namespace

RELPOS_SHARED void GaitDetector::reset() {
  memset(static_cast<void*>(this), 0, sizeof *this);
  since_s_ = kPause_s + 1.0f;
  period_s_ = kFirstPeriod_s;
  restart_arc();
}

RELPOS_SHARED void GaitDetector::restart_arc() {
  trough_m_ = height_m_;
  lowest_m_s2_ = minus_highest_m_s2_ = 1e6f;
}

RELPOS_APART bool GaitDetector::walking() const { return since_s_ < kPause_s; }

RELPOS_SHARED bool GaitDetector::update(float vertical_m_s2, float dt_s, Stance* stance) {
  if (!running_) {
    mean_m_s2_ = vertical_m_s2;
    running_ = true;
  }
  follow(&mean_m_s2_, vertical_m_s2, dt_s * (1.0f / kMeanTime_s));
  const float acceleration = vertical_m_s2 - mean_m_s2_;
  const float before = velocity_m_s_;
  integrate(&velocity_m_s_, acceleration, dt_s);
  integrate(&height_m_, velocity_m_s_, dt_s);
  add(&since_s_, dt_s);  // within a week it grows no more: a float of 5e5
  lower(&trough_m_, height_m_);
  lower(&lowest_m_s2_, acceleration);
  lower(&minus_highest_m_s2_, -acceleration);

  const bool first = !walking();
  stance->first = first;
  stance->age_s = 0.0f;
  stance->last = first && footfall_due_;
  if (stance->last) {
    // A wearer over one foot and walking put down the other one before standing.
    footfall_due_ = false;
    stance->age_s = since_s_ - period_s_;
    return true;
  }
  if (!(before > 0.0f && velocity_m_s_ <= 0.0f)) return false;
  const float swing = height_m_ - trough_m_;
  const float range_m_s2 = -minus_highest_m_s2_ - lowest_m_s2_;
  const float since_s = since_s_;
  const float periods = since_s / period_s_;
  // Not of a longer period than at the start: one that grew in a turn would reject every other step
  // for good (6 s of it in one walk; 16 % of its distance by 2 % of gain).
  const float early_s = kEarly * (period_s_ < kFirstPeriod_s ? period_s_ : kFirstPeriod_s);
  stance->weak = swing < kSmallestSwing_m || since_s < early_s || since_s < kShortestStep_s ||
                 range_m_s2 < kSmallestRange_m_s2;
  if (stance->weak && (first || range_m_s2 < kDueRange_m_s2 || periods < kDueFrom ||
                       periods > kDueUntil)) {
    if (first) restart_arc();
    return false;
  }
  float excursion = swing;
  float interval_s = since_s;
  if (first) {
    steps_ = 0;
    interval_s = period_s_ = kFirstPeriod_s;
  } else {
    if (since_s < kLongestPeriod_s) follow(&period_s_, since_s, kPeriodGain);
    // The mean of both sides, at least half of this one.
    excursion += 0.5f * (peak_m_ - height_m_);
    if (excursion < 0.5f * swing) excursion = 0.5f * swing;
  }
  stance->interval_s = interval_s;
  if (steps_ < 255) ++steps_;
  footfall_due_ = !stance->weak && steps_ >= kWalk;
  // The three leaky filters shrink an oscillation of period T by 1/sqrt(1 + (T / 2 pi tau)^2) each.
  const float ratio = interval_s * (1.0f / (2.0f * kPi * kLeakTime_s));
  const float square = ratio * ratio;
  const float mean = 0.5f * (kLeakTime_s / kMeanTime_s) * (kLeakTime_s / kMeanTime_s);
  stance->excursion_m = excursion * (1.0f + square) * (1.0f + mean * square);
  peak_m_ = height_m_;
  since_s_ = 0.0f;
  restart_arc();
  return true;
}

float pendulum_step_m(float excursion_m, float leg_length_m, float gain) {
  const float length = gain * cube_root(leg_length_m * leg_length_m * excursion_m);
  return excursion_m < kSmallRise_m ? length * excursion_m * (1.0f / kSmallRise_m) : length;
}

RELPOS_APART float turning_share(float stride_rad) {
  const float turn = stride_rad * (1.0f / kTurn_rad);
  const float square = turn * turn;
  return 1.0f / (1.0f + square * square);
}

RELPOS_SHARED void ForwardFinder::reset() {
  memset(static_cast<void*>(this), 0, sizeof *this);
  axis_[kX] = 1.0f;
}

RELPOS_SHARED void ForwardFinder::forget() {
  memset(product_, 0, sizeof product_);
  power_a_ = power_v_ = 0.0f;
}

void ForwardFinder::update(const float a[2], float vertical_velocity_m_s, float dt_s) {
  const float gain = dt_s * (1.0f / kForwardMemory_s);
  for (uint8_t i = 0; i < 2; ++i) follow(&product_[i], -a[i] * vertical_velocity_m_s, gain);
  follow(&power_a_, dot(a, a, 2), gain);
  follow(&power_v_, vertical_velocity_m_s * vertical_velocity_m_s, gain);
}

void ForwardFinder::turn(float angle_rad) {
  float axis[2], turned[2];
  direct(angle_rad, axis);
  compose(axis, product_, turned);
  memcpy(product_, turned, sizeof product_);
  point();
}

RELPOS_SHARED void ForwardFinder::point() {
  offset_rad_ = bearing(product_);
  memset(axis_, 0, sizeof axis_);
  add_scaled(axis_, product_, 1.0f / sqrtf(dot(product_, product_, 2)), 2);
}

void ForwardFinder::step() {
  if (steps_ < 255) ++steps_;
  if (steps_ < kForwardSteps) return;
  if (!(dot(product_, product_, 2) > kForwardCoherence * power_a_ * power_v_)) return;
  point();
  found_ = true;
}

}  // namespace relpos
