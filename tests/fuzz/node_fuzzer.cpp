// Whatever comes out of the radio module: the stream parser, open() and every decode(), and the whole
// node on a board of fakes, fed with the same bytes. An input is a script of small operations (see
// Script::run), so that what a search changes are frames, orders and moments, and the harness knows
// of every frame whether it is genuine. Two ways to run it:
//   with -fsanitize=fuzzer      libFuzzer finds the scripts, guided by coverage
//   with -DRELPOS_RANDOM        random scripts: fuzzer FRAMES SEED
// Ends with a line of totals; at the first broken promise it says which and aborts.
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include <new>
#include <vector>

#include "golden_frames.h"  // made from protocol/vectors/frames.json
#include "node/node.h"
#include "references.h"
#include "support/fake_board.h"
#include "wire/frame.h"
#include "wire/messages.h"
#include "wire/siphash.h"

using relpos::BusStatus;
using relpos::Node;
using relpos::NodeState;
using relpos::Xbee;
namespace wire = relpos::wire;

namespace {

struct Totals {
  uint64_t frames, genuine, mutants, noise, forged, opened, obeyed, refused, restarts, sent;
  uint64_t crc_of_mutants, crc_of_noise;
} totals;

uint64_t milliseconds() {
  timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return static_cast<uint64_t>(now.tv_sec) * 1000 + static_cast<uint64_t>(now.tv_nsec) / 1000000;
}
uint64_t started_ms;

void print_totals() {
  const double seconds = static_cast<double>(milliseconds() - started_ms) / 1000.0;
  printf("frames %llu, a second %.0f: genuine %llu, mutants %llu, noise %llu, forged %llu; "
         "opened %llu, obeyed %llu, refused %llu; crc of mutants %llu, crc of noise %llu; "
         "frames of the node %llu, restarts %llu\n",
         static_cast<unsigned long long>(totals.frames),
         static_cast<double>(totals.frames) / (seconds > 0 ? seconds : 1),
         static_cast<unsigned long long>(totals.genuine),
         static_cast<unsigned long long>(totals.mutants),
         static_cast<unsigned long long>(totals.noise),
         static_cast<unsigned long long>(totals.forged),
         static_cast<unsigned long long>(totals.opened),
         static_cast<unsigned long long>(totals.obeyed),
         static_cast<unsigned long long>(totals.refused),
         static_cast<unsigned long long>(totals.crc_of_mutants),
         static_cast<unsigned long long>(totals.crc_of_noise),
         static_cast<unsigned long long>(totals.sent),
         static_cast<unsigned long long>(totals.restarts));
  fflush(stdout);
}

// ---- the board ----

struct Genuine {
  Bytes frame;
  uint8_t key[wire::kKeyBytes];
};

struct Asked {  // a command that waits for its answer
  uint32_t counter;
  uint16_t token;
  uint8_t command;
};

struct World : FakeBoard {
  uint8_t eeprom[relpos::kStorageBytes];
  uint32_t now = 0;
  Bytes line;  // to the node
  size_t line_read = 0;
  ReferenceModule module;  // hears what the node sends
  uint8_t space = 255, space_left = 255;
  uint8_t present = 7;  // chips: 1 inertial, 2 magnetometer, 4 tag
  bool hostile = false;  // the chips answer anything
  uint64_t chaos = 1;
  uint32_t writes_left = 0xFFFFFFFF;  // then the power fails
  bool without_power = false;
  uint32_t busy_polls = 0;
  bool active = false;  // wrote to the EEPROM or the line
  bool restart_asked = false;
  bool cable = false;  // what comes now comes by it
  std::vector<Bytes> received;

  World() { memset(eeprom, 0xFF, sizeof eeprom); }

