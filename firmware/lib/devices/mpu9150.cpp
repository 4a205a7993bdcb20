#include "devices/mpu9150.h"

#include "inertial/calls.h"
#include "devices/flash.h"
#include "devices/sensor.h"

namespace relpos {
namespace {

enum Register : uint8_t {
  kSampleRateDivider = 0x19,
  kConfig = 0x1A,
  kGyroConfig = 0x1B,
  kAccelConfig = 0x1C,
  kAccelConfig2 = 0x1D,  // of the successors
  kIntPinConfig = 0x37,
  kIntEnable = 0x38,
  kIntStatus = 0x3A,
  kAccelXHigh = 0x3B,
  kUserControl = 0x6A,
  kPowerManagement1 = 0x6B,
  kWhoAmI = 0x75
};

// Of the MPU-9150 bits 6:1 are specified; 0x71 is the MPU-9250, 0x73 the MPU-9255.
constexpr uint8_t kIdentity = kSuccessor ? 0x71 : 0x68;
constexpr uint8_t kIdentityMask = kSuccessor ? 0xFD : 0x7E;
constexpr uint8_t kDataReady = 0x01;
// Read with every sample: INT_PIN_CFG, INT_ENABLE, two more, then the sample. The first two
// differ from their set-up where a chip has lost it, or at 0xFF, zeros or noise on the bus.
constexpr uint8_t kPinConfig = 0x22;  // latched until INT_STATUS is read; bypass
constexpr uint8_t kBefore = kAccelXHigh - kIntPinConfig;
constexpr uint8_t kBurst = kBefore + 14;

// DLPF 4 (21 Hz, 8.5 ms): under the 25 Hz that 50 Hz sampling carries, above the harmonics of a
// walk's vertical motion (2 Hz and multiples). 4 g: heel strikes clip at 2 g.
// 1000 deg/s: they shake a sensor on the lower back by up to 840 deg/s. Bypass leads the host to the
// magnetometer, which needs the MPU's own I2C master off.
struct Setting {
  uint8_t reg, value, wait_ms;
};
const Setting kSetup[] RELPOS_FLASH = {
    {kPowerManagement1, 0x80, 100},  // reset
    {kPowerManagement1, 0x00, 100},  // wake
    {kPowerManagement1, 0x01, 1},    // clock from the X gyro's PLL
    {kUserControl, 0x00, 1},
    {kConfig, 0x04, 1},
    {kSampleRateDivider, 19, 1},     // 1 kHz / (1 + 19)
    {kGyroConfig, 0x10, 1},          // 1000 deg/s
    {kAccelConfig, 0x08, 1},         // 4 g
#if RELPOS_IMU == MPU9250
    {kAccelConfig2, 0x04, 1},        // its CONFIG filters the gyroscope alone
#endif
    {kIntPinConfig, kPinConfig, 1},
    {kIntEnable, kDataReady, 1},
};
constexpr uint8_t kSetupCount = sizeof kSetup / sizeof kSetup[0];

// Both clocks together are within 1.5 % (1 % for the chip's PLL, 0.5 % for the Uno's resonator), so
// looking 0.3 ms early follows every sample; one look in three then comes too early.
constexpr uint32_t kAfterSampleUs = 19700;
constexpr uint32_t kRetryUs = 1000;         // between looks for a sample that is not there yet
// A bus that fails is asked again a little later: a stuck one costs a millisecond each time.
constexpr uint32_t kFailedUs = 5000;
constexpr uint32_t kAbsentUs = 1000000;     // between attempts to set up a chip that does not answer
// Without a sample for so long the chip has lost its settings (brown-out: it sleeps).
constexpr uint32_t kSilentUs = 120000;
// Transactions in a row, then set up anew: 0.175 s of a dead bus, less than what makes the dead
// reckoning start anew. With a loose contact that spoils a third of them 5 would be met every second,
// and 20 hardly ever.
constexpr uint8_t kMostFailures = 35;

constexpr float kAccelerationUnit = 9.80665f / 8192.0f;                   // 4 g range
constexpr float kAngularRateUnit = 3.14159265f / 180.0f / 32.8f;  // LSB/(deg/s), 1000 deg/s range

int16_t big_endian(const uint8_t* bytes) {
  return static_cast<int16_t>(static_cast<uint16_t>(static_cast<uint16_t>(bytes[0]) << 8) |
                              bytes[1]);
}

}  // namespace

Mpu9150::Event Mpu9150::step(Board& board, uint32_t now_us, uint32_t* wait_us) {
  if (position_ < kSetupCount) {
    *wait_us = kAbsentUs;
    const uint8_t reg = flash_byte(&kSetup[position_].reg);
    if (position_ == 0) {
      uint8_t identity = 0;
      if (!board.read_registers(kAddress, kWhoAmI, &identity, 1)) return Event::kNothing;
      if ((identity & kIdentityMask) != kIdentity) return Event::kNothing;
    }
    if (!board.write_register(kAddress, reg, flash_byte(&kSetup[position_].value))) {
      if (!fail()) *wait_us = kFailedUs;
      return Event::kNothing;
    }
    *wait_us = 1000UL * flash_byte(&kSetup[position_].wait_ms);
    if (++position_ == kSetupCount) {
      position_ = kRunning;
      failures_ = 0;
      last_ready_us_ = now_us;
      // What is announced by now was measured at the former range: twice the value.
      uint8_t stale = 0;
      board.read_registers(kAddress, kIntStatus, &stale, 1);
    }
    return Event::kNothing;
  }
  *wait_us = kRetryUs;
  uint8_t status = 0;
  if (!board.read_registers(kAddress, kIntStatus, &status, 1)) {
    *wait_us = kFailedUs;
    fail();
    return Event::kNothing;
  }
  if ((status & kDataReady) == 0) {
    if (now_us - last_ready_us_ > kSilentUs) restart();
    return Event::kNothing;
  }
  last_ready_us_ = now_us;
  *wait_us = kAfterSampleUs;
  return Event::kReady;
}

RELPOS_APART bool Mpu9150::read(Board& board, float acceleration_m_s2[3], float angular_rate_rad_s[3]) {
  uint8_t raw[kBurst];
  bool good = false;
  if (board.read_registers(kAddress, kIntPinConfig, raw, kBurst)) {
    for (uint8_t axis = 0; axis < 3; ++axis) {
      const uint8_t* sample = raw + kBefore + 2 * axis;
      acceleration_m_s2[axis] = big_endian(sample) * kAccelerationUnit;
      angular_rate_rad_s[axis] = big_endian(sample + 8) * kAngularRateUnit;
      good |= sample[1] != last_low_[axis];
      last_low_[axis] = sample[1];
    }
    good = good && raw[0] == kPinConfig && raw[1] == kDataReady;
  }
  if (good) {
    failures_ = 0;
  } else {
    fail();
  }
  return good;
}

// Whether that was once too often: then everything begins anew.
RELPOS_APART bool Mpu9150::fail() {
  if (++failures_ < kMostFailures) return false;
  failures_ = 0;
  restart();
  return true;
}

}  // namespace relpos
