// The firmware's parsers without a node around them, so that they are tried more often: the radio
// module's line, frames, bodies of messages, the EEPROM. An input's first byte chooses one. For
// -fsanitize=fuzzer; ends with how often each was tried.
#include <algorithm>

#include "node/settings.h"
#include "references.h"
#include "wire/siphash.h"

using relpos::Marks;
using relpos::Persistent;
using relpos::Record;
using relpos::Settings;
using relpos::Storage;

namespace {

const uint8_t kKey[wire::kKeyBytes] = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};

uint64_t lines, frames, bodies, images, chances;

void print_totals() {
  printf("line %llu, frames %llu, bodies %llu, eeprom %llu (CRC by chance %llu)\n",
         static_cast<unsigned long long>(lines), static_cast<unsigned long long>(frames),
         static_cast<unsigned long long>(bodies), static_cast<unsigned long long>(images),
         static_cast<unsigned long long>(chances));
  fflush(stdout);
}

// Bytes of no order; then one good frame, which is always found.
void read_line(const Bytes& bytes) {
  Xbee parser = Xbee();
  ReferenceModule module;
  Bytes part;
  part.reserve(bytes.size() + 32);
  module.plain.reserve(bytes.size() + 32);
  static const Bytes good = received_frame(Bytes(3, 0x7E));
  size_t found = 0;
  for (size_t i = 0; i < bytes.size() + good.size(); ++i) {
    const uint8_t byte = i < bytes.size() ? bytes[i] : good[i - bytes.size()];
    part.push_back(byte);
    module.take(byte);
    if (module.payloads.size() == found) continue;
    ++found;
    check_parser(&parser, part, &module.payloads.back());
    part.clear();
  }
  check_parser(&parser, part, nullptr);
  if (found == 0 || module.payloads.back() != Bytes(3, 0x7E)) fail("a good frame is missed");
}

// As it is, then with a right CRC, then with a right tag, too.
void open_frame(Bytes frame) {
  frame.resize(std::min<size_t>(frame.size(), 255));
  for (int made_right = 0; made_right < 3; ++made_right) {
    const size_t size = frame.size();
    const bool sized = size >= wire::kOverhead && size <= wire::kFrameBytes;
    if (made_right > 0 && !sized) return;
    if (made_right > 0) {
      frame[0] = wire::kMagic;
      frame[1] = wire::kProtocolVersion;
      redo_crc(&frame);
    }
    uint8_t tag[wire::kTagBytes] = {};
    if (sized) {
      const uint8_t tagged = static_cast<uint8_t>(size - wire::kTagBytes);
      wire::siphash24(kKey, frame.data(), tagged, tag);
      if (made_right == 2) std::copy(tag, tag + wire::kTagBytes, frame.end() - wire::kTagBytes);
    }
    const bool ours = size > 1 && frame[0] == wire::kMagic && frame[1] == wire::kProtocolVersion;
    const bool tagged = sized && std::equal(tag, tag + wire::kTagBytes, frame.end() - wire::kTagBytes);
    const Bytes exact(frame);
    wire::Header header;
    const wire::FrameStatus status =
        wire::open(exact.data(), static_cast<uint8_t>(exact.size()), kKey, &header);
    const bool good = status == wire::FrameStatus::kGood;
    if (good != (ours && tagged && crc_fits(frame))) fail("a frame is opened that is none, or not");
    if (good && (static_cast<uint8_t>(header.type) != frame[2] || header.node != frame[3] ||
                 header.boot != frame[4] ||
                 header.counter != (frame[5] | frame[6] << 8 | frame[7] << 16 |
                                    static_cast<uint32_t>(frame[8]) << 24))) {
      fail("a header is read as another one");
    }
  }
}

// ---- the EEPROM, by the description in settings.h ----

struct Memory : FakeBoard {
  uint8_t bytes[relpos::kStorageBytes];
  uint32_t writes_left = 0xFFFFFFFF;
  uint8_t storage_read(uint16_t at) override {
    if (at >= sizeof bytes) fail("the EEPROM is read behind its end");
    return bytes[at];
  }
  void storage_write(uint16_t at, uint8_t value) override {
    if (at >= sizeof bytes) fail("the EEPROM is written behind its end");
    if (writes_left == 0) return;
    --writes_left;
    bytes[at] = value;
  }
};

constexpr uint8_t kLayout = 3;
constexpr size_t kSizes[] = {sizeof(Marks), sizeof(Settings), sizeof(Persistent::keys_)};

