// Time inside a node, from a 32-bit microsecond counter that wraps every 71 minutes.
#pragma once

#include <stdint.h>

#include "inertial/calls.h"

namespace relpos {

// Milliseconds since begin(). They wrap after 49 days.
class NodeClock {
 public:
  void begin(uint32_t now_us) {
    last_us_ = now_us;
    ms_ = 0;
  }
  void advance(uint32_t now_us) {  // at least every 71 minutes
    const uint32_t whole = (now_us - last_us_) / 1000;
    ms_ += whole;
    last_us_ += whole * 1000;
  }
  RELPOS_APART uint32_t ms() const { return ms_; }

 private:
  uint32_t last_us_;
  uint32_t ms_;
};

// The IMU samples by its own clock, up to 1 % off; integrating with a wrong period would turn every
// angle wrong by as much. The period is measured in blocks by the node's clock. Zeroed memory is the
// start.
class SampleClock {
 public:
  static constexpr uint32_t kNominalUs = 20000;
  static constexpr uint32_t kGapUs = 30000;  // longer: at least one sample is missing

  void begin(uint32_t now_us) { last_us_ = now_us; }
  // A sample seen at now_us. Returns the time that it stands for.
  uint32_t step_us(uint32_t now_us) {
    const uint32_t gap_us = now_us - last_us_;
    last_us_ = now_us;
    if (!started_ || gap_us > kGapUs) {
      const bool first = !started_;
      if (first) period_us_ = kNominalUs;
      started_ = true;
      block_start_us_ = now_us;
      block_samples_ = 0;
      return first && gap_us < kStartUs ? kNominalUs : gap_us;
    }
    if (++block_samples_ == kBlockSamples) {
      // Seen with up to 1 ms of jitter: 1e-4 of a block. Half of each block's news is taken.
      // To the nearest, or every block would pull it down by half a microsecond.
      const uint32_t measured_us = (now_us - block_start_us_ + kBlockSamples / 2) / kBlockSamples;
      period_us_ = (period_us_ + measured_us + 1) / 2;
      block_start_us_ = now_us;
      block_samples_ = 0;
    }
    return period_us_;
  }

 private:
  static constexpr uint16_t kBlockSamples = 512;  // 10 s
  static constexpr uint32_t kStartUs = 1000000;   // setting the sensor up takes 0.25 s

  uint32_t last_us_;
  uint32_t block_start_us_;
  uint32_t period_us_;
  uint16_t block_samples_;
  bool started_;
};

}  // namespace relpos
