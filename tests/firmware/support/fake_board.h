// A board without anything on it; a suite overrides what it drives.
#pragma once

#include "board/board.h"

struct FakeBoard : relpos::Board {
  uint8_t uart_write_space() override { return 0; }
  void uart_write(uint8_t) override {}
  int16_t uart_read() override { return -1; }
  uint8_t storage_read(uint16_t) override { return 0xFF; }
  void storage_write(uint16_t, uint8_t) override {}
  bool storage_ready() override { return true; }
  relpos::UartErrors uart_errors() override { return {0, 0}; }
  uint32_t now_us() override { return 0; }
  void watchdog_reset() override {}
  void led(bool) override {}
  void reset() override {}
  uint16_t free_stack() override { return 0; }
  uint16_t supply_mv() override { return 5000; }
  void mark(uint8_t) override {}

 protected:
  relpos::BusStatus i2c_transfer(uint8_t, const uint8_t*, uint8_t, const uint8_t*, uint8_t,
                                 uint8_t*, uint8_t) override {
    return relpos::BusStatus::kAddressNack;
  }
};