  uint8_t any() {
    chaos = chaos * 6364136223846793005ULL + 1442695040888963407ULL;
    return static_cast<uint8_t>(chaos >> 56);
  }
  uint8_t uart_write_space() override { return space_left; }
  void uart_write(uint8_t byte) override {
    if (space_left == 0) fail("the node writes into a full line");
    --space_left;
    active = true;
    hear(byte);
  }
  int16_t uart_read() override {
    return line_read < line.size() ? static_cast<int16_t>(line[line_read++]) : -1;
  }
  uint8_t storage_read(uint16_t at) override {
    if (at >= sizeof eeprom) fail("the node reads behind its EEPROM");
    return eeprom[at];
  }
  bool storage_ready() override {
    active = true;
    if (busy_polls != 0) {
      --busy_polls;
      return false;
    }
    return true;
  }
  void storage_write(uint16_t at, uint8_t value) override {
    if (at >= sizeof eeprom) fail("the node writes behind its EEPROM");
    active = true;
    without_power = writes_left == 0;
    if (without_power) return;
    --writes_left;
    eeprom[at] = value;
  }
  uint32_t now_us() override { return now; }
  void reset() override { restart_asked = true; }

 protected:
  BusStatus i2c_transfer(uint8_t address, const uint8_t* first, uint8_t first_count, const uint8_t*,
                         uint8_t, uint8_t* read, uint8_t read_count) override {
    if (hostile) {
      for (uint8_t i = 0; i < read_count; ++i) read[i] = any();
      return (any() & 7) != 0 ? BusStatus::kOk : BusStatus::kTimeout;
    }
    for (uint8_t i = 0; i < read_count; ++i) read[i] = 0;
    if (address == 0x68 && (present & 1) != 0) {
      if (first_count == 1 && first[0] == 0x75) read[0] = 0x68;
      if (first_count == 1 && first[0] == 0x3A && now - sampled_us_ >= 20000) {
        sampled_us_ = now;
        read[0] = 1;
      }
      if (first_count == 1 && first[0] == 0x37) {
        read[0] = 0x22;
        read[1] = 0x01;
        for (uint8_t i = 2; i < read_count; ++i) read[i] = static_cast<uint8_t>(any() & 0x3F);
      }
      return BusStatus::kOk;
    }
    if (address == 0x0C && (present & 2) != 0) {
      if (read_count == 1) read[0] = 0x48;
      if (read_count == 3) read[0] = read[1] = read[2] = 128;
      if (read_count == 8) {
        read[0] = 1;
        read[1] = static_cast<uint8_t>(80 + (any() & 31));
        read[3] = any();
      }
      return BusStatus::kOk;
    }
    if (address == 0x4B && (present & 4) != 0) {
      if (first_count == 1 && first[0] == 0x00) read[0] = 0x43;
      if (first_count == 1 && first[0] == 0x05) read[0] = 0x10;
      if (first_count == 3 && read_count > 0) read[0] = 1;
      if (first_count == 3 && first[0] == 0xC7 && read_count > 10) {
        const uint32_t row[2] = {now / 1000, 1000u * first[1]};
        memcpy(read + 1, row, sizeof row);
        read[9] = 0xB0;
        read[10] = 0xFF;
      }
      return BusStatus::kOk;
    }
    return BusStatus::kAddressNack;
  }

 private:
  // TX16 requests of the node.
  void hear(uint8_t byte) {
    if (byte == 0x7E) {
      sent_.clear();
      escape_ = false;
      return;
    }
    if (byte == 0x7D) {
      escape_ = true;
      return;
    }
    sent_.push_back(escape_ ? static_cast<uint8_t>(byte ^ 0x20) : byte);
    escape_ = false;
    if (sent_.size() < 4 || sent_.size() < 4U + sent_[1] - 1U) return;
    const size_t length = static_cast<size_t>(sent_[0]) << 8 | sent_[1];
    if (sent_.size() != length + 3) return;
    uint8_t sum = 0;
    for (size_t i = 2; i < sent_.size(); ++i) sum = static_cast<uint8_t>(sum + sent_[i]);
    if (sum != 0xFF || sent_[2] != 0x01) fail("the node sends the module something else");
    frame_id = sent_[3];
    received.push_back(Bytes(sent_.begin() + 7, sent_.end() - 1));
  }

 public:
  uint8_t frame_id = 0;

