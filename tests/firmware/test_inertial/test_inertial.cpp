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
  CHECK(d.quality_flags & relpos::kForwardUnknown);
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

#if !defined(__AVR__)  // what follows is no arithmetic that a compiler could spoil

TEST(a_bias_that_was_known_is_not_counted_twice_after_a_gap_at_rest) {
  switch_on();
  ImuSample still = sample_at(0.0f);
  still.angular_rate_rad_s[0] = 0.02f;
  for (uint8_t start = 0; start < 2; ++start) {
    for (uint16_t tick = 0; tick < 520; ++tick) reckoning.update(still, kTick_s);
    CHECK_NEAR(0.02f, reckoning.gyro_bias_rad_s()[0], 0.002f);
    reckoning.reset();
  }
}

TEST(steps_of_the_first_second_count_and_are_walked) {
  switch_on();
  for (uint16_t tick = 0; tick < 45; ++tick) {
    reckoning.update(sample_at(5.0f + static_cast<float>(tick) * kTick_s), kTick_s);
  }
  const Displacement& d = reckoning.displacement();
  CHECK(!d.initialised);
  CHECK(d.steps >= 1);
  CHECK(d.path_m > 0.2f);
}

TEST(a_walk_flows_from_step_to_step_and_ends_in_a_short_footfall) {
  switch_on();
  float closing_m[2];
  uint8_t jumps = 0;
  for (uint8_t walk = 0; walk < 2; ++walk) {
    float before_m = reckoning.displacement().x_m;
    for (float time_s = walk == 0 ? 0.0f : 3.3f; time_s < 8.0f; time_s += kTick_s) {
      reckoning.update(sample_at(time_s), kTick_s);
      const Displacement& d = reckoning.displacement();
      if (time_s > 6.0f && fabsf(d.x_m - before_m) > 0.15f) ++jumps;
      before_m = d.x_m;
    }
    CHECK(reckoning.displacement().moving);
    CHECK(!(reckoning.displacement().quality_flags & relpos::kForwardUnknown));
    const uint16_t steps = reckoning.displacement().steps;
    const float step_m = reckoning.displacement().last_step_length_m;
    const float path_m = reckoning.displacement().path_m;
    for (uint8_t tick = 0; tick < 200; ++tick) reckoning.update(sample_at(0.0f), kTick_s);
    const Displacement& d = reckoning.displacement();
    CHECK(!d.moving);
    CHECK_EQUAL(steps + 1, d.steps);
    closing_m[walk] = d.last_step_length_m;
    CHECK(closing_m[walk] > 0.1f && closing_m[walk] < 0.6f * step_m);
    CHECK_NEAR(path_m + closing_m[walk], d.path_m, 1e-3f);
  }
  CHECK_NEAR(closing_m[0], closing_m[1], 0.05f);
  CHECK_EQUAL(0, jumps);
}

TEST(switched_on_while_walking_the_way_flows_once_the_forward_axis_is_known) {
  switch_on();
  const Displacement& d = reckoning.displacement();
  uint8_t jumps = 0;
  float known_s = 0.0f;
  for (uint16_t tick = 0; tick < 500; ++tick) {
    const float x_m = d.x_m;
    ImuSample sample = sample_at(3.3f + static_cast<float>(tick) * kTick_s);
    sample.angular_rate_rad_s[0] = 0.0f;
    reckoning.update(sample, kTick_s);
    if (!(d.quality_flags & relpos::kForwardUnknown)) known_s += kTick_s;
    if (known_s > 1.0f && fabsf(d.x_m - x_m) > 0.15f) ++jumps;
  }
  CHECK(known_s > 5.0f);
  CHECK_EQUAL(0, jumps);
  CHECK_EQUAL(0, reckoning.counters().lost_steps);
  CHECK_EQUAL(0, reckoning.counters().doubtful_steps);
}

TEST(a_blow_that_contradicts_the_steps_is_doubted_and_starts_the_velocity_anew) {
  walk(8.0f);
  const Displacement& d = reckoning.displacement();
  const float path_m = d.path_m;
  for (uint16_t tick = 0; tick < 150; ++tick) {
    ImuSample sample = sample_at(8.0f + static_cast<float>(tick) * kTick_s);
    if (tick < 25) sample.acceleration_m_s2[2] = -8.0f;
    sample.angular_rate_rad_s[0] = 0.0f;
    reckoning.update(sample, kTick_s);
  }
  CHECK_EQUAL(1, reckoning.counters().lost_steps);
  CHECK(reckoning.counters().doubtful_steps >= 1);
  CHECK(d.quality_flags & relpos::kStepDoubtful);
  CHECK_NEAR(3.5f, d.path_m - path_m, 0.6f);  // the steps' own way
}

TEST(the_first_steps_after_a_turn_on_the_spot_go_where_one_faces) {
  walk(8.0f);
  ImuSample still = sample_at(0.0f);
  for (uint8_t tick = 0; tick < 200; ++tick) reckoning.update(still, kTick_s);
  still.angular_rate_rad_s[0] = 0.78539816f;  // to the left
  for (uint8_t tick = 0; tick < 100; ++tick) reckoning.update(still, kTick_s);
  const float x_m = reckoning.displacement().x_m, y_m = reckoning.displacement().y_m;
  const uint16_t steps = reckoning.displacement().steps;
  float time_s = 3.2f;
  while (reckoning.displacement().steps < steps + 2 && time_s < 7.0f) {
    reckoning.update(sample_at(time_s += kTick_s), kTick_s);
  }
  const float x = reckoning.displacement().x_m - x_m, y = reckoning.displacement().y_m - y_m;
  CHECK(y > 0.2f && fabsf(x) < 0.2f * y);
}

