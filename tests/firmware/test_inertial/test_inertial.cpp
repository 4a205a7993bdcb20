// Torso dead reckoning on a synthetic walk: the same figures on the PC and on the AVR, whose compiler
// has miscompiled float loops before. Physics on real walks: tests/inertial/test_inertial.py.
#include "support/check.h"

#include <math.h>

#include <new>

#include "inertial/dead_reckoning.h"

using relpos::DeadReckoning;
using relpos::Displacement;
using relpos::ImuSample;

namespace {

const float kTick_s = 0.02f;
const float kTwoPi = 6.2831853f;
const float kGravity = 9.80665f;

// 3.2 s still, then steps of 1.8 Hz: the torso bobs by 4 cm, its fore-aft acceleration leads the
// height by a quarter period as the pendulum's does, and from 8 s on it turns left at 20 deg/s.
// Sensor axes: x up, y left, z backward.
ImuSample sample_at(float time_s) {
  ImuSample sample = {{kGravity, 0.0f, 0.0f}, {0.0f, 0.0f, 0.0f}};
  if (time_s > 3.2f) {
    const float rate = kTwoPi * 1.8f;
    const float phase = rate * (time_s - 3.2f);
    sample.acceleration_m_s2[0] += 0.02f * rate * rate * cosf(phase);
    sample.acceleration_m_s2[1] += 0.3f * sinf(0.5f * phase);
    sample.acceleration_m_s2[2] += -1.2f * sinf(phase);
    if (time_s > 8.0f) sample.angular_rate_rad_s[0] = 0.34906585f;
  }
  return sample;
}

// In one place: in the stack frame of a test it would not fit the Uno.
DeadReckoning reckoning;

void switch_on() { new (&reckoning) DeadReckoning(); }

const Displacement& walk(float seconds) {
  switch_on();
  const uint16_t ticks = static_cast<uint16_t>(seconds / kTick_s + 0.5f);
  for (uint16_t tick = 0; tick < ticks; ++tick) {
    reckoning.update(sample_at(static_cast<float>(tick) * kTick_s), kTick_s);
  }
  return reckoning.displacement();
}

}  // namespace

TEST(standing_goes_nowhere) {
  const Displacement& d = walk(3.2f);
  CHECK_EQUAL(0, d.steps);
  CHECK_NEAR(0.0f, d.path_m, 1e-6f);
}

// The constants are what the PC computes; a change of the filter that is meant changes them.
TEST(a_walk_ends_where_it_does_on_every_machine) {
  const Displacement& d = walk(12.0f);
  CHECK_EQUAL(16, d.steps);
  CHECK_NEAR(1.071867e1f, d.path_m, 1e-3f);
  CHECK_NEAR(9.559442e0f, d.x_m, 1e-3f);
  CHECK_NEAR(2.878035e0f, d.y_m, 1e-3f);
  CHECK_NEAR(1.388554e0f, d.heading_rad, 1e-4f);
  CHECK_NEAR(9.005705e-2f, d.variance_along_m2, 1e-4f);
}

TEST(the_turn_is_the_gyroscopes) {
  const Displacement& d = walk(12.0f);
  CHECK_NEAR(0.34906585f * 4.0f, d.heading_rad, 0.05f);
}

// A step's updates take six ticks, and the next step comes within five or six.
TEST(steps_are_walked_with_ten_samples_a_second_too) {
  const uint16_t steps = walk(8.0f).steps;
  const float path_m = reckoning.displacement().path_m;
  switch_on();
  const float tick_s = 0.1f;
  for (uint8_t tick = 0; tick < 80; ++tick) {
    reckoning.update(sample_at(static_cast<float>(tick) * tick_s), tick_s);
  }
  CHECK(reckoning.displacement().steps + 1 >= steps);
  CHECK(reckoning.displacement().path_m > 0.7f * path_m);
}

TEST(what_is_no_number_is_refused_and_counted) {
  walk(6.0f);
  const float x_m = reckoning.displacement().x_m;
  ImuSample bad = sample_at(6.0f);
  bad.acceleration_m_s2[1] = NAN;
  reckoning.update(bad, kTick_s);
  reckoning.update(sample_at(6.0f), 0.0f);
  CHECK_EQUAL(2, reckoning.counters().refused_samples);
  CHECK_NEAR(x_m, reckoning.displacement().x_m, 1e-6f);
}