 private:
  Bytes sent_;
  bool escape_ = false;
  uint32_t sampled_us_ = 0;
};

// ---- a script ----

class Script {
 public:
  Script(const uint8_t* data, size_t size) : data_(data), left_(size) {
    const uint8_t id = u8();
    world_.eeprom[0] = id;
    world_.eeprom[1] = static_cast<uint8_t>(id ^ 0xFF);
    world_.chaos = id;
    const uint8_t moment = u8();  // near the clock's wrap, or anywhere
    world_.now = (moment & 1) != 0 ? 0u - 4096u * moment : static_cast<uint32_t>(moment) << 24;
    start(wire::ResetCause::kPowerOn);
  }
  ~Script() { node().~Node(); }

  void run() {
    while (left_ > 0) operation(u8());
    // Whatever came: the node goes on, and obeys its own host.
    world_.hostile = false;
    world_.writes_left = 0xFFFFFFFF;
    world_.busy_polls = 0;
    world_.space = 255;
    pass_ms(1500);
    const uint64_t obeyed = totals.obeyed;
    deliver(received_frame(sealed(wire::MessageType::kCommand, wire::kBroadcast,
                                  state().marks_.command + 1, Bytes{0x34, 0x12, 0, 0, 0, 0, 0})));
    if (totals.obeyed != obeyed + 1) fail("the node does not obey its host any more");
  }

 private:
  Node& node() { return *reinterpret_cast<Node*>(place_); }
  // The base is private: a C cast is what may do this.
  NodeState& state() { return (NodeState&)node(); }  // NOLINT

  uint8_t u8() {
    if (left_ == 0) return 0;
    --left_;
    return *data_++;
  }
  uint16_t u16() { return static_cast<uint16_t>(u8() | u8() << 8); }
  uint32_t u32() { return u16() | static_cast<uint32_t>(u16()) << 16; }

  void start(wire::ResetCause cause) {
    memset(place_, 0xA5, sizeof place_);  // nothing may depend on what was there
    new (place_) Node(world_);
    node().begin(world_.now, cause, 0);
    world_.restart_asked = false;
    poll();
  }
  void restart(wire::ResetCause cause) {
    ++totals.restarts;
    pending_.clear();
    node().~Node();
    start(cause);
  }

  void poll() {
    if (world_.without_power) return;
    world_.space_left = world_.space;
    node().poll(world_.now);
    if (world_.without_power) {
      world_.received.clear();
      world_.restart_asked = false;
    }
    for (const Bytes& frame : world_.received) {
      ++totals.sent;
      wire::Header header;
      if (wire::open(frame.data(), static_cast<uint8_t>(frame.size()), sending_key(frame), &header) !=
          wire::FrameStatus::kGood) {
        fail("the node sends a frame that its host cannot open");
      }
      if (have_sent_ && header.counter <= newest_sent_) fail("a counter of the node goes back");
      have_sent_ = true;
      newest_sent_ = header.counter;
      if (header.type == wire::MessageType::kAcknowledgement) note_answer(frame);
    }
    world_.received.clear();
  }
  void note_answer(const Bytes& frame) {
    const uint8_t* body = frame.data() + wire::kHeaderBytes;
    for (size_t i = 0; i < pending_.size(); ++i) {
      if (pending_[i].token != (body[0] | body[1] << 8) || pending_[i].command != body[2]) continue;
      if (answered_ == 0 || pending_[i].counter - answered_ - 1 < wire::kMostJump) {
        answered_ = pending_[i].counter;
      }
      pending_.erase(pending_.begin() + static_cast<long>(i));
      return;
    }
  }
  // A frame under way when the key was changed left under the old one.
  const uint8_t* sending_key(const Bytes& frame) {
    wire::Header header;
    const bool present = wire::open(frame.data(), static_cast<uint8_t>(frame.size()), state().keys_,
                                    &header) == wire::FrameStatus::kGood;
    return present ? state().keys_ : former_key_;
  }

