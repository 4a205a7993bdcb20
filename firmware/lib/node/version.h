// The firmware's version, sent in every status message.
#pragma once

#include <stdint.h>

namespace relpos {

constexpr uint8_t kFirmwareMajor = 0;
constexpr uint8_t kFirmwareMinor = 1;
constexpr uint8_t kFirmwarePatch = 0;

}  // namespace relpos
