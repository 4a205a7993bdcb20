// The driver against digi-xbee's own frames, both ways, and against a damaged stream.
#include "support/check.h"
#include "support/fake_board.h"

#include "devices/xbee.h"

using relpos::Xbee;

namespace {

struct Line : FakeBoard {
  uint8_t space = 255;       // that uart_write_space() returns
  uint8_t sent[160];
  uint8_t sent_count = 0;
  uint8_t overruns = 0;      // bytes written without space
  const uint8_t* coming = nullptr;
  uint16_t coming_count = 0;

  uint8_t uart_write_space() override { return space; }
  void uart_write(uint8_t byte) override {
    if (space == 0 || sent_count == sizeof sent) {
      ++overruns;
      return;
    }
    --space;
    sent[sent_count++] = byte;
  }
  int16_t uart_read() override {
    if (coming_count == 0) return -1;
    --coming_count;
    return *coming++;
  }
  void come(const uint8_t* bytes, uint16_t count) {
    coming = bytes;
    coming_count = count;
  }
};

struct Bench {
  Line line;
  Xbee xbee = Xbee();

  // RF payloads in what comes; the last one stays to be looked at.
  uint8_t receive(const uint8_t* bytes, uint16_t count) {
    uint8_t payloads = 0;
    line.come(bytes, count);
    while (line.coming_count > 0) payloads = static_cast<uint8_t>(payloads + xbee.step(line));
    return payloads;
  }
};

const uint8_t kTransmit[] = {0x7e, 0x00, 0x09, 0x01, 0x01, 0x00, 0x01, 0x00, 0x7d,
                             0x5e, 0x7d, 0x31, 0x48, 0x69, 0xbc};
const uint8_t kTransmitData[] = {0x7e, 0x11, 'H', 'i'};
const uint8_t kReceive16[] = {0x7e, 0x00, 0x07, 0x81, 0x00, 0x7d,
                              0x33, 0x28, 0x00, 0x48, 0x69, 0x92};
const uint8_t kReceive64[] = {0x7e, 0x00, 0x0d, 0x80, 0x00, 0x7d, 0x33, 0xa2, 0x00,
                              0x40, 0x52, 0x2b, 0xaa, 0x28, 0x00, 0x48, 0x69, 0x8a};
const uint8_t kStatusGood[] = {0x7e, 0x00, 0x03, 0x89, 0x01, 0x00, 0x75};
const uint8_t kStatusNoAck[] = {0x7e, 0x00, 0x03, 0x89, 0x01, 0x01, 0x74};
// Its checksum is the delimiter.
const uint8_t kAtResponse[] = {0x7e, 0x00, 0x07, 0x88, 0x52, 0x4d, 0x59, 0x00,
                               0x00, 0x01, 0x7d, 0x5e};
const uint8_t kZigbeeStatus[] = {0x7e, 0x00, 0x07, 0x8b, 0x01, 0x7d, 0x5d,
                                 0x84, 0x00, 0x00, 0x00, 0x72};

// An RX16 frame of so many bytes 0x55 from 0x0002. Returns its length.
uint8_t make_frame(uint8_t* frame, uint8_t payload) {
  const uint8_t header[] = {0x7e, 0x00, static_cast<uint8_t>(5 + payload), 0x81, 0x00, 0x02, 0x30,
                            0x00};
  memcpy(frame, header, sizeof header);
  memset(frame + sizeof header, 0x55, payload);
  uint8_t sum = 0;
  const uint8_t end = static_cast<uint8_t>(sizeof header + payload);
  for (uint8_t i = 3; i < end; ++i) sum = static_cast<uint8_t>(sum + frame[i]);
  frame[end] = static_cast<uint8_t>(0xFF - sum);
  return static_cast<uint8_t>(end + 1);
}

}  // namespace

TEST(what_is_sent_is_digis_own_frame) {
  Bench bench;
  CHECK(bench.xbee.send(0x0001, kTransmitData, sizeof kTransmitData));
  CHECK(bench.xbee.busy());
  CHECK(!bench.xbee.step(bench.line));
  CHECK(!bench.xbee.busy());
  CHECK_EQUAL(sizeof kTransmit, bench.line.sent_count);
  CHECK_BYTES(kTransmit, bench.line.sent, sizeof kTransmit);
}

