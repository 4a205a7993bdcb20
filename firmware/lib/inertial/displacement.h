// Running totals of a walk: where the node is relative to its reset, how far it came and how
// uncertain that is.
#ifndef RELPOS_INERTIAL_DISPLACEMENT_H
#define RELPOS_INERTIAL_DISPLACEMENT_H

#include <stdint.h>

namespace relpos {

// Bits of Displacement::quality_flags.
enum QualityFlag : uint16_t {
  kAccelerationSaturated = 1u << 0,  // within the last two seconds
  kAngularRateSaturated = 1u << 1,   // within the last two seconds
  kMagneticDisturbed = 1u << 2,      // the last magnetometer reading was rejected
  kForwardUnknown = 1u << 3,         // forward axis not found yet: steps go along the heading axis
  kBadInput = 1u << 6,               // a sample or dt was refused within the last two seconds
  kStepDoubtful = 1u << 8            // a step contradicted the inertial motion, last two seconds
};

// Running totals since the reset, in the wearer's heading frame at the reset: x forward, y left.
// The three variances only grow: the difference of two readings is the variance of the motion
// between them, so that a receiver that loses reports loses nothing.
struct Displacement {
  float x_m, y_m, heading_rad;  // heading in (-pi, pi]
  float variance_along_m2, variance_across_m2, variance_heading_rad2;
  float scale_error_m;          // what all steps err by together: standard deviation of the path from
                                // the wearer's gain; its square comes on top of variance_along_m2
  float path_m;                 // sum of the step lengths
  uint16_t steps;               // wraps
  uint32_t last_step_tick;      // update() calls since the reset at the last mid-stance
  float last_step_length_m;
  float magnetic_heading_rad;   // raw: the heading axis against magnetic north, counter-clockwise
  bool magnetic_heading_valid;  // the reading was plausible (norm and vertical part)
  bool moving;
  bool initialised;
  uint16_t quality_flags;
};

// Totals in units of 2^-16 m: 15 um wherever the walk has led, 32 km before the sign turns over.
class Totals {
 public:
  enum Which : uint8_t { kAlongX, kAlongY, kPath, kTotals };
  void reset();
  void add(const float way_m[2], float length_m);
  void tell(Which which, float* metres) const;

 private:
  uint32_t units_[kTotals];  // the first two signed; unsigned, as overflow is to wrap
};

}  // namespace relpos

#endif
