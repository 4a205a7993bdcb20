// Gait detector, forward axis and error filter by themselves, against what their equations give.
#include "support/check.h"

#include <math.h>

#include "inertial/filter.h"
#include "inertial/gait.h"

using relpos::ErrorFilter;
using relpos::ForwardFinder;
using relpos::GaitDetector;
using relpos::Stance;
using relpos::State;
using relpos::kAttitude;
using relpos::kBias;
using relpos::kPosition;
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

// The filter once more, as the textbook has it: a full covariance of all states and the reference.
const uint8_t kAll = kStates + 1;
float dense[kAll][kAll];

// P' = M P M' of the map x_to += factor[i][j] x_from of two groups of three.
void dense_map(State to, State from, const float factor[9]) {
  for (uint8_t side = 0; side < 2; ++side) {
    for (uint8_t k = 0; k < kAll; ++k) {
      for (uint8_t i = 0; i < 3; ++i) {
        float& element = side == 0 ? dense[to + i][k] : dense[k][to + i];
        for (uint8_t j = 0; j < 3; ++j) {
          element += factor[3 * i + j] * (side == 0 ? dense[from + j][k] : dense[k][from + j]);
        }
      }
    }
  }
}

void dense_widen(State group, float variance) {
  for (uint8_t i = 0; i < 3; ++i) dense[group + i][group + i] += variance;
}

bool turns(uint8_t i) { return (i >= 2 && i < 6) || i == kReference; }  // heading, bias, reference

// Of the reference only the correlations with heading and bias are kept.
void dense_forget() {
  for (uint8_t i = 0; i < kStates; ++i) {
    if (!turns(i)) dense[i][kReference] = dense[kReference][i] = 0.0f;
  }
}

// A Kalman update, after Schmidt (1966) where the measurement leaves some states as they are.
float dense_update(State group, const float h[kAll], float innovation, float variance,
                   float correction[kAll]) {
  float ph[kAll], total = variance;
  for (uint8_t i = 0; i < kAll; ++i) {
    ph[i] = 0.0f;
    for (uint8_t j = 0; j < kAll; ++j) ph[i] += dense[i][j] * h[j];
  }
  for (uint8_t i = 0; i < kAll; ++i) total += h[i] * ph[i];
  for (uint8_t i = 0; i < kAll; ++i) {
    const bool fixed = group != kBias && turns(i) == (group != kAttitude);
    correction[i] = fixed ? 0.0f : ph[i] / total * innovation;
    for (uint8_t j = 0; j < kAll; ++j) {
      const bool both = fixed && turns(j) == (group != kAttitude);
      if (!both) dense[i][j] -= ph[i] * ph[j] / total;
    }
  }
  dense_forget();
  return total;
}

uint32_t dice = 1;

float thrown(float to) {
  dice = dice * 1664525u + 1013904223u;
  return to * (static_cast<float>(dice >> 8) / 8388608.0f - 1.0f);
}

void check_alike(const ErrorFilter& filter) {
  for (uint8_t i = 0; i < kStates; ++i) {
    for (uint8_t j = 0; j < kStates; ++j) {
      const float scale = sqrtf(dense[i][i] * dense[j][j]);
      CHECK_NEAR(dense[i][j], filter.covariance(i, j), 1e-4f * scale);
    }
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

TEST(the_packed_filter_does_what_the_full_matrix_does) {
  const float kTilt = 1e-3f, kBiases = 1e-5f, kVelocities = 1e-2f, kNorth = 0.09f;
  ErrorFilter filter;
  filter.reset(kTilt, kBiases, kVelocities);
  filter.widen(kAttitude + 2, 0.04f, 1);
  filter.set_reference(kNorth);
  for (uint8_t i = 0; i < kAll; ++i) {
    for (uint8_t j = 0; j < kAll; ++j) dense[i][j] = 0.0f;
  }
  dense_widen(kBias, kBiases);
  dense_widen(kVelocity, kVelocities);
  dense[0][0] = dense[1][1] = kTilt;
  dense[2][2] = 0.04f;
  dense[kReference][kReference] = kNorth;
  const float half_s[9] = {0.05f, 0.0f, 0.0f, 0.0f, 0.05f, 0.0f, 0.0f, 0.0f, 0.05f};
  float half_owed_s = 0.0f;
  for (uint8_t round = 0; round < 40; ++round) {
    float rotation[9], turn[9], impulse[3];
    for (uint8_t i = 0; i < 9; ++i) turn[i] = -0.1f * (rotation[i] = thrown(1.0f));
    filter.predict_attitude(rotation, 0.1f);
    dense_map(kAttitude, kBias, turn);
    dense_widen(kAttitude, 0.1f * 6.8538919e-6f);  // (0.15 deg)^2 a second
    dense_widen(kBias, 0.1f * 4.8738787e-9f);      // (0.004 deg/s)^2 a second
    for (uint8_t i = 0; i < 3; ++i) impulse[i] = thrown(1.0f);
    filter.predict_motion(impulse, 0.1f);
    if (half_owed_s > 0.0f) dense_map(kPosition, kVelocity, half_s);
    dense_map(kPosition, kVelocity, half_s);
    const float cross[9] = {0.0f, impulse[2], -impulse[1], -impulse[2], 0.0f,
                            impulse[0], impulse[1], -impulse[0], 0.0f};
    dense_map(kVelocity, kAttitude, cross);
    dense_forget();
    dense_widen(kVelocity, 0.1f * 0.0625f);
    half_owed_s = 0.05f;
    if (round % 3 == 2) continue;
    filter.settle();
    filter.settle();
    dense_map(kPosition, kVelocity, half_s);
    half_owed_s = 0.0f;
    check_alike(filter);
    const State group = static_cast<State>(3 * (round % 4));
    float direction[3], h[kAll], correction[kAll], expected[kAll];
    const float yaw = group == kAttitude ? 1.0f : group == kBias ? 0.0f : thrown(1.0f);
    for (uint8_t i = 0; i < kAll; ++i) h[i] = 0.0f;
    for (uint8_t i = 0; i < 3; ++i) {
      direction[i] = group == kAttitude ? 0.0f : thrown(1.0f);
      h[group + i] = direction[i];
    }
    h[2] += yaw;
    if (group == kAttitude) h[kReference] = -1.0f;
    const float variance = group == kBias ? 1e-5f : 0.02f;
    const float total = dense_update(group, h, 0.3f, variance, expected);
    CHECK_NEAR(total, filter.update(group, direction, yaw, 0.3f, variance, correction),
               1e-4f * total);
    for (uint8_t i = 0; i < kAll; ++i) {
      const float scale = sqrtf(dense[i][i] + 1e-9f);
      CHECK_NEAR(expected[i], correction[i], 1e-3f * scale);
    }
    check_alike(filter);
    CHECK_NEAR(direction[0] * direction[0] * dense[group][group] +
                   2.0f * direction[0] * direction[1] * dense[group][group + 1] +
                   direction[1] * direction[1] * dense[group + 1][group + 1],
               filter.along(group, direction), 1e-4f * dense[group][group] + 1e-4f);
  }
  CHECK_EQUAL(0, filter.repairs());
  filter.restart(kPosition, 0.5f);
  for (uint8_t i = 0; i < kStates; ++i) {
    for (uint8_t j = kPosition; j < kStates; ++j) {
      CHECK_NEAR(i == j ? 0.5f : 0.0f, filter.covariance(i, j), 0.0f);
    }
  }
}

RUN_TESTS()
