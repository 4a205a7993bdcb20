#include "node/motion_totals.h"
#include "inertial/calls.h"

#include <stddef.h>
#include <string.h>

#include "devices/flash.h"
#include "inertial/vector.h"

namespace relpos {
namespace {

constexpr float kPi = 3.14159265f;
constexpr float kTurnRad = 6.2831853f;

// What a wearer may do unseen. A walk of unknown direction at 1 m/s, turning at 0.5 rad/s; the
// heading is unknown altogether (uniform: pi^2 / 3) after 4 s. The gap is cut at 60 s, where the
// sigma of 60 m says nothing any more and the 32-bit total of mm^2 must not overtake itself.
constexpr float kGapSpeedMps = 1.0f;
// The steps under way at the gap's ends are lost besides, up to two of them: 1.4 m more than the way
// of the gap where a walker's bus was stuck for 0.1 to 0.3 s (tests/emulator/test_faults_sweeps.py).
constexpr float kRestart_s = 1.0f;
constexpr float kGapRateRadS = 0.5f;
constexpr float kUnknownHeadingRad2 = kPi * kPi / 3.0f;
constexpr float kMostGapS = 60.0f;

// The totals that are a float of the displacement and 32 bits of the message: from where to where,
// and how many thousands make the message's unit. A loop over a table: six times the same code
// would cost the Uno 200 bytes of flash.
struct Total {
  uint8_t from, to, thousands;
};
static_assert(__is_standard_layout(Displacement) && __is_standard_layout(wire::Motion),
              "a total is where its offset says");
enum : uint8_t { kHeadingVariance = 5 };  // a hundred million
const Total kTable[] RELPOS_FLASH = {
    {offsetof(Displacement, x_m), offsetof(wire::Motion, x_mm), 1},
    {offsetof(Displacement, y_m), offsetof(wire::Motion, y_mm), 1},
    {offsetof(Displacement, path_m), offsetof(wire::Motion, path_mm), 1},
    {offsetof(Displacement, variance_along_m2), offsetof(wire::Motion, variance_along_mm2), 2},
    {offsetof(Displacement, variance_across_m2), offsetof(wire::Motion, variance_across_mm2), 2},
    {offsetof(Displacement, variance_heading_rad2),
     offsetof(wire::Motion, variance_heading_100urad2), 2},
    {offsetof(Displacement, scale_error_m), offsetof(wire::Motion, scale_error_mm), 1},
};

}  // namespace

uint32_t scaled(float value, uint32_t per_unit) {
  const int32_t whole = static_cast<int32_t>(value);  // towards zero
  const float rest = (value - static_cast<float>(whole)) * static_cast<float>(per_unit);
  return static_cast<uint32_t>(whole) * per_unit + static_cast<uint32_t>(rounded(rest));
}

void MotionTotals::track(const Displacement& now) {
  const float change = now.heading_rad - previous_heading_rad_;
  if (change > kPi) {
    --turns_;
  } else if (change < -kPi) {
    ++turns_;
  }
  previous_heading_rad_ = now.heading_rad;
}

int32_t MotionTotals::heading_100urad(const Displacement& now) const {
  return base_heading_100urad_ +
         static_cast<int32_t>(scaled(now.heading_rad, 10000) +
                              scaled(static_cast<float>(turns_) * kTurnRad, 10000));
}

void MotionTotals::fill(const Displacement& now, wire::Motion* motion) const {
  const float way_m[2] = {now.x_m, now.y_m};
  float base_axis[2], moved_m[2];
  direct(static_cast<float>(base_heading_100urad_) * 1e-4f, base_axis);
  compose(base_axis, way_m, moved_m);
  for (uint8_t i = 0; i < kTotals; ++i) {
    float value;
    const void* from = reinterpret_cast<const uint8_t*>(&now) + flash_byte(&kTable[i].from);
    if (i < 2) from = moved_m + i;
    memcpy(&value, from, sizeof value);
    uint32_t per_unit = 1000;
    for (uint8_t k = flash_byte(&kTable[i].thousands); k > 1; --k) per_unit *= 1000;
    if (i == kHeadingVariance) per_unit *= 100;
    const uint32_t total = base_[i] + scaled(value, per_unit);
    memcpy(reinterpret_cast<uint8_t*>(motion) + flash_byte(&kTable[i].to), &total, sizeof total);
  }
  motion->heading_100urad = heading_100urad(now);
  motion->steps = static_cast<uint16_t>(steps_ + now.steps);
}

RELPOS_APART RELPOS_SHARED void MotionTotals::rebase(const Displacement& last, float gap_s) {
  wire::Motion motion;
  fill(last, &motion);
  if (gap_s > kMostGapS) gap_s = kMostGapS;
  const float gap_m = (gap_s + kRestart_s) * kGapSpeedMps;
  const float gap_rad = gap_s * kGapRateRadS;
  float gap_rad2 = gap_rad * gap_rad;
  if (gap_rad2 > kUnknownHeadingRad2) gap_rad2 = kUnknownHeadingRad2;
  motion.variance_along_mm2 += scaled(gap_m * gap_m, 1000000);
  motion.variance_across_mm2 += scaled(gap_m * gap_m, 1000000);
  motion.variance_heading_100urad2 += scaled(gap_rad2, 100000000);
  for (uint8_t i = 0; i < kTotals; ++i) {
    memcpy(base_ + i, reinterpret_cast<const uint8_t*>(&motion) + flash_byte(&kTable[i].to),
           sizeof base_[i]);
  }
  steps_ = motion.steps;
  base_heading_100urad_ = motion.heading_100urad;
  turns_ = 0;
}

}  // namespace relpos
