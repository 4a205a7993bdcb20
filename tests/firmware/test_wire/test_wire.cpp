// The golden frames of protocol/vectors/frames.json, which the Python side is held to as well.
#include "support/check.h"

#include "wire/frame.h"

#include "vectors.h"

namespace wire = relpos::wire;
using wire::FrameStatus;
using wire::Header;

namespace {

// Structures have padding on the PC, so values are compared one by one.
bool same(const wire::Motion& a, const wire::Motion& b) {
  return a.time_ms == b.time_ms && a.x_mm == b.x_mm && a.y_mm == b.y_mm &&
         a.heading_100urad == b.heading_100urad && a.path_mm == b.path_mm && a.steps == b.steps &&
         a.variance_along_mm2 == b.variance_along_mm2 &&
         a.variance_across_mm2 == b.variance_across_mm2 &&
         a.variance_heading_100urad2 == b.variance_heading_100urad2 &&
         a.height_cm == b.height_cm && a.magnetic_heading_100urad == b.magnetic_heading_100urad &&
         a.state == b.state && a.gain_version == b.gain_version && a.quality == b.quality;
}

bool same(const wire::Ranges& a, const wire::Ranges& b) {
  if (a.time_ms != b.time_ms || a.count != b.count) return false;
  for (uint8_t i = 0; i < a.count; ++i) {
    const wire::RangeEntry& x = a.entries[i];
    const wire::RangeEntry& y = b.entries[i];
    if (x.peer != y.peer || x.range_mm != y.range_mm || x.rss_dbm != y.rss_dbm ||
        x.age_ms != y.age_ms || x.quality != y.quality) {
      return false;
    }
  }
  return true;
}

bool same(const wire::Status& a, const wire::Status& b) {
  return a.time_ms == b.time_ms && a.firmware_major == b.firmware_major &&
         a.firmware_minor == b.firmware_minor && a.firmware_patch == b.firmware_patch &&
         a.uptime_s == b.uptime_s && a.reset_cause == b.reset_cause &&
         a.battery_mv == b.battery_mv && a.bus_errors == b.bus_errors &&
         a.ranging_successes == b.ranging_successes && a.ranging_failures == b.ranging_failures &&
         a.worst_tick_us == b.worst_tick_us && a.missed_ticks == b.missed_ticks &&
         a.free_stack_bytes == b.free_stack_bytes && a.bad_frames == b.bad_frames &&
         a.dropped_ranges == b.dropped_ranges && a.dropped_steps == b.dropped_steps &&
         a.damaged_bytes == b.damaged_bytes && a.lost_bytes == b.lost_bytes &&
         a.ranging_error == b.ranging_error && a.radio_failures == b.radio_failures &&
         a.refused_frames == b.refused_frames && a.range_offset_mm == b.range_offset_mm &&
         a.neighbours == b.neighbours && a.team == b.team && a.health == b.health;
}

bool same(const wire::Steps& a, const wire::Steps& b) {
  if (a.time_ms != b.time_ms || a.count != b.count) return false;
  for (uint8_t i = 0; i < a.count; ++i) {
    if (a.entries[i].age_ms != b.entries[i].age_ms ||
        a.entries[i].length_mm != b.entries[i].length_mm) {
      return false;
    }
  }
  return true;
}

bool same(const wire::Samples& a, const wire::Samples& b) {
  return a.time_ms == b.time_ms && a.acceleration_x_10um_s2 == b.acceleration_x_10um_s2 &&
         a.acceleration_y_10um_s2 == b.acceleration_y_10um_s2 &&
         a.acceleration_z_10um_s2 == b.acceleration_z_10um_s2 &&
         a.angular_rate_x_10urad_s == b.angular_rate_x_10urad_s &&
         a.angular_rate_y_10urad_s == b.angular_rate_y_10urad_s &&
         a.angular_rate_z_10urad_s == b.angular_rate_z_10urad_s && a.field_x_10pt == b.field_x_10pt &&
         a.field_y_10pt == b.field_y_10pt && a.field_z_10pt == b.field_z_10pt && a.samples == b.samples &&
         a.field_readings == b.field_readings;
}

bool same(const wire::Command& a, const wire::Command& b) {
  return a.token == b.token && a.command == b.command && a.value == b.value;
}

bool same(const wire::Acknowledgement& a, const wire::Acknowledgement& b) {
  return a.token == b.token && a.command == b.command && a.result == b.result &&
         a.value == b.value;
}

bool same(const wire::Beacon& a, const wire::Beacon& b) {
  if (a.phase_ms != b.phase_ms || a.period_ms != b.period_ms || a.round != b.round ||
      a.count != b.count) {
    return false;
  }
  for (uint8_t i = 0; i < a.count; ++i) {
    if (a.entries[i].node != b.entries[i].node) return false;
  }
  return true;
}

bool same(const wire::NewKey& a, const wire::NewKey& b) {
  return a.token == b.token && a.masked_0 == b.masked_0 && a.masked_1 == b.masked_1 &&
         a.masked_2 == b.masked_2 && a.masked_3 == b.masked_3 && a.masked_4 == b.masked_4 &&
         a.masked_5 == b.masked_5 && a.masked_6 == b.masked_6 && a.masked_7 == b.masked_7;
}

template <typename Message>
void check_both_ways(wire::MessageType type, uint8_t node, uint8_t boot, uint32_t counter,
                     const uint8_t* key, const uint8_t* golden, uint8_t golden_count,
                     const Message& values) {
  uint8_t frame[wire::kFrameBytes];
  const uint8_t body_length = wire::encode(values, frame + wire::kHeaderBytes);
  const Header header = {type, node, boot, counter};
  CHECK_EQUAL(golden_count, wire::seal(header, body_length, key, frame));
  CHECK_BYTES(golden, frame, golden_count);

  Header opened = {wire::MessageType::kMotion, 0, 0, 0};
  CHECK_EQUAL(FrameStatus::kGood, wire::open(golden, golden_count, key, &opened));
  CHECK_EQUAL(type, opened.type);
  CHECK_EQUAL(node, opened.node);
  CHECK_EQUAL(boot, opened.boot);
  CHECK(counter == opened.counter);
  Message decoded = {};
  CHECK(wire::decode(golden + wire::kHeaderBytes,
                     static_cast<uint8_t>(golden_count - wire::kOverhead),
                     &decoded));
  CHECK(same(values, decoded));
}

void check_damage(const uint8_t* golden, uint8_t count, const uint8_t* key) {
  uint8_t frame[wire::kFrameBytes];
  memcpy(frame, golden, count);
  for (uint16_t bit = 0; bit < 8U * count; ++bit) {
    const uint8_t flip = static_cast<uint8_t>(1 << bit % 8);
    frame[bit / 8] ^= flip;
    Header header;
    CHECK(wire::open(frame, count, key, &header) != FrameStatus::kGood);
    frame[bit / 8] ^= flip;
  }
}

}  // namespace

