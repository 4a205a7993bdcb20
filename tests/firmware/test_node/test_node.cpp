// The whole node against chips of the simplest kind: what it sends, when, and what no fault changes.
#include "support/check.h"
#include "support/fake_board.h"

#include <math.h>

#include <initializer_list>

#include "node/calibration.h"
#include "node/node.h"
#include "wire/frame.h"
#include "wire/messages.h"

using relpos::BusStatus;
using relpos::Node;
namespace wire = relpos::wire;

namespace {

constexpr uint8_t kId = 3;
constexpr uint16_t kMostFrames = 400;

struct Sent {
  uint32_t time_us;
  wire::Header header;
  uint8_t body[wire::kFrameBytes];
  uint8_t length;
};

// Sensors that always have news, a module that answers every request, an EEPROM.
struct World : FakeBoard {
  uint32_t now = 0;
  uint32_t start = 0;  // the chips' clocks do not wrap with the node's
  uint8_t eeprom[relpos::kStorageBytes];
  uint16_t writes[relpos::kStorageBytes] = {};
  bool inertial_present = true;
  bool samples = true;  // comes with news
  bool walking = false;
  bool tag_present = true;
  bool magnetometer_present = false;
  uint32_t writes_left = 0xFFFFFFFF;  // then the power is cut
  bool module_present = true;
  uint8_t delivery = 0;  // of the transmit status
  uint8_t line_bytes = 255;  // a poll
  uint32_t restarts = 0;
  uint32_t marks = 0;
  uint16_t pressures = 0;  // that were read
  uint8_t written = 0;     // most bytes in a transaction's first part
  uint16_t supply = 5000;
  uint16_t flashes = 0;
  uint32_t lit_us = 0;

  Sent frames[kMostFrames];
  uint16_t count = 0;
  uint16_t damaged = 0;

  World() {
    for (uint8_t& byte : eeprom) byte = 0xFF;
    eeprom[0] = kId;
    eeprom[1] = kId ^ 0xFF;
  }

  uint16_t supply_mv() override { return supply; }
  void led(bool on) override {
    if (on) {
      ++flashes;
      lit_since_us_ = now;
    } else {
      lit_us += now - lit_since_us_;
    }
  }

  // -- the UART, with the module behind it --
  uint8_t uart_write_space() override { return space_; }
  void uart_write(uint8_t byte) override {
    --space_;
    if (byte == 0x7E) {
      got_ = 0;
      in_frame_ = true;
      return;
    }
    if (!in_frame_) return;
    if (byte == 0x7D) {
      escape_ = true;
      return;
    }
    packet_[got_++] = escape_ ? byte ^ 0x20 : byte;
    escape_ = false;
    if (got_ < 3 || got_ < 3 + packet_[1]) return;
    in_frame_ = false;
    take_packet();
  }
  int16_t uart_read() override {
    return taken_ < given_ ? static_cast<int16_t>(queue_[taken_++]) : -1;
  }
  void begin_poll() {
    space_ = line_bytes;
    if (taken_ == given_) taken_ = given_ = 0;
  }
  void give(const uint8_t* data, uint8_t length) {  // a whole API frame's data
    uint8_t sum = 0xFF;
    queue_[given_++] = 0x7E;
    escaped(0);
    escaped(length);
    for (uint8_t i = 0; i < length; ++i) {
      escaped(data[i]);
      sum = static_cast<uint8_t>(sum - data[i]);
    }
    escaped(sum);
  }
  void command(uint16_t token, uint8_t code, int32_t value, uint8_t node = kId) {
    uint8_t body[wire::kCommandBytes];
    const wire::Command request = {token, 0, value};
    wire::encode(request, body);
    body[2] = code;
    down(wire::MessageType::kCommand, body, sizeof body, node, ++host_counter);
  }
  // A frame of the host's.
  void down(wire::MessageType type, const uint8_t* body, uint8_t length, uint8_t node,
            uint32_t counter) {
    uint8_t data[80] = {0x81, 0, 0, 0x28, by_cable ? wire::kCableOptions : uint8_t{0}};
    uint8_t* frame = data + 5;
    memcpy(frame + wire::kHeaderBytes, body, length);
    const wire::Header header = {type, node == kId ? to : node, 0, counter};
    length = wire::seal(header, length, key, frame);
    give(data, static_cast<uint8_t>(5 + length));
  }
  uint8_t key[wire::kKeyBytes] = {};   // the host's, and what the node's frames are opened with
  bool by_cable = false;
  uint32_t host_counter = 1000;
  uint32_t exchange_us = 0;            // of UWB
  uint32_t bus_us = 0;                 // of a transaction
  uint32_t exchange_at_us[64] = {};    // since exchanges was cleared
  uint8_t exchanges = 0;
  uint32_t pressure_mpa = 101325000;
  int16_t force = 8192;     // along x, of the sensor's counts
  int16_t rate = 0;         // about z
  uint8_t field = 100;      // the die's x, the accelerometer's y: 30 uT
  bool field_fails = false;
  int8_t signal_dbm = -80;
  uint8_t to = kId;  // the node that is meant

  uint32_t storage_us = 0;  // a byte takes
  uint32_t stored_at = 0;
  uint16_t waited = 0;      // reads and writes that waited for the end of another write
  relpos::UartErrors errors = {0, 0};

  relpos::UartErrors uart_errors() override { return errors; }
  bool storage_ready() override { return now - stored_at >= storage_us; }
  uint8_t storage_read(uint16_t at) override {
    if (!storage_ready()) ++waited;
    return eeprom[at];
  }
  void storage_write(uint16_t at, uint8_t value) override {
    if (!storage_ready()) ++waited;
    stored_at = now;
    if (writes_left == 0) return;
    --writes_left;
    if (eeprom[at] != value) ++writes[at];
    eeprom[at] = value;
  }
  uint32_t now_us() override { return now; }
  void reset() override { ++restarts; }
  void mark(uint8_t value) override { marks += value; }

 protected:
  BusStatus i2c_transfer(uint8_t address, const uint8_t* first, uint8_t first_count,
                         const uint8_t* second, uint8_t second_count, uint8_t* read,
                         uint8_t read_count) override {
    now += bus_us;
    if (first_count > written) written = first_count;
    for (uint8_t i = 0; i < read_count; ++i) read[i] = 0;
    if (address == 0x68 && inertial_present) {
      if (first_count == 1 && first[0] == 0x75) read[0] = 0x68;
      if (first_count == 1 && first[0] == 0x3A && samples && now - start - sampled_us_ >= 20000) {
        sampled_us_ = now - start;
        read[0] = 1;
      }
      if (first_count == 1 && first[0] == 0x37) {  // set up, then the sample
        read[0] = 0x22;
        read[1] = 0x01;
        const int16_t up = static_cast<int16_t>(
            force + (walking ? 2500.0 * sin(12.0 * 1e-6 * (now - start)) : 0.0));
        read[4] = static_cast<uint8_t>(up >> 8);  // 1 g along x
        read[5] = static_cast<uint8_t>(up);
        read[7] = ++noise_ & 1;  // along y: no sample is quite the one before
        read[16] = static_cast<uint8_t>(rate >> 8);
        read[17] = static_cast<uint8_t>(rate);
      }
      return BusStatus::kOk;
    }
    if (address == 0x0C && magnetometer_present && !field_fails) {
      if (read_count == 1) read[0] = 0x48;
      if (read_count == 3) read[0] = read[1] = read[2] = 128;
      if (read_count == 8) {
        read[0] = 1;
        read[1] = field;
        read[3] = ++field_noise_ & 1;  // no reading is quite the one before
      }
      return BusStatus::kOk;
    }
    if (address == 0x4B && tag_present) {
      if (first_count == 1 && first[0] == 0x00) read[0] = 0x43;
      if (first_count == 1 && first[0] == 0x05 && now - exchanged_us_ >= exchange_us) read[0] = 0x10;
      if (first_count == 1 && first[0] == 0x1A && read_count == 2) read[0] = tag_id_;
      if (first_count == 1 && first[0] == 0x1A && second_count == 2) tag_id_ = second[0];
      if (first_count == 1 && first[0] == 0x50) {
        memcpy(read, &pressure_mpa, sizeof pressure_mpa);
        ++pressures;
      }
      if (first_count == 3 && first[2] != 0) return BusStatus::kDataNack;  // no peer beyond 255
      if (first_count == 3) read[0] = 1;
      if (first_count == 3 && first[0] == 0xB5) {
        exchanged_us_ = now;
        if (exchanges < 64) exchange_at_us[exchanges++] = now;
      }
      if (first_count == 3 && first[0] == 0xC7) {
        const uint32_t row[2] = {(now - start) / 1000, 1000u * first[1]};
        memcpy(read + 1, row, sizeof row);
        read[9] = static_cast<uint8_t>(signal_dbm);
        read[10] = 0xFF;
      }
      return BusStatus::kOk;
    }
    return BusStatus::kAddressNack;
  }

 private:
  void escaped(uint8_t byte) {
    if (byte == 0x7E || byte == 0x7D || byte == 0x11 || byte == 0x13) {
      queue_[given_++] = 0x7D;
      byte ^= 0x20;
    }
    queue_[given_++] = byte;
  }
  void take_packet() {
    const uint8_t length = static_cast<uint8_t>(packet_[1] - 5);
    if (count == kMostFrames) return;
    Sent& sent = frames[count];
    sent.time_us = now;
    if (wire::open(packet_ + 7, length, key, &sent.header) != wire::FrameStatus::kGood) {
      ++damaged;
      return;
    }
    sent.length = static_cast<uint8_t>(length - wire::kOverhead);
    memcpy(sent.body, packet_ + 7 + wire::kHeaderBytes, sent.length);
    ++count;
    const uint8_t answer[3] = {0x89, packet_[3], delivery};
    if (module_present) give(answer, 3);
  }

  uint32_t lit_since_us_ = 0;
  uint32_t sampled_us_ = 0;
  uint32_t exchanged_us_ = 0;
  uint8_t tag_id_ = 0;
  uint8_t noise_ = 0, field_noise_ = 0;
  uint8_t packet_[128];
  uint8_t queue_[2048];
  uint16_t given_ = 0, taken_ = 0;
  uint8_t got_ = 0;
  uint8_t space_ = 0;
  bool in_frame_ = false, escape_ = false;
};

struct Team {
  World world;
  Node node;
  explicit Team(uint32_t start_us = 0, wire::ResetCause cause = wire::ResetCause::kPowerOn)
      : node(world) {
    world.now = world.start = start_us;
    node.begin(start_us, cause, 0);
  }
  void run_ms(uint32_t ms) { run(node, ms); }
  void run(Node& which, uint32_t ms) {
    for (const uint32_t start_us = world.now; world.now - start_us < ms * 1000;) {
      world.begin_poll();
      const uint32_t wait_us = which.poll(world.now);
      world.now += wait_us < 100 ? 100 : wait_us;
    }
  }
  uint16_t sent(wire::MessageType type) const {
    uint16_t found = 0;
    for (uint16_t i = 0; i < world.count; ++i) found += world.frames[i].header.type == type;
    return found;
  }
  const Sent* last(wire::MessageType type) const {
    for (uint16_t i = world.count; i > 0; --i) {
      if (world.frames[i - 1].header.type == type) return &world.frames[i - 1];
    }
    return nullptr;
  }
  template <typename Message>
  bool read(wire::MessageType type, Message* message) const {
    const Sent* found = last(type);
    return found != nullptr && wire::decode(found->body, found->length, message);
  }
  wire::Acknowledgement answer() const {
    wire::Acknowledgement message = {};
    read(wire::MessageType::kAcknowledgement, &message);
    return message;
  }
};

int32_t staged(uint8_t index, int16_t word) {
  return static_cast<int32_t>(static_cast<uint32_t>(index) << 16 | static_cast<uint16_t>(word));
}

constexpr uint8_t code(wire::CommandCode command) { return static_cast<uint8_t>(command); }
constexpr uint8_t result(wire::CommandResult value) { return static_cast<uint8_t>(value); }

// One command, and its answer: asked again with a new token while the node is busy. No answer is no
// result.
wire::Acknowledgement ask(Team& team, Node& node, wire::CommandCode command, int32_t value) {
  static uint16_t token = 1000;
  wire::Acknowledgement answer = {};
  do {
    team.world.command(++token, code(command), value);
    for (uint8_t tries = 0; tries < 40 && team.answer().token != token; ++tries) {
      team.run(node, 20);
    }
    answer = team.answer();
  } while (answer.token == token && answer.result == result(wire::CommandResult::kBusy));
  if (answer.token != token) answer.result = 0xFF;
  return answer;
}

struct Words {
  int16_t word[wire::kCalibrationWords];
  uint16_t crc() const {
    return wire::crc16(reinterpret_cast<const uint8_t*>(word), sizeof word);
  }
};

Words example(int16_t seed) {
  Words words;
  for (uint8_t i = 0; i < wire::kCalibrationWords; ++i) {
    words.word[i] = static_cast<int16_t>(seed * (i + 1) - 700);
  }
  words.word[wire::kGyroBiasSigma] = 29;
  return words;
}

void stage(Team& team, Node& node, const Words& words) {
  for (uint8_t i = 0; i < wire::kCalibrationWords; ++i) {
    ask(team, node, wire::CommandCode::kSetCalibration, staged(i, words.word[i]));
  }
}

bool in_force(Team& team, Node& node, const Words& words) {
  for (uint8_t i = 0; i < wire::kCalibrationWords; ++i) {
    const wire::Acknowledgement answer =
        ask(team, node, wire::CommandCode::kReadCalibration, staged(i, 0));
    if (answer.result != result(wire::CommandResult::kDone)) return false;
    if (answer.value != words.word[i]) return false;
  }
  return true;
}

wire::Beacon beacon_of(uint8_t count, uint8_t first_id = 1) {
  wire::Beacon beacon = {};
  beacon.period_ms = 2000;
  beacon.count = count;
  for (uint8_t i = 0; i < count; ++i) beacon.entries[i].node = static_cast<uint8_t>(first_id + i);
  return beacon;
}

void send_beacon(Team& team, uint8_t count, uint8_t first_id = kId, uint16_t phase_ms = 0,
                 uint8_t round = 0, uint16_t period_ms = 2000) {
  wire::Beacon beacon = beacon_of(count, first_id);
  beacon.phase_ms = phase_ms;
  beacon.period_ms = period_ms;
  beacon.round = round;
  uint8_t body[wire::kBeaconBytes];
  const uint8_t length = wire::encode(beacon, body);
  team.world.down(wire::MessageType::kBeacon, body, length, wire::kBroadcast,
                  ++team.world.host_counter);
}

// Nodes in the beacon that is in force, as the next status says.
uint8_t beacon_team(Team& team) {
  team.run_ms(1200);
  wire::Status status = {};
  return team.read(wire::MessageType::kStatus, &status) ? status.team : 0xFF;
}

}  // namespace

