// The Uno and the Mega: own drivers on the bare registers, because Wire and HardwareSerial cost
// 400 bytes of RAM and wait for ever on a stuck bus. Nothing of the Arduino core is linked.
#pragma once

#if defined(ARDUINO) && !defined(RELPOS_VIRTUAL_BOARD)

#include "board/board.h"
#include "wire/messages.h"

namespace relpos {

// One per program: the hardware is one. The functions of Board are this board's.
class ArduinoBoard final : public Board {
 public:
  void begin();
  wire::ResetCause reset_cause() const;  // of this start
  // Nothing to do for so many microseconds: sleeps until an interrupt where that is long enough.
  void idle(uint32_t wait_us);
};

}  // namespace relpos

#endif