TEST(a_uart_with_space_for_one_byte_gets_the_same_frame) {
  Bench bench;
  CHECK(bench.xbee.send(0x0001, kTransmitData, sizeof kTransmitData));
  for (uint8_t i = 0; i < sizeof kTransmit; ++i) {
    CHECK(bench.xbee.busy());
    bench.line.space = 0;
    bench.xbee.step(bench.line);
    CHECK_EQUAL(i, bench.line.sent_count);
    bench.line.space = 1;
    bench.xbee.step(bench.line);
    CHECK_EQUAL(i + 1, bench.line.sent_count);
  }
  CHECK(!bench.xbee.busy());
  CHECK_EQUAL(0, bench.line.overruns);
  CHECK_BYTES(kTransmit, bench.line.sent, sizeof kTransmit);
}

TEST(a_frame_under_way_is_not_replaced) {
  Bench bench;
  bench.line.space = 3;
  CHECK(bench.xbee.send(0x0001, kTransmitData, sizeof kTransmitData));
  bench.xbee.step(bench.line);
  CHECK(!bench.xbee.send(0x0002, kStatusGood, sizeof kStatusGood));
  bench.line.space = 255;
  bench.xbee.step(bench.line);
  CHECK_BYTES(kTransmit, bench.line.sent, sizeof kTransmit);
}

TEST(every_byte_but_the_first_delimiter_is_escaped) {
  Bench bench;
  // Length 0x11, destination 0x7d13, and a checksum of 0x7e.
  const uint8_t data[] = {0x13, 0x7d, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x5f};
  const uint8_t expected[] = {0x7e, 0x00, 0x7d, 0x31, 0x01, 0x01, 0x7d, 0x5d, 0x7d, 0x33, 0x00,
                              0x7d, 0x33, 0x7d, 0x5d, 0,    0,    0,    0,    0,    0,    0,
                              0,    0,    0x5f, 0x7d, 0x5e};
  CHECK(bench.xbee.send(0x7d13, data, sizeof data));
  bench.xbee.step(bench.line);
  CHECK_EQUAL(sizeof expected, bench.line.sent_count);
  CHECK_BYTES(expected, bench.line.sent, sizeof expected);
}

TEST(the_frame_id_is_never_0) {
  Bench bench;
  for (uint16_t i = 1; i <= 256; ++i) {
    bench.line.sent_count = 0;
    bench.line.space = 255;
    CHECK(bench.xbee.send(0, nullptr, 0));
    bench.xbee.step(bench.line);
    CHECK(!bench.xbee.busy());
    uint8_t id = bench.line.sent[4];
    if (id == 0x7d) id = bench.line.sent[5] ^ 0x20;
    CHECK_EQUAL(i == 256 ? 1 : i, id);
  }
}

TEST(a_payload_from_a_16_bit_address_arrives) {
  Bench bench;
  CHECK_EQUAL(1, bench.receive(kReceive16, sizeof kReceive16));
  CHECK_EQUAL(2, bench.xbee.received_length());
  CHECK_BYTES("Hi", bench.xbee.received(), 2);
  CHECK_EQUAL(0, bench.xbee.bad_frames());
}

TEST(a_payload_from_a_64_bit_address_arrives) {
  Bench bench;
  CHECK_EQUAL(1, bench.receive(kReceive64, sizeof kReceive64));
  CHECK_EQUAL(2, bench.xbee.received_length());
  CHECK_BYTES("Hi", bench.xbee.received(), 2);
}

// The options that the host's cable sets; the kinds of XBee set bits 1 and 2 alone.
TEST(only_a_frame_with_the_cables_options_came_by_cable) {
  Bench bench;
  for (uint16_t options = 0; options < 256; ++options) {
    if (options == 0x7E || options == 0x7D || options == 0x11 || options == 0x13) continue;
    const uint8_t sum = static_cast<uint8_t>(0xFF - 0x81 - 0x28 - options - 'H');
    if (sum == 0x7E || sum == 0x7D || sum == 0x11 || sum == 0x13) continue;
    const uint8_t frame[] = {0x7E, 0, 6, 0x81, 0, 0, 0x28, static_cast<uint8_t>(options), 'H', sum};
    CHECK_EQUAL(1, bench.receive(frame, sizeof frame));
    CHECK_EQUAL(options == relpos::wire::kCableOptions, bench.xbee.by_cable());
  }
}

