#include "siphash.h"

#include <string.h>

namespace relpos {
namespace wire {

#if defined(__AVR__)

// By hand: 348 bytes of flash where the compiler takes 1,130. One step of the round, a += b and
// b = rotl(b, r) ^ a, is a routine. The word a (v0 or v2) is in r2-r9, the other of the two in
// r10-r17; b (v1 or v3) is in the frame and during the step in r18-r25. v0 and v2 are due their
// rotation by 32 just when each makes room for the other, so the exchange does it for nothing. A
// rotation of b is two bytes to the left, which is the order of the eor, after single bits; that by
// 13 is one byte less. The register file is addressed as memory where that is shorter.
// Frame (Y points to v3 once it is filled): v1, v3, count, tag.
__attribute__((naked, noinline)) void siphash24(const uint8_t*, const uint8_t*, uint8_t, uint8_t*) {
  asm volatile(
      // r24: key, r22: data, r20: count, r18: tag
      "ldi r26, 19\n"  // bytes of the frame
      "ldi r27, 0\n"
      "ldi r30, lo8(gs(1f))\n"
      "ldi r31, hi8(gs(1f))\n"
      "jmp __prologue_saves__\n"
      "1: std Y+17, r20\n"
      "std Y+18, r18\n"
      "std Y+19, r19\n"
      // The words' first values: v0 and v2 in r2-r17 by the key's first half, v1 and v3 by the other.
      "movw r18, r28\n"
      "movw r26, r24\n"
      "ldi r30, lo8(0f)\n"
      "ldi r31, hi8(0f)\n"
      "ldi r28, 2\n"
      "ldi r29, 0\n"
      "rcall 2f\n"
      "movw r28, r18\n"
      "adiw r28, 1\n"
      "rcall 2f\n"
      "movw r26, r22\n"

      // A block of data: eor it to v3, two rounds, eor it to v0. r26: data, r20: bytes left.
      "4: push r26\n"
      "push r27\n"
      "push r20\n"
      "movw r30, r28\n"
      "rcall 5f\n"
      "rcall 9f\n"
      "pop r20\n"
      "pop r27\n"
      "pop r26\n"
      "ldi r30, 2\n"
      "ldi r31, 0\n"
      "rcall 5f\n"
      "sbrs r20, 7\n"
      "rjmp 4b\n"
      // The end.
      "com r10\n"
      "rcall 9f\n"
      "rcall 9f\n"
      "ldd r26, Y+9\n"
      "ldd r27, Y+10\n"
      "sbiw r28, 8\n"
      "ldi r30, 2\n"
      "ldi r31, 0\n"
      "ldi r21, 8\n"
      "1: ld r0, Z+\n"
      "ldd r18, Z+7\n"
      "eor r0, r18\n"
      "ld r18, Y+\n"
      "eor r0, r18\n"
      "ldd r18, Y+7\n"
      "eor r0, r18\n"
      "st X+, r0\n"
      "dec r21\n"
      "brne 1b\n"
      "adiw r28, 10\n"
      "ldi r30, 18\n"  // registers to restore
      "jmp __epilogue_restores__\n"

      // Two words at Y from one half of the key.
      "2: ldi r21, 8\n"
      "3: ld r0, X+\n"
      "lpm r24, Z+\n"
      "eor r24, r0\n"
      "std Y+8, r24\n"
      "lpm r24, Z+\n"
      "eor r24, r0\n"
      "st Y+, r24\n"
      "dec r21\n"
      "brne 3b\n"
      "ret\n"

      // Eight bytes at X to the word at Z; behind the last byte zeros and, eighth, the count. r20
      // is then negative.
      "5: ldi r21, 7\n"
      "6: ldd r0, Y+8\n"
      "cpse r21, r1\n"
      "clr r0\n"
      "subi r20, 1\n"
      "brmi 7f\n"
      "ld r0, X+\n"
      "7: ld r22, Z\n"
      "eor r22, r0\n"
      "st Z+, r22\n"
      "dec r21\n"
      "brpl 6b\n"
      "ret\n"

      // v1 is b.
      "8: sbiw r28, 8\n"
      "rjmp 2f\n"
      // Two rounds. r26: single bits, T: one byte less.
      "9: rcall 1f\n"
      "1: set\n"
      "ldi r26, 5\n"
      "rcall 8b\n"  // 13
      "clt\n"
      "rcall 1f\n"  // 16: no bits, r26 is negative
      "ldi r26, 1\n"
      "rcall 8b\n"  // 17
      "ldi r26, 5\n"  // 21
      // v0 and v2 change places; v3 is b.
      "1: movw r30, r10\n"
      "movw r10, r6\n"
      "movw r6, r14\n"
      "movw r14, r2\n"
      "movw r2, r30\n"
      "movw r30, r12\n"
      "movw r12, r8\n"
      "movw r8, r16\n"
      "movw r16, r4\n"
      "movw r4, r30\n"
      "adiw r28, 8\n"
      "2: ld r18, Y\n"
      "ldd r19, Y+1\n"
      "ldd r20, Y+2\n"
      "ldd r21, Y+3\n"
      "ldd r22, Y+4\n"
      "ldd r23, Y+5\n"
      "ldd r24, Y+6\n"
      "ldd r25, Y+7\n"
      "add r2, r18\n"
      "adc r3, r19\n"
      "adc r4, r20\n"
      "adc r5, r21\n"
      "adc r6, r22\n"
      "adc r7, r23\n"
      "adc r8, r24\n"
      "adc r9, r25\n"
      "rjmp 4f\n"
      "3: lsl r18\n"
      "rol r19\n"
      "rol r20\n"
      "rol r21\n"
      "rol r22\n"
      "rol r23\n"
      "rol r24\n"
      "rol r25\n"
      "adc r18, r1\n"
      "4: dec r26\n"
      "brpl 3b\n"
      "brtc 5f\n"
      "mov r0, r18\n"
      "mov r18, r19\n"
      "mov r19, r20\n"
      "mov r20, r21\n"
      "mov r21, r22\n"
      "mov r22, r23\n"
      "mov r23, r24\n"
      "mov r24, r25\n"
      "mov r25, r0\n"
      "5: eor r18, r4\n"
      "eor r19, r5\n"
      "eor r20, r6\n"
      "eor r21, r7\n"
      "eor r22, r8\n"
      "eor r23, r9\n"
      "eor r24, r2\n"
      "eor r25, r3\n"
      "std Y+2, r18\n"
      "std Y+3, r19\n"
      "std Y+4, r20\n"
      "std Y+5, r21\n"
      "std Y+6, r22\n"
      "std Y+7, r23\n"
      "st Y, r24\n"
      "std Y+1, r25\n"
      "ret\n"
      // "somepseudorandomlygeneratedbytes" as four little-endian words in pairs: v2, v0; v3, v1
      "0: .byte 0x61, 0x75, 0x72, 0x65, 0x65, 0x73, 0x6e, 0x70\n"
      ".byte 0x65, 0x65, 0x67, 0x6d, 0x79, 0x6f, 0x6c, 0x73\n"
      ".byte 0x73, 0x6d, 0x65, 0x6f, 0x74, 0x64, 0x79, 0x6e\n"
      ".byte 0x62, 0x61, 0x64, 0x72, 0x65, 0x6f, 0x74, 0x64\n");
}

#else

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

#endif

}  // namespace wire
}  // namespace relpos