TEST(motion_every_second_a_round_every_two_status_every_ten) {
  Team team;
  team.run_ms(30500);
  CHECK(team.sent(wire::MessageType::kMotion) >= 29);
  CHECK(team.sent(wire::MessageType::kMotion) <= 31);
  CHECK(team.sent(wire::MessageType::kRanges) >= 13);
  CHECK(team.sent(wire::MessageType::kRanges) <= 16);
  CHECK_EQUAL(4, team.sent(wire::MessageType::kStatus));  // the first one after half a second
  CHECK_EQUAL(wire::MessageType::kMotion, team.world.frames[0].header.type);
  CHECK_EQUAL(wire::MessageType::kStatus, team.world.frames[1].header.type);
  CHECK_EQUAL(0, team.sent(wire::MessageType::kSteps));
  CHECK(team.world.pressures >= 200 && team.world.pressures <= 270);  // ten a second less looks
  CHECK_EQUAL(0, team.world.damaged);
  CHECK(team.world.marks > 1400);  // the tick is marked
}

TEST(a_round_holds_every_other_node_and_not_the_node_itself) {
  Team team;
  team.world.magnetometer_present = true;  // whose raw readings stand where ranges do
  team.world.exchange_us = 20000;
  team.run_ms(30000);
  wire::Ranges ranges;
  for (uint16_t i = 0; i < team.world.count; ++i) {
    const Sent& sent = team.world.frames[i];
    if (sent.header.type != wire::MessageType::kRanges) continue;
    CHECK(wire::decode(sent.body, sent.length, &ranges));
    for (uint8_t k = 0; k < ranges.count; ++k) {
      CHECK_EQUAL(1000u * ranges.entries[k].peer, ranges.entries[k].range_mm);
    }
  }
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(0, status.dropped_ranges);
  CHECK_EQUAL(5, ranges.count);
  const uint8_t peers[5] = {4, 5, 6, 1, 2};  // from this node on
  for (uint8_t i = 0; i < 5; ++i) {
    CHECK_EQUAL(peers[i], ranges.entries[i].peer);
    CHECK_EQUAL(1000u * peers[i], ranges.entries[i].range_mm);
    CHECK_EQUAL(-80, ranges.entries[i].rss_dbm);
  }
}

TEST(of_more_than_seven_each_ranges_the_half_that_comes_after_it) {
  Team team;
  team.world.command(1, code(wire::CommandCode::kSetTeamSize), 13);
  team.run_ms(2000);
  const uint16_t before = team.sent(wire::MessageType::kRanges);
  team.run_ms(20000);
  const uint16_t frames = static_cast<uint16_t>(team.sent(wire::MessageType::kRanges) - before);
  CHECK(frames >= 18);  // ten rounds of 6: 5, 1
  CHECK(frames <= 22);
}

// ---- slots ----

struct Slots {
  static void hear(Team& team, uint16_t phase_ms, uint8_t round, uint8_t count,
                   uint8_t first_id = 1, uint16_t period_ms = 2000) {
    send_beacon(team, count, first_id, phase_ms, round, period_ms);
  }
};

TEST(with_a_beacon_every_exchange_lies_in_the_node_s_own_window) {
  for (uint8_t count : {4, 7, 12, 20}) {
    Team team;
    team.world.exchange_us = 20000;
    team.run_ms(3000);
    const uint32_t start_us = team.world.now;
    uint16_t exchanges = 0;
    for (uint8_t second = 0; second < 24; ++second) {
      const uint32_t phase_ms = (team.world.now - start_us) / 1000 % 2000;
      Slots::hear(team, static_cast<uint16_t>(phase_ms), static_cast<uint8_t>(second / 2), count);
      team.world.exchanges = 0;
      const uint32_t from_us = team.world.now;
      team.run_ms(1000);
      if (second < 2) continue;  // begun before the first beacon
      const uint32_t window_ms = 2000 / count;
      for (uint16_t i = 0; i < team.world.exchanges; ++i) {
        CHECK(team.world.exchange_at_us[i] >= from_us);
        const uint32_t at_ms = (team.world.exchange_at_us[i] - start_us) / 1000 % 2000;
        CHECK(at_ms + 1 >= (kId - 1) * window_ms);  // its place is id - 1
        CHECK(at_ms + relpos::kExchangeMs <= kId * window_ms);
        ++exchanges;
      }
    }
    // Eleven rounds: all others up to seven; else half of them, or what 100 ms take.
    const uint16_t a_round = count <= 7 ? count - 1 : count == 12 ? 6 : 4;
    CHECK(exchanges >= 10 * a_round && exchanges <= 12 * a_round);
  }
}

TEST(twenty_nodes_get_every_pair_within_ten_seconds) {
  uint32_t last_ms[21][21] = {};
  uint32_t longest_ms = 0;
  for (uint8_t id = 1; id <= 20; ++id) {
    relpos::RangingPlan plan = relpos::RangingPlan();
    plan.begin(0, id);
    uint32_t busy_until_ms = 0;
    for (uint32_t now_ms = 0; now_ms < 60000; ++now_ms) {
      if (now_ms % 1000 == 0) {
        wire::Beacon beacon = beacon_of(20);
        beacon.phase_ms = static_cast<uint16_t>(now_ms % 2000);
        beacon.round = static_cast<uint8_t>(now_ms / 2000);
        plan.beacon(static_cast<uint16_t>(now_ms), beacon, id);
      }
      if (now_ms < busy_until_ms) continue;
      uint16_t wait_ms = 0;
      const uint8_t peer = plan.next(static_cast<uint16_t>(now_ms), id, 6, 2000, &wait_ms);
      if (peer == 0) continue;
      CHECK(peer != id && peer <= 20);
      plan.done(true);
      busy_until_ms = now_ms + 23;
      const uint32_t gap_ms = now_ms - last_ms[id][peer];
      if (gap_ms > longest_ms) longest_ms = gap_ms;
      last_ms[id][peer] = now_ms;
    }
  }
  CHECK(longest_ms <= 10000);
  for (uint8_t a = 1; a <= 20; ++a) {
    for (uint8_t b = 1; b < a; ++b) {
      const uint32_t last = last_ms[a][b] > last_ms[b][a] ? last_ms[a][b] : last_ms[b][a];
      CHECK(last > 50000);
    }
  }
}

TEST(a_node_retries_only_peers_it_ranged_recently_in_its_window) {
  wire::Beacon beacon = beacon_of(6);
  relpos::RangingPlan plan = relpos::RangingPlan();
  plan.begin(0, 1);
  uint16_t others = 0, in_a_row = 0, most_in_a_row = 0, most_later = 0, retried = 0;
  uint16_t busy_until_ms = 0;
  uint8_t previous = 0;
  for (uint16_t now_ms = 0; now_ms < 60000; ++now_ms) {
    if (now_ms % 1000 == 0) {
      beacon.phase_ms = now_ms % 2000;
      beacon.round = static_cast<uint8_t>(now_ms / 2000);
      plan.beacon(now_ms, beacon, 1);
    }
    if (now_ms < busy_until_ms) continue;
    uint16_t wait_ms = 0;
    const uint8_t peer = plan.next(now_ms, 1, 6, 2000, &wait_ms);
    if (peer == 0) continue;
    in_a_row = peer == previous ? in_a_row + 1 : 1;
    previous = peer;
    const bool gone = peer == 3 || (peer == 4 && now_ms >= 20000);  // 3 was never there
    if (peer == 3) CHECK_EQUAL(1, in_a_row);
    if (peer == 4 && in_a_row > most_in_a_row) most_in_a_row = in_a_row;
    retried = static_cast<uint16_t>(retried + (peer == 4 && in_a_row > relpos::kRetries));
    if (peer == 4 && now_ms >= 37000 && in_a_row > most_later) most_later = in_a_row;
    others = static_cast<uint16_t>(others + (peer == 2 || peer > 4));
    plan.done(!gone);
    busy_until_ms = static_cast<uint16_t>(now_ms + 23);
  }
  CHECK_EQUAL(1 + relpos::kRetries, most_in_a_row);
  CHECK(retried >= 4);         // in each round of the next 8 s
  CHECK_EQUAL(1, most_later);  // not ranged for 16 s
  CHECK(others >= 3 * 29);     // thirty rounds, the gone one takes nothing from the others
}

TEST(without_a_beacon_nobody_is_asked_twice_in_a_row_and_no_seed_makes_rounds_alike) {
  for (const uint16_t seed : {0, 1234}) {
    relpos::RangingPlan plan = relpos::RangingPlan();
    plan.begin(0, seed);
    uint16_t busy_until_ms = 0, first_ms = 0, begins = 0;
    uint8_t previous = 0;
    for (uint16_t now_ms = 0; now_ms < 20000; ++now_ms) {
      if (now_ms < busy_until_ms) continue;
      uint16_t wait_ms = 0;
      const uint8_t peer = plan.next(now_ms, 1, 6, 2000, &wait_ms);
      if (peer == 0) continue;
      CHECK(peer != previous);
      if (peer == 2) {
        begins = static_cast<uint16_t>(begins + (now_ms % 2000 != first_ms));
        first_ms = now_ms % 2000;
      }
      previous = peer;
      plan.done(peer != 3 || now_ms < 3000);  // 3 was there
      busy_until_ms = static_cast<uint16_t>(now_ms + 23);
    }
    CHECK(begins >= 8);
  }
}

TEST(an_exchange_that_fails_after_the_next_beacon_costs_no_round) {
  wire::Beacon beacon = beacon_of(20);
  relpos::RangingPlan plan = relpos::RangingPlan();
  plan.begin(0, 1);
  uint8_t exchanges[12] = {};
  uint16_t busy_until_ms = 0;
  bool busy = false, fails = false;
  for (uint16_t now_ms = 0; now_ms < 24000; ++now_ms) {
    const uint8_t round = static_cast<uint8_t>(now_ms / 2000);
    if (now_ms % 1000 == 0) {
      beacon.phase_ms = now_ms % 2000;
      beacon.round = round;
      plan.beacon(now_ms, beacon, 20);
    }
    if (now_ms < busy_until_ms) continue;
    if (busy) plan.done(!fails);
    uint16_t wait_ms = 0;
    busy = plan.next(now_ms, 20, 6, 2000, &wait_ms) != 0;
    if (!busy) continue;
    ++exchanges[round];
    fails = round == 9 && now_ms % 2000 > 1955;  // it is still waited for when round 10 is told
    busy_until_ms = static_cast<uint16_t>(now_ms + (fails ? 100 : 22));
  }
  CHECK_EQUAL(exchanges[8], exchanges[10]);
}

TEST(the_led_distinguishes_the_states) {
  enum State { kWell, kNoBeacon, kSupplyLow, kNoImu, kNoMagnetometer, kNoPozyx };
  // Flashes in 4.096 s, and the share of the time that it is lit, in per cent.
  const uint8_t flashes[] = {4, 8, 4, 16, 16, 16}, lit[] = {6, 12, 75, 50, 50, 50};
  for (uint8_t state = kWell; state <= kNoPozyx; ++state) {
    Team team;
    team.world.magnetometer_present = state != kNoMagnetometer;
    team.world.inertial_present = state != kNoImu;
    team.world.tag_present = state != kNoPozyx;
    team.world.supply = state >= kSupplyLow ? 4499 : state == kWell ? 4500 : 0;  // 0: not measured
    uint16_t before = 0;
    uint32_t lit_before_us = 0;
    for (uint8_t part = 0; part < 12; ++part) {
      if (state == kWell) Slots::hear(team, 0, part, 4);
      if (part == 8) {
        before = team.world.flashes;
        lit_before_us = team.world.lit_us;
      }
      team.run_ms(1024);
    }
    const int16_t more = static_cast<int16_t>(team.world.flashes - before - flashes[state]);
    CHECK(more >= -1 && more <= 1);
    // Without samples the loop sleeps for up to 100 ms.
    CHECK_NEAR(lit[state], (team.world.lit_us - lit_before_us) / 40960.0f,
               state == kNoImu ? 15 : 3);
  }
}

