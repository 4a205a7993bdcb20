// The motion message's running totals: integers that wrap, and that a restart of the dead reckoning
// does not set back.
#pragma once

#include <stdint.h>

#include "inertial/displacement.h"
#include "wire/messages.h"

namespace relpos {

// value * per_unit, rounded, modulo 2^32: exact for the whole units however large they are.
uint32_t scaled(float value, uint32_t per_unit);

class MotionTotals {
 public:
  void track(const Displacement& now);  // after every update: follows whole turns
  void fill(const Displacement& now, wire::Motion* motion) const;
  // The dead reckoning is about to be reset after gap_s without samples: what it had stays, its next
  // totals are appended, and the unknown motion of the gap is charged as variance.
  void rebase(const Displacement& last, float gap_s);

 private:
  int32_t heading_100urad(const Displacement& now) const;

  uint32_t x_mm_ = 0, y_mm_ = 0, path_mm_ = 0;
  uint32_t along_mm2_ = 0, across_mm2_ = 0, heading_100urad2_ = 0;
  int32_t base_heading_100urad_ = 0;
  float previous_heading_rad_ = 0.0f;
  int16_t turns_ = 0;
  uint16_t steps_ = 0;
};

}  // namespace relpos
