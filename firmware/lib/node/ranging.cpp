#include "node/ranging.h"
#include "inertial/calls.h"

#include <string.h>

namespace relpos {

void RangingPlan::begin(uint16_t now_ms, uint16_t seed) {
  origin_ms_ = now_ms;
  random_ = seed | 1;  // not 0, where it would stay
  probing_ = true;
}

void RangingPlan::beacon(uint16_t now_ms, const wire::Beacon& beacon, uint8_t id) {
  if (count_ == 0 || round_ != beacon.round) tried_ = 0;
  count_ = 0;
  for (uint8_t i = 0; i < beacon.count; ++i) {
    ids_[i] = beacon.entries[i].node;
    if (ids_[i] == id) {
      place_ = i;
      count_ = beacon.count;
    }
  }
  planned_ = false;
  if (count_ == 0) return;
  heard_ms_ = now_ms;
  origin_ms_ = static_cast<uint16_t>(now_ms - beacon.phase_ms);
  period_ms_ = beacon.period_ms;
  round_ = beacon.round;
}

RELPOS_SHARED void RangingPlan::age(uint16_t now_ms) {
  const uint8_t epoch = static_cast<uint8_t>(now_ms >> 13);
  if (epoch != epoch_) {
    epoch_ = epoch;
    memcpy(before_, ranged_, sizeof before_);
    memset(ranged_, 0, sizeof ranged_);
  }
  if (count_ != 0 && static_cast<uint16_t>(now_ms - heard_ms_) >= kBeaconHoldMs) {
    count_ = 0;
    planned_ = false;
  }
}

RELPOS_SHARED uint8_t RangingPlan::next(uint16_t now_ms, uint8_t id, uint8_t team_size, uint16_t period_ms,
                          uint16_t* wait_ms) {
  age(now_ms);
  uint8_t count = team_size;
  uint8_t place = static_cast<uint8_t>(id - 1);
  if (count_ != 0) {
    period_ms = period_ms_;
    count = count_;
    place = place_;
  } else if (place >= count) {
    place = count++;  // one more than the team, at its end
  }

  uint16_t at_ms = static_cast<uint16_t>(now_ms - origin_ms_);
  if (at_ms >= period_ms) {
    at_ms = static_cast<uint16_t>(at_ms - period_ms);
    if (at_ms >= period_ms) at_ms = 0;  // after a pause
    origin_ms_ = static_cast<uint16_t>(now_ms - at_ms);
    ++round_;
    tried_ = 0;
    planned_ = false;
  }
  if (!planned_) {
    planned_ = true;
    // In 32 bits, because that division is in the program anyway.
    const uint16_t window_ms = static_cast<uint16_t>(static_cast<uint32_t>(period_ms) / count);
    begin_ms_ = place * window_ms;
    if (count_ == 0) {
      // Marsaglia 2003, for 16 bits: of full period. A linear congruence would keep nodes with
      // neighbouring ids evenly apart, sometimes next to each other.
      random_ ^= static_cast<uint16_t>(random_ << 7);
      random_ ^= random_ >> 9;
      random_ ^= static_cast<uint16_t>(random_ << 8);
      begin_ms_ = static_cast<uint16_t>((random_ & 127) * ((period_ms - window_ms) / 128));
    }
    // Where the window takes no exchange whole, one is begun all the same: ranges that collide now and
    // then are better than none.
    const uint16_t least_ms = kExchangeMs + 2 * kGuardMs;
    end_ms_ = static_cast<uint16_t>(begin_ms_ + (window_ms > least_ms ? window_ms : least_ms) -
                                    (kExchangeMs + kGuardMs));
  }

  resting_ = tried_ == 0;  // else it backs off
  if (at_ms < begin_ms_) {
    *wait_ms = static_cast<uint16_t>(begin_ms_ - at_ms);
    return 0;
  }
  const uint8_t most = static_cast<uint8_t>(count > kAllInARound ? count / 2 : count - 1);
  while (at_ms <= end_ms_ && tried_ < most) {
    ++tried_;
    if (++step_ > most) {
      step_ = 1;
      const uint8_t now = static_cast<uint8_t>(now_ms / kProbeMs);
      probing_ = now != probed_;
      probed_ = now;
    }
    uint8_t index = static_cast<uint8_t>(place + step_);
    if (index >= count) index = static_cast<uint8_t>(index - count);
    index_ = index;
    resting_ = false;
    if (count_ != 0) return ids_[index];
    const uint8_t bits = ranged_[index / 8] | before_[index / 8];
    if (probing_ || (bits >> (index & 7) & 1) != 0) return static_cast<uint8_t>(index + 1);
  }
  resting_ = true;
  *wait_ms = static_cast<uint16_t>(period_ms - at_ms);
  return 0;
}

RELPOS_UNCLONED void RangingPlan::done(bool success) {
  const uint8_t byte = index_ / 8;
  const uint8_t bit = static_cast<uint8_t>(1 << (index_ & 7));
  const uint8_t lately = (ranged_[byte] | before_[byte]) & bit;
  if (success) {
    ranged_[byte] |= bit;
  } else if (count_ != 0 && lately != 0 && ++again_ <= kRetries) {
    --step_;
    if (tried_ != 0) --tried_;  // a beacon may have begun the next round meanwhile
    return;
  }
  again_ = 0;
}

uint8_t RangingPlan::neighbours() const {
  uint8_t count = 0;
  for (uint8_t i = 0; i < kBitBytes; ++i) {
    for (uint8_t bits = ranged_[i] | before_[i]; bits != 0; bits &= static_cast<uint8_t>(bits - 1)) {
      ++count;
    }
  }
  return count;
}

}  // namespace relpos
