#include "displacement.h"

#include <string.h>

#include "vector.h"

namespace relpos {
namespace {

const float kUnitsPerMetre = 65536.0f;

}  // namespace

void Totals::reset() { memset(units_, 0, sizeof units_); }

void Totals::add(const float way_m[2], float length_m) {
  for (uint8_t i = 0; i < kTotals; ++i) {
    units_[i] += static_cast<uint32_t>(rounded((i == kPath ? length_m : way_m[i]) * kUnitsPerMetre));
  }
}

RELPOS_APART void Totals::tell(Which which, float* metres) const {
  const float units = which == kPath ? static_cast<float>(units_[which])
                                     : static_cast<float>(static_cast<int32_t>(units_[which]));
  *metres = units * (1.0f / kUnitsPerMetre);
}

}  // namespace relpos