TEST(without_a_beacon_a_silent_node_is_asked_again_within_ten_seconds_and_not_all_the_time) {
  for (uint8_t team_size = 3; team_size <= 20; ++team_size) {
    for (uint8_t silent_share = 2; silent_share <= 4; ++silent_share) {  // one in so many
      relpos::RangingPlan plan = relpos::RangingPlan();
      plan.begin(0, 1234);
      uint32_t asked_ms[21] = {};
      uint8_t asked[21] = {};
      uint32_t longest_ms = 0, busy_until_ms = 0;
      for (uint32_t now_ms = 0; now_ms < 120000; ++now_ms) {
        if (now_ms < busy_until_ms) continue;
        uint16_t wait_ms = 0;
        const uint8_t peer = plan.next(static_cast<uint16_t>(now_ms), 2, team_size, 2000, &wait_ms);
        if (peer == 0) continue;
        const bool silent = peer % silent_share == 0;
        plan.done(!silent);
        busy_until_ms = now_ms + (silent ? 33 : 23);
        ++asked[peer];
        if (silent) CHECK(asked[peer] <= 31);  // of 60 rounds
        const uint32_t gap_ms = now_ms - asked_ms[peer];
        if (asked_ms[peer] != 0 && gap_ms > longest_ms) longest_ms = gap_ms;
        asked_ms[peer] = now_ms;
      }
      CHECK(longest_ms <= 10000);
      uint8_t late = 0;
      for (uint8_t peer = 1; peer <= team_size; ++peer) {
        late = static_cast<uint8_t>(late + (asked_ms[peer] < 110000));
      }
      // This node, and of more than seven the half of the ring that asks it.
      CHECK_EQUAL(team_size <= 7 ? 1 : team_size - team_size / 2, late);
    }
  }
}

TEST(after_five_seconds_without_a_beacon_a_node_ranges_on_by_itself) {
  Team team;
  team.run_ms(1000);
  Slots::hear(team, 0, 9, 2, kId);  // only 3 and 4
  team.run_ms(4500);
  wire::Status status;
  for (uint8_t second = 0; second < 12; ++second) {
    Slots::hear(team, 0, 9, 2, kId);
    team.run_ms(1000);
  }
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(2, status.team);
  CHECK(status.health & static_cast<uint8_t>(wire::Health::kBeacon));
  wire::Ranges ranges;
  CHECK(team.read(wire::MessageType::kRanges, &ranges));
  CHECK_EQUAL(1, ranges.count);
  CHECK_EQUAL(4, ranges.entries[0].peer);
  team.run_ms(20000);
  CHECK(team.read(wire::MessageType::kRanges, &ranges));
  CHECK_EQUAL(5, ranges.count);
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(0, status.team);
  CHECK_EQUAL(5, status.neighbours);
}

TEST(a_node_that_is_not_in_the_beacon_ranges_by_itself) {
  Team team;
  for (uint8_t second = 0; second < 15; ++second) {
    Slots::hear(team, 0, 9, 2, kId + 1);
    team.run_ms(1000);
  }
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(0, status.team);
  CHECK_EQUAL(5, status.neighbours);
}

TEST(a_node_whose_number_is_beyond_the_team_ranges_all_of_it) {
  Team team;
  Node ninth(team.world);
  ninth.begin(0, wire::ResetCause::kPowerOn, 9);
  team.run(ninth, 24000);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(6, status.neighbours);
}

TEST(a_beacon_within_a_window_begins_no_second_round) {
  wire::Beacon beacon = beacon_of(4);
  relpos::RangingPlan plan = relpos::RangingPlan();
  plan.begin(0, 1);
  uint16_t exchanges = 0;
  for (uint16_t now_ms = 0; now_ms < 20000; ++now_ms) {
    if (now_ms % 1000 == 200) {
      beacon.phase_ms = now_ms % 2000;
      beacon.round = static_cast<uint8_t>(now_ms / 2000);
      plan.beacon(now_ms, beacon, 1);
    }
    uint16_t wait_ms = 0;
    if (now_ms % 25 != 0 || plan.next(now_ms, 1, 6, 2000, &wait_ms) == 0) continue;
    plan.done(true);
    exchanges = static_cast<uint16_t>(exchanges + (now_ms >= 2000));
  }
  CHECK_EQUAL(9 * 3, exchanges);
}

TEST(a_node_without_its_pozyx_reports_no_neighbours_and_no_old_team) {
  Team team;
  for (uint8_t second = 0; second < 12; ++second) {
    Slots::hear(team, 0, second, 5);
    team.run_ms(1000);
  }
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(5, status.team);
  CHECK_EQUAL(4, status.neighbours);
  team.world.tag_present = false;
  team.run_ms(31000);
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(0, status.team);
  CHECK_EQUAL(0, status.neighbours);
  CHECK(!(status.health & static_cast<uint8_t>(wire::Health::kBeacon)));
}

TEST(a_period_too_short_for_everybody_s_window_still_gives_ranges) {
  for (const bool beacon : {false, true}) {
    Team team;
    team.world.exchange_us = 20000;
    team.world.command(1, static_cast<uint8_t>(wire::CommandCode::kSetRangingPeriodMs), 200);
    for (uint8_t second = 0; second < 12; ++second) {
      if (beacon) Slots::hear(team, 0, static_cast<uint8_t>(5 * second), 6, 1, 200);
      team.run_ms(1000);
    }
    wire::Status status;
    CHECK(team.read(wire::MessageType::kStatus, &status));
    CHECK(status.ranging_successes > 20);
    CHECK(status.ranging_successes < 80);
    CHECK_EQUAL(5, status.neighbours);
  }
}

TEST(a_replayed_beacon_moves_no_slot) {
  Team team;
  Slots::hear(team, 0, 9, 7);
  team.run_ms(100);
  team.world.host_counter -= 1;
  Slots::hear(team, 0, 9, 2);
  team.world.host_counter -= 2;
  Slots::hear(team, 0, 9, 2);
  team.run_ms(14000);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(2, status.refused_frames);
  CHECK_EQUAL(0, team.sent(wire::MessageType::kAcknowledgement));
}

// ---- height ----

// The barometric formula of the standard atmosphere, whole and in double precision.
double standard_pressure_mpa(double height_m) {
  return 101325000.0 * pow(1.0 - 0.0065 * height_m / 288.15, 5.255876);
}

TEST(height_is_that_of_the_standard_atmosphere_within_a_decimetre) {
  for (double target_m : {-30.0, -3.0, 3.0, 30.0, 100.0, 300.0}) {
    relpos::Barometer barometer = relpos::Barometer();
    for (uint8_t i = 0; i < 16; ++i) {
      CHECK(!barometer.ready());
      barometer.add(static_cast<uint32_t>(standard_pressure_mpa(0.0)));
    }
    CHECK(barometer.ready());
    CHECK_NEAR(0.0f, barometer.height_m(), 1e-3f);
    const double step_m = target_m > 0 ? 0.1 : -0.1;
    for (double at_m = 0; at_m * step_m < target_m * step_m; at_m += step_m) {
      barometer.add(static_cast<uint32_t>(standard_pressure_mpa(at_m)));
    }
    for (uint8_t i = 0; i < 100; ++i) {
      barometer.add(static_cast<uint32_t>(standard_pressure_mpa(target_m)));
    }
    CHECK_NEAR(static_cast<float>(target_m), barometer.height_m(), 0.11f);
  }
}

TEST(a_climb_is_followed_within_a_second) {
  relpos::Barometer barometer = relpos::Barometer();
  for (uint8_t i = 0; i < 16; ++i) barometer.add(101325000);
  double at_m = 0;
  for (uint8_t i = 0; i < 80; ++i) {  // 20 s of stairs
    at_m += 0.3 / 4;
    barometer.add(static_cast<uint32_t>(standard_pressure_mpa(at_m)));
  }
  CHECK_NEAR(static_cast<float>(at_m), barometer.height_m(), 0.3f);
}

TEST(garbage_pressure_is_no_height_and_a_new_level_is_no_climb) {
  relpos::Barometer barometer = relpos::Barometer();
  for (uint8_t i = 0; i < 30; ++i) barometer.add(i % 3 == 0 ? 0 : 101325000);
  for (uint32_t garbage : {0u, 4294967295u, 20000000u, 90000000u, 110000000u, 101325000u}) {
    barometer.add(garbage);
    CHECK_NEAR(0.0f, barometer.height_m(), 0.01f);
  }
  for (uint8_t i = 0; i < 40; ++i) barometer.add(101025000);  // a door: 300 Pa for good
  CHECK_NEAR(0.0f, barometer.height_m(), 0.01f);
}

TEST(a_pressure_sensor_with_invalid_readings_leaves_no_old_height) {
  for (const uint32_t invalid : {0u, 130000000u}) {
    relpos::Barometer barometer = relpos::Barometer();
    for (uint8_t i = 0; i < 20; ++i) barometer.add(101325000);
    CHECK(barometer.ready());
    for (uint16_t i = 1; i < 300; ++i) {
      barometer.add(invalid);
      CHECK_EQUAL(i < 8, barometer.ready());
    }
    for (uint8_t i = 0; i < 40; ++i) barometer.add(101325000 - 36000);
    CHECK(barometer.ready());
    CHECK_NEAR(3.0f, barometer.height_m(), 0.05f);
  }
}

TEST(a_height_beyond_the_message_is_not_reported) {
  Team team;
  team.run_ms(10000);
  for (uint32_t i = 0; i < 85; ++i) {  // a lift of 4 m/s, up to 360 m
    team.world.pressure_mpa -= 50000;
    team.run_ms(1000);
  }
  wire::Motion motion;
  CHECK(team.read(wire::MessageType::kMotion, &motion));
  CHECK(!(motion.quality & static_cast<uint8_t>(wire::Quality::kHeightValid)));
}

TEST(the_height_travels_with_the_motion_once_it_is_known) {
  Team team;
  team.run_ms(1600);
  wire::Motion motion;
  CHECK(team.read(wire::MessageType::kMotion, &motion));
  CHECK(!(motion.quality & static_cast<uint8_t>(wire::Quality::kHeightValid)));
  team.run_ms(8000);
  team.world.pressure_mpa = 101325000 - 36000;  // 3 m
  team.run_ms(8000);
  CHECK(team.read(wire::MessageType::kMotion, &motion));
  CHECK(motion.quality & static_cast<uint8_t>(wire::Quality::kHeightValid));
  CHECK_NEAR(300.0f, static_cast<float>(motion.height_cm), 3.0f);
  ask(team, team.node, wire::CommandCode::kSetStatusPeriodMs, 1000);
  team.run_ms(1500);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK(status.health & static_cast<uint8_t>(wire::Health::kPressure));
  team.world.tag_present = false;
  team.run_ms(8000);
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK(!(status.health & static_cast<uint8_t>(wire::Health::kPressure)));
  CHECK(team.read(wire::MessageType::kMotion, &motion));
  CHECK(!(motion.quality & static_cast<uint8_t>(wire::Quality::kHeightValid)));
}

TEST(nodes_started_together_do_not_range_together) {
  uint32_t last_us[6];
  uint8_t together = 0;
  for (uint8_t id = 1; id <= 6; ++id) {
    Team team;
    Node node(team.world);
    node.begin(0, wire::ResetCause::kPowerOn, id);
    team.run(node, 8000);
    CHECK(team.last(wire::MessageType::kRanges) != nullptr);
    last_us[id - 1] = team.last(wire::MessageType::kRanges)->time_us;
    for (uint8_t other = 1; other < id; ++other) {
      const int32_t apart = static_cast<int32_t>(last_us[id - 1] - last_us[other - 1]);
      together += apart < 100000 && apart > -100000;
    }
  }
  CHECK(together <= 5);  // of 15 pairs; 2.8 where rounds begin at random within a second
}

TEST(the_schedule_does_not_feel_the_wrap_of_the_microseconds) {
  Team early(0), late(0xFFFFFFFFu - 7000000u);  // wraps after 7 s
  early.run_ms(21000);
  late.run_ms(21000);
  CHECK_EQUAL(early.world.count, late.world.count);
  for (uint16_t i = 0; i < early.world.count; ++i) {
    const Sent& a = early.world.frames[i];
    const Sent& b = late.world.frames[i];
    CHECK_EQUAL(a.header.type, b.header.type);
    CHECK_EQUAL(a.time_us, b.time_us - (0xFFFFFFFFu - 7000000u));
    CHECK_BYTES(a.body, b.body, a.length);
  }
  wire::Motion motion;
  CHECK(late.read(wire::MessageType::kMotion, &motion));
  CHECK(motion.time_ms > 19000 && motion.time_ms < 21000);
}

TEST(a_lost_frame_changes_nothing_in_the_next_ones) {
  Team received, lost;
  lost.world.delivery = 1;  // no acknowledgement from the coordinator
  received.run_ms(12000);
  lost.run_ms(12000);
  const Sent* a = received.last(wire::MessageType::kMotion);
  const Sent* b = lost.last(wire::MessageType::kMotion);
  CHECK(a != nullptr && b != nullptr);
  CHECK(a->header.counter == b->header.counter);
  CHECK_BYTES(a->body, b->body, a->length);
  wire::Status status;
  lost.run_ms(10000);
  CHECK(lost.read(wire::MessageType::kStatus, &status));
  CHECK(status.radio_failures >= 15);
}

TEST(without_a_module_s_answer_telemetry_goes_on_and_counts_it) {
  Team team;
  team.world.module_present = false;
  team.run_ms(22000);
  CHECK(team.sent(wire::MessageType::kMotion) >= 20);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK(status.radio_failures > 10);
}

