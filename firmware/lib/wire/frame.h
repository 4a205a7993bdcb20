// Header, CRC and checks around the generated message bodies. Layout: docs/protocol.md.
#pragma once

#include <stdint.h>

#include "messages.h"

namespace relpos {
namespace wire {

struct Header {
  MessageType type;
  uint8_t node;  // sender going up, addressee going down
  uint8_t boot;
  uint16_t sequence;
};

enum class FrameStatus : uint8_t {
  kGood,
  kNotOurs,
  kForeignVersion,
  kBadLength,
  kBadCrc,
};

// CRC-16/CCITT, polynomial 0x1021, most significant bit first, no final inversion.
uint16_t crc16(const uint8_t* data, uint8_t count, uint16_t seed = kFingerprint);

// Completes a frame whose body of body_length bytes already stands at frame + kHeaderBytes:
// writes header and CRC, returns the frame's length.
uint8_t seal(const Header& header, uint8_t body_length, uint8_t* frame);

// Checks magic, version, length and CRC in this order; the header is filled only when good. The
// body stands at frame + kHeaderBytes and has length - kHeaderBytes - kCrcBytes bytes.
FrameStatus open(const uint8_t* frame, uint8_t length, Header* header);

}  // namespace wire
}  // namespace relpos
