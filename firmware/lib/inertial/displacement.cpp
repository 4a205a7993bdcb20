#include "displacement.h"

namespace relpos {
namespace {

const float kUnitsPerMetre = 65536.0f;

int32_t to_units(float metres) {
  const float units = metres * kUnitsPerMetre;
  return static_cast<int32_t>(units < 0.0f ? units - 0.5f : units + 0.5f);
}

}  // namespace

void Totals::reset() {
  x_ = y_ = 0;
  path_ = 0;
}

void Totals::add(float x_m, float y_m) {
  // Sums as unsigned: overflow wraps instead of being undefined.
  x_ = static_cast<int32_t>(static_cast<uint32_t>(x_) + static_cast<uint32_t>(to_units(x_m)));
  y_ = static_cast<int32_t>(static_cast<uint32_t>(y_) + static_cast<uint32_t>(to_units(y_m)));
}

void Totals::add_path(float length_m) { path_ += static_cast<uint32_t>(to_units(length_m)); }

float Totals::x_m() const { return static_cast<float>(x_) * (1.0f / kUnitsPerMetre); }
float Totals::y_m() const { return static_cast<float>(y_) * (1.0f / kUnitsPerMetre); }
float Totals::path_m() const { return static_cast<float>(path_) * (1.0f / kUnitsPerMetre); }

}  // namespace relpos
