// Pozyx tag (firmware 1.x): two-way ranging by UWB, without waiting.
#pragma once

#include <stdint.h>

#include "board/board.h"

namespace relpos {

struct PozyxRange {
  uint32_t range_mm;
  int16_t rss_dbm;
};

// Each call of step() does at most one transaction and says after how many microseconds it wants
// the next. An exchange is: note the peer's last row, clear the flags, start, poll each millisecond,
// fetch the row; it counts only if the row's time stamp has changed, so that a completion that
// belongs to somebody else's exchange is not taken for ours.
class Pozyx {
 public:
  static constexpr uint8_t kAddress = 0x4B;

  enum class Event : uint8_t {
    kNothing,
    kRanged,  // *range holds the distance asked for
    kFailed,  // the exchange gave none
  };

  void begin(uint8_t network_id) { network_id_ = network_id; }
  // The tag answers and bears our network id; false while an exchange runs.
  bool idle() const { return state_ == State::kIdle; }
  bool present() const { return state_ >= State::kIdle; }
  // Only when idle. Checks the network id first: a tag that restarted has lost it.
  void start(uint8_t peer);
  Event step(Board& board, uint32_t now_us, PozyxRange* range, uint32_t* wait_us);

 private:
  enum class State : uint8_t {
    kBoot,
    kIdentify,
    kSetMask,
    kSetId,
    kIdle,
    kCheckId,
    kBaseline,
    kClear,
    kRange,
    kPoll,
    kFetch,
    kError,
  };

  bool call(Board& board, uint8_t function, uint8_t* result, uint8_t count);
  bool row(Board& board, uint8_t* row);
  Event fail(uint32_t* wait_us, bool bus);

  State state_ = State::kBoot;
  uint8_t network_id_ = 0;
  uint8_t peer_ = 0;
  uint8_t failures_ = 0;  // of the bus, in a row
  bool has_baseline_ = false;
  uint32_t baseline_ms_ = 0;  // the tag's clock
  uint32_t started_us_ = 0;   // also: of the boot
};

}  // namespace relpos
