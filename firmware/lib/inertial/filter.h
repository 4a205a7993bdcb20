// Covariance of the error-state Kalman filter: twelve states, packed, predicted in two stages.
//
//   attitude' = attitude - R dt bias            (error as a rotation in the navigation frame)
//   velocity' = velocity - [F x] attitude       (F = integral of the specific force, navigation)
//   position' = position + dt velocity
//
// The stages may run in different ticks: predict_attitude, then predict_motion over the same span.
// Half of the position's move comes before the velocity's change and half after it; the second half
// waits for the next span's first, and is made up for by settle() where a measurement comes first.
#ifndef RELPOS_INERTIAL_FILTER_H
#define RELPOS_INERTIAL_FILTER_H

#include <stdint.h>

#include "attitude.h"

namespace relpos {

enum State : uint8_t {
  kAttitude = 0,   // three each: x, y, z
  kBias = 3,
  kVelocity = 6,
  kPosition = 9,   // since the last mid-stance
  kStates = 12,
  kReference = 12  // in a correction: the magnetic reference
};

class ErrorFilter {
 public:
  static const uint8_t kPacked = kStates * (kStates + 1) / 2;

  // Diagonal start, from variances; the heading starts as known.
  void reset(float tilt_rad2, float bias_rad2_s2, float velocity_m2_s2);
  // Returns by how much the heading's variance grew.
  float predict_attitude(const float rotation[kAxes * kAxes], float dt_s);
  void predict_motion(const float impulse_m_s[kAxes], float dt_s);
  // Before a measurement, a restart or a look at the position's variances.
  void settle();
  // A reference direction that the heading is compared with (kAttitude's measurement): a thirteenth
  // state that does not move, of which only the correlations with heading and bias are kept.
  void set_reference(float variance_rad2) { reference_variance_ = variance_rad2; }
  // Scalar measurement z = direction . x[group .. group+2] + yaw x[heading] with the innovation and
  // variance given; correction[kStates + 1] is what to add to the nominal state. Returns the
  // innovation variance.
  float update(State group, const float direction[kAxes], float yaw, float innovation,
               float variance, float correction[kStates + 1]);
  // A group becomes known exactly (position at a step's end) or anew with the given variance.
  void restart(State group, float variance);

  float covariance(uint8_t i, uint8_t j) const { return *at(i, j); }
  void set_covariance(uint8_t i, uint8_t j, float value) { *at(i, j) = value; }
  void widen(uint8_t state, float variance, uint8_t count);  // adds to as many, from that one on
  float along(State group, const float direction[2]) const;  // variance along a horizontal unit vector
  uint16_t repairs() const { return repairs_; }      // variances that had to be lifted

 private:
  float* at(uint8_t i, uint8_t j);
  const float* at(uint8_t i, uint8_t j) const { return const_cast<ErrorFilter*>(this)->at(i, j); }
  // From the element in row `other` of the column `state` to the next one.
  static uint8_t step(uint8_t other, uint8_t state) {
    return other < state ? static_cast<uint8_t>(kStates - 1 - other) : 1;
  }
  // x_to += factor x_from for two states: all that the prediction does.
  void mix(uint8_t to, uint8_t from, float factor);
  // out += factor P(:, state).
  void add_column(float out[kStates], uint8_t state, float factor) const;

  static const uint8_t kReferenced = 4;  // heading and the three biases, neighbours in State

  float p_[kPacked];
  float reference_[kReferenced];
  float reference_variance_;
  float owed_s_;  // of the position's move
  uint16_t repairs_;
};

}  // namespace relpos

#endif
