// The sensors' calibration as the node stores it: words of the wire (docs/protocol.md), all zero
// where there is none. How they are found: docs/calibration.md.
#pragma once

#include <stdint.h>

namespace relpos {

// sample: specific force, then angular rate (6). Both less their bias, the force then times
// (1 + scale). Where sums is given, the sample as it was is added to it (6).
void correct_inertial(const int16_t* words, float* sample, float* sums);
// field (3) := (unit matrix + soft iron) (field - hard iron).
void correct_field(const int16_t* words, float* field_ut);

}  // namespace relpos