  // Until nothing more happens at this moment.
  void settle() {
    for (uint16_t polls = 0; polls < 5000; ++polls) {
      const NodeState before = state();
      world_.active = false;
      poll();
      if (world_.restart_asked) restart(wire::ResetCause::kCommand);
      if (!world_.active && memcmp(&before, &state(), sizeof before) == 0) return;
    }
    fail("the node does not come to rest");
  }

  void pass_ms(uint32_t ms) {
    while (ms > 0) {
      const uint32_t step = ms < 5 ? ms : 5;
      ms -= step;
      world_.now += step * 1000;
      for (uint8_t polls = 0; polls < 4; ++polls) poll();
      if (world_.restart_asked) restart(wire::ResetCause::kCommand);
    }
  }

  const Genuine* find_genuine(const Bytes& frame, const uint8_t* key) const {
    for (const Genuine& each : genuine_) {
      if (each.frame == frame && memcmp(each.key, key, wire::kKeyBytes) == 0) return &each;
    }
    return nullptr;
  }

  // Bytes from the module: node, parser and codecs take them, up to the end of one payload after the
  // other. What none of the genuine frames is must change nothing in the node but its counts.
  void deliver(const Bytes& bytes, bool by_cable = false) {
    world_.cable = by_cable;
    Bytes part;
    for (const uint8_t byte : bytes) {
      part.push_back(byte);
      module_.take(byte);
      if (module_.payloads.empty()) continue;
      const Bytes payload = module_.payloads.back();
      module_.payloads.clear();
      check_parser(&parser_, part, &payload);
      settle();
      world_.line.swap(part);
      take_payload(payload);
      line_is_read();
      part.clear();
    }
    check_parser(&parser_, part, nullptr);
    settle();
    world_.line.swap(part);
    const NodeState before = state();
    poll();
    // Answered, the node may send the next.
    if (!module_.answered) compare(before, "bytes that are no frame change the node");
    module_.answered = false;
    line_is_read();
  }

  void line_is_read() {
    if (world_.line_read != world_.line.size()) fail("the node leaves bytes in its line");
    world_.line.clear();
    world_.line_read = 0;
  }

  void take_payload(const Bytes& payload) {
    wire::Header header;
    const Bytes exact(payload);
    const bool by_beacons_key =
        exact.size() > wire::kTypeAt &&
        exact[wire::kTypeAt] == static_cast<uint8_t>(wire::MessageType::kBeacon);
    const uint8_t* key = by_beacons_key ? state().keys_ + wire::kKeyBytes : state().keys_;
    const bool good = wire::open(exact.data(), static_cast<uint8_t>(exact.size()), key, &header) ==
                      wire::FrameStatus::kGood;
    const bool genuine = find_genuine(payload, key) != nullptr;
    if (good && !genuine) fail("a frame without a genuine tag is opened");
    if (!good && genuine && payload.size() <= wire::kFrameBytes) fail("a genuine frame is refused");
    totals.opened += good;
    if (payload.size() >= wire::kOverhead) {
      try_every_decode(Bytes(payload.begin() + wire::kHeaderBytes,
                             payload.end() - wire::kTagBytes - wire::kCrcBytes));
    }
    const NodeState before = state();
    const bool beacon = good && header.type == wire::MessageType::kBeacon;
    const bool command = good && (header.type == wire::MessageType::kCommand ||
                                  header.type == wire::MessageType::kNewKey);
    const uint32_t mark = beacon ? before.beacon_mark_ : before.marks_.command;
    const bool meant = good && (header.node == before.id_ || header.node == wire::kBroadcast);
    const bool follows = mark == 0 || header.counter - mark - 1 < wire::kMostJump;
    const bool obeyed = meant && (beacon || command) && follows;
    poll();
    if (!obeyed) {
      ++totals.refused;
      compare(before, "a refused frame changes the node");
      return;
    }
    ++totals.obeyed;
    if (command && answered_ != 0 && header.counter - answered_ - 1 >= wire::kMostJump) {
      fail("a command that was answered is taken again");
    }
    const uint8_t none[wire::kKeyBytes] = {};
    if (memcmp(before.keys_, state().keys_, sizeof before.keys_) != 0) {
      if (memcmp(before.keys_, none, sizeof none) == 0 && !world_.cable) {
        fail("a first key is taken from the radio");
      }
      memcpy(former_key_, before.keys_, sizeof former_key_);
    } else if (command && before.reboot_step_ == 0 &&
               payload.size() == wire::kOverhead + wire::kCommandBytes) {
      const uint8_t* body = payload.data() + wire::kHeaderBytes;
      pending_.push_back({header.counter, static_cast<uint16_t>(body[0] | body[1] << 8), body[2]});
    }
  }

