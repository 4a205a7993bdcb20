#include "attitude.h"

#include <math.h>

namespace relpos {

float wrap_angle(float angle_rad) {
  while (angle_rad > kPi) angle_rad -= 2.0f * kPi;
  while (angle_rad <= -kPi) angle_rad += 2.0f * kPi;
  return angle_rad;
}

void Attitude::set_identity() {
  w = 1.0f;
  x = y = z = 0.0f;
}

void Attitude::level(const float up[kAxes]) {
  const float norm = sqrtf(up[kX] * up[kX] + up[kY] * up[kY] + up[kZ] * up[kZ]);
  const float cosine = up[kZ] / norm;
  if (cosine < -0.9999f) {  // upside down: any horizontal axis will do
    w = y = z = 0.0f;
    x = 1.0f;
    return;
  }
  // q = (1 + cos, up x z), normalised
  w = 1.0f + cosine;
  x = up[kY] / norm;
  y = -up[kX] / norm;
  z = 0.0f;
  const float scale = 1.0f / sqrtf(w * w + x * x + y * y);
  w *= scale;
  x *= scale;
  y *= scale;
}

void Attitude::normalise() {
  // One Newton step for 1/sqrt near 1: the norm moves by 1e-7 a tick.
  const float scale = 1.5f - 0.5f * (w * w + x * x + y * y + z * z);
  w *= scale;
  x *= scale;
  y *= scale;
  z *= scale;
}

void Attitude::integrate(const float angle[kAxes]) {
  // Half-angle sine and cosine to third order: at 500 deg/s and 20 ms the angle is 0.17 rad and
  // the truncation 1e-7.
  const float square =
      0.25f * (angle[kX] * angle[kX] + angle[kY] * angle[kY] + angle[kZ] * angle[kZ]);
  const float sine = 0.5f - square * (1.0f / 12.0f);
  const float cosine = 1.0f - 0.5f * square + square * square * (1.0f / 24.0f);
  const float ax = angle[kX] * sine, ay = angle[kY] * sine, az = angle[kZ] * sine;
  const float nw = w * cosine - x * ax - y * ay - z * az;
  const float nx = x * cosine + w * ax + y * az - z * ay;
  const float ny = y * cosine + w * ay + z * ax - x * az;
  const float nz = z * cosine + w * az + x * ay - y * ax;
  w = nw;
  x = nx;
  y = ny;
  z = nz;
  normalise();
}

void Attitude::premultiply(const Attitude& first) {
  const float nw = first.w * w - first.x * x - first.y * y - first.z * z;
  const float nx = first.w * x + first.x * w + first.y * z - first.z * y;
  const float ny = first.w * y + first.y * w + first.z * x - first.x * z;
  const float nz = first.w * z + first.z * w + first.x * y - first.y * x;
  w = nw;
  x = nx;
  y = ny;
  z = nz;
}

void Attitude::correct(const float angle[kAxes]) {
  Attitude turn;
  turn.set_identity();
  turn.integrate(angle);
  premultiply(turn);
  normalise();
}

void Attitude::matrix(float r[kAxes * kAxes]) const {
  const float x2 = x + x, y2 = y + y, z2 = z + z;
  const float xx = x * x2, yy = y * y2, zz = z * z2;
  const float xy = x * y2, xz = x * z2, yz = y * z2;
  const float wx = w * x2, wy = w * y2, wz = w * z2;
  r[0] = 1.0f - (yy + zz);
  r[1] = xy - wz;
  r[2] = xz + wy;
  r[3] = xy + wz;
  r[4] = 1.0f - (xx + zz);
  r[5] = yz - wx;
  r[6] = xz - wy;
  r[7] = yz + wx;
  r[8] = 1.0f - (xx + yy);
}

void rotate(const float r[kAxes * kAxes], const float in[kAxes], float out[kAxes]) {
  for (uint8_t i = 0; i < kAxes; ++i) {
    out[i] = r[3 * i] * in[kX] + r[3 * i + 1] * in[kY] + r[3 * i + 2] * in[kZ];
  }
}

}  // namespace relpos
