// The Uno and the Mega: own drivers on the bare registers, because Wire and HardwareSerial cost
// 400 bytes of RAM and wait for ever on a stuck bus. Of the Arduino core only micros() is used.
#pragma once

#if defined(ARDUINO)

#include "board/board.h"
#include "wire/messages.h"

namespace relpos {

// One per program: the hardware is one.
class ArduinoBoard final : public Board {
 public:
  void begin();
  wire::ResetCause reset_cause() const;  // of this start
  // Nothing to do for so many microseconds: sleeps until an interrupt where that is long enough.
  void idle(uint32_t wait_us);

  uint8_t uart_write_space() override;
  void uart_write(uint8_t byte) override;
  int16_t uart_read() override;
  uint8_t storage_read(uint16_t at) override;
  bool storage_write(uint16_t at, uint8_t value) override;
  uint32_t now_us() override;
  void watchdog_reset() override;
  void led(bool on) override;
  void reset() override;
  uint16_t free_stack() override;
  void mark(uint8_t value) override;

 protected:
  BusStatus i2c_transfer(uint8_t address, const uint8_t* first, uint8_t first_count,
                         const uint8_t* second, uint8_t second_count, uint8_t* read,
                         uint8_t read_count) override;
};

}  // namespace relpos

#endif
