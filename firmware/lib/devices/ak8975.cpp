#include "devices/ak8975.h"

#include <string.h>

#include "devices/flash.h"
#include "devices/sensor.h"
#include "inertial/calls.h"

namespace relpos {
namespace {

enum Register : uint8_t {
  kWhoAmI = 0x00,
  kStatus1 = 0x02,  // then the field and ST2
  kControl = 0x0A,
  kAdjustment = 0x10
};
// The AK8963 measures with 14 bits of 0.6 uT or, as bit 4 asks and ST2 then repeats, 16 of 0.15 uT.
constexpr uint8_t kWide = kSuccessor ? 0x10 : 0;
enum Mode : uint8_t { kPowerDownMode = 0x00, kSingleMode = 0x01 | kWide, kFuseRomMode = 0x0F | kWide };

constexpr uint8_t kIdentity = 0x48;
constexpr uint8_t kDataReady = 0x01;     // ST1
constexpr uint8_t kPeriodTicks = 10;     // 5 Hz
constexpr uint8_t kAbsentTicks = 50;     // between attempts to reach a chip that does not answer
constexpr uint8_t kMostFailures = 3;     // in a row, then set up anew
// Readings in a row that a chip may repeat: it never repeats one while its wearer walks, and no heading
// is needed while the wearer stands.
constexpr uint8_t kMostRepeats = 5;
// Microtesla a count, adjusted by (ASA + 128) / 256.
constexpr float kUnit = (kSuccessor ? 0.15f : 0.3f) / 256.0f;

// Each state's transaction: a register, and what is written to it or how many bytes are read. A table
// and one call: a call a state would cost the Uno 140 bytes. From mode to mode only through power-down,
// with at least 100 us between: a tick.
struct Transaction {
  uint8_t reg, value, read;
};
const Transaction kTransactions[] RELPOS_FLASH = {
    {kWhoAmI, 0, 1},
    {kControl, kPowerDownMode, 0},
    {kControl, kFuseRomMode, 0},
    {kAdjustment, 0, 3},
    {kControl, kPowerDownMode, 0},
    {kControl, kSingleMode, 0},
    {kStatus1, 0, 8},
};

int16_t little_endian(const uint8_t* bytes) {
  return static_cast<int16_t>(static_cast<uint16_t>(static_cast<uint16_t>(bytes[1]) << 8) |
                              bytes[0]);
}

}  // namespace

RELPOS_UNCLONED void Ak8975::fail() {
  if (state_ >= State::kIdle && ++failures_ < kMostFailures) {
    state_ = State::kIdle;
    wait_ticks_ = kPeriodTicks - 1;
    return;
  }
  state_ = State::kIdentify;
  wait_ticks_ = kAbsentTicks;
}

bool Ak8975::step(Board& board, float field_ut[3]) {
  if (wait_ticks_ > 0) {
    --wait_ticks_;
    return false;
  }
  const Transaction* transaction = &kTransactions[static_cast<uint8_t>(state_)];
  const uint8_t bytes[2] = {flash_byte(&transaction->reg), flash_byte(&transaction->value)};
  const uint8_t read = flash_byte(&transaction->read);
  uint8_t raw[8];  // of a measurement: ST1, X, Y, Z, ST2
  if (board.transfer(kAddress, bytes, read != 0 ? 1 : 2, nullptr, 0, raw, read) != BusStatus::kOk ||
      (state_ == State::kIdentify && raw[0] != kIdentity)) {
    fail();
    return false;
  }
  if (state_ == State::kFuseRead) memcpy(adjustment_, raw, sizeof adjustment_);
  if (state_ < State::kIdle) failures_ = 0;
  if (state_ != State::kFetch) {
    state_ = static_cast<State>(static_cast<uint8_t>(state_) + 1);
    return false;
  }
  bool changed = false;
  for (uint8_t axis = 0; axis < 3; ++axis) {
    changed |= raw[1 + 2 * axis] != last_low_[axis];
    last_low_[axis] = raw[1 + 2 * axis];
  }
  if (changed) repeats_ = 0;
  // All other bits of ST1 read as 0.
  if (raw[0] != kDataReady || repeats_ >= kMostRepeats) {
    ++rejected_;
    fail();
    return false;
  }
  ++repeats_;
  state_ = State::kIdle;
  wait_ticks_ = kPeriodTicks - 2;
  failures_ = 0;
  if (raw[7] != kWide) {  // data error, overflow; all other bits of ST2 read as 0
    ++rejected_;
    return false;
  }
  float own[3];
  for (uint8_t axis = 0; axis < 3; ++axis) {
    own[axis] = static_cast<float>(little_endian(raw + 1 + 2 * axis)) *
                static_cast<float>(adjustment_[axis] + 128) * kUnit;
  }
  // The die lies turned in the package: its x is the accelerometer's y, its y the x, its z is -z.
  field_ut[0] = own[1];
  field_ut[1] = own[0];
  field_ut[2] = -own[2];
  return true;
}

}  // namespace relpos