#define BOTH_WAYS(type, name)                                                                  \
  check_both_ways(wire::MessageType::type, vectors::name##Node, vectors::name##Boot,           \
                  vectors::name##Counter, vectors::name##Key, vectors::name##Bytes,            \
                  sizeof vectors::name##Bytes, vectors::name)

TEST(motion_frames_are_the_golden_ones) {
  BOTH_WAYS(kMotion, kMotionAtStart);
  BOTH_WAYS(kMotion, kMotionWalking);
  BOTH_WAYS(kMotion, kMotionWrapping);
}

TEST(ranges_frames_are_the_golden_ones) {
  BOTH_WAYS(kRanges, kRangesNone);
  BOTH_WAYS(kRanges, kRangesFive);
}

TEST(status_frames_are_the_golden_ones) { BOTH_WAYS(kStatus, kStatus); }

TEST(steps_frames_are_the_golden_ones) { BOTH_WAYS(kSteps, kSteps); }

TEST(samples_frames_are_the_golden_ones) { BOTH_WAYS(kSamples, kSamples); }

TEST(command_frames_are_the_golden_ones) { BOTH_WAYS(kCommand, kCommand); }

TEST(beacon_frames_are_the_golden_ones) {
  BOTH_WAYS(kBeacon, kBeacon);
  BOTH_WAYS(kBeacon, kBeaconOfNobody);
}

TEST(new_key_frames_are_the_golden_ones) { BOTH_WAYS(kNewKey, kNewKey); }

TEST(acknowledgement_frames_are_the_golden_ones) { BOTH_WAYS(kAcknowledgement, kAcknowledgement); }

TEST(no_single_damaged_bit_gets_through) {
  check_damage(vectors::kMotionWalkingBytes, sizeof vectors::kMotionWalkingBytes, vectors::kMotionWalkingKey);
  check_damage(vectors::kRangesFiveBytes, sizeof vectors::kRangesFiveBytes, vectors::kRangesFiveKey);
  check_damage(vectors::kCommandBytes, sizeof vectors::kCommandBytes, vectors::kCommandKey);
}

TEST(a_frame_cut_short_anywhere_is_refused) {
  for (uint8_t count = 0; count < sizeof vectors::kMotionWalkingBytes; ++count) {
    Header header;
    CHECK(wire::open(vectors::kMotionWalkingBytes, count, vectors::kMotionWalkingKey, &header) != FrameStatus::kGood);
  }
}

TEST(a_foreign_version_is_distinguished_from_damage) {
  uint8_t frame[sizeof vectors::kCommandBytes];
  memcpy(frame, vectors::kCommandBytes, sizeof frame);
  Header header;
  for (uint8_t version = 0; version < 6; ++version) {
    if (version == wire::kProtocolVersion) continue;
    frame[1] = version;
    CHECK_EQUAL(FrameStatus::kForeignVersion, wire::open(frame, sizeof frame, vectors::kCommandKey, &header));
  }
  // The version is checked even where the length differs.
  CHECK_EQUAL(FrameStatus::kForeignVersion, wire::open(frame, 3, vectors::kCommandKey, &header));
  frame[0] ^= 1;
  CHECK_EQUAL(FrameStatus::kNotOurs, wire::open(frame, sizeof frame, vectors::kCommandKey, &header));
  frame[0] ^= 1;
  frame[1] = wire::kProtocolVersion;
  CHECK_EQUAL(FrameStatus::kBadLength, wire::open(frame, 3, vectors::kCommandKey, &header));
  frame[4] ^= 1;
  CHECK_EQUAL(FrameStatus::kBadCrc, wire::open(frame, sizeof frame, vectors::kCommandKey, &header));
}

TEST(another_layout_of_the_same_version_is_refused) {
  const uint8_t count = sizeof vectors::kCommandBytes;
  uint8_t frame[count];
  memcpy(frame, vectors::kCommandBytes, count);
  const uint16_t crc = wire::crc16(frame, count - 10, wire::kFingerprint ^ 1);
  frame[count - 10] = static_cast<uint8_t>(crc);
  frame[count - 9] = static_cast<uint8_t>(crc >> 8);
  Header header;
  CHECK_EQUAL(FrameStatus::kBadCrc, wire::open(frame, count, vectors::kCommandKey, &header));
}

TEST(a_forged_frame_with_a_good_crc_is_refused) {
  const uint8_t count = sizeof vectors::kCommandBytes;
  uint8_t frame[count];
  for (uint16_t bit = 16; bit < 8U * (count - 10); ++bit) {
    memcpy(frame, vectors::kCommandBytes, count);
    frame[bit / 8] ^= static_cast<uint8_t>(1 << bit % 8);
    const uint16_t crc = wire::crc16(frame, count - 10);
    frame[count - 10] = static_cast<uint8_t>(crc);
    frame[count - 9] = static_cast<uint8_t>(crc >> 8);
    Header header;
    CHECK_EQUAL(FrameStatus::kBadTag, wire::open(frame, count, vectors::kCommandKey, &header));
  }
}

TEST(another_teams_frame_is_refused) {
  uint8_t key[wire::kKeyBytes];
  memcpy(key, vectors::kCommandKey, sizeof key);
  key[15] ^= 1;
  Header header;
  CHECK_EQUAL(FrameStatus::kBadTag,
              wire::open(vectors::kCommandBytes, sizeof vectors::kCommandBytes, key, &header));
}

// framing.masked_keys(bytes(range(16)), 0x0605, 0x01020304, bytes(32)), from PyPI's siphash24.
TEST(new_keys_come_out_from_under_their_mask) {
  uint8_t keys[2 * wire::kKeyBytes] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
  const uint8_t body[wire::kNewKeyBytes] = {
      0x05, 0x06, 0x52, 0xb6, 0xdb, 0x32, 0xf8, 0x25, 0x04, 0xab, 0xb6, 0x4e,
      0x98, 0x76, 0xc9, 0x6c, 0xf8, 0xa3, 0x56, 0xeb, 0xa5, 0xbe, 0xcc, 0x48,
      0x79, 0xdb, 0x8d, 0x24, 0x9c, 0xb6, 0x71, 0x15, 0xd8, 0xd5};
  wire::unmask_keys(0x01020304, body, keys);
  const uint8_t zero[sizeof keys] = {};
  CHECK_BYTES(zero, keys, sizeof keys);
}

// CRC-16/CCITT-FALSE of "123456789" in the catalogue of parametrised CRC algorithms.
TEST(the_crc_is_the_catalogues) {
  const uint8_t digits[] = {'1', '2', '3', '4', '5', '6', '7', '8', '9'};
  CHECK_EQUAL(0x29B1, wire::crc16(digits, sizeof digits, 0xFFFF));
}

TEST(a_value_outside_its_range_is_not_sent) {
  uint8_t body[wire::kFrameBytes];
  wire::Ranges ranges = vectors::kRangesFive;
  ranges.entries[4].range_mm = 0;
  CHECK_EQUAL(0, wire::encode(ranges, body));
  ranges.entries[4].range_mm = 200001;
  CHECK_EQUAL(0, wire::encode(ranges, body));
  ranges.entries[4].range_mm = 200000;
  CHECK_EQUAL(wire::kRangesBytes, wire::encode(ranges, body));
  ranges.count = wire::kMostRanges + 1;
  CHECK_EQUAL(0, wire::encode(ranges, body));
}

TEST(a_body_of_another_length_is_refused) {
  const uint8_t* body = vectors::kRangesFiveBytes + wire::kHeaderBytes;
  wire::Ranges ranges;
  CHECK(wire::decode(body, wire::kRangesBytes, &ranges));
  CHECK(!wire::decode(body, wire::kRangesBytes - 1, &ranges));
  CHECK(!wire::decode(body, wire::kRangesBytes - 8, &ranges));
  CHECK(!wire::decode(body, 4, &ranges));
}

RUN_TESTS()
