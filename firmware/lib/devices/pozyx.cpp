#include "devices/pozyx.h"

namespace relpos {
namespace {

enum Register : uint8_t {
  kWhoAmI = 0x00,
  kErrorCode = 0x04,
  kInterruptStatus = 0x05,  // reading clears it
  kInterruptMask = 0x10,
  kNetworkIdLow = 0x1A,
  kPressure = 0x50,
};
enum Function : uint8_t { kDoRanging = 0xB5, kGetRangeInfo = 0xC7 };
enum Interrupt : uint8_t { kErrorFlag = 0x01, kFunctionFlag = 0x10 };

constexpr uint8_t kIdentity = 0x43;
constexpr uint32_t kPowerUpUs = 250000;
constexpr uint32_t kAbsentUs = 1000000;   // between attempts to reach a chip that does not answer
constexpr uint32_t kPollUs = 1000;
// After a failed poll: a stuck bus costs a millisecond each time.
constexpr uint32_t kFailedPollUs = 5000;
constexpr uint32_t kTimeoutUs = 100000;
constexpr uint8_t kMostFailures = 5;
// From here on garbage: chips have been seen to report 167772160 mm.
constexpr uint32_t kLeastImplausibleMm = 200000;

uint16_t little_endian(const uint8_t* bytes) {
  return static_cast<uint16_t>(bytes[0] |
                               static_cast<uint16_t>(static_cast<uint16_t>(bytes[1]) << 8));
}

uint32_t little_endian_long(const uint8_t* bytes) {
  return little_endian(bytes) | static_cast<uint32_t>(little_endian(bytes + 2)) << 16;
}

// The Pozyx wants a repeated start with a second write address between register and data.
bool write_framed(Board& board, uint8_t reg, const uint8_t* data, uint8_t count) {
  return board.transfer(Pozyx::kAddress, &reg, 1, data, count, nullptr, 0) == BusStatus::kOk;
}

// The first byte of the answer is the status: 1 success.
bool call_function(Board& board, Function function, uint16_t peer, uint8_t* answer,
                   uint8_t count) {
  const uint8_t bytes[3] = {function, static_cast<uint8_t>(peer),
                            static_cast<uint8_t>(peer >> 8)};
  return board.transfer(Pozyx::kAddress, bytes, sizeof bytes, nullptr, 0, answer, count) ==
         BusStatus::kOk;
}

bool is_due(uint32_t now_us, uint32_t due_us) {
  return static_cast<int32_t>(now_us - due_us) >= 0;
}

}  // namespace

void Pozyx::begin(uint16_t network_id) {
  network_id_ = network_id;
  state_ = State::kPowerUp;
}

bool Pozyx::range(uint16_t peer) {
  if (!ready()) return false;
  peer_ = peer;
  state_ = State::kBefore;
  return true;
}

bool Pozyx::look(Board& board, uint32_t* pressure_mpa) {
  const bool identity = (++looks_ & 7) == 0;
  uint8_t bytes[4];
  const bool answered =
      board.read_registers(kAddress, identity ? kNetworkIdLow : kPressure, bytes, identity ? 2 : 4);
  if (!answered) count_failure();
  if (failures_ >= kMostFailures ||
      (answered && identity && little_endian(bytes) != network_id_)) {
    begin(network_id_);
    return false;
  }
  *pressure_mpa = little_endian_long(bytes);
  return answered && !identity;
}

void Pozyx::fail_set_up(uint32_t now_us, uint32_t* wait_us) {
  state_ = State::kIdentify;
  due_us_ = now_us + kAbsentUs;
  *wait_us = kAbsentUs;
}

void Pozyx::count_failure() {
  if (failures_ < kMostFailures) ++failures_;
}

// Ends the exchange; after too many failures the chip has lost its settings or the bus.
Pozyx::Event Pozyx::done(uint8_t error, uint32_t* wait_us, Result* result) {
  result->peer = static_cast<uint8_t>(peer_);
  result->success = error == 0;
  result->error = error;
  if (error != 0) {
    result->range_mm = 0;
    result->rss_dbm = 0;
  }
  if (failures_ >= kMostFailures) {
    begin(network_id_);
    *wait_us = 0;
  } else {
    state_ = State::kIdle;
    *wait_us = kIdleUs;
  }
  return Event::kDone;
}

Pozyx::Event Pozyx::step(Board& board, uint32_t now_us, uint32_t* wait_us, Result* result) {
  *wait_us = 0;
  switch (state_) {
    case State::kOff:
    case State::kIdle:
      *wait_us = kIdleUs;
      return Event::kNothing;

    case State::kPowerUp:
      state_ = State::kIdentify;
      due_us_ = now_us + kPowerUpUs;
      *wait_us = kPowerUpUs;
      return Event::kNothing;

    case State::kIdentify: {
      if (!is_due(now_us, due_us_)) {
        *wait_us = due_us_ - now_us;
        return Event::kNothing;
      }
      uint8_t identity = 0;
      if (!board.read_registers(kAddress, kWhoAmI, &identity, 1) || identity != kIdentity) {
        fail_set_up(now_us, wait_us);
        return Event::kNothing;
      }
      state_ = State::kNetworkId;
      return Event::kNothing;
    }

    case State::kNetworkId: {
      const uint8_t bytes[2] = {static_cast<uint8_t>(network_id_),
                                static_cast<uint8_t>(network_id_ >> 8)};
      if (!write_framed(board, kNetworkIdLow, bytes, sizeof bytes)) {
        fail_set_up(now_us, wait_us);
        return Event::kNothing;
      }
      state_ = State::kMask;
      return Event::kNothing;
    }

    case State::kMask: {
      const uint8_t mask = kErrorFlag | kFunctionFlag;
      if (!write_framed(board, kInterruptMask, &mask, 1)) {
        fail_set_up(now_us, wait_us);
        return Event::kNothing;
      }
      state_ = State::kIdle;
      failures_ = 0;
      *wait_us = kIdleUs;
      return Event::kNothing;
    }

    case State::kBefore: {
      // What the chip has of this peer by now is no answer to the exchange: after a failure with
      // inverted flags, or another's exchange that ends meanwhile, it would be told as one.
      uint8_t answer[5] = {};
      if (!call_function(board, kGetRangeInfo, peer_, answer, sizeof answer)) {
        count_failure();
        return done(kBusFailed, wait_us, result);
      }
      before_ms_ = little_endian_long(answer + 1);  // 0 where it has nothing
      state_ = State::kClear;
      return Event::kNothing;
    }

    case State::kClear: {
      // A peer's exchange with this Pozyx raises FUNC here too.
      uint8_t stale = 0;
      if (!board.read_registers(kAddress, kInterruptStatus, &stale, 1)) {
        count_failure();
        return done(kBusFailed, wait_us, result);
      }
      state_ = State::kCall;
      return Event::kNothing;
    }

    case State::kCall: {
      uint8_t status = 0;
      if (!call_function(board, kDoRanging, peer_, &status, 1)) {
        count_failure();
        return done(kBusFailed, wait_us, result);
      }
      if (status != 1) return done(kRefused, wait_us, result);
      state_ = State::kPoll;
      due_us_ = now_us + kTimeoutUs;
      *wait_us = kPollUs;
      return Event::kNothing;
    }

    case State::kPoll: {
      uint8_t flags = 0;
      const bool answered = board.read_registers(kAddress, kInterruptStatus, &flags, 1);
      if (!answered) {
        count_failure();
        if (failures_ >= kMostFailures) return done(kBusFailed, wait_us, result);
      } else if ((flags & kErrorFlag) != 0) {
        state_ = State::kError;
        return Event::kNothing;
      } else if ((flags & kFunctionFlag) != 0) {
        state_ = State::kFetch;
        return Event::kNothing;
      }
      if (is_due(now_us, due_us_)) {
        // A chip that has restarted with its interrupts masked answers, but never tells.
        count_failure();
        return done(kTimedOut, wait_us, result);
      }
      *wait_us = answered ? kPollUs : kFailedPollUs;
      return Event::kNothing;
    }

    case State::kError: {
      uint8_t code = 0;
      if (!board.read_registers(kAddress, kErrorCode, &code, 1)) {
        count_failure();
        return done(kBusFailed, wait_us, result);
      }
      failures_ = 0;
      // An error flag with code 0 is still no distance.
      return done(code != 0 ? code : static_cast<uint8_t>(kRefused), wait_us, result);
    }

    case State::kFetch:
      break;
  }
  uint8_t answer[11];  // status, time ms, distance mm, signal strength dBm
  if (!call_function(board, kGetRangeInfo, peer_, answer, sizeof answer)) {
    count_failure();
    return done(kBusFailed, wait_us, result);
  }
  failures_ = 0;
  const int32_t advance_ms = static_cast<int32_t>(little_endian_long(answer + 1) - before_ms_);
  if (answer[0] != 1 || (before_ms_ != 0 && advance_ms <= 0)) {
    // No row or the one from before: it was another exchange that ended, where this chip answered.
    state_ = State::kPoll;
    *wait_us = kPollUs;
    return Event::kNothing;
  }
  const uint32_t range_mm = little_endian_long(answer + 5);
  if (range_mm == 0 || range_mm >= kLeastImplausibleMm) return done(kImplausible, wait_us, result);
  const int16_t rss_dbm = static_cast<int16_t>(little_endian(answer + 9));
  result->range_mm = range_mm;
  result->rss_dbm = static_cast<int8_t>(rss_dbm < -128 ? -128 : rss_dbm > 127 ? 127 : rss_dbm);
  return done(0, wait_us, result);
}

}  // namespace relpos
