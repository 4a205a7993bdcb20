#include "frame.h"

#include <string.h>

#include "siphash.h"

namespace relpos {
namespace wire {
namespace {

// Offsets inside the header; the order is host/relpos/protocol/messages.py's HEADER.
enum HeaderOffset : uint8_t {
  kAtMagic,
  kAtVersion,
  kAtType,
  kAtNode,
  kAtBoot,
  kAtCounter,
  kAfterHeader = kAtCounter + 4
};
static_assert(kAtType == kTypeAt && kAfterHeader == kHeaderBytes, "the header's layout and its size must agree");
static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "numbers are copied as they are");
static_assert(2 * kKeyBytes == 4 * kTagBytes, "two keys are masked by four blocks");

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

uint8_t seal(const Header& header, uint8_t body_length, const uint8_t* key, uint8_t* frame) {
  frame[kAtMagic] = kMagic;
  frame[kAtVersion] = kProtocolVersion;
  frame[kAtType] = static_cast<uint8_t>(header.type);
  frame[kAtNode] = header.node;
  frame[kAtBoot] = header.boot;
  memcpy(frame + kAtCounter, &header.counter, sizeof header.counter);
  uint8_t length = static_cast<uint8_t>(kHeaderBytes + body_length);
  const uint16_t crc = crc16(frame, length);
  memcpy(frame + length, &crc, sizeof crc);
  length = static_cast<uint8_t>(length + kCrcBytes);
  siphash24(key, frame, length, frame + length);
  return static_cast<uint8_t>(length + kTagBytes);
}

FrameStatus open(const uint8_t* frame, uint8_t length, const uint8_t* key, Header* header) {
  if (length == 0 || frame[kAtMagic] != kMagic) return FrameStatus::kNotOurs;
  if (length > kAtVersion && frame[kAtVersion] != kProtocolVersion) {
    return FrameStatus::kForeignVersion;
  }
  if (length < kOverhead || length > kFrameBytes) return FrameStatus::kBadLength;
  const uint8_t tagged = static_cast<uint8_t>(length - kTagBytes);
  const uint8_t checked = static_cast<uint8_t>(tagged - kCrcBytes);
  uint16_t crc;
  memcpy(&crc, frame + checked, sizeof crc);
  if (crc16(frame, checked) != crc) return FrameStatus::kBadCrc;
  uint8_t tag[kTagBytes];
  siphash24(key, frame, tagged, tag);
  // All bytes, whatever the first ones are: the time it takes gives a forger no information.
  uint8_t different = 0;
  for (uint8_t i = 0; i < kTagBytes; ++i) different |= static_cast<uint8_t>(frame[tagged + i] ^ tag[i]);
  if (different != 0) return FrameStatus::kBadTag;
  header->type = static_cast<MessageType>(frame[kAtType]);
  header->node = frame[kAtNode];
  header->boot = frame[kAtBoot];
  memcpy(&header->counter, frame + kAtCounter, sizeof header->counter);
  return FrameStatus::kGood;
}

void unmask_keys(uint32_t counter, const uint8_t* body, uint8_t* keys) {
  uint8_t mask[2 * kKeyBytes];
  uint8_t input[8] = {0, 0, body[0], body[1]};
  memcpy(input + 4, &counter, sizeof counter);
  for (; input[1] < 4; ++input[1]) {
    siphash24(keys, input, sizeof input, mask + input[1] * kTagBytes);
  }
  for (uint8_t i = 0; i < sizeof mask; ++i) keys[i] = body[2 + i] ^ mask[i];
}

}  // namespace wire
}  // namespace relpos
