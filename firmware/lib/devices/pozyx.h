// Pozyx tag or shield (firmware 1.x): distances to other Pozyx by ultra-wideband two-way ranging.
#pragma once

#include <stdint.h>

#include "board/board.h"

namespace relpos {

// Set-up and exchanges without waiting: each call does at most one transaction and says after how
// many microseconds it wants the next. Zeroed memory is the start: make it as `Pozyx()`.
class Pozyx {
 public:
  static constexpr uint8_t kAddress = Board::kStretchingAddress;
  static constexpr uint32_t kIdleUs = UINT32_MAX;  // *wait_us where only range() gives work

  // Result::error where the fault was not found by the chip, in a gap of the chip's own codes.
  enum Error : uint8_t {
    kTimedOut = 0x80,     // neither result nor error within 100 ms
    kBusFailed = 0x81,
    kRefused = 0x82,      // a function call was answered with failure, or an error flag, without a code
    kImplausible = 0x83,  // not a distance
  };

  struct Result {
    uint8_t peer;
    bool success;
    uint32_t range_mm;  // only with success, as the next
    int8_t rss_dbm;     // clamped
    uint8_t error;      // the chip's code or Error; 0 with success
  };

  enum class Event : uint8_t {
    kNothing,
    kDone,  // *result is filled
  };

  // Sets up anew; an exchange under way is forgotten. Idle until the first call.
  void begin(uint16_t network_id);
  bool ready() const { return state_ == State::kIdle; }  // for range()
  bool running() const { return state_ >= State::kIdle; }
  // Asks for an exchange, which the following steps make. False where not ready().
  bool range(uint16_t peer);
  // Between exchanges, while ready(): reads the air pressure, or every eighth time looks whether the
  // chip still has its network id, and sets it up anew where not. True with a pressure.
  bool look(Board& board, uint32_t* pressure_mpa);
  // Call when due, and at once after begin() and range(). *wait_us: when to call again.
  Event step(Board& board, uint32_t now_us, uint32_t* wait_us, Result* result);

 private:
  enum class State : uint8_t {
    kOff,       // begin() was never called
    kPowerUp,
    kIdentify,  // from due_us_ on
    kNetworkId,
    kMask,
    kIdle,
    kBefore,    // first of an exchange
    kClear,
    kCall,
    kPoll,      // until due_us_
    kError,
    kFetch,
    kWatch,     // no state: the transaction of look()
  };

  bool transact(Board& board, State state, uint8_t* answer);  // that of the state; false: the bus failed
  void advance() { state_ = static_cast<State>(static_cast<uint8_t>(state_) + 1); }
  Event done(uint8_t error, Result* result);

  uint32_t due_us_;
  uint32_t before_ms_;  // the chip's time of the peer's row before the exchange; 0: none
  uint32_t last_ms_;    // likewise of the last distance
  uint16_t network_id_;
  uint16_t peer_;
  State state_;
  uint8_t looks_;
  uint8_t failures_;  // bus failures and silences since the chip last ended an exchange
};

}  // namespace relpos