TEST(motion_that_is_always_due_leaves_room_for_ranges_and_status) {
  Team team;
  team.world.command(1, code(wire::CommandCode::kSetReportPeriodMs), 100);
  team.run_ms(1500);
  team.world.module_present = false;  // 5 frames a second at most
  team.world.count = 0;
  team.run_ms(30000);
  CHECK(team.sent(wire::MessageType::kMotion) >= 70);
  CHECK(team.sent(wire::MessageType::kRanges) >= 10);
  CHECK(team.sent(wire::MessageType::kStatus) >= 2);
}

TEST(motion_that_is_due_a_little_after_every_frame_leaves_room_for_ranges_and_status) {
  Team team;
  team.world.command(1, code(wire::CommandCode::kSetReportPeriodMs), 201);
  team.run_ms(1500);
  team.world.module_present = false;  // a frame takes a little over 200 ms
  team.world.count = 0;
  team.run_ms(30000);
  CHECK(team.sent(wire::MessageType::kMotion) >= 70);
  CHECK(team.sent(wire::MessageType::kRanges) >= 10);
  CHECK(team.sent(wire::MessageType::kStatus) >= 2);
}

TEST(a_weak_signal_is_told_with_its_range) {
  for (const int8_t signal_dbm : {-96, -95}) {
    Team team;
    team.world.signal_dbm = signal_dbm;
    team.run_ms(5000);
    wire::Ranges ranges;
    CHECK(team.read(wire::MessageType::kRanges, &ranges));
    CHECK_EQUAL(signal_dbm, ranges.entries[0].rss_dbm);
    CHECK_EQUAL(signal_dbm == -96 ? static_cast<uint8_t>(wire::RangeQuality::kWeakSignal) : 0,
                ranges.entries[0].quality);
  }
}

TEST(a_slow_line_drops_the_oldest_ranges_counts_them_and_keeps_the_motion) {
  Team team;
  team.world.command(1, code(wire::CommandCode::kSetTeamSize), 20);
  team.world.command(2, code(wire::CommandCode::kSetRangingPeriodMs), 200);
  team.run_ms(1500);
  team.world.module_present = false;  // 5 frames a second at most
  team.run_ms(30000);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK(status.dropped_ranges > 0);
  CHECK(team.sent(wire::MessageType::kMotion) >= 25);
}

TEST(every_step_is_reported_at_its_own_time) {
  Team team;
  team.world.command(1, code(wire::CommandCode::kSetStepReports), 1);
  team.run_ms(5000);
  team.world.walking = true;
  team.run_ms(6000);
  team.world.inertial_present = false;  // the dead reckoning starts anew: no step, no other time
  team.run_ms(1500);
  team.world.inertial_present = true;
  team.run_ms(9300);
  team.world.walking = false;  // the last one is a footfall that is known a second later
  team.run_ms(4000);
  const float period_ms = 1000.0f * 2.0f * 3.14159f / 12.0f;  // of the world's walk
  float last_ms = 0.0f;
  uint16_t intervals = 0;
  for (uint16_t i = 0; i < team.world.count; ++i) {
    const Sent& sent = team.world.frames[i];
    wire::Steps steps;
    if (sent.header.type != wire::MessageType::kSteps) continue;
    CHECK(wire::decode(sent.body, sent.length, &steps));
    CHECK(steps.count <= 3);  // told before there are more
    for (uint8_t k = 0; k < steps.count; ++k) {
      const float time_ms = static_cast<float>(steps.time_ms) - steps.entries[k].age_ms;
      CHECK(time_ms < 11500.0f || time_ms > 14000.0f);  // none between
      const bool level = time_ms < 12000.0f || last_ms > 15000.0f;  // else that is still looked for
      if (last_ms > 0.0f && level) CHECK_NEAR(period_ms, time_ms - last_ms, 45.0f);  // two ticks
      intervals += last_ms > 0.0f;
      last_ms = time_ms;
    }
  }
  CHECK(intervals > 20);
  CHECK_NEAR(21800.0f + period_ms, last_ms, 100.0f);
}

TEST(a_step_is_told_within_four_seconds_however_few_there_are) {
  Team team;
  ask(team, team.node, wire::CommandCode::kSetStepReports, 1);
  team.run_ms(5000);
  team.world.walking = true;
  team.run_ms(1000);
  team.world.walking = false;
  team.run_ms(4000);
  wire::Steps steps;
  CHECK(team.read(wire::MessageType::kSteps, &steps));
  CHECK(steps.count < 3);
}

TEST(steps_are_reported_only_while_that_is_asked_for) {
  Team team;
  team.run_ms(5000);
  team.world.walking = true;
  team.run_ms(5000);
  CHECK_EQUAL(0, team.sent(wire::MessageType::kSteps));
  ask(team, team.node, wire::CommandCode::kSetStepReports, 1);
  while (team.sent(wire::MessageType::kSteps) == 0) team.run_ms(100);
  team.run_ms(700);  // another one waits to be told
  ask(team, team.node, wire::CommandCode::kSetStepReports, 0);
  team.run_ms(4000);
  CHECK_EQUAL(1, team.sent(wire::MessageType::kSteps));
}

TEST(steps_that_are_dropped_are_not_counted_as_ranges) {
  Team team;
  team.world.command(1, code(wire::CommandCode::kSetStepReports), 1);
  team.world.command(2, code(wire::CommandCode::kSetRangingPeriodMs), 0);
  team.run_ms(5000);
  team.world.walking = true;
  team.run_ms(10000);
  CHECK(team.sent(wire::MessageType::kSteps) > 0);
  team.world.line_bytes = 0;
  team.run_ms(10000);
  team.world.line_bytes = 255;
  team.world.walking = false;
  team.run_ms(12000);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK(status.dropped_steps > 2);
  CHECK_EQUAL(0, status.dropped_ranges);
}

TEST(the_status_has_what_the_uart_and_the_tag_complained_of) {
  Team team;
  team.world.errors = {513, 258};
  team.world.exchange_us = 0xFFFFFFFF;  // none ends
  team.run_ms(12000);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(513, status.damaged_bytes);
  CHECK_EQUAL(258, status.lost_bytes);
  CHECK(status.ranging_failures > 0);
  CHECK_EQUAL(relpos::Pozyx::kTimedOut, status.ranging_error);
}

TEST(the_status_has_the_longest_tick_since_the_one_before) {
  Team team;
  ask(team, team.node, wire::CommandCode::kSetStatusPeriodMs, 2000);
  const auto worst_tick_us = [&](uint32_t bus_us) {
    team.world.bus_us = bus_us;
    team.run_ms(100);
    team.world.bus_us = 100;
    team.run_ms(2000);
    wire::Status status = {};
    team.read(wire::MessageType::kStatus, &status);
    return status.worst_tick_us;
  };
  worst_tick_us(100);
  const uint16_t slow_us = worst_tick_us(700);
  CHECK(slow_us >= 700 && slow_us <= 2 * 700);  // the magnetometer is looked for now and then
  CHECK(worst_tick_us(100) <= 2 * 100);
  CHECK_EQUAL(65535, worst_tick_us(70000));
}

TEST(the_loop_never_waits_for_the_storage) {
  Team team;
  team.world.storage_us = 3400;
  team.world.waited = 0;
  team.run_ms(2000);
  ask(team, team.node, wire::CommandCode::kSetTeamSize, 9);
  const Words words = example(91);
  stage(team, team.node, words);
  CHECK_EQUAL(result(wire::CommandResult::kDone),
              ask(team, team.node, wire::CommandCode::kCommitCalibration, words.crc()).result);
  team.run_ms(2000);
  CHECK_EQUAL(1, team.world.restarts);
  CHECK_EQUAL(0, team.world.waited);
}

TEST(a_commit_in_the_moment_that_a_word_is_written_waits_for_nothing) {
  Team team;
  team.world.storage_us = 3400;
  team.run_ms(2000);
  for (uint8_t ms = 0; ms < 100; ++ms) {  // the word, then the mark of its command
    team.run_ms(200);
    team.world.waited = 0;
    team.world.command(100 + ms, code(wire::CommandCode::kSetCalibration), staged(1, ms + 1));
    for (uint16_t hundredth = 0; hundredth < 1200; ++hundredth) {
      if (hundredth == 10 * ms) {
        team.world.command(300 + ms, code(wire::CommandCode::kCommitCalibration), 1);
      }
      team.world.begin_poll();
      team.node.poll(team.world.now);
      team.world.now += 100;
    }
    CHECK_EQUAL(0, team.world.waited);
  }
}

TEST(a_missing_imu_is_reported_and_stops_neither_ranges_nor_reports) {
  Team team;
  team.world.inertial_present = false;
  team.run_ms(1200);
  wire::Status first;
  CHECK(team.read(wire::MessageType::kStatus, &first));
  CHECK(!(first.health & static_cast<uint8_t>(wire::Health::kImu)));
  team.run_ms(10800);
  wire::Motion motion;
  CHECK(team.read(wire::MessageType::kMotion, &motion));
  CHECK_EQUAL(static_cast<uint8_t>(wire::MotionState::kStarting), motion.state);
  CHECK((motion.quality & static_cast<uint8_t>(wire::Quality::kImuGap)) != 0);
  CHECK(team.sent(wire::MessageType::kRanges) >= 4);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK(status.bus_errors > 0);
}

TEST(a_missing_tag_stops_only_the_ranges) {
  Team team;
  team.world.tag_present = false;
  team.run_ms(12000);
  CHECK_EQUAL(0, team.sent(wire::MessageType::kRanges));
  CHECK(team.sent(wire::MessageType::kMotion) >= 10);
}

TEST(a_node_whose_imu_falls_silent_is_starting_again_and_has_no_compass_either) {
  Team team;
  team.world.magnetometer_present = true;
  ask(team, team.node, wire::CommandCode::kSetStatusPeriodMs, 1000);
  team.run_ms(20000);
  const uint8_t sensors = static_cast<uint8_t>(wire::Health::kImu) |
                          static_cast<uint8_t>(wire::Health::kMagnetometer);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(sensors, status.health & sensors);
  wire::Motion motion;
  CHECK(team.read(wire::MessageType::kMotion, &motion));
  CHECK_EQUAL(static_cast<uint8_t>(wire::MotionState::kStanding), motion.state);
  CHECK(motion.quality & static_cast<uint8_t>(wire::Quality::kMagnetometerValid));
  team.world.inertial_present = false;
  team.run_ms(3000);
  CHECK(team.read(wire::MessageType::kMotion, &motion));
  CHECK_EQUAL(static_cast<uint8_t>(wire::MotionState::kStarting), motion.state);
  CHECK(!(motion.quality & static_cast<uint8_t>(wire::Quality::kMagnetometerValid)));
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(0, status.health & sensors);
}

TEST(a_short_gap_of_samples_is_counted_and_one_of_over_a_fifth_of_a_second_starts_anew) {
  for (const uint16_t gap_ms : {90, 250}) {
    Team team;
    ask(team, team.node, wire::CommandCode::kSetStatusPeriodMs, 1000);
    ask(team, team.node, wire::CommandCode::kSetReportPeriodMs, 100);
    team.run_ms(12000);
    wire::Status before, status;
    CHECK(team.read(wire::MessageType::kStatus, &before));
    const uint32_t since_ms = team.world.now / 1000;
    team.world.samples = false;
    team.run_ms(gap_ms);
    wire::Motion motion;
    CHECK(team.read(wire::MessageType::kMotion, &motion));
    CHECK(motion.time_ms <= since_ms);  // the motion ends with the last sample
    team.world.samples = true;
    team.run_ms(2000);
    CHECK(team.read(wire::MessageType::kStatus, &status));
    // After 0.12 s the sensor is set up anew, which takes longer than the gap.
    const float missed = static_cast<float>(status.missed_ticks - before.missed_ticks);
    CHECK_NEAR(gap_ms / 20.0f, missed, gap_ms > 120 ? 7.0f : 1.1f);
    uint8_t quality = 0;
    for (uint16_t i = static_cast<uint16_t>(team.world.count - 25); i < team.world.count; ++i) {
      const Sent& sent = team.world.frames[i];
      if (sent.header.type != wire::MessageType::kMotion) continue;
      CHECK(wire::decode(sent.body, sent.length, &motion));
      quality |= motion.quality;
    }
    CHECK(quality & static_cast<uint8_t>(wire::Quality::kImuGap));
    CHECK_EQUAL(gap_ms > 200, (quality & static_cast<uint8_t>(wire::Quality::kFilterReset)) != 0);
  }
}

TEST(quality_tells_of_saturation_a_strange_field_and_an_axis_that_is_not_known) {
  const uint8_t saturated = static_cast<uint8_t>(wire::Quality::kSaturated);
  const uint8_t valid = static_cast<uint8_t>(wire::Quality::kMagnetometerValid);
  const uint8_t disturbed = static_cast<uint8_t>(wire::Quality::kMagnetometerDisturbed);
  for (const bool spins : {false, true}) {
    Team team;
    team.world.magnetometer_present = true;
    team.run_ms(3000);
    wire::Motion motion;
    CHECK(team.read(wire::MessageType::kMotion, &motion));
    CHECK_EQUAL(static_cast<uint8_t>(wire::MotionState::kStarting), motion.state);
    team.run_ms(9000);
    CHECK(team.read(wire::MessageType::kMotion, &motion));
    CHECK_EQUAL(valid | static_cast<uint8_t>(wire::Quality::kForwardAxisUnknown),
                motion.quality & ~static_cast<uint8_t>(wire::Quality::kHeightValid));
    (spins ? team.world.rate : team.world.force) = 32767;
    team.world.field = 255;  // 76 uT
    team.run_ms(1500);
    CHECK(team.read(wire::MessageType::kMotion, &motion));
    CHECK_EQUAL(saturated | disturbed, motion.quality & (saturated | disturbed | valid));
    team.world.field = 100;
    team.world.field_fails = true;  // a heading of two seconds ago is none
    team.run_ms(3000);
    CHECK(team.read(wire::MessageType::kMotion, &motion));
    CHECK_EQUAL(0, motion.quality & valid);
  }
}

