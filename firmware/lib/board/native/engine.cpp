#include "engine.h"

#if !defined(ARDUINO)

#include <string.h>

#include <new>

#include "board/board.h"
#include "node/node.h"
#include "node/settings.h"

namespace relpos {
namespace {

// The PC's board: the bus and the line are the caller's, the clock is the one handed to poll().
class NativeBoard final : public Board {
 public:
  NativeBoard(const relpos_board_callbacks& callbacks, uint8_t* eeprom, uint16_t eeprom_size,
              uint32_t now_us)
      : callbacks_(callbacks), eeprom_(eeprom), eeprom_size_(eeprom_size), now_us_(now_us) {}

  void set_supply(uint16_t supply_mv) { supply_mv_ = supply_mv; }
  void set_now(uint32_t now_us) { now_us_ = now_us; }
  void receive(uint8_t byte) {
    if (received_count_ == kReceiveBytes) {
      ++errors_.lost;
      return;
    }
    received_[(received_first_ + received_count_++) % kReceiveBytes] = byte;
  }
  void flush() {
    if (written_count_ == 0) return;
    const uint16_t count = written_count_;
    written_count_ = 0;
    callbacks_.uart_write(callbacks_.context, written_, count);
  }

  uint8_t uart_write_space() override {
    return static_cast<uint8_t>(kWriteBytes - written_count_);
  }
  void uart_write(uint8_t byte) override {
    if (written_count_ < kWriteBytes) written_[written_count_++] = byte;
  }
  int16_t uart_read() override {
    if (received_count_ == 0) return -1;
    const uint8_t byte = received_[received_first_];
    received_first_ = static_cast<uint16_t>((received_first_ + 1) % kReceiveBytes);
    --received_count_;
    return byte;
  }
  UartErrors uart_errors() override { return errors_; }
  uint8_t storage_read(uint16_t at) override { return at < eeprom_size_ ? eeprom_[at] : 0xFF; }
  bool storage_ready() override {
    if (writing_ && now_us_ - writing_since_us_ >= kStorageWriteUs) writing_ = false;
    return !writing_;
  }
  void storage_write(uint16_t at, uint8_t value) override {
    if (at >= eeprom_size_ || eeprom_[at] == value) return;
    writing_ = true;
    writing_since_us_ = now_us_;
    if (callbacks_.storage_write != nullptr) {
      callbacks_.storage_write(callbacks_.context, at, value);
    } else {
      eeprom_[at] = value;
    }
  }
  uint32_t now_us() override { return now_us_; }
  void watchdog_reset() override {}
  void led(bool) override {}
  void reset() override { callbacks_.reset(callbacks_.context); }
  uint16_t free_stack() override { return 0xFFFF; }  // a PC has enough
  // Through the boards' 10-bit converter, so that all report the same.
  uint16_t supply_mv() override {
    constexpr uint32_t kReferenceCounts = 1100UL * 1024;
    const uint32_t reading = supply_mv_ == 0 ? 0 : kReferenceCounts / supply_mv_;
    return reading == 0 ? 0 : static_cast<uint16_t>(kReferenceCounts / reading);
  }
  void mark(uint8_t) override {}

 protected:
  BusStatus i2c_transfer(uint8_t address, const uint8_t* first, uint8_t first_count,
                         const uint8_t* second, uint8_t second_count, uint8_t* read,
                         uint8_t read_count) override {
    memcpy(callbacks_.wire, first, first_count);
    if (second_count != 0) memcpy(callbacks_.wire + first_count, second, second_count);
    const uint8_t status = callbacks_.i2c_transfer(callbacks_.context, address, first_count,
                                                   second_count, read_count);
    if (status == 0 && read_count != 0) memcpy(read, callbacks_.wire, read_count);
    return status <= static_cast<uint8_t>(BusStatus::kTimeout) ? static_cast<BusStatus>(status)
                                                               : BusStatus::kTimeout;
  }

 private:
  static constexpr uint16_t kReceiveBytes = 256;
  static constexpr uint8_t kWriteBytes = 255;
  static constexpr uint32_t kStorageWriteUs = 3400;  // a byte (ATmega328P data sheet, EEPROM timing)

  relpos_board_callbacks callbacks_;
  uint8_t* eeprom_;
  uint16_t eeprom_size_;
  bool writing_ = false;
  uint32_t writing_since_us_ = 0;
  uint32_t now_us_;
  uint16_t supply_mv_ = 5000;
  uint8_t received_[kReceiveBytes];
  uint16_t received_first_ = 0;
  uint16_t received_count_ = 0;
  UartErrors errors_ = {0, 0};
  uint8_t written_[kWriteBytes];
  uint8_t written_count_ = 0;
};

}  // namespace
}  // namespace relpos

struct relpos_node {
  relpos_node(const relpos_board_callbacks& callbacks, uint8_t* eeprom, uint16_t eeprom_size,
              uint32_t now_us)
      : board(callbacks, eeprom, eeprom_size, now_us), node(board) {}
  relpos::NativeBoard board;
  relpos::Node node;
};

relpos_node* relpos_node_create(const relpos_board_callbacks* callbacks, uint8_t* eeprom,
                                uint16_t eeprom_size, uint8_t node_id, uint8_t reset_cause,
                                uint32_t now_us) {
  if (callbacks == nullptr || callbacks->i2c_transfer == nullptr ||
      callbacks->wire == nullptr || callbacks->uart_write == nullptr ||
      callbacks->reset == nullptr || eeprom == nullptr || eeprom_size < relpos::kStorageBytes ||
      node_id == relpos::wire::kBroadcast) {
    return nullptr;
  }
  relpos_node* node = new (std::nothrow) relpos_node(*callbacks, eeprom, eeprom_size, now_us);
  if (node == nullptr) return nullptr;
  const uint8_t most = static_cast<uint8_t>(relpos::wire::ResetCause::kCommand);
  node->node.begin(now_us,
                   reset_cause <= most ? static_cast<relpos::wire::ResetCause>(reset_cause)
                                       : relpos::wire::ResetCause::kUnknown,
                   node_id);
  return node;
}

void relpos_node_destroy(relpos_node* node) { delete node; }

void relpos_node_receive(relpos_node* node, const uint8_t* bytes, uint16_t count) {
  for (uint16_t i = 0; i < count; ++i) node->board.receive(bytes[i]);
}

void relpos_node_set_supply(relpos_node* node, uint16_t supply_mv) {
  node->board.set_supply(supply_mv);
}

uint32_t relpos_node_poll(relpos_node* node, uint32_t now_us) {
  node->board.set_now(now_us);
  const uint32_t wait_us = node->node.poll(now_us);
  node->board.flush();
  return wait_us;
}

#endif
