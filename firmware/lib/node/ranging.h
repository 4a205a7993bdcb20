// Which peer to range when. With the coordinator's beacon: in this node's own window of the superframe, so
// that exchanges do not collide. Without: at random times. How it works: docs/ranging.md.
#pragma once

#include <stdint.h>

#include "wire/messages.h"

namespace relpos {

// One exchange that is answered: 20 ms (assumed, see docs/emulator.md) and the steps around it. One
// without an answer takes 33 ms: it reaches into the guard, where it disturbs the next window only if
// the clocks differ as well. So the window of one of 20 takes four exchanges instead of three.
constexpr uint8_t kExchangeMs = 24;
// Between the windows of two nodes. A beacon is seen up to a tick (9 ms) late, and not by all alike;
// clocks of 0.5 % drift by 5 ms in a second apart.
constexpr uint8_t kGuardMs = 10;
// In its window a node asks one again that failed but was ranged lately: so often, then the next. One
// exchange in six fails at the distances of a room (docs/ranging.md): of 20, pairs that are ranged at
// least every 10 s were 28 % without, 91 % with this and four exchanges in a window.
constexpr uint8_t kRetries = 2;
// A beacon holds so long: of one a second, five in a row are lost once a minute at 50 % loss,
// and by then two clocks may be 25 ms apart.
constexpr uint16_t kBeaconHoldMs = 5000;
// Up to so many nodes everybody ranges everybody in every round. Of more, each ranges the half of the
// ring that comes after it, as many in a round as its window takes: 10 of 20 in three rounds.
constexpr uint8_t kAllInARound = 7;
// Without a beacon a window is as long as it would be with one, and begins at random in each round: so
// the nodes ask no more of the air than it has, and two do not collide again and again. (Whole rounds
// with a pause after each failure left 20 nodes 16 % of their exchanges and some nodes none; this, 42 %:
// bench/ranging/slots.py.)
// Without a beacon ids are tried that may not exist: the silent ones only in the first pass over all
// that begins in each so many ms. A pass takes at most five rounds: no node waits longer than 10 s.
constexpr uint16_t kProbeMs = 4096;

// Zeroed memory is the start: make it as `RangingPlan()`. Times are the low 16 bits of milliseconds;
// next() is to be asked at least every few seconds.
class RangingPlan {
 public:
  void begin(uint16_t now_ms, uint16_t seed);
  void beacon(uint16_t now_ms, const wire::Beacon& beacon, uint8_t id);
  // The node to range now, or 0. Then *wait_ms until it may be another one's turn. Without a beacon:
  // one round a period_ms, over ids 1 to team_size.
  uint8_t next(uint16_t now_ms, uint8_t id, uint8_t team_size, uint16_t period_ms,
               uint16_t* wait_ms);
  void done(bool success);  // of what next() returned last

  bool resting() const { return resting_; }  // nothing more in this round
  void age(uint16_t now_ms);                 // before the next two are read
  uint8_t team() const { return count_; }    // in the beacon in force; 0: none, or without this node
  uint8_t neighbours() const;                // ranged in the last 8 to 16 s

 private:
  static constexpr uint8_t kBitBytes = (wire::kMostBeacon + 8) / 8;  // and a node more

  uint16_t origin_ms_;  // of the superframe
  uint16_t heard_ms_;   // the beacon
  uint16_t begin_ms_;   // of this node's window, or of its round, in the superframe
  uint16_t end_ms_;     // no exchange begins after it
  uint16_t period_ms_;  // of the beacon
  uint16_t random_;
  uint8_t ranged_[kBitBytes];  // one bit a place: since epoch_ began
  uint8_t before_[kBitBytes];  // and in the one before
  uint8_t ids_[wire::kMostBeacon];
  uint8_t count_;
  uint8_t place_;
  uint8_t round_;
  uint8_t step_;    // last place ranged, from this node's on
  uint8_t tried_;   // in this round
  uint8_t again_;   // how often the present one was asked again
  uint8_t index_;   // of the exchange under way
  uint8_t epoch_;
  uint8_t probed_;  // when a pass did last
  bool probing_;    // the silent ones, too, in this pass
  bool planned_;    // begin_ms_ and end_ms_ are those of this superframe
  bool resting_;
};

}  // namespace relpos