TEST(a_calibrated_sensor_has_lower_limits_and_a_surer_gyroscope) {
  wire::Motion of[2] = {}, walked = {};
  for (uint8_t calibrated = 0; calibrated < 2; ++calibrated) {
    for (const bool spins : {false, true}) {
      Team team;
      Words words = {};
      words.word[wire::kGyroBiasSigma] = 29;  // 0.1 deg/s; else 1
      if (calibrated) {
        stage(team, team.node, words);
        ask(team, team.node, wire::CommandCode::kCommitCalibration, words.crc());
        team.run_ms(200);
      }
      Node again(team.world);
      team.world.count = 0;
      again.begin(team.world.now, wire::ResetCause::kWatchdog, 0);
      team.world.walking = true;
      team.run(again, 8000);
      if (!spins) CHECK(team.read(wire::MessageType::kMotion, calibrated ? &of[1] : &of[0]));
      team.world.walking = false;
      (spins ? team.world.rate : team.world.force) = 31500;
      team.run(again, 1500);
      CHECK(team.read(wire::MessageType::kMotion, &walked));
      const uint8_t saturated = static_cast<uint8_t>(wire::Quality::kSaturated);
      CHECK_EQUAL(calibrated, (walked.quality & saturated) != 0);
    }
  }
  CHECK(of[1].variance_heading_100urad2 * 20.0f < of[0].variance_heading_100urad2);
}

TEST(an_imu_that_was_away_gives_a_gap_a_reset_and_a_larger_variance) {
  Team team;
  team.run_ms(6000);
  wire::Motion before;
  CHECK(team.read(wire::MessageType::kMotion, &before));
  team.world.inertial_present = false;
  team.run_ms(3000);
  team.world.inertial_present = true;
  team.run_ms(2000);
  bool reset_reported = false;
  wire::Motion motion = {};
  for (uint16_t i = 0; i < team.world.count; ++i) {
    const Sent& sent = team.world.frames[i];
    if (sent.header.type != wire::MessageType::kMotion) continue;
    CHECK(wire::decode(sent.body, sent.length, &motion));
    reset_reported |= (motion.quality & static_cast<uint8_t>(wire::Quality::kFilterReset)) != 0;
  }
  CHECK(reset_reported);
  // At least 3 s at the 1 m/s that a wearer may have walked unseen.
  CHECK(motion.variance_along_mm2 - before.variance_along_mm2 >= 9000000);
  team.run_ms(10000);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK(status.missed_ticks >= 140);
}

TEST(an_imu_that_comes_after_a_minute_is_charged_for_the_minute) {
  Team team;
  team.world.inertial_present = false;
  team.run_ms(60000);
  team.world.count = 0;
  team.world.inertial_present = true;
  team.run_ms(3000);
  wire::Motion motion;
  CHECK(team.read(wire::MessageType::kMotion, &motion));
  CHECK(motion.variance_along_mm2 >= 3600000000u);  // 1 m/s
}

TEST(an_imu_that_was_away_for_a_turn_of_the_microseconds_is_charged_for_it) {
  Team team;
  team.run_ms(6000);
  team.world.inertial_present = false;
  for (uint8_t minutes = 0; minutes < 71; ++minutes) {
    team.world.count = 0;
    team.run_ms(60000);
  }
  wire::Motion before;
  CHECK(team.read(wire::MessageType::kMotion, &before));
  team.world.count = 0;
  team.run_ms(35500);  // 71.6 minutes are 2^32 us
  team.world.inertial_present = true;
  team.run_ms(3000);
  wire::Motion motion;
  CHECK(team.read(wire::MessageType::kMotion, &motion));
  // The most that is charged, a minute at 1 m/s.
  CHECK(motion.variance_along_mm2 - before.variance_along_mm2 >= 3600000000u);
}

TEST(a_command_is_done_once_however_often_it_comes) {
  Team team;
  team.run_ms(500);
  for (uint8_t i = 0; i < 3; ++i) {
    team.world.command(7, code(wire::CommandCode::kSetStepGainPermille), 900);
    team.run_ms(300);
  }
  CHECK_EQUAL(3, team.sent(wire::MessageType::kAcknowledgement));
  CHECK_EQUAL(7, team.answer().token);
  CHECK_EQUAL(900, team.answer().value);
  CHECK_EQUAL(result(wire::CommandResult::kDone), team.answer().result);
  team.run_ms(2000);
  wire::Motion motion;
  CHECK(team.read(wire::MessageType::kMotion, &motion));
  CHECK_EQUAL(1, motion.gain_version);
}

TEST(a_late_repetition_does_not_undo_a_newer_command) {
  Team team;
  team.world.command(7, code(wire::CommandCode::kSetLegLengthMm), 900);
  team.run_ms(300);
  team.world.command(8, code(wire::CommandCode::kSetLegLengthMm), 950);
  team.run_ms(300);
  team.world.command(7, code(wire::CommandCode::kSetLegLengthMm), 900);
  team.run_ms(300);
  CHECK_EQUAL(7, team.answer().token);
  team.world.command(9, code(wire::CommandCode::kSetLegLengthMm), 5);
  team.run_ms(300);
  CHECK_EQUAL(result(wire::CommandResult::kOutOfRange), team.answer().result);
  CHECK_EQUAL(950, team.answer().value);
}

TEST(a_token_that_is_used_anew_for_another_command_is_another_one) {
  Team team;
  team.world.command(7, code(wire::CommandCode::kSetTeamSize), 9);
  team.run_ms(300);
  team.world.command(7, code(wire::CommandCode::kSetLegLengthMm), 900);
  team.run_ms(300);
  CHECK_EQUAL(code(wire::CommandCode::kSetLegLengthMm), team.answer().command);
  CHECK_EQUAL(900, ask(team, team.node, wire::CommandCode::kSetLegLengthMm, 0).value);
}

TEST(a_fifth_command_while_four_answers_wait_is_not_done_and_counted) {
  Team team;
  team.run_ms(2000);
  team.world.line_bytes = 0;
  for (uint8_t i = 0; i < 5; ++i) {
    team.world.command(20 + i, code(wire::CommandCode::kSetTeamSize), 10 + i);
  }
  team.run_ms(1000);
  team.world.line_bytes = 255;
  team.run_ms(12000);
  CHECK_EQUAL(4, team.sent(wire::MessageType::kAcknowledgement));
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(1, status.bad_frames);
  CHECK_EQUAL(13, ask(team, team.node, wire::CommandCode::kSetTeamSize, 0).value);
}

TEST(a_setting_that_is_as_it_was_wears_no_storage_and_a_gain_has_one_more_version_each_time) {
  Team team;
  ask(team, team.node, wire::CommandCode::kSetLegLengthMm, 900);
  ask(team, team.node, wire::CommandCode::kSetStepGainPermille, 2000);
  const auto versions = [&] {
    team.run_ms(1500);
    wire::Motion motion = {};
    team.read(wire::MessageType::kMotion, &motion);
    return motion.gain_version;
  };
  CHECK_EQUAL(2, versions());
  memset(team.world.writes, 0, sizeof team.world.writes);
  ask(team, team.node, wire::CommandCode::kSetStepGainPermille, 2000);
  CHECK_EQUAL(2, versions());
  const uint16_t settings = relpos::kStoredRecords + relpos::stored_bytes(sizeof(relpos::Marks));
  for (uint16_t at = settings; at < relpos::kStorageBytes; ++at) {
    CHECK_EQUAL(0, team.world.writes[at]);
  }
}

TEST(gain_and_leg_are_in_force_at_once_and_a_gain_is_surer_than_that_of_everybody) {
  wire::Motion of[3] = {};
  for (uint8_t set = 0; set < 3; ++set) {
    Team team;
    if (set == 1) ask(team, team.node, wire::CommandCode::kSetStepGainPermille, 1070);
    if (set == 2) ask(team, team.node, wire::CommandCode::kSetLegLengthMm, 465);
    team.run_ms(5000);
    team.world.walking = true;
    team.run_ms(20000);
    CHECK(team.read(wire::MessageType::kMotion, &of[set]));
  }
  CHECK(of[0].path_mm > 1000);
  CHECK_NEAR(0.5f, static_cast<float>(of[1].path_mm) / of[0].path_mm, 0.05f);
  CHECK_NEAR(0.63f, static_cast<float>(of[2].path_mm) / of[0].path_mm, 0.05f);  // 1/2 to the 2/3
  const float relative[2] = {static_cast<float>(of[0].scale_error_mm) / of[0].path_mm,
                             static_cast<float>(of[1].scale_error_mm) / of[1].path_mm};
  CHECK_NEAR(0.06f, relative[0], 0.005f);
  CHECK_NEAR(0.05f, relative[1], 0.005f);
}

TEST(a_command_for_another_node_or_a_damaged_one_does_nothing) {
  Team team;
  team.world.command(7, code(wire::CommandCode::kSetLed), 1, kId + 1);
  team.run_ms(300);
  const uint8_t garbage[12] = {0x81, 0, 0, 0x28, 0, 0xB5, 1, 16, 3, 0, 0, 0};
  team.world.give(garbage, sizeof garbage);
  const uint8_t short_command[2] = {7, 0};  // sealed well
  team.world.down(wire::MessageType::kCommand, short_command, 2, kId, ++team.world.host_counter);
  const uint8_t module_restarted[2] = {0x8A, 0};
  team.world.give(module_restarted, sizeof module_restarted);
  team.run_ms(300);
  CHECK_EQUAL(0, team.sent(wire::MessageType::kAcknowledgement));
  team.run_ms(12000);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(3, status.bad_frames);
}

TEST(an_unknown_command_is_answered_as_unknown) {
  Team team;
  team.world.command(7, 200, 1);
  team.run_ms(300);
  CHECK_EQUAL(7, team.answer().token);
  CHECK_EQUAL(200, team.answer().command);
  CHECK_EQUAL(result(wire::CommandResult::kUnknownCommand), team.answer().result);
}

TEST(a_transaction_for_the_host_answers_what_was_read_and_how_long_it_took) {
  Team team;
  team.run_ms(2000);
  team.world.bus_us = 148;
  // Address, register, parameter, bytes written and read.
  wire::Acknowledgement answer = ask(team, team.node, wire::CommandCode::kAccessBus, 0x11007568);
  CHECK_EQUAL(result(wire::CommandResult::kDone), answer.result);
  CHECK_EQUAL(0x68, answer.value >> 8 & 0xFF);
  CHECK_EQUAL(148, answer.value >> 16);
  // The last two of a range's eleven bytes: -80 dBm.
  const int32_t row = static_cast<int32_t>(0xB302C74B);
  answer = ask(team, team.node, wire::CommandCode::kAccessBus, row);
  CHECK_EQUAL(result(wire::CommandResult::kDone), answer.result);
  CHECK_EQUAL(0xFFB0, answer.value & 0xFFFF);
  answer = ask(team, team.node, wire::CommandCode::kAccessBus, 0x11007569);
  CHECK_EQUAL(result(wire::CommandResult::kNoAnswer), answer.result);
  // The most that can be asked for at once.
  const int32_t most = static_cast<int32_t>(0xFFFFFF68);
  answer = ask(team, team.node, wire::CommandCode::kAccessBus, most);
  CHECK_EQUAL(result(wire::CommandResult::kDone), answer.result);
  CHECK_EQUAL(3, team.world.written);
}

TEST(settings_survive_a_restart_and_a_torn_copy) {
  Team team;
  team.world.command(7, code(wire::CommandCode::kSetTeamSize), 4);
  team.run_ms(500);
  team.world.eeprom[20] ^= 0x40;  // the first copy
  Node again(team.world);
  again.begin(team.world.now, wire::ResetCause::kBrownOut, 0);
  team.run(again, 4500);
  wire::Ranges ranges;
  CHECK(team.read(wire::MessageType::kRanges, &ranges));
  CHECK_EQUAL(3, ranges.count);
}

TEST(a_stored_number_that_nobody_may_have_or_that_is_damaged_makes_node_1) {
  for (const uint8_t stored : {0, 7, 8, 255}) {
    Team team;
    team.world.eeprom[relpos::kStoredNodeId] = stored;
    team.world.eeprom[relpos::kStoredNodeIdComplement] = stored == 8 ? 0xF6 : stored ^ 0xFF;
    Node again(team.world);
    again.begin(team.world.now, wire::ResetCause::kPowerOn, 0);
    CHECK_EQUAL(stored == 7 ? 7 : 1, again.id());
  }
}

TEST(every_start_counts) {
  Team team;
  CHECK_EQUAL(0, team.world.eeprom[relpos::kStoredBootCount]);
  Node again(team.world);
  again.begin(0, wire::ResetCause::kBrownOut, 0);
  CHECK_EQUAL(1, team.world.eeprom[relpos::kStoredBootCount]);
  team.run(again, 2500);
  CHECK_EQUAL(1, team.last(wire::MessageType::kMotion)->header.boot);
}

