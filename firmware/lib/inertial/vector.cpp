#include "vector.h"
#include "inertial/calls.h"

#include <math.h>
#include <string.h>

namespace relpos {

#if defined(__AVR__)
// What avr-libc's __mulsf3 and __addsf3 are made of: __mulsf3x leaves its result with eight bits more
// (r27), __addsf3x takes them so and those of the other number in r26.
__attribute__((naked, noinline)) float multiply_add(float, float, float) {
  asm volatile(
      "call __mulsf3x\n"
      "movw r18, r14\n"
      "movw r20, r16\n"
      "clr r26\n"
      "call __addsf3x\n"
      "jmp __fp_round\n");
}
#endif

RELPOS_SHARED float dot(const float* a, const float* b, uint8_t count) {
  float sum = *a * *b;
  while (--count != 0) sum = multiply_add(*++a, *++b, sum);
  return sum;
}

RELPOS_SHARED float norm(const float v[kAxes]) { return sqrtf(dot(v, v)); }

RELPOS_SHARED void add(float* to, float value) { *to += value; }

RELPOS_SHARED void add_scaled(float* to, const float* from, float factor, uint8_t count) {
  for (; count != 0; --count, ++to) *to = multiply_add(*from++, factor, *to);
}

RELPOS_SHARED void follow(float* value, float target, float gain) {
  *value = multiply_add(target - *value, gain, *value);
}

RELPOS_SHARED void left_of(const float axis[2], float out[2]) {
  out[kX] = -axis[kY];
  out[kY] = axis[kX];
}

RELPOS_SHARED void resolve(const float axis[2], const float v[2], float out[2]) {
  float left[2];
  left_of(axis, left);
  out[kX] = dot(axis, v, 2);
  out[kY] = dot(left, v, 2);
}

RELPOS_SHARED void compose(const float axis[2], const float v[2], float out[2]) {
  const float mirrored[2] = {axis[kX], -axis[kY]};
  resolve(mirrored, v, out);
}

float cube_root(float x) {
  // Newton's steps, from a third of the exponent: within 4 % at the start, squared each time.
  static_assert(sizeof(uint32_t) == sizeof x, "a float's bits are taken");
  uint32_t bits;
  memcpy(&bits, &x, sizeof bits);
  bits = bits / 3 + 0x2a514067;
  float root;
  memcpy(&root, &bits, sizeof root);
  for (uint8_t i = 0; i < 3; ++i) root += (x / (root * root) - root) * (1.0f / 3.0f);
  return root;
}

int32_t rounded(float x) {
  return static_cast<int32_t>(x + (x < 0.0f ? -0.5f : 0.5f));
}

RELPOS_SHARED void direct(float angle_rad, float out[2]) {
  const double angle = angle_rad;
  out[kX] = static_cast<float>(cos(angle));
  out[kY] = static_cast<float>(sin(angle));
}

}  // namespace relpos
