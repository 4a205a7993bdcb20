#include "attitude.h"
#include "inertial/calls.h"

#include <math.h>
#include <string.h>

// Written in loops: unrolled, each product of quaternions would be 600 bytes of the Uno's flash.

namespace relpos {
namespace {

// out := a * b, out neither of them. With the units 1, i, j, k numbered 0 to 3, the product of two is
// the one numbered by their exclusive or, but for its sign.
void multiply(const float a[4], const float b[4], float out[4]) {
  // Bit 4 row + column: a[column] b[row ^ column] is subtracted from out[row].
  uint16_t negative = 1u << 1 | 1u << 2 | 1u << 3 | 1u << 7 | 1u << 9 | 1u << 14;
  for (uint8_t row = 0; row < 4; ++row) {
    float sum = 0.0f;
    for (uint8_t column = 0; column < 4; ++column) {
      const float factor = a[column];
      sum = multiply_add((negative & 1) != 0 ? -factor : factor, b[row ^ column], sum);
      negative >>= 1;
    }
    out[row] = sum;
  }
}

// Rotation by a small angle. Half-angle sine and cosine to third order: at 1000 deg/s and 20 ms the
// angle is 0.35 rad and the truncation 4e-5. A fall may come after a gap of 200 ms: that is inexact,
// but a rotation.
void turn(const float angle[kAxes], float out[4]) {
  const float square = 0.25f * dot(angle, angle);
  const float sine = 0.5f - square * (1.0f / 12.0f);
  out[0] = 1.0f - 0.5f * square;
  memset(out + 1, 0, kAxes * sizeof *out);
  add_scaled(out + 1, angle, sine, kAxes);
  if (square > 0.25f) add_scaled(out, out, 1.0f / sqrtf(dot(out, out, 4)) - 1.0f, 4);
}

}  // namespace

RELPOS_SHARED float wrap_angle(float angle_rad) {
  while (angle_rad > kPi) angle_rad -= 2.0f * kPi;
  while (angle_rad <= -kPi) angle_rad += 2.0f * kPi;
  return angle_rad;
}

RELPOS_SHARED float turn_between(const float& from_rad, const float& to_rad) {
  return wrap_angle(to_rad - from_rad);
}

RELPOS_SHARED void Attitude::set_identity() {
  q[0] = 1.0f;
  q[1] = q[2] = q[3] = 0.0f;
}

void Attitude::level(const float up[kAxes]) {
  // q = (|up| + up_z, up x z), normalised
  const float length = norm(up);
  float half[4] = {length + up[kZ], up[kY], -up[kX], 0.0f};
  if (half[0] < 1e-4f * length) {  // upside down: any horizontal axis will do
    half[0] = half[2] = 0.0f;
    half[1] = 1.0f;
  }
  memset(q, 0, sizeof q);
  add_scaled(q, half, 1.0f / sqrtf(dot(half, half, 4)), 4);
}

void Attitude::normalise() {
  // One Newton step for 1/sqrt near 1: the norm moves by 1e-7 a tick.
  float old[4];
  memcpy(old, q, sizeof q);
  add_scaled(q, old, 0.5f - 0.5f * dot(q, q, 4), 4);
}

void Attitude::integrate(const float angle[kAxes]) {
  Attitude small;
  turn(angle, small.q);
  multiply(Attitude(*this).q, small.q, q);
}

void Attitude::correct(const float angle[kAxes], float scratch[8]) {
  turn(angle, scratch);
  memcpy(scratch + 4, q, sizeof q);
  multiply(scratch, scratch + 4, q);
}

void Attitude::premultiply(const Attitude& first) { multiply(first.q, Attitude(*this).q, q); }

// Two opposite elements of a matrix and the axis between them.
RELPOS_SHARED void shift(float* plus, float* minus, float by) {
  add(plus, by);
  add(minus, -by);
}

void Attitude::matrix(float r[kAxes * kAxes]) const {
  const float* const v = q + 1;
  const float* const end = v + kAxes;
  float* out = r;
  for (const float* i = v; i != end; ++i) {
    const float twice = *i + *i;
    for (const float* j = v; j != end; ++j) *out++ = twice * *j;
  }
  const float twice = q[0] + q[0];
  const float diagonal = twice * q[0] - 1.0f;
  for (uint8_t i = kAxes; i != 0; --i) {
    --out;
    add(out, diagonal);
    out -= kAxes;
  }
  shift(r + 3, r + 1, twice * v[kZ]);
  shift(r + 2, r + 6, twice * v[kY]);
  shift(r + 7, r + 5, twice * v[kX]);
}

void rotate(const float r[kAxes * kAxes], const float in[kAxes], float out[kAxes]) {
  for (uint8_t i = 0; i < kAxes; ++i, r += kAxes) *out++ = dot(r, in);
}

}  // namespace relpos
