// Steps from the vertical acceleration of the torso, and the length the inverted pendulum gives
// them; the forward axis of the body from the phase between vertical and horizontal motion.
#ifndef RELPOS_INERTIAL_GAIT_H
#define RELPOS_INERTIAL_GAIT_H

#include <stdint.h>

namespace relpos {

struct Stance {
  float excursion_m;  // height of the torso's arc over this step
  float interval_s;   // since the previous mid-stance
  float age_s;        // how long ago it was; not 0 for `last` alone
  bool first;         // nothing before it within the pause time: the walk starts here
  bool last;          // the footfall that ended the walk, inferred: nothing of it was measured
  bool weak;          // known by its time, not by its size
};

// Finds mid-stance: the torso at the top of its arc, where its vertical velocity crosses from up
// to down. Velocity and height are leaky integrals of the vertical acceleration. A step is known by
// the size of its arc, or, smaller, by coming when the rhythm has it due: in a turn and before
// standing people hardly rise.
class GaitDetector {
 public:
  void reset();
  // vertical: specific force along the vertical, gravity included. True at a mid-stance.
  bool update(float vertical_m_s2, float dt_s, Stance* stance);
  float vertical_velocity_m_s() const { return velocity_m_s_; }
  float since_stance_s() const { return since_s_; }
  bool walking() const;  // a step within the pause time

 private:
  void restart_arc();
  float mean_m_s2_, velocity_m_s_, height_m_;
  float trough_m_, peak_m_;
  float lowest_m_s2_, minus_highest_m_s2_;
  float since_s_, period_s_;
  uint8_t steps_;  // steps of this walk, saturating
  bool running_, footfall_due_;
};

// Length of a step: s = c (l^2 h)^(1/3), h the excursion, l the length of the leg.
// The chord of the leg's arc, 2 sqrt(2 l h - h^2) (Zijlstra and Hof 1997), has the wrong exponent
// between people: who rises by 55 mm needs a gain of 1.1, who rises by 28 mm one of 1.28, because
// the torso also goes forward in double support and the pelvis flattens the arc. See
// docs/deadreckoning.md. Under kSmallRise_m the rise is sway and bending as much as stepping.
const float kSmallRise_m = 0.02f;
float pendulum_step_m(float excursion_m, float leg_length_m, float gain);
// What turning leaves of a step's length: 1 straight ahead and in bends, half at kTurn_rad a stride.
// Of a stride, because the trunk swings by up to 0.3 rad from step to step.
float turning_share(float stride_rad);

// Forward axis on the body. The pendulum trades height against speed: the torso gains forward
// speed while it sinks and loses it while it rises, so horizontal acceleration times downward
// velocity points forward on average, while sway, at half that frequency, averages out.
class ForwardFinder {
 public:
  void reset();
  // Horizontal acceleration in the heading frame (x along the heading axis, y left of it).
  void update(const float acceleration_m_s2[2], float vertical_velocity_m_s, float dt_s);
  void step();  // at every mid-stance: decides, and recomputes the angle
  void forget();  // the sums; what is found stays
  void turn(float angle_rad);  // the heading axis was turned the other way
  bool found() const { return found_; }
  const float& offset_rad() const { return offset_rad_; }      // from heading axis to forward, ccw
  const float* axis() const { return axis_; }           // its cosine and sine

 private:
  void point();

  float product_[2];             // leaky sums of acceleration times downward velocity
  float power_a_, power_v_;      // leaky sums of their squares, for the coherence
  float offset_rad_, axis_[2];
  uint8_t steps_;
  bool found_;
};

}  // namespace relpos

#endif
