// Explicit complementary filter with bias correction: R. Mahony, T. Hamel, J.-M. Pflimlin, "Nonlinear
// Complementary Filters on the Special Orthogonal Group", IEEE Trans. Automatic Control 53(5), 2008,
// section V in its quaternion form. The field's direction in the navigation frame is taken from the
// estimate, turned to the north, so that no dip has to be known (Madgwick 2010, equations 45 and 46).
// Output: the upward direction in the sensor's axes.
#include "filter.h"

#include "ahrs.h"

namespace bench {
namespace {

const float kProportional = 1.0f;
const float kIntegral = 0.1f;

float q[4];
float bias[3];

// error += measured x estimated
void compare(const float a[3], const float b[3], float error[3]) {
  error[0] += a[1] * b[2] - a[2] * b[1];
  error[1] += a[2] * b[0] - a[0] * b[2];
  error[2] += a[0] * b[1] - a[1] * b[0];
}

void step(const Sample& sample, const float error[3]) {
  float w[3], rate[4];
  for (uint8_t i = 0; i < 3; ++i) {
    bias[i] -= kIntegral * error[i] * kTick_s;
    w[i] = sample.rate[i] - bias[i] + kProportional * error[i];
  }
  quaternion_rate(q, w, rate);
  for (uint8_t i = 0; i < 4; ++i) q[i] += rate[i] * kTick_s;
  normalise(q, 4);
}

void compare_up(const Sample& sample, float error[3]) {
  float a[3] = {sample.force[0], sample.force[1], sample.force[2]};
  float up[3];
  if (!normalise(a, 3)) return;
  up_of(q, up);
  compare(a, up, error);
}

}  // namespace

void begin() { q[0] = 1.0f; }

void update(const Sample& sample) {
  float error[3] = {0.0f, 0.0f, 0.0f};
  compare_up(sample, error);
  step(sample, error);
}

void update(const Sample& sample, const float field_ut[3]) {
  float error[3] = {0.0f, 0.0f, 0.0f};
  compare_up(sample, error);
  float m[3] = {field_ut[0], field_ut[1], field_ut[2]};
  if (normalise(m, 3)) {
    float r[3][3];  // R, navigation from sensor
    const float x2 = q[1] + q[1], y2 = q[2] + q[2], z2 = q[3] + q[3];
    const float xx = q[1] * x2, yy = q[2] * y2, zz = q[3] * z2;
    const float xy = q[1] * y2, xz = q[1] * z2, yz = q[2] * z2;
    const float wx = q[0] * x2, wy = q[0] * y2, wz = q[0] * z2;
    r[0][0] = 1.0f - yy - zz;
    r[0][1] = xy - wz;
    r[0][2] = xz + wy;
    r[1][0] = xy + wz;
    r[1][1] = 1.0f - xx - zz;
    r[1][2] = yz - wx;
    r[2][0] = xz - wy;
    r[2][1] = yz + wx;
    r[2][2] = 1.0f - xx - yy;
    float h[3];
    for (uint8_t i = 0; i < 3; ++i) h[i] = r[i][0] * m[0] + r[i][1] * m[1] + r[i][2] * m[2];
    const float level = sqrtf(h[0] * h[0] + h[1] * h[1]);
    float expected[3];
    for (uint8_t i = 0; i < 3; ++i) expected[i] = r[0][i] * level + r[2][i] * h[2];
    compare(m, expected, error);
  }
  step(sample, error);
}

void output(float values[kOutputs]) { up_of(q, values); }

}  // namespace bench
