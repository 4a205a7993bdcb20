// Height over the start from air pressure.
#pragma once

#include <stdint.h>

namespace relpos {

// Zeroed memory is the start: make it as `Barometer()`.
class Barometer {
 public:
  void add(uint32_t pressure_mpa);  // ten times a second
  bool ready() const { return readings_ == kStartReadings && strange_ != kMostStrange; }
  // Metres over where the first readings led. The barometric formula of the standard atmosphere to
  // the second order: 0.1 m of error at 300 m. It counts in metres of air at 15 degrees: at T
  // kelvin a height is T / 288 of it (4 % at 27 degrees).
  float height_m() const;

 private:
  static constexpr uint8_t kStartReadings = 16;  // 1.6 s
  static constexpr uint8_t kMostStrange = 8;     // 0.8 s: no height, or a new start

  uint32_t start_mpa_;
  int32_t fall_mpa_;  // of the pressure since then, smoothed
  uint8_t readings_;  // up to kStartReadings
  uint8_t strange_;   // in a row, up to kMostStrange
};

}  // namespace relpos
