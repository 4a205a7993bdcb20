#include "devices/pozyx.h"

#include "devices/flash.h"

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
constexpr uint8_t kFirstFunction = 0xB0;
enum Function : uint8_t { kDoRanging = 0xB5, kGetRangeInfo = 0xC7 };
enum Interrupt : uint8_t { kErrorFlag = 0x01, kFunctionFlag = 0x10 };

constexpr uint8_t kIdentity = 0x43;
constexpr uint32_t kPowerUpUs = 250000;
constexpr uint32_t kAbsentUs = 1000000;   // between attempts to reach a chip that does not answer
constexpr uint32_t kPollUs = 1000;
// After a failed poll: a stuck bus costs six milliseconds each time.
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

// One transaction: a register or function, how many bytes it answers, how many are written to it.
// A function takes the peer; the first byte of its answer is the status, 1 success. What is written
// to a register goes behind a repeated start with a second write address.
struct Exchange {
  uint8_t code, answer_bytes, written;
};

// Of the states from kIdentify on. A table and one call: nine calls would cost the Uno 400 bytes.
const Exchange kExchanges[] RELPOS_FLASH = {
    {kWhoAmI, 1, 0},
    {kNetworkIdLow, 0, 2},
    {kInterruptMask, 0, 1},
    {kPressure, 4, 0},        // idle
    {kGetRangeInfo, 5, 0},    // before the exchange: status and time
    {kInterruptStatus, 1, 0},
    {kDoRanging, 1, 0},
    {kInterruptStatus, 1, 0},
    {kErrorCode, 1, 0},
    {kGetRangeInfo, 11, 0},   // status, time ms, distance mm, signal strength dBm
    {kNetworkIdLow, 2, 0},    // idle, now and then
};
constexpr uint8_t kMostAnswer = 11;

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

bool Pozyx::transact(Board& board, State state, uint8_t* answer) {
  const Exchange* exchange =
      kExchanges + (static_cast<uint8_t>(state) - static_cast<uint8_t>(State::kIdentify));
  const uint8_t code = flash_byte(&exchange->code);
  const uint8_t first[3] = {code, static_cast<uint8_t>(peer_), static_cast<uint8_t>(peer_ >> 8)};
  uint8_t second[2] = {kErrorFlag | kFunctionFlag, 0};  // the mask
  if (state == State::kNetworkId) {
    second[0] = static_cast<uint8_t>(network_id_);
    second[1] = static_cast<uint8_t>(network_id_ >> 8);
  }
  return board.transfer(kAddress, first, code >= kFirstFunction ? sizeof first : 1, second,
                        flash_byte(&exchange->written), answer,
                        flash_byte(&exchange->answer_bytes)) == BusStatus::kOk;
}

bool Pozyx::look(Board& board, uint32_t* pressure_mpa) {
  const bool identity = (++looks_ & 7) == 0;
  uint8_t answer[4];
  const bool answered = transact(board, identity ? State::kWatch : State::kIdle, answer);
  if (!answered) ++failures_;
  if (failures_ >= kMostFailures || (answered && identity && little_endian(answer) != network_id_)) {
    begin(network_id_);
  }
  *pressure_mpa = little_endian_long(answer);
  return answered && !identity;
}

// Ends the exchange; after too many failures the chip has lost its settings or the bus.
Pozyx::Event Pozyx::done(uint8_t error, Result* result) {
  result->peer = static_cast<uint8_t>(peer_);
  result->success = error == 0;
  result->error = error;
  if (failures_ >= kMostFailures) {
    begin(network_id_);
  } else {
    state_ = State::kIdle;
  }
  return Event::kDone;
}

Pozyx::Event Pozyx::step(Board& board, uint32_t now_us, uint32_t* wait_us, Result* result) {
  *wait_us = 0;
  if (state_ == State::kPowerUp) {
    state_ = State::kIdentify;
    due_us_ = now_us + kPowerUpUs;
  }
  if (state_ == State::kOff || state_ == State::kIdle) {
    *wait_us = kIdleUs;
    return Event::kNothing;
  }
  if (state_ == State::kIdentify && !reached(now_us, due_us_)) {
    *wait_us = due_us_ - now_us;
    return Event::kNothing;
  }
  uint8_t answer[kMostAnswer] = {};
  const bool answered = transact(board, state_, answer);

  if (state_ < State::kIdle) {  // set-up
    if (!answered || (state_ == State::kIdentify && answer[0] != kIdentity)) {
      state_ = State::kIdentify;
      due_us_ = now_us + kAbsentUs;
      *wait_us = kAbsentUs;
      return Event::kNothing;
    }
    advance();
    if (state_ == State::kIdle) {
      failures_ = 0;
      *wait_us = kIdleUs;
    }
    return Event::kNothing;
  }

  if (!answered) {
    ++failures_;
    // While the exchange runs one may be lost.
    if (state_ != State::kPoll || failures_ >= kMostFailures) {
      return done(kBusFailed, result);
    }
  }
  switch (state_) {
    case State::kBefore:
      // The chip's present distance of this peer is no answer to the exchange: after a failure with
      // inverted flags, or another's exchange that ends meanwhile, it would be reported as one.
      before_ms_ = little_endian_long(answer + 1);  // 0 where it has nothing
      advance();
      return Event::kNothing;

    case State::kClear:  // a peer's exchange with this Pozyx raises FUNC here too
      advance();
      return Event::kNothing;

    case State::kCall:
      if (answer[0] != 1) {  // the chip knows why: busy, or no such peer
        state_ = State::kError;
        return Event::kNothing;
      }
      advance();
      due_us_ = now_us + kTimeoutUs;
      *wait_us = kPollUs;
      return Event::kNothing;

    case State::kPoll:
      if ((answer[0] & kErrorFlag) != 0) {
        state_ = State::kError;
        return Event::kNothing;
      }
      if ((answer[0] & kFunctionFlag) != 0) {
        state_ = State::kFetch;
        return Event::kNothing;
      }
      if (reached(now_us, due_us_)) {
        // Neither a result nor an error: setting the chip up anew may help. (Not by the mask, which
        // concerns the interrupt's pin: without it the flags show as well.)
        ++failures_;
        return done(kTimedOut, result);
      }
      *wait_us = answered ? kPollUs : kFailedPollUs;
      return Event::kNothing;

    case State::kError:
      failures_ = 0;
      // An error flag with code 0 is still no distance.
      return done(answer[0] != 0 ? answer[0] : static_cast<uint8_t>(kRefused), result);

    default:
      break;
  }
  failures_ = 0;
  const uint32_t time_ms = little_endian_long(answer + 1);
  const int32_t advance_ms = static_cast<int32_t>(time_ms - before_ms_);
  if (answer[0] != 1 || (before_ms_ != 0 && advance_ms <= 0) || time_ms == last_ms_) {
    // No row or the one from before: it was another exchange that ended, where this chip answered.
    // Or the one of another peer, which chips have been seen to report twice.
    state_ = State::kPoll;
    *wait_us = kPollUs;
    return Event::kNothing;
  }
  const uint32_t range_mm = little_endian_long(answer + 5);
  if (range_mm == 0 || range_mm >= kLeastImplausibleMm) return done(kImplausible, result);
  last_ms_ = time_ms;
  const int16_t rss_dbm = static_cast<int16_t>(little_endian(answer + 9));
  result->range_mm = range_mm;
  result->rss_dbm = static_cast<int8_t>(rss_dbm < -128 ? -128 : rss_dbm > 127 ? 127 : rss_dbm);
  return done(0, result);
}

}  // namespace relpos
