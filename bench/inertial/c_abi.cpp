// Flat C interface of the inertial library for replay.py: a whole recording in one call.
#include <stdint.h>

#include <new>

#include "dead_reckoning.h"

using relpos::DeadReckoning;
using relpos::Displacement;
using relpos::ErrorFilter;
using relpos::InertialConfig;

extern "C" {

struct inertial_row {  // what replay.py reads back, one a sample
  double x_m, y_m, heading_rad;
  double variance_along_m2, variance_across_m2, variance_heading_rad2, path_m;
  double last_step_length_m, magnetic_heading_rad, forward_rad, scale_error_m;
  uint32_t steps, last_step_tick, flags, moving;
};

DeadReckoning* inertial_create(void) { return new (std::nothrow) DeadReckoning(); }
void inertial_destroy(DeadReckoning* reckoning) { delete reckoning; }
uint32_t inertial_object_size(void) { return sizeof(DeadReckoning); }

float inertial_default_gain(void) { return InertialConfig().step_gain; }

// A value that is not positive leaves the library's default.
void inertial_configure(DeadReckoning* reckoning, float leg_length_m, float step_gain,
                        float scale_sigma) {
  InertialConfig config;
  if (leg_length_m > 0.0f) config.leg_length_m = leg_length_m;
  if (step_gain > 0.0f) config.step_gain = step_gain;
  if (scale_sigma > 0.0f) config.scale_sigma = scale_sigma;
  reckoning->configure(config);
}

// imu: count rows of six (force, rate); field: count rows of three, used every `divider`-th row
// where divider > 0; dt_s: count spans, one a sample.
void inertial_run(DeadReckoning* reckoning, const float* imu, const float* field, uint32_t count,
                  uint32_t divider, const float* dt_s, inertial_row* rows) {
  for (uint32_t i = 0; i < count; ++i) {
    relpos::ImuSample sample;
    for (int j = 0; j < 3; ++j) {
      sample.acceleration_m_s2[j] = imu[6 * i + j];
      sample.angular_rate_rad_s[j] = imu[6 * i + 3 + j];
    }
    reckoning->update(sample, dt_s[i]);
    if (divider > 0 && i % divider == 0) reckoning->magnetometer(field + 3 * i);
    const Displacement& d = reckoning->displacement();
    const inertial_row row = {d.x_m, d.y_m, d.heading_rad,
                              d.variance_along_m2 + d.scale_error_m * d.scale_error_m,
                              d.variance_across_m2, d.variance_heading_rad2, d.path_m,
                              d.last_step_length_m, d.magnetic_heading_rad,
                              reckoning->forward().offset_rad(), d.scale_error_m, d.steps,
                              d.last_step_tick, d.quality_flags, d.moving};
    rows[i] = row;
  }
}

void inertial_covariance(const DeadReckoning* reckoning, double* matrix) {
  for (int i = 0; i < relpos::kStates; ++i) {
    for (int j = 0; j < relpos::kStates; ++j) {
      matrix[relpos::kStates * i + j] = reckoning->filter().covariance(i, j);
    }
  }
}

void inertial_bias(const DeadReckoning* reckoning, double* bias_rad_s) {
  for (int i = 0; i < 3; ++i) bias_rad_s[i] = reckoning->gyro_bias_rad_s()[i];
}

void inertial_counters(const DeadReckoning* reckoning, uint32_t* values) {
  const relpos::InertialCounters& c = reckoning->counters();
  values[0] = c.refused_samples;
  values[1] = c.saturated_samples;
  values[2] = c.doubtful_steps;
  values[3] = c.rejected_magnetic;
  values[4] = c.lost_steps;
  values[5] = reckoning->filter().repairs();
  values[6] = c.turned_sensors;
}

// P := F P F' + Q over one span, for the check of the Jacobian: matrix is kStates x kStates.
void inertial_predict(double* matrix, const float* rotation, const float* impulse_m_s, float dt_s) {
  ErrorFilter filter;
  filter.reset(0.0f, 0.0f, 0.0f);
  for (int i = 0; i < relpos::kStates; ++i) {
    for (int j = i; j < relpos::kStates; ++j) {
      filter.set_covariance(i, j, static_cast<float>(matrix[relpos::kStates * i + j]));
    }
  }
  filter.predict_attitude(rotation, dt_s);
  filter.predict_motion(impulse_m_s, dt_s);
  filter.settle();
  for (int i = 0; i < relpos::kStates; ++i) {
    for (int j = 0; j < relpos::kStates; ++j) {
      matrix[relpos::kStates * i + j] = filter.covariance(i, j);
    }
  }
}

}  // extern "C"
