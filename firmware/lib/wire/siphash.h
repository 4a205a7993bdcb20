// SipHash-2-4 with an 8-byte tag (Aumasson & Bernstein 2012).
#pragma once

#include <stdint.h>

namespace relpos {
namespace wire {

// key: 16 bytes. The tag may stand right behind the data.
void siphash24(const uint8_t* key, const uint8_t* data, uint8_t count, uint8_t* tag);

}  // namespace wire
}  // namespace relpos
