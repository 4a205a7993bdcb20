#include "node/motion_totals.h"

#include <math.h>

namespace relpos {
namespace {

constexpr float kPi = 3.14159265f;
constexpr float kTurnRad = 6.2831853f;

// What a wearer may do unseen. A walk of unknown direction at 1 m/s, turning at 0.5 rad/s; the
// heading is unknown altogether (uniform: pi^2 / 3) after 4 s. The gap is cut at 60 s, where the
// sigma of 60 m says nothing any more and the 32-bit total of mm^2 must not overtake itself.
constexpr float kGapSpeedMps = 1.0f;
constexpr float kGapRateRadS = 0.5f;
constexpr float kUnknownHeadingRad2 = kPi * kPi / 3.0f;
constexpr float kMostGapS = 60.0f;

}  // namespace

uint32_t scaled(float value, uint32_t per_unit) {
  const float whole = floorf(value);
  const float rest = (value - whole) * static_cast<float>(per_unit);
  return static_cast<uint32_t>(static_cast<int32_t>(whole)) * per_unit +
         static_cast<uint32_t>(rest + 0.5f);
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
  float x_m = now.x_m;
  float y_m = now.y_m;
  if (base_heading_100urad_ != 0) {
    const float base_rad = static_cast<float>(base_heading_100urad_) * 1e-4f;
    const float c = cosf(base_rad);
    const float s = sinf(base_rad);
    x_m = c * now.x_m - s * now.y_m;
    y_m = s * now.x_m + c * now.y_m;
  }
  motion->x_mm = static_cast<int32_t>(x_mm_ + scaled(x_m, 1000));
  motion->y_mm = static_cast<int32_t>(y_mm_ + scaled(y_m, 1000));
  motion->heading_100urad = heading_100urad(now);
  motion->path_mm = path_mm_ + scaled(now.path_m, 1000);
  motion->steps = static_cast<uint16_t>(steps_ + now.steps);
  motion->variance_along_mm2 = along_mm2_ + scaled(now.variance_along_m2, 1000000);
  motion->variance_across_mm2 = across_mm2_ + scaled(now.variance_across_m2, 1000000);
  motion->variance_heading_100urad2 =
      heading_100urad2_ + scaled(now.variance_heading_rad2, 100000000);
}

void MotionTotals::rebase(const Displacement& last, float gap_s) {
  wire::Motion motion;
  fill(last, &motion);
  if (gap_s > kMostGapS) gap_s = kMostGapS;
  const float gap_m = gap_s * kGapSpeedMps;
  const float gap_rad = gap_s * kGapRateRadS;
  float gap_rad2 = gap_rad * gap_rad;
  if (gap_rad2 > kUnknownHeadingRad2) gap_rad2 = kUnknownHeadingRad2;
  x_mm_ = static_cast<uint32_t>(motion.x_mm);
  y_mm_ = static_cast<uint32_t>(motion.y_mm);
  path_mm_ = motion.path_mm;
  steps_ = motion.steps;
  base_heading_100urad_ = motion.heading_100urad;
  along_mm2_ = motion.variance_along_mm2 + scaled(gap_m * gap_m, 1000000);
  across_mm2_ = motion.variance_across_mm2 + scaled(gap_m * gap_m, 1000000);
  heading_100urad2_ = motion.variance_heading_100urad2 + scaled(gap_rad2, 100000000);
  turns_ = 0;
  previous_heading_rad_ = 0.0f;
}

}  // namespace relpos
