#include "filter.h"

namespace relpos {
namespace {

const float kDegree = kPi / 180.0f;
// Process noise, as densities (a prototype's; the velocity one stands for soft tissue
// and for accelerometer errors that vary within a step, far above the sensor's own noise).
const float kAttitudeNoise_rad2_s = (0.15f * kDegree) * (0.15f * kDegree);
const float kVelocityNoise_m2_s3 = 0.25f * 0.25f;
const float kBiasNoise_rad2_s3 = (0.004f * kDegree) * (0.004f * kDegree);
// A variance never falls below these; float32 rounding would otherwise make it negative.
const float kFloor[kStates / kAxes] = {1e-9f, 1e-12f, 1e-7f, 0.0f};

}  // namespace

void ErrorFilter::reset(float tilt_rad, float bias_rad2_s2, float velocity_m_s) {
  for (uint8_t i = 0; i < kPacked; ++i) p_[i] = 0.0f;
  repairs_ = 0;
  for (uint8_t i = 0; i < kReferenced; ++i) reference_[i] = 0.0f;
  for (uint8_t i = 0; i < kAxes; ++i) {
    p_[index(kAttitude + i, kAttitude + i)] = tilt_rad * tilt_rad;
    p_[index(kBias + i, kBias + i)] = bias_rad2_s2;
    p_[index(kVelocity + i, kVelocity + i)] = velocity_m_s * velocity_m_s;
  }
  p_[index(kAttitude + kZ, kAttitude + kZ)] = 0.0f;
}

void ErrorFilter::couple(State to, State from, const float m[kAxes * kAxes]) {
  // First the covariances with every state outside `to`, then the block of `to` itself:
  // P_tt' = P_tt + M P_ft + P_tf' M', where P_tf' is already the new one.
  float old[kAxes * kAxes];  // P_tf before the change
  for (uint8_t i = 0; i < kAxes; ++i) {
    for (uint8_t j = 0; j < kAxes; ++j) old[3 * j + i] = p_[index(from + i, to + j)];
  }
  float row[kAxes];
  for (uint8_t other = 0; other < kStates; ++other) {
    if (other >= to && other < to + kAxes) continue;
    for (uint8_t i = 0; i < kAxes; ++i) row[i] = p_[index(from + i, other)];
    for (uint8_t i = 0; i < kAxes; ++i) p_[index(to + i, other)] += dot(m + 3 * i, row);
  }
  for (uint8_t i = 0; i < kAxes; ++i) {
    for (uint8_t k = 0; k < kAxes; ++k) row[k] = p_[index(to + i, from + k)];
    for (uint8_t j = i; j < kAxes; ++j) {
      p_[index(to + i, to + j)] += dot(m + 3 * i, old + 3 * j) + dot(row, m + 3 * j);
    }
  }
}

void ErrorFilter::predict_attitude(const float rotation[kAxes * kAxes], float dt_s) {
  float m[kAxes * kAxes];
  for (uint8_t i = 0; i < kAxes * kAxes; ++i) m[i] = -dt_s * rotation[i];
  couple(kAttitude, kBias, m);
  reference_[0] += dot(m + 3 * kZ, reference_ + 1);
  for (uint8_t i = 0; i < kAxes; ++i) {
    p_[index(kAttitude + i, kAttitude + i)] += kAttitudeNoise_rad2_s * dt_s;
    p_[index(kBias + i, kBias + i)] += kBiasNoise_rad2_s3 * dt_s;
  }
}

void ErrorFilter::move_position(float dt_s) {
  for (uint8_t i = 0; i < kAxes; ++i) {
    for (uint8_t j = i; j < kAxes; ++j) {
      p_[index(kPosition + i, kPosition + j)] +=
          dt_s * (p_[index(kVelocity + i, kPosition + j)] + p_[index(kVelocity + j, kPosition + i)] +
                  dt_s * p_[index(kVelocity + i, kVelocity + j)]);
    }
  }
  for (uint8_t j = 0; j < kAxes; ++j) {
    for (uint8_t other = 0; other < kPosition; ++other) {
      p_[index(other, kPosition + j)] += dt_s * p_[index(other, kVelocity + j)];
    }
  }
}

void ErrorFilter::predict_motion(const float f[kAxes], float dt_s) {
  // Half the position step before the velocity changes and half after it: second-order accurate
  // over a span of five ticks, where a single step would be a tenth of a second off.
  move_position(0.5f * dt_s);
  const float m[kAxes * kAxes] = {0.0f, f[kZ], -f[kY], -f[kZ], 0.0f, f[kX], f[kY], -f[kX], 0.0f};
  couple(kVelocity, kAttitude, m);
  for (uint8_t i = 0; i < kAxes; ++i) {
    p_[index(kVelocity + i, kVelocity + i)] += kVelocityNoise_m2_s3 * dt_s;
  }
  move_position(0.5f * dt_s);
}

float ErrorFilter::update(State group, const float direction[kAxes], float yaw, float innovation,
                          float variance, float correction[kStates + 1]) {
  float ph[kStates];
  for (uint8_t i = 0; i < kStates; ++i) {
    float sum = yaw * p_[index(i, kAttitude + kZ)];
    for (uint8_t j = 0; j < kAxes; ++j) {
      if (direction[j] != 0.0f) sum += direction[j] * p_[index(i, group + j)];
    }
    ph[i] = sum;
  }
  // The reference's share in the measurement: with the heading it is compared, with the bias it is
  // correlated alone.
  float shared = 0.0f;
  if (group == kAttitude) {
    for (uint8_t i = 0; i < kReferenced; ++i) ph[kAttitude + kZ + i] -= reference_[i];
    shared = reference_[0] - reference_variance_;
    variance -= shared;
  } else if (group == kBias) {
    shared = dot(direction, reference_ + 1);
  }
  float total = variance + yaw * ph[kAttitude + kZ];
  for (uint8_t j = 0; j < kAxes; ++j) total += direction[j] * ph[group + j];
  const float inverse = 1.0f / total;
  // A torso's velocity and position say nothing of use about its heading or the gyroscope's bias:
  // a bias of 0.1 deg/s shows as 2 mm/s2 of sideways force, as much as 0.01 deg of tilt. What these
  // measurements seemed to say was model error, so they only consider heading and bias (Schmidt
  // 1966): correlations count, the states and their own variances stay.
  const bool considers = group >= kVelocity;
  float* p = p_;
  for (uint8_t i = 0; i < kStates; ++i) {
    const bool fixed = considers && i >= kAttitude + kZ && i < kVelocity;
    const float gain = ph[i] * inverse;
    const float floor = kFloor[i / kAxes];
    for (uint8_t j = i; j < kStates; ++j, ++p) {
      if (fixed && j < kVelocity) continue;
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
  if (!considers) {
    for (uint8_t i = 0; i < kReferenced; ++i) {
      reference_[i] -= ph[kAttitude + kZ + i] * inverse * shared;
    }
    reference_variance_ -= shared * shared * inverse;
    correction[kStates] = shared * inverse * innovation;
  }
  return total;
}

void ErrorFilter::restart(State group, float sigma) {
  for (uint8_t i = 0; i < kAxes; ++i) {
    for (uint8_t other = 0; other < kStates; ++other) p_[index(group + i, other)] = 0.0f;
  }
  for (uint8_t i = 0; i < kAxes; ++i) p_[index(group + i, group + i)] = sigma * sigma;
}

float ErrorFilter::along(State group, float x, float y) const {
  return x * x * p_[index(group, group)] + 2.0f * x * y * p_[index(group, group + 1)] +
         y * y * p_[index(group + 1, group + 1)];
}

}  // namespace relpos
