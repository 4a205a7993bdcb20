// InvenSense MPU-9150: accelerometer and gyroscope at 50 Hz. Registers: MPU-9150 register map; also its
// successors (sensor.h).
#pragma once

#include <stdint.h>

#include "board/board.h"

namespace relpos {

// Set-up and reading without waiting: each call does at most one transaction and says after how
// many microseconds it wants the next. Zeroed memory is the start: make it as `Mpu9150()`.
class Mpu9150 {
 public:
  static constexpr uint8_t kAddress = 0x68;

  enum class Event : uint8_t {
    kNothing,
    kReady,  // a new sample waits in the chip: call read()
  };

  // Call when due. *wait_us: when to call again (after kReady: counted from read()).
  Event step(Board& board, uint32_t now_us, uint32_t* wait_us);
  // Fetches the sample announced by kReady, in the sensor's own axes. False, and nothing of it is to
  // be used, where the bus fails, the chip has lost its set-up, or it shows the former sample again.
  bool read(Board& board, float acceleration_m_s2[3], float angular_rate_rad_s[3]);
  bool running() const { return position_ == kRunning; }

 private:
  static constexpr uint8_t kRunning = 0xFF;

  void restart() { position_ = 0; }
  bool fail();

  uint8_t position_;  // in the set-up, or kRunning
  uint8_t failures_;  // transactions in a row
  // Low bytes of the last specific force. All three the same again by chance: one sample in 300,000
  // at rest (400 ug/rtHz make 19 counts), one in 16 million moving.
  uint8_t last_low_[3];
  uint32_t last_ready_us_;
};

}  // namespace relpos