  // Everything but what the parser holds of its line, and the counts of what was bad.
  void compare(const NodeState& before, const char* promise) {
    NodeState a = before, b = state();
    memcpy(&b.xbee_, &a.xbee_, sizeof a.xbee_);
    b.bad_frames_ = a.bad_frames_;
    b.lost_.refused_frames = a.lost_.refused_frames;
    b.refused_token_ = a.refused_token_;  // told with the newest counter
    b.refusal_due_ = a.refusal_due_;
    if (memcmp(&a, &b, sizeof a) == 0) return;
    const uint8_t* x = reinterpret_cast<const uint8_t*>(&a);
    const uint8_t* y = reinterpret_cast<const uint8_t*>(&b);
    for (size_t i = 0; i < sizeof a; ++i) {
      if (x[i] != y[i]) fprintf(stderr, "byte %zu of the state: %02x, now %02x\n", i, x[i], y[i]);
    }
    fail(promise);
  }

  // ---- frames ----

  Bytes sealed(wire::MessageType type, uint8_t node, uint32_t counter, const Bytes& body,
               const uint8_t* key = nullptr) {
    const bool beacon = type == wire::MessageType::kBeacon;
    if (key == nullptr) key = beacon ? state().keys_ + wire::kKeyBytes : state().keys_;
    Genuine made;
    memcpy(made.key, key, sizeof made.key);
    made.frame.assign(wire::kHeaderBytes, 0);
    made.frame.insert(made.frame.end(), body.begin(), body.end());
    made.frame.resize(made.frame.size() + wire::kCrcBytes + wire::kTagBytes);
    const wire::Header header = {type, node, 0, counter};
    wire::seal(header, static_cast<uint8_t>(body.size()), key, made.frame.data());
    remember(made);
    return made.frame;
  }
  void remember(const Genuine& made) {
    if (genuine_.size() < 64) {
      genuine_.push_back(made);
    } else {
      genuine_[next_genuine_++ % 64] = made;
    }
  }
  Bytes golden() {
    const uint8_t k = static_cast<uint8_t>(u8() % kGoldenFrames);
    Genuine made;
    memcpy(made.key, kGolden[k].key, sizeof made.key);
    made.frame.assign(kGolden[k].bytes, kGolden[k].bytes + kGolden[k].length);
    if (find_genuine(made.frame, made.key) == nullptr) remember(made);
    return made.frame;
  }
  Bytes fresh() {  // golden, or sealed just now
    if ((u8() & 1) != 0) return golden();
    return plausible_command(next_counter());
  }
  uint32_t next_counter() {
    const uint32_t mark = state().marks_.command;
    return mark + 1;
  }
  uint8_t addressee() {
    const uint8_t choice = u8();
    if (choice < 120) return state().id_;
    return choice < 200 ? wire::kBroadcast : u8();
  }
  Bytes body(size_t length) {
    Bytes made;
    for (size_t i = 0; i < length; ++i) made.push_back(u8());
    return made;
  }
  Bytes plausible_command(uint32_t counter) {
    Bytes made = body(2);
    made.push_back(static_cast<uint8_t>(u8() % 20));
    const uint8_t kind = u8();
    const uint32_t value = kind < 100 ? u8() : kind < 200 ? u16() : u32();
    for (uint8_t i = 0; i < 4; ++i) made.push_back(static_cast<uint8_t>(value >> (8 * i)));
    return sealed(wire::MessageType::kCommand, addressee(), counter, made);
  }
  Bytes plausible_beacon() {
    Bytes made = body(5);
    const uint8_t entries = static_cast<uint8_t>(u8() % 21);
    for (uint8_t i = 0; i < entries; ++i) made.push_back(u8());
    return sealed(wire::MessageType::kBeacon, wire::kBroadcast, state().beacon_mark_ + 1 + u8() / 16,
                  made);
  }

