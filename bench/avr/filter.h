// What harness.cpp runs: one filter a program.
#pragma once

#include <stdint.h>

namespace bench {

const float kTick_s = 0.02f;
const uint8_t kOutputs = 3;

// Specific force m/s^2 and angular rate rad/s in the sensor's axes.
struct Sample {
  float force[3], rate[3];
};

void begin();
void update(const Sample& sample);
void update(const Sample& sample, const float field_ut[3]);  // where there is a new field
void output(float values[kOutputs]);

}  // namespace bench
