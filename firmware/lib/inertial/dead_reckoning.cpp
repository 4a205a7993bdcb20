#include "dead_reckoning.h"

namespace relpos {

DeadReckoning::DeadReckoning() { reset(); }
void DeadReckoning::configure(const InertialConfig& config) { config_ = config; }
void DeadReckoning::reset() {
  displacement_ = Displacement();
  counters_ = InertialCounters();
}
void DeadReckoning::update(const ImuSample&, float) {}
void DeadReckoning::magnetometer(const float[3]) {}

}  // namespace relpos
