// What a node needs from the board it runs on. The boards: arduino/ (Uno and Mega) and native/ (the
// same node on a PC). Everything above this header is the same source on both.
#pragma once

#include <stdint.h>

#include "inertial/calls.h"

namespace relpos {

// Whether `now` has reached `due`, on any counter that wraps, as long as they are less than half
// its span apart.
inline bool reached(uint32_t now, uint32_t due) { return static_cast<int32_t>(now - due) >= 0; }

// How an I2C transaction ended. The numbers are part of native/engine.h.
enum class BusStatus : uint8_t {
  kOk = 0,
  kAddressNack = 1,
  kDataNack = 2,
  kTimeout = 3,  // also: the bus is held by somebody
};

// Of the receiver since the start; they wrap.
struct UartErrors {
  uint16_t damaged;  // without a stop bit: noise, or another speed
  uint16_t lost;     // there was no room
};

// One class and no other with functions of the board's. Firmware has one board: a table of virtual
// functions would cost it 22 bytes of RAM and 490 of flash. Where a program makes boards of its own
// (on the PC, in the suites) they are virtual.
#if defined(ARDUINO) && !defined(RELPOS_VIRTUAL_BOARD)
#define RELPOS_VIRTUAL
#define RELPOS_PURE
#else
#define RELPOS_VIRTUAL virtual
#define RELPOS_PURE = 0
#endif

class Board {
 public:
  // The one chip that may hold the clock: the Pozyx, while it carries out a function. How long is not
  // published (docs/emulator.md).
  static constexpr uint8_t kStretchingAddress = 0x4B;
  static constexpr uint16_t kMostStretchUs = 5000;

  // One transaction, every part but the address optional:
  //   S address+W first.. [Sr address+W second..] [Sr address+R read..] P
  // Blocks until the end, at most 1 ms (at 400 kHz), with the chip that stretches 6 ms. Failures are
  // counted.
  RELPOS_APART BusStatus transfer(uint8_t address, const uint8_t* first, uint8_t first_count,
                     const uint8_t* second, uint8_t second_count, uint8_t* read,
                     uint8_t read_count) {
    const BusStatus status =
        i2c_transfer(address, first, first_count, second, second_count, read, read_count);
    if (status != BusStatus::kOk) ++bus_errors_;
    return status;
  }
  bool read_registers(uint8_t address, uint8_t reg, uint8_t* data, uint8_t count) {
    return transfer(address, &reg, 1, nullptr, 0, data, count) == BusStatus::kOk;
  }
  bool write_register(uint8_t address, uint8_t reg, uint8_t value) {
    const uint8_t bytes[2] = {reg, value};
    return transfer(address, bytes, 2, nullptr, 0, nullptr, 0) == BusStatus::kOk;
  }
  uint16_t bus_errors() const { return bus_errors_; }  // wraps

  RELPOS_VIRTUAL uint8_t uart_write_space() RELPOS_PURE;  // bytes that uart_write takes at once
  RELPOS_VIRTUAL void uart_write(uint8_t byte) RELPOS_PURE;  // only with space left
  RELPOS_VIRTUAL int16_t uart_read() RELPOS_PURE;            // -1 where nothing has come
  RELPOS_VIRTUAL UartErrors uart_errors() RELPOS_PURE;
  // Non-volatile; 0xFF where never written. Both wait for the end of a write that is under way, some
  // milliseconds: ask storage_ready() first.
  RELPOS_VIRTUAL uint8_t storage_read(uint16_t at) RELPOS_PURE;
  RELPOS_VIRTUAL void storage_write(uint16_t at, uint8_t value) RELPOS_PURE;  // begins
  RELPOS_VIRTUAL bool storage_ready() RELPOS_PURE;
  RELPOS_VIRTUAL uint32_t now_us() RELPOS_PURE;  // wraps
  RELPOS_VIRTUAL void watchdog_reset() RELPOS_PURE;
  RELPOS_VIRTUAL void led(bool on) RELPOS_PURE;
  RELPOS_VIRTUAL void reset() RELPOS_PURE;           // restarts the node
  RELPOS_VIRTUAL uint16_t free_stack() RELPOS_PURE;  // bytes that the stack has never reached
  // Supply of the microcontroller itself, as measured at the previous call; 0 where it is not measured.
  RELPOS_VIRTUAL uint16_t supply_mv() RELPOS_PURE;
  // 1 at the start of a tick, 0 at its end: for timing.
  RELPOS_VIRTUAL void mark(uint8_t value) RELPOS_PURE;

 protected:
  RELPOS_VIRTUAL BusStatus i2c_transfer(uint8_t address, const uint8_t* first,
                                        uint8_t first_count, const uint8_t* second,
                                        uint8_t second_count, uint8_t* read,
                                        uint8_t read_count) RELPOS_PURE;
  ~Board() {}

 private:
  uint16_t bus_errors_ = 0;
};

}  // namespace relpos

#undef RELPOS_VIRTUAL
#undef RELPOS_PURE
