// What survives a restart, and where it stands in the EEPROM.
#pragma once

#include <stdint.h>

#include "board/board.h"
#include "wire/messages.h"

namespace relpos {

constexpr uint8_t kDefaultNodeId = 1;  // where none is stored

enum LedMode : uint8_t { kLedOff = 0, kLedOn = 1, kLedHealth = 2 };

struct Preferences {
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

struct Settings : Preferences {
  int16_t calibration[wire::kCalibrationWords];  // in force; all zero: none
};

// A stored record: layout, Settings, CRC(2).
constexpr uint8_t kRecordBytes = 1 + sizeof(Settings) + 2;

// The EEPROM's layout. Whoever prepares a board writes the first two bytes.
enum StorageAddress : uint16_t {
  kStoredNodeId = 0,            // 1 to 254
  kStoredNodeIdComplement = 1,  // node id ^ 0xFF
  kStoredBootCount = 2,
  kStoredReboot = 3,            // boot count, token(2), key(2) of the last REBOOT command
  kStoredSettings = 16,         // two records, then the calibration words that wait for their COMMIT
  kStoredStaging = kStoredSettings + 2 * kRecordBytes,
  kStorageBytes = 192
};
static_assert(kStoredStaging + sizeof(Settings::calibration) <= kStorageBytes, "all must fit");

// Two copies with a CRC each: a power cut while one is written leaves the other. A calibration comes
// word by word; the words wait in the EEPROM, where they cost no RAM, until all of them are there.
class SettingsStore {
 public:
  void load(Board& board, Settings* settings);  // defaults where neither copy is good
  void save(const Settings& settings);          // begins; step() does it
  void stage(uint8_t index, uint16_t word);     // of a calibration; likewise. Only when not saving
  // The staged words become the settings' calibration, and are saved, where crc is theirs.
  bool commit(Board& board, Settings* settings, uint16_t crc);
  bool saving() const { return position_ != kDone; }
  bool staging() const { return saving() && position_ >= kStaging; }
  void step(Board& board, const Settings& settings);  // at most one byte

 private:
  static constexpr uint8_t kDone = 0xFF;
  static constexpr uint8_t kStaging = 2 * kRecordBytes;

  uint16_t crc_ = 0;  // of the settings, or the word that is staged
  uint8_t position_ = kDone;  // behind kStoredSettings
};

}  // namespace relpos
