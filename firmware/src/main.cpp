// Wiring only: the board, the node on it, the loop.
#if defined(ARDUINO)

#include <Arduino.h>

#include "board/arduino/arduino_board.h"
#include "node/node.h"

namespace {

relpos::ArduinoBoard board;
relpos::Node node(board);

}  // namespace

void setup() {
  board.begin();
  node.begin(board.now_us(), board.reset_cause(), 0);
}

void loop() { board.idle(node.poll(board.now_us())); }

#else

// On a computer the node is a library: firmware/lib/board/native/engine.h.
int main() { return 0; }

#endif