  void mutate(Bytes* frame) {
    const uint8_t changes = static_cast<uint8_t>(1 + u8() % 4);
    for (uint8_t k = 0; k < changes; ++k) {
      const uint8_t kind = u8();
      const size_t at = frame->empty() ? 0 : u8() % frame->size();
      switch (kind % 7) {
        case 0:
          if (!frame->empty()) (*frame)[at] ^= static_cast<uint8_t>(1 << (kind >> 5));
          break;
        case 1:
          if (!frame->empty()) (*frame)[at] = u8();
          break;
        case 2:
          frame->resize(at);
          break;
        case 3:
          frame->insert(frame->begin() + static_cast<long>(at), u8());
          break;
        case 4:
          if (!frame->empty()) frame->erase(frame->begin() + static_cast<long>(at));
          break;
        case 5: {  // the tail of another one
          const Bytes other = golden();
          if (at < other.size()) {
            frame->resize(at);
            frame->insert(frame->end(), other.begin() + static_cast<long>(at), other.end());
          }
          break;
        }
        default: {  // bytes change places
          if (frame->size() > 1) std::swap((*frame)[at], (*frame)[u8() % frame->size()]);
          break;
        }
      }
    }
    if (frame->size() > 100) frame->resize(100);
  }

  void frame_from_module(const Bytes& frame, bool by_cable = false) {
    ++totals.frames;
    deliver(received_frame(frame, by_cable), by_cable);
  }

  void operation(uint8_t code) {
    switch (code % 18) {
      case 0: {  // bytes of no order
        ++totals.frames;
        deliver(body(1 + u8() % 64));
        break;
      }
      case 1:
        ++totals.genuine;
        frame_from_module(golden());
        break;
      case 2:
      case 3:
      case 4: {  // damaged on its way
        Bytes frame = fresh();
        mutate(&frame);
        count_mutant(frame);
        frame_from_module(frame);
        break;
      }
      case 5: {  // the right beginning, then anything: what the CRC must keep out on its own
        world_.chaos ^= u32();
        Bytes frame = {wire::kMagic, wire::kProtocolVersion};
        const size_t length = wire::kOverhead + u8() % (wire::kMostBody + 1);
        while (frame.size() < length) frame.push_back(world_.any());
        ++totals.noise;
        totals.crc_of_noise += crc_fits(frame);
        frame_from_module(frame);
        break;
      }
      case 6:
      case 7: {  // somebody without the key makes the CRC right
        Bytes frame = fresh();
        mutate(&frame);
        redo_crc(&frame);
        totals.forged += find_genuine(frame, state().keys_) == nullptr;
        frame_from_module(frame);
        break;
      }
      case 8: {  // the host, with anything in it
        const size_t length = u8() % (wire::kMostBody + 1);
        const wire::MessageType type = static_cast<wire::MessageType>(u8());
        ++totals.genuine;
        frame_from_module(sealed(type, addressee(), next_counter() + u8() / 32, body(length)));
        break;
      }
      case 9:
      case 10:
        ++totals.genuine;
        frame_from_module(plausible_command(next_counter() + u8() / 32));
        break;
      case 11:
        ++totals.genuine;
        frame_from_module(plausible_beacon());
        break;
      case 12: {  // a new key, or another team's frame
        uint8_t key[wire::kKeyBytes];
        for (uint8_t& byte : key) byte = u8();
        if ((key[0] & 1) != 0) {
          ++totals.genuine;
          frame_from_module(
              sealed(wire::MessageType::kNewKey, addressee(), next_counter(), body(34)),
              (key[0] & 2) != 0);
        } else {
          ++totals.forged;
          frame_from_module(sealed(wire::MessageType::kCommand, addressee(), next_counter(), body(7), key));
        }
        break;
      }
      case 13:  // sent again
        if (!genuine_.empty()) {
          ++totals.genuine;
          frame_from_module(Bytes(genuine_[u8() % genuine_.size()].frame));
        }
        break;
      case 14: {  // the module's own frames, of any type; or broken ones
        Bytes data = body(1 + u8() % 24);
        const uint8_t kind = u8();
        if (kind < 128) {
          data = Bytes{0x89, world_.frame_id, static_cast<uint8_t>(kind & 1)};
        }
        Bytes bytes = api_frame(data.data(), data.size());
        if (kind % 4 == 0) bytes[u8() % bytes.size()] = u8();
        ++totals.frames;
        deliver(bytes);
        break;
      }
      case 15:
        pass_ms(u16() % 700);
        break;
      case 16: {  // chips and line
        const uint8_t kind = u8();
        world_.present = kind & 7;
        world_.hostile = (kind & 0x38) == 0x38;
        world_.space = static_cast<uint8_t>(kind < 64 ? 1 + kind : 255);
        world_.busy_polls = kind >> 6;
        break;
      }
      default: {  // the power fails, at once or so many EEPROM bytes later
        const uint8_t kind = u8();
        if (kind >= 128) {
          world_.writes_left = kind & 31;
          settle();
        }
        world_.writes_left = 0xFFFFFFFF;
        world_.without_power = false;
        restart(static_cast<wire::ResetCause>(kind % 6));
        break;
      }
    }
  }