TEST(a_reboot_is_acknowledged_first_and_not_repeated_by_the_same_command) {
  Team team;
  Node node(team.world);  // the second start: the complement of 0 is what an erased byte is
  node.begin(0, wire::ResetCause::kPowerOn, 0);
  team.world.command(7, code(wire::CommandCode::kReboot), 0);
  team.run(node, 1000);
  CHECK_EQUAL(1, team.world.restarts);
  CHECK_EQUAL(1, team.sent(wire::MessageType::kAcknowledgement));
  Node again(team.world);
  again.begin(team.world.now, wire::ResetCause::kWatchdog, 0);
  ask(team, again, wire::CommandCode::kPing, 0);  // another one comes first
  team.world.command(7, code(wire::CommandCode::kReboot), 0);  // the answer had been lost
  team.run(again, 3000);
  CHECK_EQUAL(1, team.world.restarts);
  CHECK_EQUAL(3, team.sent(wire::MessageType::kAcknowledgement));
  CHECK_EQUAL(7, team.answer().token);
  CHECK_EQUAL(code(wire::CommandCode::kReboot), team.answer().command);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(static_cast<uint8_t>(wire::ResetCause::kCommand), status.reset_cause);
}

TEST(no_other_command_is_taken_while_a_restart_is_written_down) {
  for (const uint8_t before : {0, 3}) {  // commands: the reboot is the first or the last kept
    Team team;
    team.world.storage_us = 3400;
    team.run_ms(500);
    for (uint8_t i = 0; i < before; ++i) ask(team, team.node, wire::CommandCode::kPing, 0);
    team.world.command(7, code(wire::CommandCode::kReboot), 0);
    while (team.world.eeprom[relpos::kStoredReboot] != 7) team.run_ms(1);
    team.world.command(8, code(wire::CommandCode::kSetTeamSize), 9);
    team.run_ms(1000);
    CHECK_EQUAL(1, team.world.restarts);
    Node again(team.world);
    again.begin(team.world.now, wire::ResetCause::kWatchdog, 0);
    team.run(again, 1000);
    team.world.command(7, code(wire::CommandCode::kReboot), 0);
    team.run(again, 1000);
    CHECK_EQUAL(1, team.world.restarts);
    CHECK_EQUAL(7, team.answer().token);
    CHECK_EQUAL(6, ask(team, again, wire::CommandCode::kSetTeamSize, 0).value);
  }
}

TEST(a_reboot_is_known_where_the_boot_loader_hides_the_cause) {
  Team team;
  team.world.command(7, code(wire::CommandCode::kReboot), 0);
  team.run_ms(1000);
  Node again(team.world);
  again.begin(team.world.now, wire::ResetCause::kUnknown, 0);
  team.world.command(7, code(wire::CommandCode::kReboot), 0);
  team.run(again, 3000);
  CHECK_EQUAL(1, team.world.restarts);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(static_cast<uint8_t>(wire::ResetCause::kCommand), status.reset_cause);
}

TEST(a_record_of_a_reboot_that_a_power_cut_left_unfinished_counts_for_nothing) {
  Team team;
  team.world.command(7, code(wire::CommandCode::kReboot), 0);
  while (team.world.eeprom[relpos::kStoredReboot] != 7) team.run_ms(1);  // the token's first byte
  Node again(team.world);
  again.begin(team.world.now, wire::ResetCause::kBrownOut, 0);
  team.run(again, 3000);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(static_cast<uint8_t>(wire::ResetCause::kBrownOut), status.reset_cause);
}

TEST(a_restart_that_was_commanded_is_told_once_and_not_256_starts_later) {
  Team team;
  team.world.command(7, code(wire::CommandCode::kReboot), 0);
  team.run_ms(1000);
  for (uint16_t start = 0; start <= 256; ++start) {
    Node again(team.world);
    team.world.count = 0;
    again.begin(team.world.now, wire::ResetCause::kBrownOut, 0);
    if (start > 0 && start < 256) continue;
    team.run(again, 3000);
    wire::Status status;
    CHECK(team.read(wire::MessageType::kStatus, &status));
    const wire::ResetCause cause =
        start == 0 ? wire::ResetCause::kCommand : wire::ResetCause::kBrownOut;
    CHECK_EQUAL(static_cast<uint8_t>(cause), status.reset_cause);
  }
}

// As the host asks that has had no answer: twice, back to back.
TEST(a_second_command_while_a_restart_waits_leaves_the_counters_whole) {
  for (uint32_t apart_us = 500; apart_us < 20000; apart_us += 1500) {
    Team team;
    team.world.storage_us = 3400;
    team.run_ms(1500);
    ask(team, team.node, wire::CommandCode::kPing, 0);
    team.world.command(7, code(wire::CommandCode::kReboot), 0);
    const uint32_t start_us = team.world.now;
    bool again = false;
    while (team.world.restarts == 0) {
      if (!again && team.world.now - start_us >= apart_us) {
        again = true;
        team.world.command(7, code(wire::CommandCode::kReboot), 0);
      }
      team.world.begin_poll();
      team.node.poll(team.world.now);
      team.world.now += 100;
    }
    const uint16_t copy_bytes = 11;
    for (uint8_t copy = 0; copy < 2; ++copy) {
      const uint8_t* stored = team.world.eeprom + relpos::kStoredRecords + copy * copy_bytes;
      uint16_t crc;
      memcpy(&crc, stored + copy_bytes - 2, 2);
      CHECK_EQUAL(wire::crc16(stored + 1, copy_bytes - 3, 0xFFFF - stored[0]), crc);
    }
  }
}

TEST(a_uart_with_little_space_carries_the_same_frames) {
  Team team;
  team.world.line_bytes = 3;
  team.run_ms(6000);
  CHECK_EQUAL(0, team.world.damaged);
  CHECK(team.sent(wire::MessageType::kMotion) >= 4);
}

TEST(totals_keep_their_millimetre_and_turn_over) {
  CHECK_EQUAL(1234, relpos::scaled(1.2344f, 1000));
  CHECK_EQUAL(-1235, static_cast<int32_t>(relpos::scaled(-1.2346f, 1000)));
  CHECK_EQUAL(8000001, relpos::scaled(8000.001f, 1000));
  // 100 rad^2 in 1e-8: more than 32 bits hold, the difference is still right.
  CHECK_EQUAL(100000000u, relpos::scaled(100.0f, 100000000) - relpos::scaled(99.0f, 100000000));
}

TEST(whole_turns_count_and_a_reset_of_the_filter_sets_nothing_back) {
  relpos::MotionTotals totals = relpos::MotionTotals();
  relpos::Displacement now = relpos::Displacement();
  for (int16_t degree = 0; degree <= 810; degree += 10) {  // two turns and a quarter, left
    int16_t within = static_cast<int16_t>(degree % 360);
    if (within > 180) within = static_cast<int16_t>(within - 360);
    now.heading_rad = static_cast<float>(within) * 0.01745329f;
    totals.track(now);
  }
  now.x_m = 3.0f;
  now.y_m = 4.0f;
  now.steps = 65530;
  wire::Motion motion;
  totals.fill(now, &motion);
  CHECK_NEAR(141372.0f, static_cast<float>(motion.heading_100urad), 2.0f);
  relpos::MotionTotals right = relpos::MotionTotals();
  for (int16_t degree = 0; degree >= -200; degree -= 10) {
    now.heading_rad = static_cast<float>(degree < -180 ? degree + 360 : degree) * 0.01745329f;
    right.track(now);
  }
  right.fill(now, &motion);
  CHECK_NEAR(-34907.0f, static_cast<float>(motion.heading_100urad), 2.0f);
  right.rebase(now, 600.0f);
  right.fill(relpos::Displacement(), &motion);  // charged like a minute
  CHECK_NEAR(3.721e9f, static_cast<float>(motion.variance_along_mm2), 1e3f);
  CHECK_NEAR(3.721e9f, static_cast<float>(motion.variance_across_mm2), 1e3f);
  CHECK_NEAR(3.2898681e8f, static_cast<float>(motion.variance_heading_100urad2), 1e3f);  // any
  now.heading_rad = 1.5707963f;
  totals.rebase(now, 0.5f);
  relpos::Displacement anew = relpos::Displacement();
  anew.x_m = 2.0f;  // ahead, which is now the old frame's left
  anew.steps = 10;
  totals.track(anew);
  totals.fill(anew, &motion);
  CHECK_NEAR(3000.0f, static_cast<float>(motion.x_mm), 2.0f);
  CHECK_NEAR(6000.0f, static_cast<float>(motion.y_mm), 2.0f);
  CHECK_EQUAL(4, motion.steps);  // wrapped
  CHECK_NEAR(141372.0f, static_cast<float>(motion.heading_100urad), 2.0f);
  CHECK_NEAR(2250000.0f, static_cast<float>(motion.variance_along_mm2), 1.0f);
  CHECK_NEAR(2250000.0f, static_cast<float>(motion.variance_across_mm2), 1.0f);
  CHECK_NEAR(6250000.0f, static_cast<float>(motion.variance_heading_100urad2), 1.0f);
}

TEST(no_calibration_changes_nothing) {
  const int16_t none[wire::kCalibrationWords] = {};
  float sample[6] = {9.8f, -0.3f, 39.2f, 8.7f, -0.001f, 0.0f};
  float field[3] = {-18.3f, 0.15f, 1228.0f};
  const float same[6] = {9.8f, -0.3f, 39.2f, 8.7f, -0.001f, 0.0f};
  relpos::correct_inertial(none, sample, nullptr);
  relpos::correct_field(none, field);
  for (uint8_t i = 0; i < 6; ++i) CHECK_NEAR(same[i], sample[i], 0.0f);
  CHECK_NEAR(-18.3f, field[0], 0.0f);
  CHECK_NEAR(0.15f, field[1], 0.0f);
  CHECK_NEAR(1228.0f, field[2], 0.0f);
}

TEST(a_calibration_undoes_the_errors_that_it_describes) {
  int16_t words[wire::kCalibrationWords] = {};
  const float unit = 16384.0f;
  words[wire::kAccelerationBias + 2] = static_cast<int16_t>(-0.5f * unit);
  words[wire::kAccelerationScale + 2] = static_cast<int16_t>(0.25f * unit);
  words[wire::kGyroBias + 1] = static_cast<int16_t>(0.125f * unit);
  words[wire::kFieldOffset + 0] = 16 * -40;
  words[wire::kFieldMatrix + 1] = static_cast<int16_t>(0.5f * unit);   // row 0, column 1
  words[wire::kFieldMatrix + 8] = static_cast<int16_t>(-0.25f * unit);  // row 2, column 2
  float sample[6] = {1.0f, 2.0f, 3.5f, 0.5f, 0.25f, 0.0f};
  float sums[6] = {10.0f, 10.0f, 10.0f, 10.0f, 10.0f, 10.0f};
  relpos::correct_inertial(words, sample, sums);
  const float corrected[6] = {1.0f, 2.0f, 5.0f, 0.5f, 0.125f, 0.0f};
  const float summed[6] = {11.0f, 12.0f, 13.5f, 10.5f, 10.25f, 10.0f};  // as they were
  for (uint8_t i = 0; i < 6; ++i) {
    CHECK_NEAR(corrected[i], sample[i], 1e-6f);
    CHECK_NEAR(summed[i], sums[i], 1e-6f);
  }
  float field[3] = {-10.0f, 20.0f, 8.0f};
  relpos::correct_field(words, field);
  CHECK_NEAR(40.0f, field[0], 1e-5f);  // -10 + 40 + 20 / 2
  CHECK_NEAR(20.0f, field[1], 1e-5f);
  CHECK_NEAR(6.0f, field[2], 1e-5f);
}

TEST(raw_samples_come_five_times_a_second_and_end_by_themselves) {
  Team team;
  team.world.magnetometer_present = true;
  team.run_ms(3000);
  CHECK_EQUAL(0, team.sent(wire::MessageType::kSamples));
  CHECK_EQUAL(result(wire::CommandResult::kDone),
              ask(team, team.node, wire::CommandCode::kSetRawReports, 50).result);
  team.run_ms(9000);
  CHECK(team.sent(wire::MessageType::kSamples) >= 43);
  wire::Samples samples = {};
  CHECK(team.read(wire::MessageType::kSamples, &samples));
  CHECK(samples.samples >= 9 && samples.samples <= 11);
  CHECK_NEAR(9.80665f * 1e5f * samples.samples, static_cast<float>(samples.acceleration_x_10um_s2),
             100.0f);
  CHECK_EQUAL(0, samples.angular_rate_z_10urad_s);
  CHECK_EQUAL(1, samples.field_readings);
  CHECK_NEAR(30.0f * 1e5f, static_cast<float>(samples.field_y_10pt), 10.0f);
  CHECK(samples.time_ms > 11000 && samples.time_ms < 12100);
  team.run_ms(5000);
  CHECK_EQUAL(50, team.sent(wire::MessageType::kSamples));
  CHECK(team.sent(wire::MessageType::kMotion) >= 15);  // which goes on
}

TEST(raw_samples_report_a_silent_sensor_and_still_end) {
  Team team;
  team.world.inertial_present = false;
  ask(team, team.node, wire::CommandCode::kSetRawReports, 10);
  team.run_ms(4000);
  wire::Samples samples = {};
  CHECK_EQUAL(10, team.sent(wire::MessageType::kSamples));
  CHECK(team.read(wire::MessageType::kSamples, &samples));
  CHECK_EQUAL(0, samples.samples);
  CHECK_EQUAL(0, samples.field_readings);
  CHECK_EQUAL(result(wire::CommandResult::kOutOfRange),
              ask(team, team.node, wire::CommandCode::kSetRawReports, 3001).result);
  CHECK_EQUAL(result(wire::CommandResult::kOutOfRange),
              ask(team, team.node, wire::CommandCode::kSetRawReports, -1).result);
}