bool intact(const uint8_t* copy, size_t size) {
  const uint16_t crc = reference_crc(copy + 1, size, 0xFFFF - kLayout);
  return copy[0] == kLayout && copy[size + 1] == (crc & 0xFF) && copy[size + 2] == crc >> 8;
}

void make_intact(uint8_t* copy, size_t size) {
  copy[0] = kLayout;
  const uint16_t crc = reference_crc(copy + 1, size, 0xFFFF - kLayout);
  copy[size + 1] = static_cast<uint8_t>(crc);
  copy[size + 2] = static_cast<uint8_t>(crc >> 8);
}

Bytes part_of(const Persistent& all, size_t record) {
  const uint8_t* from = reinterpret_cast<const uint8_t*>(&all);
  for (size_t k = 0; k < record; ++k) from += kSizes[k];
  return Bytes(from, from + kSizes[record]);
}

Persistent loaded(Memory* memory) {
  Persistent all;
  memset(&all, 0xA5, sizeof all);
  Storage storage = Storage();
  storage.load(*memory, &all);
  return all;
}

// Control: which copies are made right, then which record is saved and after how many bytes the
// power fails. The rest, again and again, is what the EEPROM holds.
void load_and_save(const Bytes& input) {
  Memory memory;
  memset(memory.bytes, 0xFF, sizeof memory.bytes);
  const uint8_t right = input.size() > 0 ? input[0] : 0;
  const uint8_t record = input.size() > 1 ? input[1] % relpos::kRecords : 0;
  const uint8_t writes = input.size() > 2 ? input[2] : 0;
  for (size_t i = 0; i < sizeof memory.bytes && input.size() > 3; ++i) {
    memory.bytes[i] = input[3 + i % (input.size() - 3)];
  }
  uint8_t* copy = memory.bytes + relpos::kStoredRecords;
  Bytes expected[relpos::kRecords];
  bool was_intact[relpos::kRecords];  // the first copy, which is read first
  for (size_t k = 0; k < relpos::kRecords; ++k) {
    for (size_t twin = 0; twin < 2; ++twin, copy += kSizes[k] + 3) {
      if ((right >> (2 * k + twin) & 1) != 0) make_intact(copy, kSizes[k]);
      if (twin == 0) was_intact[k] = intact(copy, kSizes[k]);
      if (!expected[k].empty() || !intact(copy, kSizes[k])) continue;
      expected[k].assign(copy + 1, copy + 1 + kSizes[k]);
    }
  }
  Settings defaults;
  memset(&defaults, 0, sizeof defaults);
  Storage::restore_defaults(&defaults);
  const uint8_t* plain = reinterpret_cast<const uint8_t*>(&defaults);
  for (size_t k = 0; k < relpos::kRecords; ++k) {
    if (!expected[k].empty()) continue;
    if (k == static_cast<size_t>(Record::kSettings)) expected[k].assign(plain, plain + sizeof defaults);
    expected[k].resize(kSizes[k], 0);
  }
  Persistent all = loaded(&memory);
  for (size_t k = 0; k < relpos::kRecords; ++k) {
    if (part_of(all, k) != expected[k]) fail("a record is not the first good copy, or its default");
  }

  Persistent changed = all;
  reinterpret_cast<uint8_t*>(&changed)[record == 0 ? 0 : record == 1 ? kSizes[0] : kSizes[0] + kSizes[1]] ^= 0xFF;
  memory.writes_left = writes;
  Storage storage = Storage();
  storage.save(static_cast<Record>(record));
  for (int steps = 0; storage.saving(); ++steps) {
    if (steps > 500) fail("saving never ends");
    storage.step(memory, changed);
  }
  const bool whole = writes >= 2 * (kSizes[record] + 3);
  const Persistent after = loaded(&memory);
  for (size_t k = 0; k < relpos::kRecords; ++k) {
    const bool is_new = part_of(after, k) == part_of(changed, k);
    const bool is_old = part_of(after, k) == part_of(all, k);
    if (is_new || (is_old && !whole)) continue;
    // A copy that was damaged before, and is cut while it is written, fits its CRC once in 65,536.
    const bool by_chance = k == record && !whole && !was_intact[k];
    if (!by_chance) fail("a record is neither the old one nor the new one");
    ++chances;
  }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  static const int registered = atexit(print_totals);
  (void)registered;
  if (size == 0) return 0;
  const Bytes rest(data + 1, data + size);
  switch (data[0] % 4) {
    case 0: ++lines; read_line(rest); break;
    case 1: ++frames; open_frame(rest); break;
    case 2: ++bodies; try_every_decode(rest); break;
    default: ++images; load_and_save(rest); break;
  }
  return 0;
}
