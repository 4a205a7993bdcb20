#include "node/barometer.h"
#include "inertial/calls.h"

namespace relpos {
namespace {

// Pressures that people can be in; a chip that is not ready reports 0.
constexpr uint32_t kLeastMpa = 30000000;
constexpr uint32_t kMostMpa = 120000000;
// More than 12 m in a tenth of a second is a fault; so many of them are a new truth (a fan, a
// pressurised staircase) that starts at the height where it was met.
constexpr int32_t kStrangeMpa = 150000;
// Follows a climb with 0.4 s of delay; leaves 2 Pa of noise 0.8 Pa: 0.06 m.
constexpr uint8_t kSmoothingBits = 2;  // a quarter of the news; a shift keeps the sign with both compilers
// Standard atmosphere (ISO 2533): 288.15 K / 0.0065 K/m x 0.190263, and (1 - 0.190263) / 2.
constexpr float kScaleHeightM = 8434.5f;
constexpr float kSecondOrder = 0.40487f;

}  // namespace

RELPOS_SHARED void Barometer::add(uint32_t pressure_mpa) {
  if (readings_ == 0) start_mpa_ = pressure_mpa;
  const int32_t news = static_cast<int32_t>(start_mpa_ - pressure_mpa) - fall_mpa_;
  const bool garbage = pressure_mpa < kLeastMpa || pressure_mpa > kMostMpa;
  if (garbage || (news < 0 ? -news : news) > kStrangeMpa) {
    if (strange_ != kMostStrange) ++strange_;
    if (garbage || strange_ != kMostStrange) return;
    start_mpa_ -= static_cast<uint32_t>(news);
  } else if (readings_ < kStartReadings) {
    ++readings_;
    start_mpa_ -= static_cast<uint32_t>((news >> kSmoothingBits));
  } else {
    fall_mpa_ += (news >> kSmoothingBits);
  }
  strange_ = 0;
}

float Barometer::height_m() const {
  const float x = static_cast<float>(fall_mpa_) / static_cast<float>(start_mpa_);
  return kScaleHeightM * x * (1.0f + kSecondOrder * x);
}

}  // namespace relpos
