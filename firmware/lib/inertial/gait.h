// Steps from the vertical acceleration of the torso, and the length the inverted pendulum gives
// them; the forward axis of the body from the phase between vertical and horizontal motion.
#ifndef RELPOS_INERTIAL_GAIT_H
#define RELPOS_INERTIAL_GAIT_H

#include <stdint.h>

namespace relpos {

struct Stance {
  float excursion_m;  // height of the torso's arc over this step
  float interval_s;   // since the previous mid-stance
  bool first;         // nothing before it within the pause time: the walk starts here
};

// Finds mid-stance: the torso at the top of its arc, where its vertical velocity crosses from up
// to down. Velocity and height are leaky integrals of the vertical acceleration.
class GaitDetector {
 public:
  void reset();
  // vertical: specific force along the vertical, gravity included. True at a mid-stance.
  bool update(float vertical_m_s2, float dt_s, Stance* stance);
  float vertical_velocity_m_s() const { return velocity_m_s_; }
  float since_stance_s() const { return since_s_; }
  bool walking() const;  // a step within the pause time
  uint16_t take_rejected();  // candidates refused since the last call

 private:
  void restart_arc();
  float mean_m_s2_, velocity_m_s_, height_m_;
  float trough_m_, peak_m_;
  float lowest_m_s2_, highest_m_s2_;
  float since_s_;
  uint8_t rejected_;
  bool running_;
};

// s = k 2 sqrt(2 l h - h^2): chord of the arc that a leg of length l draws when it lifts the hip
// by h (Zijlstra and Hof 1997), times the gain k.
float pendulum_step_m(float excursion_m, float leg_length_m, float gain);

// Forward axis on the body. The pendulum trades height against speed: the torso gains forward
// speed while it sinks and loses it while it rises, so horizontal acceleration times downward
// velocity points forward on average, while sway, at half that frequency, averages out.
class ForwardFinder {
 public:
  void reset();
  // Horizontal acceleration in the heading frame (x along the heading axis, y left of it).
  void update(float ax_m_s2, float ay_m_s2, float vertical_velocity_m_s, float dt_s);
  void step();  // at every mid-stance: decides, and recomputes the angle
  bool found() const { return found_; }
  float offset_rad() const { return offset_rad_; }      // from heading axis to forward, ccw
  float cosine() const { return cosine_; }
  float sine() const { return sine_; }

 private:
  float product_x_, product_y_;  // leaky sums of acceleration times downward velocity
  float power_a_, power_v_;      // leaky sums of their squares, for the coherence
  float offset_rad_, cosine_, sine_;
  uint8_t steps_;
  bool found_;
};

}  // namespace relpos

#endif
