#include "node/settings.h"

#include <string.h>

#include "devices/flash.h"
#include "inertial/calls.h"
#include "wire/frame.h"

namespace relpos {
namespace {

static_assert(__is_trivial(Persistent), "records are copied byte by byte");
static_assert(sizeof(Preferences) == 18 && sizeof(Settings) == 62 && sizeof(Marks) == 8,
              "the stored bytes are those of the struct on every board");
constexpr uint8_t kLayout = 3;  // of all records; another one is not read
const Preferences kDefaults RELPOS_FLASH = {
    6, 0, kLedHealth, 0, 930, kPopulationGainPermille, 1000, 2000, 10000, 0, 0, 0};
constexpr uint16_t kSeed = 0xFFFF - kLayout;

static_assert(kStoredRecords == 54 && kStorageBytes - kStoredRecords <= 256, "a place is a byte");
constexpr uint8_t kRecordBytes = sizeof(Marks) + sizeof(Settings) + sizeof(Persistent::keys_);
static_assert(kRecordBytes <= sizeof(Persistent) && sizeof(Persistent) < kRecordBytes + 4,
              "no gaps between the records");
const uint8_t kSizes[kRecords] RELPOS_FLASH = {sizeof(Marks), sizeof(Settings),
                                               sizeof(Persistent::keys_)};

void read(Board& board, uint16_t at, uint8_t count, void* to) {
  for (uint8_t i = 0; i < count; ++i) static_cast<uint8_t*>(to)[i] = board.storage_read(at++);
}

// A copy of a record: layout, its bytes, CRC.
RELPOS_APART bool intact(Board& board, uint16_t at, uint8_t size) {
  if (board.storage_read(at) != kLayout) return false;
  uint16_t crc = kSeed;
  for (; size != 0; --size) {
    const uint8_t byte = board.storage_read(++at);
    crc = wire::crc16(&byte, sizeof byte, crc);
  }
  uint16_t stored;
  read(board, ++at, sizeof stored, &stored);
  return stored == crc;
}

}  // namespace

void Storage::restore_defaults(Settings* settings) {
  const uint8_t id = settings->node_id;
  uint8_t* bytes = reinterpret_cast<uint8_t*>(settings);
  for (uint8_t i = 0; i < sizeof *settings; ++i) {
    bytes[i] = i < sizeof kDefaults ? flash_byte(reinterpret_cast<const uint8_t*>(&kDefaults) + i)
                                    : 0;
  }
  settings->node_id = id;
}

void Storage::load(Board& board, Persistent* all) {
  uint8_t* image = reinterpret_cast<uint8_t*>(all);
  uint16_t at = kStoredRecords;
  for (uint8_t record = 0; record < kRecords; ++record) {
    const uint8_t size = flash_byte(&kSizes[record]);
    const uint16_t next = at + stored_bytes(size);
    bool good = false;
    for (; !good && at != next; at += size + 3) {
      good = intact(board, at, size);
      if (good) read(board, at + 1, size, image);
    }
    if (!good) {
      memset(image, 0, size);
      if (record == static_cast<uint8_t>(Record::kSettings)) restore_defaults(&all->settings_);
    }
    at = next;
    image += size;
  }
}

void Storage::stage(uint8_t index, uint16_t word) {
  crc_ = word;
  at_ = static_cast<uint8_t>(kStoredStaging + 2 * index);
  record_ = kRecords;
  left_ = 2;
}

bool Storage::commit(Board& board, Settings* settings, uint16_t crc) {
  uint8_t words[sizeof settings->calibration];
  read(board, kStoredStaging, sizeof words, words);
  if (wire::crc16(words, sizeof words) != crc) return false;
  memcpy(settings->calibration, words, sizeof words);
  save(Record::kSettings);
  return true;
}

void Storage::step(Board& board, const Persistent& all) {
  if (!saving() || !board.storage_ready()) return;
  uint8_t value;
  uint8_t end = 0;
  if (left_ != 0 && record_ == kRecords) {
    value = static_cast<uint8_t>(left_ == 2 ? crc_ : crc_ >> 8);
  } else {
    const uint8_t* image = reinterpret_cast<const uint8_t*>(&all);
    uint8_t at = 0;
    uint8_t bit = 1;
    const uint8_t* size = kSizes;
    // The record under way, else the first one due.
    for (uint8_t k = 0; left_ != 0 ? k != record_ : (due_ & bit) == 0; ++k) {
      image += flash_byte(size);
      at = static_cast<uint8_t>(at + stored_bytes(flash_byte(size)));
      ++size;
      bit = static_cast<uint8_t>(bit << 1);
    }
    const uint8_t bytes = flash_byte(size);
    if ((due_ & bit) != 0) {  // from the start, also where it has changed while it was written
      due_ = static_cast<uint8_t>(due_ & ~bit);
      record_ = static_cast<uint8_t>(size - kSizes);
      crc_ = wire::crc16(image, bytes, kSeed);
      left_ = stored_bytes(bytes);
      // Never over the only good copy: power cuts before may have left one.
      at_ = at;
      if (intact(board, kStoredRecords + at, bytes)) at_ = static_cast<uint8_t>(at + bytes + 3);
    }
    end = static_cast<uint8_t>(at + stored_bytes(bytes));
    // In a copy, from its end: the CRC's two bytes, the record's, the layout.
    uint8_t behind = left_;
    if (behind > bytes + 3) behind = static_cast<uint8_t>(behind - (bytes + 3));
    if (behind > bytes + 2) {
      value = kLayout;
    } else if (behind > 2) {
      value = image[bytes + 2 - behind];
    } else {
      value = static_cast<uint8_t>(behind == 2 ? crc_ : crc_ >> 8);
    }
  }
  board.storage_write(record_ == kRecords ? at_ : kStoredRecords + at_, value);
  --left_;
  if (++at_ == end) at_ = static_cast<uint8_t>(end - 2 * left_);  // the other copy, or done
}

}  // namespace relpos
