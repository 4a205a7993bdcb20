// UART 0 at 38400 baud, interrupt-driven, with small rings.
#pragma once

#if defined(ARDUINO)

#include <stdint.h>

#include "board/board.h"

namespace relpos {
namespace uart {

void begin();
uint8_t write_space();
void write(uint8_t byte);
int16_t read();
bool waiting();  // for read()
UartErrors errors();

}  // namespace uart
}  // namespace relpos

#endif