// The share of the way that a walk's steps may err by together, and whether it ends flagged.
struct Doubt {
  float scale, path_m;
  bool flagged;
};

const float kLeans[] = {1.75f, -1.75f};  // 100 degrees in a second

// Left and right bob by so much, turning at that rate.
Doubt doubt(float left_m, float right_m, float rate_rad_s) {
  walk(3.2f);
  const Displacement& d = reckoning.displacement();
  float error_m = 0.0f, path_m = 0.0f;
  for (uint16_t tick = 0; tick < 700; ++tick) {
    const float rate = kTwoPi * 1.8f;
    const float phase = rate * kTick_s * tick;
    ImuSample sample = sample_at(3.3f + kTick_s * tick);
    const float bob_m = static_cast<int32_t>(phase / kTwoPi) % 2 == 0 ? left_m : right_m;
    sample.acceleration_m_s2[0] = kGravity + bob_m * rate * rate * cosf(phase);
    sample.angular_rate_rad_s[0] = rate_rad_s;
    reckoning.update(sample, kTick_s);
    if (tick == 350) {
      error_m = d.scale_error_m;
      path_m = d.path_m;
    }
  }
  const Doubt found = {(d.scale_error_m - error_m) / (d.path_m - path_m), d.path_m - path_m,
                       (d.quality_flags & relpos::kStepDoubtful) != 0};
  return found;
}

TEST(a_limp_bobs_too_small_or_large_and_turning_on_the_spot_make_steps_doubtful) {
  const Doubt even = doubt(0.02f, 0.02f, 0.0f);
  const Doubt limping = doubt(0.026f, 0.014f, 0.0f);
  const Doubt shuffling = doubt(0.005f, 0.005f, 0.0f);
  const Doubt striding = doubt(0.09f, 0.09f, 0.0f);
  const Doubt turning = doubt(0.02f, 0.02f, 2.2f);
  CHECK(!even.flagged && limping.flagged && shuffling.flagged && turning.flagged);
  CHECK_NEAR(relpos::kPopulationScale, even.scale, 1e-3f);
  CHECK_NEAR(0.25f, limping.scale, 1e-3f);
  CHECK_NEAR(0.25f, shuffling.scale, 1e-3f);
  CHECK_NEAR(0.25f, striding.scale, 1e-3f);
  CHECK_NEAR(0.25f, turning.scale, 1e-3f);
  CHECK(striding.flagged && striding.path_m < 1.3f * even.path_m);  // people's steps are no longer
  CHECK_NEAR(0.81f, limping.path_m / even.path_m, 0.05f);  // less than its rises say
  CHECK(turning.path_m < 0.1f * even.path_m);
}

TEST(a_field_that_cannot_be_the_earths_gives_no_heading) {
  for (uint8_t which = 0; which < 6; ++which) {
    // Up, left, back. Too weak, too strong; of another norm, vertical, or both, after two seconds
    // of the right one; and that one.
    const float fields_ut[][3] = {{-7.0f, 7.0f, -15.0f},  {-55.0f, 7.0f, -55.0f},
                                  {-40.0f, 7.0f, -44.2f}, {-30.0f, 7.0f, -30.0f},
                                  {-45.0f, 7.0f, -20.7f}, {-40.0f, 7.0f, -29.15f}};
    const float right_ut[3] = {-40.0f, 7.0f, -29.15f};
    walk(0.4f);
    const Displacement& d = reckoning.displacement();
    reckoning.magnetometer(right_ut);  // the vertical is not known yet
    CHECK(!d.magnetic_heading_valid);
    for (uint16_t tick = 0; tick < 520; ++tick) reckoning.update(sample_at(0.0f), kTick_s);
    for (uint8_t i = 0; i < 10 && which > 1; ++i) {
      reckoning.magnetometer(right_ut);
      CHECK(d.magnetic_heading_valid);
    }
    reckoning.magnetometer(fields_ut[which]);
    CHECK_EQUAL(which == 5, d.magnetic_heading_valid);
    CHECK_EQUAL(which != 5, (d.quality_flags & relpos::kMagneticDisturbed) != 0);
    CHECK_EQUAL(which != 5, reckoning.counters().rejected_magnetic);
    reckoning.magnetometer(right_ut);
    CHECK(d.magnetic_heading_valid && !(d.quality_flags & relpos::kMagneticDisturbed));
  }
}

TEST(a_lean_beyond_the_horizontal_either_way_keeps_the_heading) {
  for (const float most_rad : kLeans) {
    switch_on();
    float angle_rad = 0.0f;
    for (uint16_t tick = 0; tick < 1500; ++tick) {
      const float rate =
          tick >= 520 && tick < 570 ? most_rad : tick >= 1400 && tick < 1450 ? -most_rad : 0.0f;
      const ImuSample sample = {
          {kGravity * cosf(angle_rad), 0.0f, kGravity * sinf(angle_rad)},
          {0.02f, rate, 0.0f}};  // with a bias
      angle_rad += rate * kTick_s;
      reckoning.update(sample, kTick_s);
      CHECK_NEAR(0.0f, reckoning.displacement().heading_rad, 0.01f);
    }
  }
}

#endif

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
