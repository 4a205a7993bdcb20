// What a node needs from the board it runs on. The boards: arduino/ (Uno and Mega) and native/ (the
// same node on a PC). Everything above this header is the same source on both.
#pragma once

#include <stdint.h>

namespace relpos {

// How an I2C transaction ended. The numbers are part of native/engine.h.
enum class BusStatus : uint8_t {
  kOk = 0,
  kAddressNack = 1,
  kDataNack = 2,
  kTimeout = 3,  // also: the bus is held by somebody
};

// One class with virtual functions and no other: on the AVR a table of them costs RAM.
class Board {
 public:
  // One transaction, every part but the address optional:
  //   S address+W first.. [Sr address+W second..] [Sr address+R read..] P
  // Blocks until the end, at most about 1 ms. Failures are counted.
  BusStatus transfer(uint8_t address, const uint8_t* first, uint8_t first_count,
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

  virtual uint8_t uart_write_space() = 0;        // bytes that uart_write takes without waiting
  virtual void uart_write(uint8_t byte) = 0;     // only with space left
  virtual int16_t uart_read() = 0;               // -1 where nothing has come
  virtual uint8_t storage_read(uint16_t at) = 0;             // non-volatile; 0xFF where never written
  virtual bool storage_write(uint16_t at, uint8_t value) = 0;  // begins; false while still busy
  virtual uint32_t now_us() = 0;                 // wraps
  virtual void watchdog_reset() = 0;
  virtual void led(bool on) = 0;
  virtual void reset() = 0;                      // restarts the node
  virtual uint16_t free_stack() = 0;             // bytes that the stack has never reached
  virtual void mark(uint8_t value) = 0;          // 1 at the start of a tick, 0 at its end: for timing

 protected:
  virtual BusStatus i2c_transfer(uint8_t address, const uint8_t* first, uint8_t first_count,
                                 const uint8_t* second, uint8_t second_count, uint8_t* read,
                                 uint8_t read_count) = 0;
  ~Board() {}

 private:
  uint16_t bus_errors_ = 0;
};

}  // namespace relpos