TEST(a_node_that_reports_raw_samples_does_not_range_and_then_ranges_again) {
  Team team;
  team.run_ms(5000);
  ask(team, team.node, wire::CommandCode::kSetRawReports, 40);
  const uint16_t before = team.sent(wire::MessageType::kRanges);
  team.run_ms(7500);
  CHECK_EQUAL(before, team.sent(wire::MessageType::kRanges));
  team.run_ms(6000);
  CHECK(team.sent(wire::MessageType::kRanges) >= before + 2);
  wire::Ranges ranges;
  CHECK(team.read(wire::MessageType::kRanges, &ranges));
  CHECK_EQUAL(5, ranges.count);
  for (uint8_t i = 0; i < 5; ++i) CHECK_EQUAL(1000u * ranges.entries[i].peer, ranges.entries[i].range_mm);
}

TEST(ranges_that_wait_when_ranging_ends_are_sent_or_counted) {
  enum End { kOff, kRaw, kNoTag, kNoLine };
  for (uint8_t end = kOff; end <= kNoLine; ++end) {
    for (uint16_t moment_ms = 0; moment_ms < 2000; moment_ms += 100) {
      Team team;
      team.world.exchange_us = 20000;
      team.run_ms(4000u + moment_ms);
      if (end == kRaw) {
        team.world.command(9, code(wire::CommandCode::kSetRawReports), 5);
        team.run_ms(3000);
      }
      if (end == kNoTag) team.world.tag_present = false;
      if (end == kNoLine) team.world.line_bytes = 0;
      if (end != kNoTag) team.world.command(10, code(wire::CommandCode::kSetRangingPeriodMs), 0);
      team.run_ms(end == kNoLine ? 70000 : 1500);  // ages have 16 bits of milliseconds
      team.world.line_bytes = 255;
      team.world.command(11, code(wire::CommandCode::kSetStatusPeriodMs), 1000);
      team.run_ms(2500);
      uint16_t sent = 0;
      wire::Ranges ranges;
      for (uint16_t i = 0; i < team.world.count; ++i) {
        const Sent& frame = team.world.frames[i];
        if (frame.header.type != wire::MessageType::kRanges) continue;
        CHECK(wire::decode(frame.body, frame.length, &ranges));
        sent = static_cast<uint16_t>(sent + ranges.count);
        for (uint8_t k = 0; k < ranges.count && end == kNoLine; ++k) {
          CHECK(ranges.time_ms - ranges.entries[k].age_ms <= 4200u + moment_ms);
        }
      }
      wire::Status status;
      CHECK(team.read(wire::MessageType::kStatus, &status));
      CHECK_EQUAL(status.ranging_successes, sent + status.dropped_ranges);
    }
  }
}

TEST(a_calibration_is_in_force_after_its_commit_and_not_a_word_earlier) {
  Team team;
  const Words none = {};
  const Words words = example(91);
  stage(team, team.node, words);
  CHECK(in_force(team, team.node, none));
  CHECK_EQUAL(result(wire::CommandResult::kOutOfRange),
              ask(team, team.node, wire::CommandCode::kCommitCalibration, words.crc() ^ 1).result);
  CHECK(in_force(team, team.node, none));
  CHECK_EQUAL(0, team.world.restarts);
  const wire::Acknowledgement answer =
      ask(team, team.node, wire::CommandCode::kCommitCalibration, words.crc());
  CHECK_EQUAL(result(wire::CommandResult::kDone), answer.result);
  team.run_ms(1000);
  CHECK_EQUAL(1, team.world.restarts);
  Node again(team.world);
  again.begin(team.world.now, wire::ResetCause::kWatchdog, 0);
  // The commit repeated, because its answer was lost: answered, not done again.
  team.world.command(answer.token, code(wire::CommandCode::kCommitCalibration), words.crc());
  team.run(again, 1000);
  CHECK_EQUAL(1, team.world.restarts);
  CHECK_EQUAL(answer.token, team.answer().token);
  CHECK_EQUAL(result(wire::CommandResult::kDone), team.answer().result);
  CHECK(in_force(team, again, words));
  CHECK_EQUAL(result(wire::CommandResult::kOutOfRange),
              ask(team, again, wire::CommandCode::kReadCalibration, staged(22, 0)).result);
  CHECK_EQUAL(result(wire::CommandResult::kOutOfRange),
              ask(team, again, wire::CommandCode::kSetCalibration, staged(22, 0)).result);
}

TEST(a_power_cut_at_any_byte_leaves_the_old_calibration_or_the_new_one) {
  const Words before = example(-57), after = example(103);
  bool old_seen = false, new_seen = false;
  for (uint32_t cut = 0; cut < 800; cut += 11) {
    Team team;
    ask(team, team.node, wire::CommandCode::kSetTeamSize, 9);
    stage(team, team.node, before);
    ask(team, team.node, wire::CommandCode::kCommitCalibration, before.crc());
    team.run_ms(500);
    Node second(team.world);
    second.begin(team.world.now, wire::ResetCause::kWatchdog, 0);
    team.world.writes_left = cut;
    stage(team, second, after);
    ask(team, second, wire::CommandCode::kCommitCalibration, after.crc());
    team.run(second, 500);
    team.world.writes_left = 0xFFFFFFFF;
    Node third(team.world);
    third.begin(team.world.now, wire::ResetCause::kPowerOn, 0);
    const bool old_one = in_force(team, third, before);
    CHECK(old_one || in_force(team, third, after));
    CHECK_EQUAL(9, ask(team, third, wire::CommandCode::kSetTeamSize, 0).value);
    (old_one ? old_seen : new_seen) = true;
  }
  CHECK(old_seen && new_seen);
}

TEST(while_a_word_or_a_setting_is_being_stored_the_next_one_has_to_wait) {
  Team team;
  team.world.command(7, code(wire::CommandCode::kSetTeamSize), 4);
  team.world.command(8, code(wire::CommandCode::kSetCalibration), staged(0, 5));
  team.run_ms(300);
  CHECK_EQUAL(8, team.answer().token);
  CHECK_EQUAL(result(wire::CommandResult::kBusy), team.answer().result);
  CHECK_EQUAL(4, ask(team, team.node, wire::CommandCode::kSetTeamSize, 0).value);
}

// ---- authentication ----

TEST(a_replayed_forged_or_foreign_frame_touches_nothing) {
  Team team;
  uint8_t body[wire::kCommandBytes];
  const wire::Command request = {7, code(wire::CommandCode::kSetTeamSize), 9};
  wire::encode(request, body);
  const auto down = [&](uint32_t counter) {
    team.world.down(wire::MessageType::kCommand, body, sizeof body, kId, counter);
    team.run_ms(300);
  };
  down(5000);
  CHECK_EQUAL(1, team.sent(wire::MessageType::kAcknowledgement));
  down(5000);  // the same again
  team.world.key[3] ^= 1;
  down(6000);  // another team's
  team.world.key[3] ^= 1;
  CHECK_EQUAL(1, team.sent(wire::MessageType::kAcknowledgement));
  down(5001);  // had the foreign one counted, this would be old
  CHECK_EQUAL(2, team.sent(wire::MessageType::kAcknowledgement));
  team.run_ms(12000);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(2, status.refused_frames);
  CHECK_EQUAL(0, status.bad_frames);
}

TEST(a_frame_of_a_node_s_own_sent_back_to_it_makes_no_command_old) {
  Team team;
  const wire::Acknowledgement own = {7, 0, 0, 0};
  uint8_t body[wire::kFrameBytes];
  const uint8_t length = wire::encode(own, body);
  ask(team, team.node, wire::CommandCode::kPing, 0);
  const uint32_t next = team.world.host_counter + 1;
  team.world.down(wire::MessageType::kAcknowledgement, body, length, kId, next + 5);
  team.run_ms(300);
  CHECK_EQUAL(9, ask(team, team.node, wire::CommandCode::kSetTeamSize, 9).value);
}

TEST(a_counter_that_does_not_follow_is_refused_with_the_newest_and_the_next_one_is_obeyed) {
  for (const uint32_t obeyed : {5000u, 0xFFFFFFFEu, 0xFFFFFFFFu}) {
    for (const uint32_t skipped : {0xFFFFFFFEu, 0x80000000u, wire::kMostJump}) {
      Team team;
      team.world.host_counter = obeyed - 1;
      CHECK_EQUAL(result(wire::CommandResult::kDone),
                  ask(team, team.node, wire::CommandCode::kSetTeamSize, 9).result);
      team.world.host_counter = obeyed + skipped;
      team.world.count = 0;
      team.world.command(77, code(wire::CommandCode::kSetTeamSize), 4);
      team.run_ms(300);
      CHECK_EQUAL(1, team.sent(wire::MessageType::kAcknowledgement));
      CHECK_EQUAL(77, team.answer().token);
      CHECK_EQUAL(result(wire::CommandResult::kCounterRefused), team.answer().result);
      CHECK_EQUAL(obeyed, static_cast<uint32_t>(team.answer().value));
      team.world.host_counter = obeyed;
      CHECK_EQUAL(9, ask(team, team.node, wire::CommandCode::kSetTeamSize, 0).value);
      team.world.host_counter = obeyed + 1 + wire::kMostJump - 1;  // the next is one further
      CHECK_EQUAL(result(wire::CommandResult::kDone),
                  ask(team, team.node, wire::CommandCode::kSetTeamSize, 5).result);
    }
  }
}

TEST(a_command_brings_back_beacons_that_a_host_of_the_future_had_made_old) {
  Team team;
  ask(team, team.node, wire::CommandCode::kSetStatusPeriodMs, 1000);
  team.world.host_counter = 0x50000000;
  send_beacon(team, 1);
  CHECK_EQUAL(1, beacon_team(team));
  team.world.host_counter = 5000;
  send_beacon(team, 2);
  CHECK_EQUAL(1, beacon_team(team));
  ask(team, team.node, wire::CommandCode::kPing, 0);
  send_beacon(team, 2);
  CHECK_EQUAL(2, beacon_team(team));
}

TEST(a_command_is_not_obeyed_again_after_a_restart) {
  Team team;
  uint8_t body[wire::kCommandBytes];
  const wire::Command request = {7, code(wire::CommandCode::kSetTeamSize), 9};
  wire::encode(request, body);
  team.world.down(wire::MessageType::kCommand, body, sizeof body, kId, 5000);
  team.run_ms(500);
  Node again(team.world);
  again.begin(team.world.now, wire::ResetCause::kPowerOn, 0);
  team.world.down(wire::MessageType::kCommand, body, sizeof body, kId, 5000);
  team.run(again, 500);
  CHECK_EQUAL(1, team.sent(wire::MessageType::kAcknowledgement));
  team.world.down(wire::MessageType::kCommand, body, sizeof body, kId, 5001);
  team.run(again, 500);
  CHECK_EQUAL(2, team.sent(wire::MessageType::kAcknowledgement));
}

TEST(no_counter_is_used_twice_wherever_the_power_is_cut) {
  Team team;
  team.world.command(7, code(wire::CommandCode::kSetReportPeriodMs), 100);
  team.run_ms(500);
  uint32_t newest = 0;
  for (uint32_t cut = 1; cut < 60; ++cut) {
    team.world.writes_left = 0xFFFFFFFF;
    Node again(team.world);
    again.begin(team.world.now, wire::ResetCause::kPowerOn, 0);
    team.world.writes_left = cut;
    team.world.count = 0;
    for (uint16_t ms = 0; ms < 600 && team.world.writes_left > 0; ++ms) team.run(again, 1);
    for (uint16_t i = 0; i < team.world.count; ++i) {
      CHECK(team.world.frames[i].header.counter > newest);
      newest = team.world.frames[i].header.counter;
    }
  }
  CHECK(newest > 1024);
}

TEST(power_cuts_in_a_row_never_take_the_last_good_copy) {
  Team team;
  ask(team, team.node, wire::CommandCode::kPing, 0);
  uint8_t stored[sizeof team.world.eeprom];
  memcpy(stored, team.world.eeprom, sizeof stored);
  const uint32_t obeyed = team.world.host_counter;
  for (uint32_t first = 1; first < 28; first += 2) {
    for (uint32_t second = 1; second < 28; second += 2) {
      memcpy(team.world.eeprom, stored, sizeof stored);
      for (const uint32_t cut : {first, second}) {  // while a start reserves its counters
        Node hurt(team.world);
        hurt.begin(team.world.now, wire::ResetCause::kPowerOn, 0);
        team.world.writes_left = cut;
        for (uint8_t ms = 0; ms < 200 && team.world.writes_left > 0; ++ms) team.run(hurt, 1);
        team.world.writes_left = 0xFFFFFFFF;
      }
      Node again(team.world);
      again.begin(team.world.now, wire::ResetCause::kPowerOn, 0);
      team.world.count = 0;
      team.world.host_counter = obeyed - 1;  // the command is sent again
      team.world.command(77, code(wire::CommandCode::kPing), 0);
      team.run(again, 20);
      CHECK_EQUAL(0, team.sent(wire::MessageType::kAcknowledgement));
    }
  }
}

