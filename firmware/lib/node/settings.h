// What survives a restart, and where it stands in the EEPROM.
#pragma once

#include <stdint.h>

#include "board/board.h"
#include "wire/messages.h"

namespace relpos {

constexpr uint8_t kDefaultNodeId = 1;  // where none is stored
constexpr uint16_t kPopulationGainPermille = 2140;  // a new node's step gain

enum LedMode : uint8_t { kLedOff = 0, kLedOn = 1, kLedHealth = 2 };

struct Preferences {
  uint8_t team_size;  // without a beacon, node ids 1 to team_size are ranged
  uint8_t step_reports;
  uint8_t led;
  uint8_t gain_version;  // counts changes of the next two
  uint16_t leg_length_mm;
  uint16_t step_gain_permille;
  uint16_t report_period_ms;
  uint16_t ranging_period_ms;  // 0: no ranging
  uint16_t status_period_ms;
  int16_t range_offset_mm;  // reported, not applied
  uint8_t node_id;          // 0: the one that the board was prepared with
  uint8_t reserved;
};

struct Settings : Preferences {
  int16_t calibration[wire::kCalibrationWords];  // in force; all zero: none
};

// Against frames that are sent again.
struct Marks {
  uint32_t counter_end;  // this node's counters below may have been used
  uint32_t command;      // newest counter of a command that was obeyed, under whichever key
};

// What the EEPROM keeps a copy of; in memory all the time. Each part is a record of its own, behind
// each other in this order in both places.
struct Persistent {
  Marks marks_;
  Settings settings_;
  uint8_t keys_[2 * wire::kKeyBytes];  // its own, then the beacon's; all zero where none was given
};

enum class Record : uint8_t { kMarks, kSettings, kKeys };
constexpr uint8_t kRecords = 3;

// A record is stored twice: layout, its bytes, CRC(2).
constexpr uint8_t stored_bytes(uint8_t size) { return static_cast<uint8_t>(2 * (size + 3)); }

// The EEPROM's layout. Preparing a board writes the first two bytes.
enum StorageAddress : uint16_t {
  kStoredNodeId = 0,            // 1 to 254
  kStoredNodeIdComplement = 1,  // node id ^ 0xFF
  kStoredBootCount = 2,
  kStoredReboot = 3,            // token(2), key(2), boot count, boot count ^ 0xFF of the last
                                // restart on command
  kStoredStaging = 10,          // a calibration before its COMMIT
  kStoredRecords = kStoredStaging + sizeof(Settings::calibration),  // where version 0.2 has them
  kStorageBytes = kStoredRecords + stored_bytes(sizeof(Marks)) + stored_bytes(sizeof(Settings)) +
                  stored_bytes(sizeof(Persistent::keys_))
};

// Two copies with a CRC each: a power cut while one is written leaves the other, the old one or the
// new. A calibration comes word by word; the words wait in the EEPROM, where they cost no RAM, until
// all of them are there. Zeroed memory is the start: make it as `Storage()`.
class Storage {
 public:
  // Every record; one with no good copy begins with its defaults.
  void load(Board& board, Persistent* all);
  static void restore_defaults(Settings* settings);  // the calibration too; not the node's id
  void save(Record record) { due_ = static_cast<uint8_t>(due_ | 1 << static_cast<uint8_t>(record)); }
  void stage(uint8_t index, uint16_t word);  // of a calibration. Only when !saving()
  // The staged words become the settings' calibration, and are saved, where crc is theirs.
  bool commit(Board& board, Settings* settings, uint16_t crc);
  bool saving() const { return due_ != 0 || left_ != 0; }
  void step(Board& board, const Persistent& all);  // at most one byte

 private:
  uint8_t due_;     // records that wait, one bit each
  uint8_t left_;    // bytes of what is being written
  uint8_t record_;  // it; kRecords: a staged word
  uint8_t at_;      // the next byte's place, from the records' start; a staged word's whole one
  uint16_t crc_;    // of the record, or the staged word
};

}  // namespace relpos
