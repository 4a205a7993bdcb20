// The AVR's two-wire interface as a polled master with a deadline.
#pragma once

#if defined(ARDUINO)

#include "board/board.h"

namespace relpos {
namespace twi {

void begin();  // 400 kHz or RELPOS_TWI_HZ, pull-ups on
BusStatus transfer(uint8_t address, const uint8_t* first, uint8_t first_count,
                   const uint8_t* second, uint8_t second_count, uint8_t* read,
                   uint8_t read_count);

}  // namespace twi
}  // namespace relpos

#endif
