#include "node/settings.h"

#include <string.h>

#include "devices/flash.h"
#include "wire/frame.h"

namespace relpos {
namespace {

static_assert(sizeof(Preferences) == 14 && sizeof(Settings) == 58,
              "the stored bytes are those of the struct on every board");
constexpr uint8_t kLayout = 2;  // of Settings; another one is not read
const Preferences kDefaults RELPOS_FLASH = {6, 0, kLedHealth, 0, 930, 2130, 1000, 2000, 10000};
constexpr uint16_t kSeed = 0xFFFF - kLayout;

uint16_t crc_of(const Settings& settings) {
  return wire::crc16(reinterpret_cast<const uint8_t*>(&settings), sizeof settings, kSeed);
}

void read(Board& board, uint16_t at, uint8_t count, void* to) {
  for (uint8_t i = 0; i < count; ++i) static_cast<uint8_t*>(to)[i] = board.storage_read(at++);
}

bool load_copy(Board& board, uint16_t at, Settings* settings) {
  uint16_t crc;
  read(board, at + 1, sizeof *settings, settings);
  read(board, at + 1 + sizeof *settings, sizeof crc, &crc);
  return board.storage_read(at) == kLayout && crc_of(*settings) == crc;
}

}  // namespace

void SettingsStore::load(Board& board, Settings* settings) {
  if (load_copy(board, kStoredSettings, settings) ||
      load_copy(board, kStoredSettings + kRecordBytes, settings)) {
    return;
  }
  uint8_t* bytes = reinterpret_cast<uint8_t*>(settings);
  for (uint8_t i = 0; i < sizeof *settings; ++i) {
    bytes[i] = i < sizeof kDefaults ? flash_byte(reinterpret_cast<const uint8_t*>(&kDefaults) + i)
                                    : 0;
  }
}

void SettingsStore::save(const Settings& settings) {
  crc_ = crc_of(settings);
  position_ = 0;
}

void SettingsStore::stage(uint8_t index, uint16_t word) {
  crc_ = word;
  position_ = static_cast<uint8_t>(kStaging + 2 * index);
}

bool SettingsStore::commit(Board& board, Settings* settings, uint16_t crc) {
  uint8_t words[sizeof settings->calibration];
  read(board, kStoredStaging, sizeof words, words);
  if (wire::crc16(words, sizeof words) != crc) return false;
  memcpy(settings->calibration, words, sizeof words);
  save(*settings);
  return true;
}

void SettingsStore::step(Board& board, const Settings& settings) {
  if (!saving()) return;
  uint8_t at = position_;  // in the record; in the staging place: 1 + sizeof settings or one more
  if (staging()) {
    at = 1 + sizeof settings + (position_ & 1);
  } else if (at >= kRecordBytes) {
    at = static_cast<uint8_t>(at - kRecordBytes);
  }
  uint8_t value = kLayout;
  if (at > sizeof settings) {
    value = static_cast<uint8_t>(at == kRecordBytes - 1 ? crc_ >> 8 : crc_);
  } else if (at > 0) {
    value = reinterpret_cast<const uint8_t*>(&settings)[at - 1];
  }
  if (!board.storage_write(kStoredSettings + position_, value)) return;
  ++position_;
  // The second copy ends where the staging place begins; a staged word has two bytes.
  static_assert(kStaging % 2 == 0, "a word begins at an even position");
  if (position_ >= kStaging && position_ % 2 == 0) position_ = kDone;
}

}  // namespace relpos
