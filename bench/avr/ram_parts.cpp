// Not linked: the size of each symbol is that of a part of the node (avr-nm -S). budget.py prints
// them as the plan of the static RAM.
#include "node/node.h"

using relpos::NodeState;

#define PART(name, bytes) char name[bytes]

extern "C" {

PART(node, sizeof(relpos::Node));
PART(inertial, sizeof(relpos::DeadReckoning));
PART(covariance, sizeof(relpos::ErrorFilter));
PART(gait, sizeof(relpos::GaitDetector) + sizeof(relpos::ForwardFinder));
PART(imu, sizeof(relpos::Mpu9150) + sizeof(relpos::Ak8975));
PART(pozyx, sizeof(relpos::Pozyx));
PART(xbee, sizeof(relpos::Xbee));
PART(frame, sizeof(NodeState::frame_));
PART(ranges, sizeof(NodeState::ranges_));
PART(steps, sizeof(NodeState::steps_));
PART(commands, sizeof(NodeState::commands_));
PART(settings, sizeof(NodeState::settings_));
PART(totals, sizeof(NodeState::totals_));

}  // extern "C"
