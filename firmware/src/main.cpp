// Wiring only: the board, the node on it, the loop.
#if defined(ARDUINO)

#include "board/arduino/arduino_board.h"
#include "node/node.h"

// The node's id, 1 to 254; 0: the one in the EEPROM, else 1. Set it when flashing:
//   PLATFORMIO_BUILD_FLAGS=-DRELPOS_NODE_ID=3 pio run -e uno -t upload
#ifndef RELPOS_NODE_ID
#define RELPOS_NODE_ID 0
#endif
static_assert(RELPOS_NODE_ID >= 0 && RELPOS_NODE_ID <= 254, "RELPOS_NODE_ID: 1 to 254, or 0");

namespace {

relpos::ArduinoBoard board;
relpos::Node node(board);

}  // namespace

// Instead of the Arduino core's, whose timers, analogue input and millis() nothing here uses.
int main() {
  board.begin();
  node.begin(board.now_us(), board.reset_cause(), RELPOS_NODE_ID);
  for (;;) board.idle(node.poll(board.now_us()));
}

#else

// On a computer the node is a library: firmware/lib/board/native/engine.h.
int main() { return 0; }

#endif
