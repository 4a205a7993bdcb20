// A fixed ring that gives up its oldest entry when it is full, and says so. Zeroed memory is an
// empty one: make it as `Ring<..>()`.
#pragma once

#include <stdint.h>

namespace relpos {

template <typename Entry, uint8_t kSize>
class Ring {
 public:
  uint8_t count() const { return count_; }
  bool push(const Entry& entry) {  // false: the oldest one was lost
    const bool full = count_ == kSize;
    if (full) pop();
    uint8_t at = static_cast<uint8_t>(first_ + count_);
    if (at >= kSize) at = static_cast<uint8_t>(at - kSize);
    entries_[at] = entry;
    ++count_;
    return !full;
  }
  Entry pop() {  // only with count() > 0
    const Entry entry = entries_[first_];
    if (++first_ == kSize) first_ = 0;
    --count_;
    return entry;
  }
  const Entry& oldest() const { return entries_[first_]; }  // only with count() > 0
  void clear() { count_ = 0; }

 private:
  Entry entries_[kSize];
  uint8_t first_;
  uint8_t count_;
};

}  // namespace relpos
