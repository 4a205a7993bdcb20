#include "frame.h"

namespace relpos {
namespace wire {
namespace {

// Offsets inside the header; the order is protocol/messages.py's HEADER.
enum HeaderOffset : uint8_t {
  kAtMagic,
  kAtVersion,
  kAtType,
  kAtNode,
  kAtBoot,
  kAtSequenceLow,
  kAtSequenceHigh,
  kAfterHeader
};
static_assert(kAfterHeader == kHeaderBytes, "the header's layout and its size must agree");

}  // namespace

uint16_t crc16(const uint8_t* data, uint8_t count, uint16_t seed) {
  uint16_t crc = seed;
  for (; count != 0; --count) {
    // Table-free byte step of the MSB-first CCITT polynomial: x^16 + x^12 + x^5 + 1.
    uint8_t mixed = static_cast<uint8_t>(crc >> 8) ^ *data++;
    mixed ^= mixed >> 4;
    crc = static_cast<uint16_t>(crc << 8) ^ static_cast<uint16_t>(static_cast<uint16_t>(mixed) << 12) ^
          static_cast<uint16_t>(static_cast<uint16_t>(mixed) << 5) ^ mixed;
  }
  return crc;
}

uint8_t seal(const Header& header, uint8_t body_length, uint8_t* frame) {
  frame[kAtMagic] = kMagic;
  frame[kAtVersion] = kProtocolVersion;
  frame[kAtType] = static_cast<uint8_t>(header.type);
  frame[kAtNode] = header.node;
  frame[kAtBoot] = header.boot;
  frame[kAtSequenceLow] = static_cast<uint8_t>(header.sequence);
  frame[kAtSequenceHigh] = static_cast<uint8_t>(header.sequence >> 8);
  const uint8_t length = static_cast<uint8_t>(kHeaderBytes + body_length);
  const uint16_t crc = crc16(frame, length);
  frame[length] = static_cast<uint8_t>(crc);
  frame[length + 1] = static_cast<uint8_t>(crc >> 8);
  return static_cast<uint8_t>(length + kCrcBytes);
}

FrameStatus open(const uint8_t* frame, uint8_t length, Header* header) {
  if (length == 0 || frame[kAtMagic] != kMagic) return FrameStatus::kNotOurs;
  if (length > kAtVersion && frame[kAtVersion] != kProtocolVersion) {
    return FrameStatus::kForeignVersion;
  }
  if (length < kHeaderBytes + kCrcBytes || length > kFrameBytes) return FrameStatus::kBadLength;
  const uint8_t checked = static_cast<uint8_t>(length - kCrcBytes);
  const uint16_t received = static_cast<uint16_t>(
      frame[checked] | static_cast<uint16_t>(static_cast<uint16_t>(frame[checked + 1]) << 8));
  if (crc16(frame, checked) != received) return FrameStatus::kBadCrc;
  header->type = static_cast<MessageType>(frame[kAtType]);
  header->node = frame[kAtNode];
  header->boot = frame[kAtBoot];
  header->sequence = static_cast<uint16_t>(
      frame[kAtSequenceLow] |
      static_cast<uint16_t>(static_cast<uint16_t>(frame[kAtSequenceHigh]) << 8));
  return FrameStatus::kGood;
}

}  // namespace wire
}  // namespace relpos