TEST(a_frame_that_comes_byte_by_byte_arrives) {
  Bench bench;
  for (uint8_t i = 0; i < sizeof kReceive16; ++i) {
    CHECK_EQUAL(i + 1 == sizeof kReceive16, bench.receive(kReceive16 + i, 1));
    CHECK(!(i + 1U < sizeof kReceive16 && bench.xbee.step(bench.line)));
  }
  CHECK_BYTES("Hi", bench.xbee.received(), 2);
}

TEST(two_frames_at_once_arrive_one_a_step) {
  Bench bench;
  uint8_t both[sizeof kReceive64 + sizeof kReceive16];
  memcpy(both, kReceive64, sizeof kReceive64);
  memcpy(both + sizeof kReceive64, kReceive16, sizeof kReceive16);
  bench.line.come(both, sizeof both);
  CHECK(bench.xbee.step(bench.line));
  CHECK(bench.xbee.step(bench.line));
  CHECK(!bench.xbee.step(bench.line));
}

TEST(only_a_frame_that_is_reported_as_delivered_is_delivered) {
  Bench bench;
  const uint8_t data[1] = {1};
  CHECK(bench.xbee.send(0, data, sizeof data));  // frame id 1, as in the status frames
  CHECK(bench.xbee.undelivered());
  CHECK_EQUAL(0, bench.receive(kStatusNoAck, sizeof kStatusNoAck));
  CHECK(bench.xbee.undelivered());
  const uint8_t another_s[] = {0x7e, 0x00, 0x03, 0x89, 0x02, 0x00, 0x74};
  CHECK_EQUAL(0, bench.receive(another_s, sizeof another_s));
  CHECK(bench.xbee.undelivered());
  CHECK_EQUAL(0, bench.receive(kStatusGood, sizeof kStatusGood));
  CHECK(!bench.xbee.undelivered());
  CHECK_EQUAL(0, bench.xbee.bad_frames());
}

TEST(frames_of_other_types_are_counted_and_passed_over) {
  Bench bench;
  CHECK_EQUAL(0, bench.receive(kAtResponse, sizeof kAtResponse));
  CHECK_EQUAL(0, bench.receive(kZigbeeStatus, sizeof kZigbeeStatus));
  CHECK_EQUAL(2, bench.xbee.bad_frames());
  // One that no buffer of the node could hold: 0x120 bytes of 0x00 after the type 0x97.
  const uint8_t head[] = {0x7e, 0x01, 0x21, 0x97};
  const uint8_t none = 0x00;
  const uint8_t checksum = 0x68;
  CHECK_EQUAL(0, bench.receive(head, sizeof head));
  for (uint16_t i = 0; i < 0x120; ++i) CHECK_EQUAL(0, bench.receive(&none, 1));
  CHECK_EQUAL(0, bench.receive(&checksum, 1));
  CHECK_EQUAL(3, bench.xbee.bad_frames());
  CHECK_EQUAL(1, bench.receive(kReceive16, sizeof kReceive16));
  CHECK_EQUAL(3, bench.xbee.bad_frames());
}

TEST(garbage_between_frames_loses_none) {
  Bench bench;
  const uint8_t garbage[] = {0x00, 0x81, 0x7d, 0xff, 0x33, 0x7d};
  CHECK_EQUAL(0, bench.receive(garbage, sizeof garbage));
  CHECK_EQUAL(1, bench.receive(kReceive16, sizeof kReceive16));
  CHECK_EQUAL(0, bench.receive(garbage, sizeof garbage));
  CHECK_EQUAL(1, bench.receive(kReceive64, sizeof kReceive64));
}