TEST(a_repetition_that_was_answered_is_not_obeyed_after_a_restart) {
  Team team;
  for (uint8_t time = 0; time < 2; ++time) {  // the host missed the first answer
    team.world.command(7, code(wire::CommandCode::kSetTeamSize), 4);
    team.run_ms(300);
  }
  CHECK_EQUAL(2, team.sent(wire::MessageType::kAcknowledgement));
  Node again(team.world);
  again.begin(team.world.now, wire::ResetCause::kPowerOn, 0);
  team.world.count = 0;
  --team.world.host_counter;  // somebody sends the repetition once more
  team.world.command(7, code(wire::CommandCode::kSetTeamSize), 4);
  team.run(again, 300);
  CHECK_EQUAL(0, team.sent(wire::MessageType::kAcknowledgement));
}

TEST(counters_go_on_in_the_next_block_and_wear_the_storage_little) {
  Team team;
  ask(team, team.node, wire::CommandCode::kSetReportPeriodMs, 100);
  memset(team.world.writes, 0, sizeof team.world.writes);
  uint32_t newest = 0;
  for (uint16_t minute = 0; minute < 20; ++minute) {
    team.world.count = 0;
    team.run_ms(30000);
    for (uint16_t i = 0; i < team.world.count; ++i) {
      CHECK(team.world.frames[i].header.counter > newest);
      newest = team.world.frames[i].header.counter;
    }
  }
  CHECK(newest > 6000);
  for (uint16_t count : team.world.writes) CHECK(count <= newest / 1024 + 1);
}

TEST(a_counter_is_stored_before_it_is_used) {
  Team team;
  team.world.storage_us = 3400;
  ask(team, team.node, wire::CommandCode::kSetReportPeriodMs, 100);
  ask(team, team.node, wire::CommandCode::kSetStatusPeriodMs, 1000);
  ask(team, team.node, wire::CommandCode::kSetRangingPeriodMs, 200);  // some frames at once
  for (uint16_t i = 0; i < 10000; ++i) {
    team.run_ms(20);
    if (team.world.count == 0) continue;
    const uint32_t used = team.world.frames[team.world.count - 1].header.counter;
    if (team.world.count > kMostFrames / 2) team.world.count = 0;
    relpos::Persistent stored;
    relpos::Storage().load(team.world, &stored);
    CHECK(used < stored.marks_.counter_end);
  }
}

// The second command changes the record while the first one's is being written.
TEST(a_power_cut_while_a_record_changes_that_is_being_written_leaves_a_good_copy) {
  for (uint32_t apart_ms = 1; apart_ms < 80; apart_ms += 6) {
    for (uint32_t cut = 1; cut < 50; cut += 2) {
      Team team;
      team.run_ms(300);
      ask(team, team.node, wire::CommandCode::kPing, 0);
      const uint32_t obeyed = team.world.host_counter;
      team.world.storage_us = 3400;
      team.world.writes_left = cut;
      team.world.command(7, code(wire::CommandCode::kPing), 0);
      team.run_ms(apart_ms);
      team.world.command(8, code(wire::CommandCode::kPing), 0);
      for (uint8_t ms = 0; ms < 250 && team.world.writes_left > 0; ++ms) team.run_ms(1);
      team.world.writes_left = 0xFFFFFFFF;
      relpos::Persistent stored;
      relpos::Storage().load(team.world, &stored);
      CHECK(stored.marks_.command >= obeyed && stored.marks_.command <= obeyed + 2);
    }
  }
}

// The body of a frame that gives a node these keys; masking and unmasking are the same.
void fill_new_keys(const uint8_t* old_key, uint32_t counter, const uint8_t* key,
                   const uint8_t* beacon_key, uint8_t* body) {
  body[0] = 7;
  body[1] = 0;
  memcpy(body + 2, key, wire::kKeyBytes);
  memcpy(body + 2 + wire::kKeyBytes, beacon_key, wire::kKeyBytes);
  uint8_t keys[2 * wire::kKeyBytes];
  memcpy(keys, old_key, wire::kKeyBytes);
  wire::unmask_keys(counter, body, keys);
  memcpy(body + 2, keys, sizeof keys);
}

struct NewKeys {
  uint8_t own[wire::kKeyBytes], beacon[wire::kKeyBytes], none[wire::kKeyBytes] = {};
  uint8_t body[wire::kNewKeyBytes];
  NewKeys() {
    for (uint8_t i = 0; i < sizeof own; ++i) {
      own[i] = static_cast<uint8_t>(17 * i + 3);
      beacon[i] = static_cast<uint8_t>(5 * i + 1);
    }
  }
  // Gives them as a host does, and waits for the answer, which comes under them.
  void give(Team& team, uint32_t counter, bool by_cable = true) {
    fill_new_keys(team.world.key, counter, own, beacon, body);
    team.world.by_cable = by_cable;
    team.world.down(wire::MessageType::kNewKey, body, sizeof body, kId, counter);
    team.world.by_cable = false;
    memcpy(team.world.key, own, sizeof own);
    team.run_ms(500);
  }
};

TEST(new_keys_are_taken_kept_and_the_old_ones_are_dead) {
  Team team;
  NewKeys keys;
  keys.give(team, 9000);
  CHECK_EQUAL(1, team.sent(wire::MessageType::kAcknowledgement));
  CHECK_EQUAL(code(wire::CommandCode::kSetKey), team.answer().command);
  CHECK_EQUAL(result(wire::CommandResult::kDone), team.answer().result);
  team.world.host_counter = 9000;
  Node again(team.world);
  again.begin(team.world.now, wire::ResetCause::kPowerOn, 0);
  team.run(again, 300);
  memcpy(team.world.key, keys.none, sizeof keys.none);
  team.world.command(9, code(wire::CommandCode::kPing), 0);
  team.run(again, 300);
  CHECK_EQUAL(1, team.sent(wire::MessageType::kAcknowledgement));
  memcpy(team.world.key, keys.own, sizeof keys.own);
  team.world.command(10, code(wire::CommandCode::kPing), 0);
  team.run(again, 300);
  CHECK_EQUAL(2, team.sent(wire::MessageType::kAcknowledgement));
  team.run(again, 12000);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK(status.health & static_cast<uint8_t>(wire::Health::kKeySet));
}

TEST(a_first_key_comes_by_cable_and_the_next_ones_by_radio_too) {
  Team team;
  NewKeys keys;
  keys.give(team, 9000, false);
  memcpy(team.world.key, keys.none, sizeof keys.none);
  team.run_ms(1500);  // without a transmit status the answer was the last frame for a while
  CHECK_EQUAL(result(wire::CommandResult::kDone),
              (team.world.host_counter = 9000, ask(team, team.node, wire::CommandCode::kPing, 0).result));
  for (const bool by_cable : {true, false}) {
    team.world.count = 0;
    keys.own[5] ^= 1;
    keys.give(team, by_cable ? 9100 : 9200, by_cable);
    CHECK_EQUAL(1, team.sent(wire::MessageType::kAcknowledgement));  // under the new keys
    CHECK_EQUAL(result(wire::CommandResult::kDone), team.answer().result);
  }
}

TEST(after_keys_a_b_and_a_again_no_old_command_is_obeyed) {
  Team team;
  NewKeys a, b;
  b.own[0] ^= 1;
  a.give(team, 9000);
  team.world.host_counter = 9000;
  ask(team, team.node, wire::CommandCode::kSetTeamSize, 9);
  b.give(team, 9100);
  a.give(team, 9200);
  team.world.host_counter = 9000;  // the command of then, once more
  team.world.count = 0;
  team.world.command(99, code(wire::CommandCode::kSetTeamSize), 4);
  team.run_ms(300);
  CHECK_EQUAL(result(wire::CommandResult::kCounterRefused), team.answer().result);
  team.world.host_counter = 9200;
  CHECK_EQUAL(9, ask(team, team.node, wire::CommandCode::kSetTeamSize, 0).value);
}

TEST(after_an_erased_memory_the_same_keys_bring_no_old_command_back) {
  Team erased;
  NewKeys keys;
  keys.give(erased, 9100);
  erased.world.host_counter = 9000;  // a command from before, under the same keys
  erased.world.count = 0;
  erased.world.command(99, code(wire::CommandCode::kSetTeamSize), 4);
  erased.run_ms(300);
  CHECK_EQUAL(result(wire::CommandResult::kCounterRefused), erased.answer().result);
  erased.world.host_counter = 9100;
  CHECK_EQUAL(6, ask(erased, erased.node, wire::CommandCode::kSetTeamSize, 0).value);
}

TEST(a_beacon_comes_under_its_own_key_which_commands_nothing) {
  Team team;
  NewKeys keys;
  keys.give(team, 9000);
  team.world.host_counter = 9001;
  ask(team, team.node, wire::CommandCode::kSetStatusPeriodMs, 1000);
  send_beacon(team, 3);  // under the node's own key
  CHECK_EQUAL(0, beacon_team(team));
  memcpy(team.world.key, keys.beacon, sizeof keys.beacon);
  send_beacon(team, 3);
  team.world.command(8, code(wire::CommandCode::kSetTeamSize), 4);
  team.run_ms(300);
  memcpy(team.world.key, keys.own, sizeof keys.own);
  CHECK_EQUAL(3, beacon_team(team));
  CHECK_EQUAL(6, ask(team, team.node, wire::CommandCode::kSetTeamSize, 0).value);
}

TEST(a_power_cut_while_keys_are_stored_leaves_the_old_ones_or_the_new_ones) {
  NewKeys keys;
  fill_new_keys(keys.none, 9000, keys.own, keys.beacon, keys.body);
  uint8_t command[wire::kCommandBytes];
  const wire::Command request = {6, code(wire::CommandCode::kSetTeamSize), 9};
  wire::encode(request, command);
  bool old_seen = false, new_seen = false;
  for (uint32_t cut = 0; cut < 100; ++cut) {
    Team team;
    team.world.down(wire::MessageType::kCommand, command, sizeof command, kId, 8000);
    team.run_ms(500);
    team.world.writes_left = cut;
    team.world.by_cable = true;
    team.world.down(wire::MessageType::kNewKey, keys.body, sizeof keys.body, kId, 9000);
    team.run_ms(500);
    team.world.writes_left = 0xFFFFFFFF;
    Node again(team.world);
    again.begin(team.world.now, wire::ResetCause::kPowerOn, 0);
    team.run(again, 300);
    // What was obeyed before is not obeyed again, whichever key is in force.
    memcpy(team.world.key, keys.none, sizeof keys.none);
    team.world.count = 0;
    team.world.down(wire::MessageType::kCommand, command, sizeof command, kId, 8000);
    team.run(again, 300);
    CHECK(team.sent(wire::MessageType::kAcknowledgement) == 0 ||
          team.answer().result == result(wire::CommandResult::kCounterRefused));
    team.world.host_counter = 10000;
    uint8_t seen = 0;
    for (uint8_t which = 0; which < 2; ++which) {
      memcpy(team.world.key, which == 0 ? keys.none : keys.own, sizeof keys.own);
      team.world.count = 0;
      team.world.command(8, code(wire::CommandCode::kPing), 0);
      team.run(again, 300);
      if (team.sent(wire::MessageType::kAcknowledgement) == 0) continue;
      ++seen;
      (which == 0 ? old_seen : new_seen) = true;
    }
    CHECK_EQUAL(1, seen);
  }
  CHECK(old_seen && new_seen);
}

TEST(a_number_is_changed_with_a_restart_and_kept) {
  Team team;
  CHECK_EQUAL(result(wire::CommandResult::kDone),
              ask(team, team.node, wire::CommandCode::kSetNodeId, 12).result);
  team.run_ms(500);
  CHECK_EQUAL(1, team.world.restarts);
  Node again(team.world);
  again.begin(team.world.now, wire::ResetCause::kWatchdog, 0);
  CHECK_EQUAL(12, again.id());
  team.world.to = 5;
  Node built_in(team.world);
  built_in.begin(team.world.now, wire::ResetCause::kPowerOn, 5);
  CHECK_EQUAL(5, built_in.id());
  for (int32_t bad : {0, 255, -1, 268}) {
    CHECK_EQUAL(result(wire::CommandResult::kOutOfRange),
                ask(team, built_in, wire::CommandCode::kSetNodeId, bad).result);
  }
}

TEST(a_range_offset_of_either_sign_is_kept_and_reported) {
  Team team;
  for (int32_t bad : {-5001, 5001}) {
    CHECK_EQUAL(result(wire::CommandResult::kOutOfRange),
                ask(team, team.node, wire::CommandCode::kSetRangeOffsetMm, bad).result);
  }
  for (int32_t good : {5000, -5000, -75}) {
    ask(team, team.node, wire::CommandCode::kSetRangeOffsetMm, good);
    CHECK_EQUAL(good, ask(team, team.node, wire::CommandCode::kSetRangeOffsetMm, 6000).value);
  }
  team.run_ms(12000);
  wire::Status status;
  CHECK(team.read(wire::MessageType::kStatus, &status));
  CHECK_EQUAL(-75, status.range_offset_mm);
}

TEST(defaults_come_back_without_number_or_key_being_lost) {
  Team team;
  ask(team, team.node, wire::CommandCode::kSetLegLengthMm, 800);
  ask(team, team.node, wire::CommandCode::kSetNodeId, 12);
  team.run_ms(500);
  team.world.to = 12;
  Node again(team.world);
  again.begin(team.world.now, wire::ResetCause::kWatchdog, 0);
  ask(team, again, wire::CommandCode::kRestoreDefaults, 0);
  team.run(again, 500);
  Node third(team.world);
  third.begin(team.world.now, wire::ResetCause::kWatchdog, 0);
  CHECK_EQUAL(12, third.id());
  CHECK_EQUAL(930, ask(team, third, wire::CommandCode::kSetLegLengthMm, 0).value);
}

RUN_TESTS()
