// Constant tables that stay in the AVR's flash; on the PC ordinary constants.
#pragma once

#include <stdint.h>

#if defined(__AVR__)
#include <avr/pgmspace.h>
#define RELPOS_FLASH PROGMEM
namespace relpos {
inline uint8_t flash_byte(const uint8_t* at) { return pgm_read_byte(at); }
inline uint16_t flash_word(const uint16_t* at) { return pgm_read_word(at); }
}  // namespace relpos
#else
#define RELPOS_FLASH
namespace relpos {
inline uint8_t flash_byte(const uint8_t* at) { return *at; }
inline uint16_t flash_word(const uint16_t* at) { return *at; }
}  // namespace relpos
#endif
