// Header, CRC, tag and their checks around the generated message bodies. Layout: docs/protocol.md.
#pragma once

#include <stdint.h>

#include "messages.h"

namespace relpos {
namespace wire {

struct Header {
  MessageType type;
  uint8_t node;  // sender going up, addressee going down
  uint8_t boot;
  uint32_t counter;
};

enum class FrameStatus : uint8_t {
  kGood,
  kNotOurs,
  kForeignVersion,
  kBadLength,
  kBadCrc,
  kBadTag,
};

// CRC-16/CCITT, polynomial 0x1021, most significant bit first, no final inversion.
uint16_t crc16(const uint8_t* data, uint8_t count, uint16_t seed = kFingerprint);

constexpr uint8_t kTypeAt = 2;  // in a frame

// Bytes of a frame besides its body.
constexpr uint8_t kOverhead = kHeaderBytes + kCrcBytes + kTagBytes;

// Completes a frame whose body of body_length bytes already stands at frame + kHeaderBytes:
// writes header, CRC and tag, returns the frame's length. key: kKeyBytes.
uint8_t seal(const Header& header, uint8_t body_length, const uint8_t* key, uint8_t* frame);

// Checks magic, version, length, CRC and tag in this order; the header is filled only when good. The
// body stands at frame + kHeaderBytes and has length - kOverhead bytes. Whether the counter is new is
// the caller's to check.
FrameStatus open(const uint8_t* frame, uint8_t length, const uint8_t* key, Header* header);

// A NEW_KEY frame's body (token, both keys XOR four SipHash blocks; docs/protocol.md) over the keys
// in force, the node's own before the beacon's.
void unmask_keys(uint32_t counter, const uint8_t* body, uint8_t keys[2 * kKeyBytes]);

}  // namespace wire
}  // namespace relpos