TEST(after_a_gap_the_gyroscope_is_the_one_that_it_was) {
  const float bias_rad_s = 0.02f;
  switch_on();
  for (uint16_t tick = 0; tick < 520; ++tick) {
    ImuSample still = sample_at(0.0f);
    still.angular_rate_rad_s[0] = bias_rad_s;
    reckoning.update(still, kTick_s);
  }
  CHECK_NEAR(bias_rad_s, reckoning.gyro_bias_rad_s()[0], 0.1f * bias_rad_s);
  reckoning.reset();
  for (uint16_t tick = 0; tick < 150; ++tick) {
    ImuSample walking = sample_at(4.0f + static_cast<float>(tick) * kTick_s);
    walking.angular_rate_rad_s[0] = bias_rad_s;
    reckoning.update(walking, kTick_s);
  }
  CHECK(reckoning.displacement().initialised);
  CHECK_NEAR(bias_rad_s, reckoning.gyro_bias_rad_s()[0], 0.1f * bias_rad_s);
  CHECK(fabsf(reckoning.displacement().heading_rad) < 0.02f);
}

// Whirled at the sensor's limit about every axis, with a contact open for eight samples.
TEST(a_fall_in_a_gap_of_samples_leaves_a_rotation) {
  walk(4.0f);
  ImuSample fall = sample_at(0.0f);
  for (uint8_t k = 0; k < 3; ++k) fall.angular_rate_rad_s[k] = k == 1 ? -17.43f : 17.43f;
  reckoning.update(fall, 0.2f);
  for (uint8_t tick = 0; tick < 100; ++tick) reckoning.update(sample_at(0.0f), kTick_s);
  const Displacement& d = reckoning.displacement();
  CHECK(fabsf(d.heading_rad) <= 0.5f * kTwoPi + 1e-6f);  // false for NaN, too
  CHECK(d.path_m < 20.0f);
}

#if defined(__AVR__)
const uint32_t kRandomSteps = 400;
#else
const uint32_t kRandomSteps = 1000000;
#endif

// Whatever the sensors say, up to their limits and beyond, at whatever intervals.
TEST(random_motion_leaves_every_variance_positive_and_growing) {
  switch_on();
  uint32_t random = 12345;
  float along = 0.0f, across = 0.0f, heading = 0.0f;
  for (uint32_t step = 0; step < kRandomSteps; ++step) {
    ImuSample sample;
    float* values = sample.acceleration_m_s2;
    const uint8_t mood = static_cast<uint8_t>(step / 100 % 4);  // still, walking, shaken, at the limits
    float size[2] = {0.05f, 0.01f};
    if (mood == 1) size[0] = 3.0f, size[1] = 1.0f;
    if (mood == 2) size[0] = 20.0f, size[1] = 8.0f;
    if (mood == 3) size[0] = 60.0f, size[1] = 40.0f;
    for (uint8_t k = 0; k < 6; ++k) {
      random = random * 1664525u + 1013904223u;
      const float unit = static_cast<float>(random >> 8) * 1.1920929e-7f - 1.0f;
      if (k == 3) values = sample.angular_rate_rad_s - 3;
      values[k] = unit * size[k / 3];
    }
    sample.acceleration_m_s2[step / 5000 % 3] += kGravity;
    const float gap_s = (random & 63) == 0 ? 0.2f : 0.15f;  // the longest that is not refused
    reckoning.update(sample, (random & 31) == 0 ? gap_s : kTick_s);
    if ((random & 15) == 0) {
      const float field_ut[3] = {sample.angular_rate_rad_s[0], 20.0f, -40.0f};
      reckoning.magnetometer(field_ut);
    }
    const Displacement& d = reckoning.displacement();
    CHECK(d.variance_along_m2 >= along && d.variance_across_m2 >= across &&
          d.variance_heading_rad2 >= heading);  // false for NaN, too
    along = d.variance_along_m2;
    across = d.variance_across_m2;
    heading = d.variance_heading_rad2;
    CHECK(!isinf(along + across + heading));
    CHECK(!isnan(d.x_m + d.y_m + d.heading_rad + d.path_m));
  }
}

RUN_TESTS()
