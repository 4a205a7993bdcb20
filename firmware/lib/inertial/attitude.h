// Attitude as a unit quaternion that turns body vectors into the navigation frame (z up).
#ifndef RELPOS_INERTIAL_ATTITUDE_H
#define RELPOS_INERTIAL_ATTITUDE_H

#include <stdint.h>

#include "vector.h"

namespace relpos {

const float kPi = 3.14159265f;

float wrap_angle(float angle_rad);  // to (-pi, pi]; for angles within a few turns
float turn_between(const float& from_rad, const float& to_rad);  // in the same interval

struct Attitude {
  float q[4];  // scalar part, then x, y, z

  void set_identity();
  // To length 1 again, from which each change takes it by 1e-7. Now and then.
  void normalise();
  // The shortest rotation that brings the body vector `up` (any length > 0) to the vertical.
  void level(const float up[kAxes]);
  // Turn by rate * dt, measured in the body frame.
  void integrate(const float angle_body_rad[kAxes]);
  // Turn by a small angle given in the navigation frame (a filter correction). The scratch floats are
  // the caller's, for the stack is deepest here.
  void correct(const float angle_navigation_rad[kAxes], float scratch[8]);
  // Rotation matrix body to navigation, row by row.
  void matrix(float rotation[kAxes * kAxes]) const;
  // this := first * this, i.e. apply `first` after what is already there.
  void premultiply(const Attitude& first);
};

// out = rotation * in.
void rotate(const float rotation[kAxes * kAxes], const float in[kAxes], float out[kAxes]);

}  // namespace relpos

#endif
