// Arithmetic on short vectors of floats, through pointers. On the AVR an operation written out moves
// eight bytes through registers, 30 to 70 bytes of flash; a call of one of these is 16 to 24.
#ifndef RELPOS_INERTIAL_VECTOR_H
#define RELPOS_INERTIAL_VECTOR_H

#include <math.h>
#include <stdint.h>

#include "calls.h"

namespace relpos {

enum Axis : uint8_t { kX = 0, kY = 1, kZ = 2, kAxes = 3 };

inline uint8_t next(uint8_t axis) { return axis == kZ ? static_cast<uint8_t>(kX) : axis + 1; }

// a b + c. On the AVR the product is not rounded before the sum, which is 40 of 300 cycles less and
// the result nearer the true one by up to half a unit in its last place.
#if defined(__AVR__)
float multiply_add(float a, float b, float c) __attribute__((const));
#else
inline float multiply_add(float a, float b, float c) { return a * b + c; }
#endif
float dot(const float* a, const float* b, uint8_t count = kAxes);
float norm(const float v[kAxes]);
void add(float* to, float value);  // to += value
// to += factor * from.
void add_scaled(float* to, const float* from, float factor, uint8_t count);
// A low-pass: moves value towards target by the share `gain`.
void follow(float* value, float target, float gain);
// The axis a quarter turn to the left; out must not be axis.
void left_of(const float axis[2], float out[2]);
// v seen along the plane's axis (any length) and to the left of it; out must not be v.
void resolve(const float axis[2], const float v[2], float out[2]);
// v turned (and stretched) by the axis, undoing resolve; out must not be v or axis.
void compose(const float axis[2], const float v[2], float out[2]);
// Of a number that is not negative, to 1e-6; cbrtf is 420 bytes of the Uno's flash.
float cube_root(float x);
int32_t rounded(float x);
// The unit vector of a direction.
void direct(float angle_rad, float out[2]);
// The direction of a vector's first two. Both by functions of double, the AVR's own: on a PC those of
// float differ in the last digit from one C library to the next, and so would every emulated walk.
inline float bearing(const float* vector) {
  return static_cast<float>(atan2(static_cast<double>(vector[1]), static_cast<double>(vector[0])));
}

}  // namespace relpos

#endif
