#include "filter.h"

#include <string.h>

#include "vector.h"

namespace relpos {
namespace {

const float kDegree = kPi / 180.0f;
// Process noise, as densities (a prototype's; the velocity one stands for soft tissue
// and for accelerometer errors that vary within a step, far above the sensor's own noise).
const float kAttitudeNoise_rad2_s = (0.15f * kDegree) * (0.15f * kDegree);
const float kVelocityNoise_m2_s3 = 0.25f * 0.25f;
const float kBiasNoise_rad2_s3 = (0.004f * kDegree) * (0.004f * kDegree);
// Without a compass the heading's variance grows for ever, and a step's measurements, in which errors
// of heading and velocity cancel, are linear only for a small one. Twelve simulated people, two hours:
// the way of the last half hour is 18 % (at worst 73 %) off that of the first minutes without a bound,
// 2.1 (5) % with 0.3 rad2, 1.6 (5) % with 0.1; from 0.2 down, headings of people under 0.6 m/s are
// surer than right (walk_treadmill_stroke_lumbar: NEES 1.7, 2.1).
const float kMostHeading_rad2 = 0.3f, kLessHeading = 0.9f;
// A variance never falls below these; float32 rounding would otherwise make it negative.
const float kFloor[kStates / kAxes] = {1e-9f, 1e-12f, 1e-7f, 0.0f};

// Heading and bias.
bool turning(uint8_t state) { return static_cast<uint8_t>(state - (kAttitude + kZ)) < 4; }

}  // namespace

// Packed by rows of the upper triangle.
RELPOS_APART float* ErrorFilter::at(uint8_t i, uint8_t j) {
  if (i > j) {
    const uint8_t swap = i;
    i = j;
    j = swap;
  }
  return p_ + static_cast<uint8_t>(static_cast<uint8_t>(i * (2 * kStates - 1 - i)) / 2 + j);
}

RELPOS_APART void ErrorFilter::widen(uint8_t state, float variance, uint8_t count) {
  for (; count != 0; --count, ++state) *at(state, state) += variance;
}

void ErrorFilter::reset(float tilt_rad2, float bias_rad2_s2, float velocity_m2_s2) {
  memset(static_cast<void*>(this), 0, sizeof *this);
  widen(kAttitude, tilt_rad2, kZ);
  widen(kBias, bias_rad2_s2, kAxes);
  widen(kVelocity, velocity_m2_s2, kAxes);
}

RELPOS_APART void ErrorFilter::mix(uint8_t to, uint8_t from, float factor) {
  // P' = E P E' with E = 1 + factor e_to e_from': a row's multiple is added to another, then the
  // column's. Only the variance of `to` takes both, the multiple of the covariance of the two as it
  // was and as it is then; the loop passes it with one of them.
  if (from < to) add_scaled(at(to, to), at(to, from), factor, 1);
  float* a = p_ + to;
  const float* b = p_ + from;
  for (uint8_t other = 0; other < kStates; ++other) {
    *a = multiply_add(*b, factor, *a);
    a += step(other, to);
    b += step(other, from);
  }
  if (from > to) add_scaled(at(to, to), at(to, from), factor, 1);
}

RELPOS_APART void ErrorFilter::add_column(float out[kStates], uint8_t state, float factor) const {
  if (factor == 0.0f) return;
  const float* p = p_ + state;
  for (uint8_t other = 0; other < kStates; ++other) {
    *out = multiply_add(*p, factor, *out);
    ++out;
    p += step(other, state);
  }
}

float ErrorFilter::predict_attitude(const float rotation[kAxes * kAxes], float dt_s) {
  const uint8_t heading = kAttitude + kZ;
  if (*at(heading, heading) > kMostHeading_rad2) {
    // All covariances and the variance by the same factor: less correlated, it stays a covariance.
    mix(heading, heading, kLessHeading - 1.0f);
    reference_[0] *= kLessHeading;
  }
  const float before = *at(heading, heading);
  for (uint8_t i = 0; i < kAxes; ++i) {
    for (uint8_t j = 0; j < kAxes; ++j) mix(kAttitude + i, kBias + j, -dt_s * *rotation++);
  }
  reference_[0] -= dt_s * dot(rotation - kAxes, reference_ + 1);
  widen(kAttitude, kAttitudeNoise_rad2_s * dt_s, kAxes);
  widen(kBias, kBiasNoise_rad2_s3 * dt_s, kAxes);
  return *at(heading, heading) - before;
}

void ErrorFilter::settle() {
  if (owed_s_ == 0.0f) return;
  for (uint8_t i = 0; i < kAxes; ++i) mix(kPosition + i, kVelocity + i, owed_s_);
  owed_s_ = 0.0f;
}

void ErrorFilter::predict_motion(const float f[kAxes], float dt_s) {
  // Half the position step before the velocity changes and half after it: second-order accurate
  // over a span of five ticks, where a single step would be a tenth of a second off.
  add(&owed_s_, 0.5f * dt_s);
  settle();
  for (uint8_t i = 0; i < kAxes; ++i) {
    const uint8_t j = next(i), k = next(j);
    mix(kVelocity + i, kAttitude + j, f[k]);  // -[F x]
    mix(kVelocity + j, kAttitude + i, -f[k]);
  }
  widen(kVelocity, kVelocityNoise_m2_s3 * dt_s, kAxes);
  owed_s_ = 0.5f * dt_s;
}

float ErrorFilter::update(State group, const float direction[kAxes], float yaw, float innovation,
                          float variance, float correction[kStates + 1]) {
  // P h first, which becomes the correction row by row, where it is no longer needed.
  float* const ph = correction;
  memset(ph, 0, (kStates + 1) * sizeof *ph);
  add_column(ph, kAttitude + kZ, yaw);
  for (uint8_t i = 0; i < kAxes; ++i) add_column(ph, group + i, direction[i]);
  // The reference's share in the measurement: with the heading it is compared, with the bias it is
  // correlated alone.
  float shared = 0.0f;
  if (group == kAttitude) {
    add_scaled(ph + kAttitude + kZ, reference_, -1.0f, kReferenced);
    shared = reference_[0] - reference_variance_;
    variance -= shared;
  } else if (group == kBias) {
    shared = dot(direction, reference_ + 1);
  }
  const float total = variance + yaw * ph[kAttitude + kZ] + dot(direction, ph + group);
  const float inverse = 1.0f / total;
  // A torso's velocity and position say nothing of use about its heading or the gyroscope's bias:
  // a bias of 0.1 deg/s shows as 2 mm/s2 of sideways force, as much as 0.01 deg of tilt. What these
  // measurements seemed to say was model error, so they only consider heading and bias (Schmidt
  // 1966): correlations count, the states and their own variances stay. The other way round a
  // compass only considers the motion, of whose correlations with its reference nothing is kept.
  const bool considers = group >= kVelocity;
  if (!considers) {
    add_scaled(reference_, ph + kAttitude + kZ, -inverse * shared, kReferenced);
    reference_variance_ -= shared * shared * inverse;
    correction[kReference] = shared * inverse * innovation;
  }
  float* p = p_;
  for (uint8_t i = 0; i < kStates; ++i) {
    const bool fixed = group != kBias && turning(i) == considers;
    const float gain = ph[i] * inverse;
    const float floor = kFloor[i / kAxes];
    for (uint8_t j = i; j < kStates; ++j, ++p) {
      if (fixed && turning(j) == considers) continue;
      const float reduced = *p - gain * ph[j];
      if (j == i && reduced < floor) {
        if (repairs_ < 65535u && *p > floor) ++repairs_;
        *p = floor;
      } else {
        *p = reduced;
      }
    }
    correction[i] = fixed ? 0.0f : gain * innovation;
  }
  return total;
}

void ErrorFilter::restart(State group, float variance) {
  for (uint8_t i = group; i < group + kAxes; ++i) {
    for (uint8_t other = 0; other < kStates; ++other) *at(i, other) = 0.0f;
  }
  widen(group, variance, kAxes);
}

RELPOS_APART float ErrorFilter::along(State group, const float direction[2]) const {
  float sum = 0.0f;
  for (uint8_t i = 0; i < kZ; ++i) {
    for (uint8_t j = 0; j < kZ; ++j) sum += direction[i] * direction[j] * *at(group + i, group + j);
  }
  return sum;
}

}  // namespace relpos
