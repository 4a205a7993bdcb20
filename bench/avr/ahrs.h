// What both orientation filters share. Quaternions are (w, x, y, z).
#pragma once

#include <math.h>
#include <stdint.h>

namespace bench {

// Scales to length one; false, and nothing changed, for a vector of zeros.
inline bool normalise(float* v, uint8_t count) {
  float square = 0.0f;
  for (uint8_t i = 0; i < count; ++i) square += v[i] * v[i];
  if (square == 0.0f) return false;
  const float scale = 1.0f / sqrtf(square);
  for (uint8_t i = 0; i < count; ++i) v[i] *= scale;
  return true;
}

// rate := 1/2 q (x) (0, w)
inline void quaternion_rate(const float q[4], const float w[3], float rate[4]) {
  rate[0] = 0.5f * (-q[1] * w[0] - q[2] * w[1] - q[3] * w[2]);
  rate[1] = 0.5f * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1]);
  rate[2] = 0.5f * (q[0] * w[1] - q[1] * w[2] + q[3] * w[0]);
  rate[3] = 0.5f * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0]);
}

// up := the navigation frame's z axis in the sensor's axes, R' e_z.
inline void up_of(const float q[4], float up[3]) {
  up[0] = 2.0f * (q[1] * q[3] - q[0] * q[2]);
  up[1] = 2.0f * (q[0] * q[1] + q[2] * q[3]);
  up[2] = 1.0f - 2.0f * (q[1] * q[1] + q[2] * q[2]);
}

}  // namespace bench