TEST(a_frame_broken_off_anywhere_costs_only_itself) {
  for (uint8_t kept = 1; kept < sizeof kReceive16; ++kept) {
    Bench bench;
    CHECK_EQUAL(0, bench.receive(kReceive16, kept));
    CHECK_EQUAL(1, bench.receive(kReceive64, sizeof kReceive64));
    CHECK_EQUAL(1, bench.xbee.bad_frames());
    CHECK_EQUAL(2, bench.xbee.received_length());
  }
}

TEST(no_damaged_bit_of_a_payload_gets_through) {
  for (uint8_t at = 3; at < sizeof kReceive16; ++at) {
    for (uint8_t bit = 0; bit < 8; ++bit) {
      uint8_t damaged[sizeof kReceive16];
      memcpy(damaged, kReceive16, sizeof damaged);
      damaged[at] = static_cast<uint8_t>(damaged[at] ^ 1 << bit);
      Bench bench;
      CHECK_EQUAL(0, bench.receive(damaged, sizeof damaged));
      CHECK_EQUAL(1, bench.receive(kReceive64, sizeof kReceive64));
      CHECK(bench.xbee.bad_frames() > 0);
    }
  }
}

TEST(lengths_that_cannot_be_are_refused) {
  const uint8_t empty[] = {0x7e, 0x00, 0x00, 0xff};
  const uint8_t short16[] = {0x7e, 0x00, 0x04, 0x81, 0x00, 0x02, 0x28, 0x54};
  const uint8_t short64[] = {0x7e, 0x00, 0x05, 0x80, 0x00, 0x02, 0x28, 0x00, 0x55};
  const uint8_t short_status[] = {0x7e, 0x00, 0x02, 0x89, 0x01, 0x75};
  Bench bench;
  CHECK_EQUAL(0, bench.receive(empty, sizeof empty));
  CHECK_EQUAL(1, bench.xbee.bad_frames());
  CHECK_EQUAL(0, bench.receive(short16, sizeof short16));
  CHECK_EQUAL(2, bench.xbee.bad_frames());
  CHECK_EQUAL(0, bench.receive(short64, sizeof short64));
  CHECK_EQUAL(3, bench.xbee.bad_frames());
  CHECK_EQUAL(0, bench.receive(short_status, sizeof short_status));
  CHECK_EQUAL(4, bench.xbee.bad_frames());
  const uint8_t type_alone[] = {0x7e, 0x00, 0x01, 0x81, 0x7d, 0x5e};  // its checksum is 0x7e
  CHECK_EQUAL(0, bench.receive(type_alone, sizeof type_alone));
  CHECK_EQUAL(5, bench.xbee.bad_frames());
  CHECK_EQUAL(1, bench.receive(kReceive16, sizeof kReceive16));
  CHECK_EQUAL(5, bench.xbee.bad_frames());
}

TEST(the_longest_payload_fits_and_one_byte_more_is_refused) {
  uint8_t frame[80];
  Bench bench;
  uint8_t length = make_frame(frame, Xbee::kMostPayload);
  CHECK_EQUAL(1, bench.receive(frame, length));
  CHECK_EQUAL(Xbee::kMostPayload, bench.xbee.received_length());
  CHECK_BYTES(frame + 8, bench.xbee.received(), Xbee::kMostPayload);
  length = make_frame(frame, Xbee::kMostPayload + 1);
  CHECK_EQUAL(0, bench.receive(frame, length));
  CHECK_EQUAL(1, bench.xbee.bad_frames());
  length = make_frame(frame, 0);
  CHECK_EQUAL(1, bench.receive(frame, length));
  CHECK_EQUAL(0, bench.xbee.received_length());
}

TEST(sending_goes_on_while_frames_come) {
  Bench bench;
  CHECK(bench.xbee.send(0x0001, kTransmitData, sizeof kTransmitData));
  for (uint8_t i = 0; i < sizeof kTransmit; ++i) {
    bench.line.space = 1;
    CHECK_EQUAL(1, bench.receive(kReceive16, sizeof kReceive16));
  }
  CHECK(!bench.xbee.busy());
  CHECK_BYTES(kTransmit, bench.line.sent, sizeof kTransmit);
}

RUN_TESTS()
