// InvenSense MPU-9150: accelerometer and gyroscope at 50 Hz. Registers: MPU-9150 register map.
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
  // Fetches the sample announced by kReady, in the sensor's own axes. False where the bus fails.
  bool read(Board& board, float acceleration_m_s2[3], float angular_rate_rad_s[3]);
  bool running() const { return position_ == kRunning; }

 private:
  static constexpr uint8_t kRunning = 0xFF;

  void restart() { position_ = 0; }

  uint8_t position_;  // in the set-up, or kRunning
  uint8_t failures_;  // transactions in a row
  uint32_t last_ready_us_;
};

}  // namespace relpos
