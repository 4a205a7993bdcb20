// Torso dead reckoning: inertial samples in, displacement since the reset out.
//
// Navigation frame n: z up, x the horizontal direction that counts as heading 0 at the start.
// The wearer's heading is the yaw about the vertical since the reset, counter-clockwise.
// Nothing is assumed about how the sensor is mounted: up comes from gravity, the forward axis from
// the walking. Method, sources and figures: docs/deadreckoning.md.
#ifndef RELPOS_INERTIAL_DEAD_RECKONING_H
#define RELPOS_INERTIAL_DEAD_RECKONING_H

#include <stdint.h>

#include "attitude.h"
#include "displacement.h"
#include "filter.h"
#include "gait.h"

namespace relpos {

// One reading of accelerometer and gyroscope, in the sensor's own axes. At rest the accelerometer
// shows +g upwards (specific force).
struct ImuSample {
  float acceleration_m_s2[kAxes];
  float angular_rate_rad_s[kAxes];
};

const float kPopulationScale = 0.06f;  // what people differ by whose steps are not flagged (docs/walkers.md)

// What is known of the wearer and of the sensor. The defaults are used until configure().
struct InertialConfig {
  InertialConfig();  // the defaults: kDefaults in dead_reckoning.cpp, in this order

  float leg_length_m;
  float step_gain;    // c of s = c (l^2 h)^(1/3)
  float scale_sigma;  // relative, correlated
  float acceleration_limit_m_s2;   // a component beyond it is saturated
  float angular_rate_limit_rad_s;
  float gyro_bias_sigma_rad_s;     // what is not known of the bias at the start, an axis
};

// What was refused, limited or repaired since the reset. Each count stops at its maximum.
struct InertialCounters {
  uint16_t refused_samples;     // not finite, or dt outside (0, 0.2] s
  uint16_t saturated_samples;
  uint16_t doubtful_steps;      // steps whose length contradicted the inertial motion
  uint16_t rejected_magnetic;
  uint16_t lost_steps;          // steps after which the velocity had to start anew
  uint16_t turned_sensors;      // turns of the sensor on the body that were noticed
};

class DeadReckoning {
 public:
  DeadReckoning();
  void configure(const InertialConfig& config) { config_ = config; }
  // To be changed in place: in force from the next step on, the bias's sigma from the next reset().
  InertialConfig& config() { return config_; }
  void reset();  // keeps the gyroscope's bias, which is as uncertain as configured
  void update(const ImuSample& sample, float dt_s);  // at 50 Hz; dt nominally 0.02 s
  void magnetometer(const float field_ut[kAxes]);    // in the accelerometer's axes, about 5 Hz
  const Displacement& displacement() const { return displacement_; }
  const InertialCounters& counters() const { return counters_; }

  // For tests and tools.
  const ErrorFilter& filter() const { return filter_; }
  const float* gyro_bias_rad_s() const { return bias_rad_s_; }
  const ForwardFinder& forward() const { return forward_; }

 private:
  // Heavy work waits here and is done one piece a tick, so that no tick is long.
  enum Job : uint8_t {
    kIdle,
    kFlush,  // bring the covariance to the mid-stance
    kForward,
    kLateral,
    kVertical,
    kDrift,
    kCommit,
    kStillX,
    kStillY,
    kStillZ,
    kStillCommit,
    // On their own, at other times.
    kStood,
    kMagnetic
  };

  enum Hold : uint8_t { kHoldAcceleration, kHoldRate, kHoldInput, kHoldDoubt, kHolds };

  struct Span {
    float impulse_m_s[kAxes], time_s;
  };

  bool refuse(const ImuSample& sample, float dt_s);
  void watch_quiet(float force_m_s2, const float angle_rad[kAxes], float dt_s);
  void gather(const ImuSample& sample, const float force_m_s2[kAxes], float dt_s);
  void initialise(bool still);
  bool advance(const ImuSample& sample, float dt_s, Stance* stance);
  void on_stance(const Stance& stance);
  void aim(float heading_rad);
  void watch_mounting();
  void work();
  void run(Job job);
  void capture_span();
  void predict_attitude();
  void measure(State group, const float direction[kAxes], float innovation, float variance,
               float yaw = 0.0f);
  void widen(float along_m2, float across_m2);
  void commit_step();
  void commit_still();
  void begin_straight();
  bool quiet() const;
  float rate_variance(float variance, float direction[kAxes]);
  void publish();

  // What is small and often used first: the AVR reaches 64 bytes from a pointer in one instruction.
  InertialConfig config_;
  float bias_rad_s_[kAxes];  // beside the configuration: reset() keeps both

  uint32_t ticks_;
  uint16_t step_ticks_;
  uint8_t straight_steps_, settled_steps_, turned_steps_;
  uint8_t magnetic_count_, magnetic_steps_;
  uint8_t hold_[kHolds];  // ticks that a flag stays up
  Job job_;
  bool motion_pending_, magnetic_pending_, step_directed_, step_straight_, velocity_known_;
  bool still_pending_, step_irregular_;
  bool moved_;  // not quiet throughout the gathering

  // The step under way and the one whose updates are under way.
  float heading_sum_rad_;
  float stance_heading_rad_;  // at the last mid-stance
  float closing_m_;           // way ahead since the last mid-stance, for the footfall that ends a walk
  float step_length_m_, step_sigma_m_, step_speed_m_s_;
  float step_heading_[2];          // mean over the step: cosine and sine
  float steep_s_;                  // for which the heading axis has shown no heading
  float mounting_rad_;             // where the forward axis has settled, from the heading axis
  float walk_[2];   // walking direction in the navigation frame: heading and forward axis
  float turn_rad_;  // over the last step
  float limp_, rise_m_;  // how unlike left and right rise, signed by the foot; the last step's rise
  float straight_heading_rad_, straight_s_;  // of the stretch that may be straight
  float straight_rate_rad_s_;

  // Nominal state. While gathering, velocity_ and position_ hold the sums of force and rate.
  Attitude attitude_;
  float rotation_[kAxes * kAxes];  // the attitude as a matrix, as the tick has it at its beginning
  float velocity_m_s_[kAxes];
  float position_m_[kAxes];         // since the last mid-stance
  float stance_position_m_[kAxes];  // of the step whose updates are under way
  float gravity_m_s2_;
  float heading_axis_[kAxes];  // body vector that was along x at the start

  Span since_;  // since the covariance's time
  Span span_;   // being predicted

  // The field as it was met so far, navigation frame.
  float magnetic_azimuth_rad_;
  float magnetic_norm_ut_, magnetic_vertical_ut_;
  float magnetic_excess_rad_;
  float quiet_s_, mean_force_m_s2_;


  Displacement displacement_;
  InertialCounters counters_;
  Totals totals_;
  ErrorFilter filter_;
  GaitDetector gait_;
  ForwardFinder forward_;
};

}  // namespace relpos

#endif
