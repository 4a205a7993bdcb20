// The inertial library as it is. Output: x m, y m, heading rad.
#include "filter.h"

#include "inertial/dead_reckoning.h"

namespace bench {
namespace {

relpos::DeadReckoning reckoning;

}  // namespace

void begin() {}

void update(const Sample& sample) {
  relpos::ImuSample imu;
  for (uint8_t i = 0; i < 3; ++i) {
    imu.acceleration_m_s2[i] = sample.force[i];
    imu.angular_rate_rad_s[i] = sample.rate[i];
  }
  reckoning.update(imu, kTick_s);
}

void update(const Sample& sample, const float field_ut[3]) {
  update(sample);
  reckoning.magnetometer(field_ut);
}

void output(float values[kOutputs]) {
  const relpos::Displacement& now = reckoning.displacement();
  values[0] = now.x_m;
  values[1] = now.y_m;
  values[2] = now.heading_rad;
}

}  // namespace bench
