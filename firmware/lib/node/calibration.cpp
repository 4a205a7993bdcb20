#include "node/calibration.h"

#include "wire/messages.h"
#include "inertial/calls.h"

namespace relpos {
namespace {

// Here and not at each use: a conversion and a product are 30 bytes of the Uno's flash.
__attribute__((noinline)) float number(int16_t word) { return word * wire::kCalibrationUnit; }

}  // namespace

static_assert(wire::kAccelerationBias == 0 && wire::kGyroBias == 3 &&
                  wire::kAccelerationScale == 6 && wire::kFieldOffset == 9 &&
                  wire::kFieldMatrix == 12,
              "the words are taken in this order");

void correct_inertial(const int16_t* words, float* sample, float* sums) {
  for (uint8_t i = 6; i != 0; --i) {
    if (sums != nullptr) *sums++ += *sample;
    *sample++ -= number(*words++);
  }
  sample -= 6;
  for (uint8_t i = 3; i != 0; --i) {
    *sample += *sample * number(*words++);
    ++sample;
  }
}

void correct_field(const int16_t* words, float* field_ut) {
  float shifted[3];
  words += wire::kFieldOffset;
  for (uint8_t i = 0; i < 3; ++i) {
    shifted[i] = field_ut[i] - number(*words++) * (wire::kFieldOffsetUnit / wire::kCalibrationUnit);
  }
  for (uint8_t i = 0; i < 3; ++i) {
    float sum = shifted[i];
    for (uint8_t j = 0; j < 3; ++j) sum += number(*words++) * shifted[j];
    field_ut[i] = sum;
  }
}

}  // namespace relpos
