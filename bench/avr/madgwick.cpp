// Gradient descent filter: S. O. H. Madgwick, "An efficient orientation filter for inertial and
// inertial/magnetic sensor arrays", report, University of Bristol, 2010; the numbers of the equations
// are those of the report. Without its optional gyroscope bias drift compensation.
// Output: the upward direction in the sensor's axes.
#include "filter.h"

#include "ahrs.h"

namespace bench {
namespace {

const float kBeta = 0.1f;  // rad/s, equation 50

float q[4];

// gradient += J' f for the upward direction, equations 25 and 26.
void descend_up(const float a[3], float gradient[4]) {
  float up[3];
  up_of(q, up);
  const float f0 = up[0] - a[0], f1 = up[1] - a[1], f2 = up[2] - a[2];
  gradient[0] += 2.0f * (q[1] * f1 - q[2] * f0);
  gradient[1] += 2.0f * (q[3] * f0 + q[0] * f1) - 4.0f * q[1] * f2;
  gradient[2] += 2.0f * (q[3] * f1 - q[0] * f0) - 4.0f * q[2] * f2;
  gradient[3] += 2.0f * (q[1] * f0 + q[2] * f1);
}

// The same for the field, equations 29 and 30, with the reference of 45 and 46.
void descend_field(const float m[3], float gradient[4]) {
  const float h0 = 2.0f * (m[0] * (0.5f - q[2] * q[2] - q[3] * q[3]) +
                           m[1] * (q[1] * q[2] - q[0] * q[3]) + m[2] * (q[1] * q[3] + q[0] * q[2]));
  const float h1 = 2.0f * (m[0] * (q[1] * q[2] + q[0] * q[3]) +
                           m[1] * (0.5f - q[1] * q[1] - q[3] * q[3]) +
                           m[2] * (q[2] * q[3] - q[0] * q[1]));
  const float h2 = 2.0f * (m[0] * (q[1] * q[3] - q[0] * q[2]) +
                           m[1] * (q[2] * q[3] + q[0] * q[1]) +
                           m[2] * (0.5f - q[1] * q[1] - q[2] * q[2]));
  const float x2 = 2.0f * sqrtf(h0 * h0 + h1 * h1), z2 = 2.0f * h2;
  const float x4 = x2 + x2, z4 = z2 + z2;
  const float f0 = x2 * (0.5f - q[2] * q[2] - q[3] * q[3]) + z2 * (q[1] * q[3] - q[0] * q[2]) - m[0];
  const float f1 = x2 * (q[1] * q[2] - q[0] * q[3]) + z2 * (q[0] * q[1] + q[2] * q[3]) - m[1];
  const float f2 = x2 * (q[0] * q[2] + q[1] * q[3]) + z2 * (0.5f - q[1] * q[1] - q[2] * q[2]) - m[2];
  gradient[0] += -z2 * q[2] * f0 + (z2 * q[1] - x2 * q[3]) * f1 + x2 * q[2] * f2;
  gradient[1] += z2 * q[3] * f0 + (x2 * q[2] + z2 * q[0]) * f1 + (x2 * q[3] - z4 * q[1]) * f2;
  gradient[2] += (-x4 * q[2] - z2 * q[0]) * f0 + (x2 * q[1] + z2 * q[3]) * f1 +
                 (x2 * q[0] - z4 * q[2]) * f2;
  gradient[3] += (z2 * q[1] - x4 * q[3]) * f0 + (z2 * q[2] - x2 * q[0]) * f1 + x2 * q[1] * f2;
}

void step(const Sample& sample, float gradient[4]) {
  float rate[4];
  quaternion_rate(q, sample.rate, rate);
  if (normalise(gradient, 4)) {
    for (uint8_t i = 0; i < 4; ++i) rate[i] -= kBeta * gradient[i];
  }
  for (uint8_t i = 0; i < 4; ++i) q[i] += rate[i] * kTick_s;
  normalise(q, 4);
}

void descend(const Sample& sample, float gradient[4]) {
  float a[3] = {sample.force[0], sample.force[1], sample.force[2]};
  if (normalise(a, 3)) descend_up(a, gradient);
}

}  // namespace

void begin() { q[0] = 1.0f; }

void update(const Sample& sample) {
  float gradient[4] = {0.0f, 0.0f, 0.0f, 0.0f};
  descend(sample, gradient);
  step(sample, gradient);
}

void update(const Sample& sample, const float field_ut[3]) {
  float gradient[4] = {0.0f, 0.0f, 0.0f, 0.0f};
  descend(sample, gradient);
  float m[3] = {field_ut[0], field_ut[1], field_ut[2]};
  if (normalise(m, 3)) descend_field(m, gradient);
  step(sample, gradient);
}

void output(float values[kOutputs]) { up_of(q, values); }

}  // namespace bench
