// Torso dead reckoning: inertial samples in, displacement since the reset out.
//
// Navigation frame n: z up, x the horizontal direction that counts as heading 0 at the start.
// The wearer's heading is the yaw about the vertical since the reset, counter-clockwise.
// Nothing is assumed about how the sensor is mounted: up comes from gravity, the forward axis from
// the walking. Method, sources and figures: docs/deadreckoning.md.
#ifndef RELPOS_INERTIAL_DEAD_RECKONING_H
#define RELPOS_INERTIAL_DEAD_RECKONING_H

#include <stdint.h>

namespace relpos {

// One reading of accelerometer and gyroscope, in the sensor's own axes. At rest the accelerometer
// shows +g upwards (specific force).
struct ImuSample {
  float acceleration_m_s2[3];
  float angular_rate_rad_s[3];
};

// What is known of the wearer and of the sensor. The defaults are used until configure().
struct InertialConfig {
  float leg_length_m = 0.93f;           // 0.53 of the stature (Zijlstra and Hof 1997); here of 1.75 m
  float step_gain = 1.25f;              // k of s = k 2 sqrt(2 l h - h^2), waist-worn literature value
  float scale_sigma = 0.07f;            // relative, correlated: 0.05 to 0.09 uncalibrated, 0.03 calibrated
  float scale_correlation_m = 10.0f;    // path over which the scale error is charged as one and the same
  float acceleration_limit_m_s2 = 39.0f;  // a component beyond it is saturated: just under 4 g
  float angular_rate_limit_rad_s = 8.7f;  // just under 500 deg/s
};

// Bits of Displacement::quality_flags.
enum QualityFlag : uint16_t {
  kAccelerationSaturated = 1u << 0,  // within the last two seconds
  kAngularRateSaturated = 1u << 1,   // within the last two seconds
  kMagneticDisturbed = 1u << 2,      // the last magnetometer reading was rejected
  kForwardUnknown = 1u << 3,         // forward axis not found yet: steps go along the heading axis
  kBiasUncertain = 1u << 4,          // started while moving and gyro bias not observed well since
  kStanding = 1u << 5,               // accelerometer and gyroscope quiet
  kBadInput = 1u << 6,               // a sample or dt was refused within the last two seconds
  kCovarianceRepaired = 1u << 7,     // a variance had to be lifted to stay positive, since the reset
  kStepRejected = 1u << 8,           // a step's displacement contradicted the model, last two seconds
  kStarting = 1u << 9,               // still gathering the first attitude
};

// Running totals since the reset, in the wearer's heading frame at the reset: x forward, y left.
// The along/across variances and the heading variance only grow: the difference of two readings is
// the variance of the motion between them, so that a receiver that loses reports loses nothing.
struct Displacement {
  float x_m, y_m, heading_rad;  // heading is continuous in (-pi, pi]
  float variance_along_m2, variance_across_m2, variance_heading_rad2;
  float path_m;
  uint16_t steps;               // wraps
  uint32_t last_step_tick;      // update() calls since the reset at the last mid-stance
  float last_step_length_m;
  float magnetic_heading_rad;   // raw: azimuth of the heading axis against magnetic north
  bool magnetic_heading_valid;  // reading was plausible (norm and vertical part)
  bool moving;
  bool initialised;
  uint16_t quality_flags;
};

// What was refused, limited or repaired since the reset. Each count stops at its maximum.
struct InertialCounters {
  uint16_t refused_samples;       // not finite, or dt outside (0, 0.2] s
  uint16_t saturated_samples;
  uint16_t rejected_steps;        // candidates that were no step, or that contradicted the filter
  uint16_t rejected_magnetic;
  uint16_t covariance_repairs;
};

class DeadReckoning {
 public:
  DeadReckoning();
  void configure(const InertialConfig& config);  // takes effect from the next step; keeps the totals
  void reset();
  void update(const ImuSample& sample, float dt_s);  // at 50 Hz; dt nominally 0.02 s
  void magnetometer(const float field_ut[3]);        // in the accelerometer's axes, about 5 Hz
  const Displacement& displacement() const { return displacement_; }
  const InertialCounters& counters() const { return counters_; }

 private:
  InertialConfig config_;
  Displacement displacement_;
  InertialCounters counters_;
};

}  // namespace relpos

#endif
