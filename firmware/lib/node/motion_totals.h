// The motion message's running totals: integers that wrap, and that a restart of the dead reckoning
// does not set back. Zeroed memory is the start: make it as `MotionTotals()`.
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

  static constexpr uint8_t kTotals = 7;

  uint32_t base_[kTotals];  // of the message's seven totals of a kind, in the order of their table
  int32_t base_heading_100urad_;
  float previous_heading_rad_;
  int16_t turns_;
  uint16_t steps_;
};

}  // namespace relpos
