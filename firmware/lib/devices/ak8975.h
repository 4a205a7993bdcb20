// AsahiKasei AK8975: the magnetometer inside the MPU-9150, behind its bypass; or AK8963 (sensor.h).
#pragma once

#include <stdint.h>

#include "board/board.h"

namespace relpos {

// Single measurements without waiting: one transaction a call, called once a 50 Hz tick. A
// measurement (at most 9 ms) is started in one tick and fetched in the next. Zeroed memory is the
// start: make it as `Ak8975()`.
class Ak8975 {
 public:
  static constexpr uint8_t kAddress = 0x0C;

  // True where *field_ut holds a new field in the axes of accelerometer and gyroscope.
  bool step(Board& board, float field_ut[3]);
  bool running() const { return state_ >= State::kIdle; }
  void restart() { state_ = State::kIdentify; wait_ticks_ = 0; }
  uint16_t rejected() const { return rejected_; }  // overflows, data errors, late or repeated results; wraps

 private:
  enum class State : uint8_t { kIdentify, kPowerDown, kFuseMode, kFuseRead, kLeaveFuse, kIdle, kFetch };

  void fail();

  State state_;
  uint8_t wait_ticks_;
  uint8_t failures_;
  uint8_t adjustment_[3];  // ASA
  uint8_t last_low_[3];    // of the last reading
  uint8_t repeats_;
  uint16_t rejected_;
};

}  // namespace relpos
