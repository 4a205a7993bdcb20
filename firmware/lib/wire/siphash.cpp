#include "siphash.h"

#include <string.h>

namespace relpos {
namespace wire {
namespace {

uint64_t rotated(uint64_t x, uint8_t bits) { return x << bits | x >> (64 - bits); }

void mix(uint64_t* a, uint64_t* b, uint8_t bits) {
  *a += *b;
  *b = rotated(*b, bits) ^ *a;
}

void sip_round(uint64_t* v) {
  mix(v + 0, v + 1, 13);
  v[0] = rotated(v[0], 32);
  mix(v + 2, v + 3, 16);
  mix(v + 0, v + 3, 21);
  mix(v + 2, v + 1, 17);
  v[2] = rotated(v[2], 32);
}

}  // namespace

void siphash24(const uint8_t* key, const uint8_t* data, uint8_t count, uint8_t* tag) {
  uint64_t v[4];
  memcpy(v, key, 16);
  memcpy(v + 2, key, 16);
  v[0] ^= 0x736f6d6570736575u;  // "somepseudorandomlygeneratedbytes"
  v[1] ^= 0x646f72616e646f6du;
  v[2] ^= 0x6c7967656e657261u;
  v[3] ^= 0x7465646279746573u;
  uint8_t left = count;
  for (bool last = false; !last; left = static_cast<uint8_t>(left - 8)) {
    last = left < 8;
    uint64_t block = last ? static_cast<uint64_t>(count) << 56 : 0;
    memcpy(&block, data, last ? left : 8);
    data += 8;
    v[3] ^= block;
    sip_round(v);
    sip_round(v);
    v[0] ^= block;
  }
  v[2] ^= 0xFF;
  for (uint8_t i = 0; i < 4; ++i) sip_round(v);
  const uint64_t sum = v[0] ^ v[1] ^ v[2] ^ v[3];
  memcpy(tag, &sum, sizeof sum);
}

}  // namespace wire
}  // namespace relpos
