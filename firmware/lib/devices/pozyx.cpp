#include "devices/pozyx.h"

namespace relpos {
namespace {

enum Register : uint8_t {
  kWhoAmI = 0x00,
  kErrorCode = 0x04,
  kInterruptStatus = 0x05,  // cleared by reading
  kInterruptMask = 0x10,
  kNetworkId = 0x1A
};
enum Function : uint8_t { kDoRanging = 0xB5, kGetRangeInfo = 0xC7 };
enum Interrupt : uint8_t { kInterruptError = 0x01, kInterruptFunction = 0x10 };

constexpr uint8_t kIdentity = 0x43;
constexpr uint8_t kSuccess = 1;
constexpr uint8_t kRowBytes = 11;  // status, u32 time stamp, u32 distance, i16 signal strength
constexpr uint32_t kMostRangeMm = 200000;  // above: the garbage that the tag is known to return

constexpr uint32_t kPollUs = 1000;
constexpr uint32_t kBootUs = 250000;      // vendor's library: no access before
constexpr uint32_t kAbsentUs = 1000000;   // between attempts to reach a tag that does not answer
constexpr uint32_t kExchangeUs = 100000;  // vendor's library gives up after that
constexpr uint8_t kMostFailures = 3;

uint32_t little_endian(const uint8_t* bytes) {
  uint32_t value = 0;
  for (uint8_t i = 4; i != 0; --i) value = value << 8 | bytes[i - 1];
  return value;
}

}  // namespace

void Pozyx::start(uint8_t peer) {
  peer_ = peer;
  state_ = State::kCheckId;
}

// function, parameters, then the answer behind a repeated start: its first byte is the status.
bool Pozyx::call(Board& board, uint8_t function, uint8_t* result, uint8_t count) {
  const uint8_t request[3] = {function, peer_, 0};  // network ids have 16 bits
  return board.transfer(kAddress, request, sizeof request, nullptr, 0, result, count) ==
         BusStatus::kOk;
}

Pozyx::Event Pozyx::fail(uint32_t* wait_us, bool bus) {
  const bool exchange = state_ > State::kIdle;
  *wait_us = kPollUs;
  if (bus && (++failures_ >= kMostFailures || !exchange)) {
    failures_ = 0;
    state_ = State::kIdentify;
    *wait_us = kAbsentUs;
  } else if (exchange) {
    state_ = State::kIdle;
  } else {
    state_ = State::kIdentify;
    *wait_us = kAbsentUs;
  }
  return exchange ? Event::kFailed : Event::kNothing;
}

Pozyx::Event Pozyx::step(Board& board, uint32_t now_us, PozyxRange* range, uint32_t* wait_us) {
  *wait_us = 0;
  uint8_t bytes[kRowBytes];
  switch (state_) {
    case State::kBoot:
      state_ = State::kIdentify;
      *wait_us = kBootUs;
      return Event::kNothing;

    case State::kIdentify:
      if (!board.read_registers(kAddress, kWhoAmI, bytes, 1)) return fail(wait_us, true);
      if (bytes[0] != kIdentity) return fail(wait_us, false);
      state_ = State::kSetMask;
      return Event::kNothing;

    case State::kSetMask:
    case State::kSetId: {
      // Unlike other chips the tag wants register and data behind two start conditions.
      const bool mask = state_ == State::kSetMask;
      const uint8_t reg = mask ? kInterruptMask : kNetworkId;
      bytes[0] = mask ? static_cast<uint8_t>(kInterruptError | kInterruptFunction) : network_id_;
      bytes[1] = 0;
      const uint8_t count = mask ? 1 : 2;
      if (board.transfer(kAddress, &reg, 1, bytes, count, nullptr, 0) != BusStatus::kOk) {
        return fail(wait_us, true);
      }
      state_ = mask ? State::kSetId : State::kIdle;
      *wait_us = kPollUs;
      return Event::kNothing;
    }

    case State::kIdle:
      *wait_us = kAbsentUs;
      return Event::kNothing;

    case State::kCheckId:
      if (!board.read_registers(kAddress, kNetworkId, bytes, 2)) return fail(wait_us, true);
      if (bytes[0] != network_id_ || bytes[1] != 0) {  // it restarted: set it up anew
        state_ = State::kIdentify;
        return Event::kFailed;
      }
      state_ = State::kBaseline;
      return Event::kNothing;

    case State::kBaseline:
      if (!call(board, kGetRangeInfo, bytes, kRowBytes)) return fail(wait_us, true);
      has_baseline_ = bytes[0] == kSuccess;  // a peer never ranged before has no row
      baseline_ms_ = little_endian(bytes + 1);
      state_ = State::kClear;
      return Event::kNothing;

    case State::kClear:
      // Behind the baseline: a refused call raises the error flag.
      if (!board.read_registers(kAddress, kInterruptStatus, bytes, 1)) return fail(wait_us, true);
      state_ = State::kRange;
      return Event::kNothing;

    case State::kRange:
      if (!call(board, kDoRanging, bytes, 1)) return fail(wait_us, true);
      if (bytes[0] != kSuccess) return fail(wait_us, false);
      started_us_ = now_us;
      state_ = State::kPoll;
      *wait_us = kPollUs;
      return Event::kNothing;

    case State::kPoll:
      *wait_us = kPollUs;
      // Strictly behind the deadline, so that a completion at the last poll still counts.
      if (now_us - started_us_ > kExchangeUs) return fail(wait_us, false);
      if (!board.read_registers(kAddress, kInterruptStatus, bytes, 1)) return fail(wait_us, true);
      failures_ = 0;
      if ((bytes[0] & kInterruptError) != 0) {
        state_ = State::kError;
        *wait_us = 0;
      } else if ((bytes[0] & kInterruptFunction) != 0) {
        state_ = State::kFetch;
        *wait_us = 0;
      }
      return Event::kNothing;

    case State::kError:
      // Read, so that the tag forgets it; which one it was, nobody asks yet.
      if (!board.read_registers(kAddress, kErrorCode, bytes, 1)) return fail(wait_us, true);
      return fail(wait_us, false);

    case State::kFetch:
      break;
  }
  if (!call(board, kGetRangeInfo, bytes, kRowBytes)) return fail(wait_us, true);
  const uint32_t stamp_ms = little_endian(bytes + 1);
  if (bytes[0] != kSuccess || (has_baseline_ && stamp_ms == baseline_ms_)) {
    // Not ours: another tag has ranged with this one. Ours may still come; the deadline decides.
    state_ = State::kPoll;
    *wait_us = kPollUs;
    return Event::kNothing;
  }
  const uint32_t range_mm = little_endian(bytes + 5);
  // Not: stamp before the baseline (signed difference, for the clock wraps).
  if (range_mm == 0 || range_mm >= kMostRangeMm ||
      (has_baseline_ && static_cast<int32_t>(stamp_ms - baseline_ms_) < 0)) {
    return fail(wait_us, false);
  }
  range->range_mm = range_mm;
  range->rss_dbm = static_cast<int16_t>(bytes[9] | static_cast<uint16_t>(static_cast<uint16_t>(bytes[10]) << 8));
  state_ = State::kIdle;
  *wait_us = kPollUs;
  return Event::kRanged;
}

}  // namespace relpos
