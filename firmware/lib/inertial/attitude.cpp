#include "attitude.h"

#include <math.h>

// Written in loops: unrolled, each product of quaternions would be 600 bytes of the Uno's flash.

namespace relpos {
namespace {

// out := a * b, out neither of them.
void multiply(const float a[4], const float b[4], float out[4]) {
  float scalar = a[0] * b[0];
  for (uint8_t i = 0; i < kAxes; ++i) {
    const uint8_t j = next(i), k = next(j);
    scalar -= a[1 + i] * b[1 + i];
    out[1 + i] = a[0] * b[1 + i] + b[0] * a[1 + i] + a[1 + j] * b[1 + k] - a[1 + k] * b[1 + j];
  }
  out[0] = scalar;
}

// Rotation by a small angle. Half-angle sine and cosine to third order: at 500 deg/s and 20 ms the
// angle is 0.17 rad and the truncation 1e-7.
void turn(const float angle[kAxes], float out[4]) {
  const float square = 0.25f * dot(angle, angle);
  const float sine = 0.5f - square * (1.0f / 12.0f);
  out[0] = 1.0f - 0.5f * square + square * square * (1.0f / 24.0f);
  for (uint8_t i = 0; i < kAxes; ++i) out[1 + i] = angle[i] * sine;
}

}  // namespace

RELPOS_SHARED float wrap_angle(float angle_rad) {
  while (angle_rad > kPi) angle_rad -= 2.0f * kPi;
  while (angle_rad <= -kPi) angle_rad += 2.0f * kPi;
  return angle_rad;
}

void Attitude::set_identity() {
  q[0] = 1.0f;
  q[1] = q[2] = q[3] = 0.0f;
}

void Attitude::level(const float up[kAxes]) {
  const float norm = sqrtf(dot(up, up));
  const float cosine = up[kZ] / norm;
  q[3] = 0.0f;
  if (cosine < -0.9999f) {  // upside down: any horizontal axis will do
    q[0] = q[2] = 0.0f;
    q[1] = 1.0f;
    return;
  }
  // q = (1 + cos, up x z), normalised
  const float scale = 1.0f / sqrtf(2.0f * (1.0f + cosine));
  q[0] = (1.0f + cosine) * scale;
  q[1] = up[kY] / norm * scale;
  q[2] = -up[kX] / norm * scale;
}

void Attitude::take(const float product[4]) {
  // One Newton step for 1/sqrt near 1: the norm moves by 1e-7 a tick.
  float square = 0.0f;
  for (uint8_t i = 0; i < 4; ++i) square += product[i] * product[i];
  const float scale = 1.5f - 0.5f * square;
  for (uint8_t i = 0; i < 4; ++i) q[i] = product[i] * scale;
}

void Attitude::integrate(const float angle[kAxes]) {
  float small[4], product[4];
  turn(angle, small);
  multiply(q, small, product);
  take(product);
}

RELPOS_SHARED void Attitude::correct(const float angle[kAxes]) {
  Attitude small;
  turn(angle, small.q);
  premultiply(small);
}

void Attitude::premultiply(const Attitude& first) {
  float product[4];
  multiply(first.q, q, product);
  take(product);
}

void Attitude::matrix(float r[kAxes * kAxes]) const {
  const float* v = q + 1;
  float twice[kAxes];
  for (uint8_t i = 0; i < kAxes; ++i) twice[i] = v[i] + v[i];
  for (uint8_t i = 0; i < kAxes; ++i) {
    const uint8_t j = next(i), k = next(j);
    r[4 * i] = 1.0f - (v[j] * twice[j] + v[k] * twice[k]);
    const float same = v[i] * twice[j], opposite = q[0] * twice[k];
    r[3 * i + j] = same - opposite;
    r[3 * j + i] = same + opposite;
  }
}

void rotate(const float r[kAxes * kAxes], const float in[kAxes], float out[kAxes]) {
  for (uint8_t i = 0; i < kAxes; ++i) out[i] = dot(r + 3 * i, in);
}

}  // namespace relpos
