#include "node/settings.h"

#include <string.h>

#include "devices/flash.h"
#include "wire/frame.h"

namespace relpos {
namespace {

static_assert(sizeof(Settings) == 14, "the stored bytes are those of the struct on every board");
constexpr uint8_t kLayout = 1;  // of Settings; another one is not read
constexpr uint8_t kRecordBytes = 1 + sizeof(Settings) + 2;
static_assert(kStoredSettings + kRecordBytes <= kStoredSettingsCopy, "records must not overlap");
static_assert(kStoredSettingsCopy + kRecordBytes <= kStorageBytes, "records must fit");
const Settings kDefaults RELPOS_FLASH = {6, 0, kLedHealth, 0, 930, 1250, 1000, 2000, 10000};
constexpr uint16_t kSeed = 0xFFFF;

uint16_t crc_of(const Settings& settings) {
  return wire::crc16(reinterpret_cast<const uint8_t*>(&settings), sizeof settings,
                     static_cast<uint16_t>(kSeed - kLayout));
}

bool load_copy(Board& board, uint16_t at, Settings* settings) {
  if (board.storage_read(at) != kLayout) return false;
  ++at;
  Settings read;
  uint8_t bytes[sizeof read];
  for (uint8_t i = 0; i < sizeof bytes; ++i) bytes[i] = board.storage_read(at++);
  memcpy(&read, bytes, sizeof read);
  const uint8_t low = board.storage_read(at);
  const uint16_t stored = static_cast<uint16_t>(
      low | static_cast<uint16_t>(static_cast<uint16_t>(board.storage_read(at + 1)) << 8));
  if (crc_of(read) != stored) return false;
  *settings = read;
  return true;
}

}  // namespace

void SettingsStore::load(Board& board, Settings* settings) {
  for (uint8_t i = 0; i < sizeof kDefaults; ++i) {
    reinterpret_cast<uint8_t*>(settings)[i] =
        flash_byte(reinterpret_cast<const uint8_t*>(&kDefaults) + i);
  }
  if (!load_copy(board, kStoredSettings, settings)) {
    load_copy(board, kStoredSettingsCopy, settings);
  }
}

void SettingsStore::save(const Settings& settings) {
  crc_ = crc_of(settings);
  position_ = 0;
}

void SettingsStore::step(Board& board, const Settings& settings) {
  if (!saving()) return;
  const bool copy = position_ >= kRecordBytes;
  const uint8_t at = copy ? static_cast<uint8_t>(position_ - kRecordBytes) : position_;
  uint8_t value = kLayout;
  if (at > sizeof settings) {
    value = static_cast<uint8_t>(at == kRecordBytes - 1 ? crc_ >> 8 : crc_);
  } else if (at > 0) {
    value = reinterpret_cast<const uint8_t*>(&settings)[at - 1];
  }
  if (!board.storage_write(static_cast<uint16_t>((copy ? kStoredSettingsCopy : kStoredSettings) + at),
                           value)) {
    return;
  }
  if (++position_ == 2 * kRecordBytes) position_ = kDone;
}

}  // namespace relpos