  void count_mutant(const Bytes& frame) {
    if (find_genuine(frame, state().keys_) != nullptr) {
      ++totals.genuine;  // changed to and fro, or into another genuine one
      return;
    }
    for (const Genuine& each : genuine_) {  // of another key, or with another tag: the CRC is right
      const size_t tagged = each.frame.size() - wire::kTagBytes;
      if (each.frame.size() == frame.size() && memcmp(each.frame.data(), frame.data(), tagged) == 0) {
        ++totals.forged;
        return;
      }
    }
    ++totals.mutants;
    totals.crc_of_mutants += crc_fits(frame);
  }

  const uint8_t* data_;
  size_t left_;
  World world_;
  ReferenceModule module_;
  Xbee parser_ = Xbee();
  std::vector<Genuine> genuine_;
  size_t next_genuine_ = 0;
  std::vector<Asked> pending_;
  uint32_t newest_sent_ = 0, answered_ = 0;
  bool have_sent_ = false;
  uint8_t former_key_[wire::kKeyBytes] = {};  // the node's own
  alignas(16) uint8_t place_[sizeof(Node)];
};

uint64_t frames_asked;

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  if (started_ms == 0) {
    started_ms = milliseconds();
    const char* asked = getenv("RELPOS_FUZZ_FRAMES");
    if (frames_asked == 0 && asked != nullptr) frames_asked = strtoull(asked, nullptr, 10);
  }
  {
    Script script(data, size);
    script.run();
  }
  if (frames_asked != 0 && totals.frames >= frames_asked) {
    print_totals();
    _Exit(0);
  }
  return 0;
}

#if defined(RELPOS_RANDOM)
int main(int count, char** arguments) {
  if (count != 3) {
    fprintf(stderr, "usage: %s FRAMES SEED\n", arguments[0]);
    return 2;
  }
  frames_asked = strtoull(arguments[1], nullptr, 10);
  uint64_t seed = strtoull(arguments[2], nullptr, 10);
  uint8_t script[600];
  for (;;) {
    for (uint8_t& byte : script) {  // splitmix64 (Steele, Lea, Flood 2014)
      uint64_t z = seed += 0x9E3779B97F4A7C15ULL;
      z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9ULL;
      z = (z ^ z >> 27) * 0x94D049BB133111EBULL;
      byte = static_cast<uint8_t>(z >> 40);
    }
    script[0] = static_cast<uint8_t>(1 + script[0] % 254);
    LLVMFuzzerTestOneInput(script, sizeof script);
  }
}
#endif
