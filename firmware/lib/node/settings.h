// What survives a restart, and where it stands in the EEPROM.
#pragma once

#include <stdint.h>

#include "board/board.h"

namespace relpos {

// The EEPROM's layout. Whoever prepares a board writes the first two bytes.
enum StorageAddress : uint16_t {
  kStoredNodeId = 0,            // 1 to 254
  kStoredNodeIdComplement = 1,  // node id ^ 0xFF
  kStoredBootCount = 2,
  kStoredReboot = 3,            // boot count, token(2), key(2) of the last REBOOT command
  kStoredSettings = 16,         // layout, Settings, CRC(2); twice
  kStoredSettingsCopy = 48,
  kStorageBytes = 128
};
constexpr uint8_t kDefaultNodeId = 1;  // where none is stored

enum LedMode : uint8_t { kLedOff = 0, kLedOn = 1, kLedHealth = 2 };

struct Settings {
  uint8_t team_size;  // node ids 1 to team_size are ranged
  uint8_t step_reports;
  uint8_t led;
  uint8_t gain_version;  // counts changes of the next two
  uint16_t leg_length_mm;
  uint16_t step_gain_permille;
  uint16_t report_period_ms;
  uint16_t ranging_period_ms;  // 0: no ranging
  uint16_t status_period_ms;
};

// Two copies with a CRC each: a power cut while one is written leaves the other.
class SettingsStore {
 public:
  void load(Board& board, Settings* settings);  // defaults where neither copy is good
  void save(const Settings& settings);          // begins; step() does it
  bool saving() const { return position_ != kDone; }
  void step(Board& board, const Settings& settings);  // at most one byte

 private:
  static constexpr uint8_t kDone = 0xFF;

  uint16_t crc_ = 0;
  uint8_t position_ = kDone;  // in the two records
};

}  // namespace relpos
