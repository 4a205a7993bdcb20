#include "vector.h"

#include <math.h>

namespace relpos {

RELPOS_SHARED float dot(const float a[kAxes], const float b[kAxes]) {
  float sum = 0.0f;
  for (uint8_t i = 0; i < kAxes; ++i) sum += a[i] * b[i];
  return sum;
}

RELPOS_SHARED float norm(const float v[kAxes]) { return sqrtf(dot(v, v)); }

RELPOS_SHARED void add(float* to, float value) { *to += value; }

RELPOS_SHARED void add_scaled(float* to, const float* from, float factor, uint8_t count) {
  for (; count != 0; --count) *to++ += factor * *from++;
}

RELPOS_SHARED void follow(float* value, float target, float gain) {
  *value += (target - *value) * gain;
}

RELPOS_SHARED void resolve(const float axis[2], const float v[2], float out[2]) {
  out[kX] = axis[kX] * v[kX] + axis[kY] * v[kY];
  out[kY] = axis[kX] * v[kY] - axis[kY] * v[kX];
}

RELPOS_SHARED void compose(const float axis[2], const float v[2], float out[2]) {
  out[kX] = axis[kX] * v[kX] - axis[kY] * v[kY];
  out[kY] = axis[kX] * v[kY] + axis[kY] * v[kX];
}

RELPOS_SHARED void direct(float angle_rad, float out[2]) {
  out[kX] = cosf(angle_rad);
  out[kY] = sinf(angle_rad);
}

}  // namespace relpos
