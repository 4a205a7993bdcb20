// What the fuzzers of the firmware compare it with, written apart from it.
#pragma once

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <vector>

#include "devices/xbee.h"
#include "support/fake_board.h"
#include "wire/frame.h"
#include "wire/messages.h"

using relpos::Xbee;
namespace wire = relpos::wire;

typedef std::vector<uint8_t> Bytes;

inline void fail(const char* what) {
  fprintf(stderr, "broken promise: %s\n", what);
  abort();
}

// CRC-16/CCITT bit by bit, as docs/protocol.md states it.
inline uint16_t reference_crc(const uint8_t* data, size_t count, uint16_t crc = wire::kFingerprint) {
  for (size_t i = 0; i < count; ++i) {
    for (int bit = 7; bit >= 0; --bit) {
      const bool feedback = ((crc >> 15) ^ (data[i] >> bit & 1)) != 0;
      crc = static_cast<uint16_t>(crc << 1);
      if (feedback) crc ^= 0x1021;
    }
  }
  return crc;
}

inline bool crc_fits(const Bytes& frame) {
  if (frame.size() < wire::kOverhead || frame.size() > wire::kFrameBytes) return false;
  const size_t at = frame.size() - wire::kTagBytes - wire::kCrcBytes;
  const uint16_t crc = reference_crc(frame.data(), at);
  return frame[at] == (crc & 0xFF) && frame[at + 1] == crc >> 8;
}

inline void redo_crc(Bytes* frame) {
  if (frame->size() < wire::kOverhead) return;
  const size_t at = frame->size() - wire::kTagBytes - wire::kCrcBytes;
  const uint16_t crc = reference_crc(frame->data(), at);
  (*frame)[at] = static_cast<uint8_t>(crc);
  (*frame)[at + 1] = static_cast<uint8_t>(crc >> 8);
}

// What an API frame with escapes carries, by Digi's description: what stands between two delimiters,
// unescaped, is length, data, checksum; the rest of it is ignored.
struct ReferenceModule {
  Bytes plain;
  bool open = false, escape = false;
  std::vector<Bytes> payloads;
  bool answered = false;  // something about the fate of a sent frame

  void take(uint8_t byte) {
    if (byte == 0x7E) {
      plain.clear();
      open = true;
      escape = false;
      return;
    }
    if (!open) return;
    if (byte == 0x7D) {
      escape = true;
      return;
    }
    plain.push_back(escape ? static_cast<uint8_t>(byte ^ 0x20) : byte);
    escape = false;
    if (plain.size() < 2) return;
    const size_t length = static_cast<size_t>(plain[0]) << 8 | plain[1];
    if (length == 0) {
      open = false;
      return;
    }
    if (plain.size() < length + 3) return;
    open = false;
    uint8_t sum = 0;
    for (size_t i = 2; i < plain.size(); ++i) sum = static_cast<uint8_t>(sum + plain[i]);
    const size_t header = plain[2] == 0x81 ? 5 : 11;
    answered = answered || (sum == 0xFF && plain[2] == 0x89);
    if (sum != 0xFF || (plain[2] != 0x81 && plain[2] != 0x80) || length < header) return;
    if (length - header > Xbee::kMostPayload) return;
    payloads.push_back(Bytes(plain.begin() + 2 + static_cast<long>(header), plain.end() - 1));
  }
};

inline Bytes api_frame(const uint8_t* data, size_t length) {
  Bytes plain;
  plain.push_back(static_cast<uint8_t>(length >> 8));
  plain.push_back(static_cast<uint8_t>(length));
  uint8_t sum = 0xFF;
  for (size_t i = 0; i < length; ++i) {
    plain.push_back(data[i]);
    sum = static_cast<uint8_t>(sum - data[i]);
  }
  plain.push_back(sum);
  Bytes out(1, 0x7E);
  for (const uint8_t byte : plain) {
    const bool escaped = byte == 0x7E || byte == 0x7D || byte == 0x11 || byte == 0x13;
    if (escaped) out.push_back(0x7D);
    out.push_back(escaped ? static_cast<uint8_t>(byte ^ 0x20) : byte);
  }
  return out;
}

inline Bytes received_frame(const Bytes& payload, bool by_cable = false) {  // RX16 from the coordinator
  Bytes data = {0x81, 0, 0, 0x28, by_cable ? wire::kCableOptions : uint8_t{0}};
  data.insert(data.end(), payload.begin(), payload.end());
  return api_frame(data.data(), data.size());
}

// ---- codecs ----

// A body that is understood is the one that encoding what was understood gives.
template <typename Message>
void try_decode(const Bytes& exact) {
  Message message;
  memset(&message, 0, sizeof message);
  if (!wire::decode(exact.data(), static_cast<uint8_t>(exact.size()), &message)) return;
  uint8_t again[wire::kFrameBytes];
  const uint8_t length = wire::encode(message, again);
  if (length != exact.size() || memcmp(again, exact.data(), length) != 0) {
    fail("a decoded body is encoded as another one");
  }
}

inline void try_every_decode(const Bytes& bytes) {
  if (bytes.size() > 255) return;
  const Bytes body(bytes);  // of exactly its size: a read behind its end is seen
  try_decode<wire::Motion>(body);
  try_decode<wire::Ranges>(body);
  try_decode<wire::Status>(body);
  try_decode<wire::Steps>(body);
  try_decode<wire::Samples>(body);
  try_decode<wire::Command>(body);
  try_decode<wire::Acknowledgement>(body);
  try_decode<wire::Beacon>(body);
  try_decode<wire::NewKey>(body);
}

// The parser alone finds the payload that the reference has found at the end of these bytes.
inline void check_parser(Xbee* parser, const Bytes& bytes, const Bytes* payload) {
  struct Line : FakeBoard {
    const Bytes* bytes;
    size_t at = 0;
    int16_t uart_read() override {
      return at < bytes->size() ? static_cast<int16_t>((*bytes)[at++]) : -1;
    }
  } line;
  line.bytes = &bytes;
  const bool found = parser->step(line);
  if (line.at != bytes.size()) fail("the parser finds a frame that is none");
  if (found != (payload != nullptr)) fail("the parser misses a frame");
  if (!found) return;
  if (payload->size() != parser->received_length() ||
      (!payload->empty() && memcmp(payload->data(), parser->received(), payload->size()) != 0)) {
    fail("the parser reads another payload than was sent");
  }
}
