// Gait detector, forward axis and error filter by themselves, against what their equations give.
#include "support/check.h"

#include <math.h>

#include "inertial/filter.h"
#include "inertial/gait.h"

using relpos::ErrorFilter;
using relpos::ForwardFinder;
using relpos::GaitDetector;
using relpos::Stance;
using relpos::kAttitude;
using relpos::kReference;
using relpos::kStates;
using relpos::kVelocity;

namespace {

const float kTick_s = 0.02f;
const float kRate = 6.2831853f * 1.8f;

uint8_t stances, inferred;

// So many steps of 4 cm at 1.8 Hz, then three seconds of standing.
void walk(uint8_t steps) {
  GaitDetector gait;
  gait.reset();
  Stance stance;
  stances = inferred = 0;
  for (uint16_t tick = 0; tick < 700; ++tick) {
    const float phase = kRate * kTick_s * tick;
    const bool walks = phase < 6.2831853f * steps;
    const float vertical = walks ? 0.02f * kRate * kRate * cosf(phase) : 0.0f;
    if (!gait.update(9.80665f + vertical, kTick_s, &stance)) continue;
    ++stances;
    if (stance.last) ++inferred;
  }
}

ForwardFinder finder;

// Forward acceleration along y that leads the height by a quarter period, or has another rhythm.
void find(float rhythm) {
  finder.reset();
  for (uint16_t tick = 0; tick < 600; ++tick) {
    const float phase = kRate * kTick_s * tick;
    const float a[2] = {0.0f, sinf(rhythm * phase)};
    finder.update(a, -0.2f * sinf(phase), kTick_s);
    if (tick % 28 == 27) finder.step();
  }
}

}  // namespace

TEST(a_walk_has_one_inferred_footfall_at_its_end) {
  walk(9);
  CHECK_EQUAL(1, inferred);
  CHECK(stances >= 9 && stances <= 10);
}

TEST(three_bobs_are_no_walk_that_ends_in_a_footfall) {
  walk(3);
  CHECK(stances > 0);
  CHECK_EQUAL(0, inferred);
}

TEST(forward_is_where_the_torso_falls) {
  find(1.0f);
  CHECK(finder.found());
  CHECK_NEAR(1.5707963f, finder.offset_rad(), 1e-3f);
}

TEST(motion_of_another_rhythm_has_no_forward) {
  find(1.7f);
  CHECK(!finder.found());
}

TEST(forward_turns_with_the_axis_that_it_is_told_from) {
  find(1.0f);
  finder.turn(0.3f);
  CHECK_NEAR(1.8707963f, finder.offset_rad(), 1e-3f);
  finder.turn(0.3f);
  CHECK_NEAR(2.1707963f, finder.offset_rad(), 1e-3f);
  CHECK_NEAR(cosf(2.1707963f), finder.axis()[0], 1e-3f);
}

TEST(a_compass_that_says_it_again_says_less) {
  ErrorFilter filter;
  float correction[kStates + 1];
  const float none[3] = {0.0f, 0.0f, 0.0f};
  filter.reset(1e-4f, 1e-6f, 1e-2f);
  filter.widen(kAttitude + 2, 0.04f, 1);
  filter.set_reference(0.09f);
  // Heading minus reference, of variance S = 0.13, measured twice with the variance R = 0.01.
  CHECK_NEAR(0.14f, filter.update(kAttitude, none, 1.0f, 0.2f, 0.01f, correction), 1e-6f);
  CHECK_NEAR(0.2f * 0.04f / 0.14f, correction[kAttitude + 2], 1e-6f);
  CHECK_NEAR(-0.2f * 0.09f / 0.14f, correction[kReference], 1e-6f);
  const float again = 0.01f + 0.13f * 0.01f / 0.14f;
  CHECK_NEAR(again, filter.update(kAttitude, none, 1.0f, 0.0f, 0.01f, correction), 1e-6f);
}

TEST(a_perfect_velocity_leaves_a_floor_of_variance_and_is_counted_once) {
  ErrorFilter filter;
  float correction[kStates + 1];
  const float along[3] = {1.0f, 0.0f, 0.0f};
  filter.reset(1e-4f, 1e-6f, 1e-2f);
  filter.update(kVelocity, along, 0.0f, 0.5f, 1e-12f, correction);
  CHECK_EQUAL(1, filter.repairs());
  CHECK_NEAR(1e-7f, filter.covariance(kVelocity, kVelocity), 1e-9f);
  CHECK_NEAR(0.5f, correction[kVelocity], 1e-6f);
  CHECK_NEAR(0.0f, correction[kReference], 1e-9f);
}

TEST(a_bias_of_the_gyroscope_widens_the_attitude_alone) {
  ErrorFilter filter;
  const float rotation[9] = {1.0f, 0.0f, 0.0f, 0.0f, 1.0f, 0.0f, 0.0f, 0.0f, 1.0f};
  filter.reset(1e-4f, 1e-2f, 1e-2f);
  filter.predict_attitude(rotation, 1.0f);
  for (uint8_t i = 0; i < 3; ++i) {
    CHECK_NEAR(1e-2f, filter.covariance(kAttitude + i, kAttitude + i), 2e-4f);
    CHECK_NEAR(-1e-2f, filter.covariance(kAttitude + i, 3 + i), 1e-6f);
    CHECK_NEAR(1e-2f, filter.covariance(3 + i, 3 + i), 1e-6f);
    CHECK_NEAR(1e-2f, filter.covariance(kVelocity + i, kVelocity + i), 1e-8f);
  }
}

RUN_TESTS()
