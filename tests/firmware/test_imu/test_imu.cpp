// MPU-9150 and AK8975 against chips that answer as their register maps say.
#include "support/check.h"
#include "support/fake_board.h"

#include "devices/ak8975.h"
#include "devices/mpu9150.h"

using relpos::Ak8975;
using relpos::BusStatus;
using relpos::Mpu9150;

namespace {

// Both chips as register files; what reading or writing does besides is in the two functions.
struct Chips : FakeBoard {
  bool present = true;
  bool stuck = false;
  uint8_t loose = 0;  // every so many-th transaction is not acknowledged
  uint8_t inertial[128] = {};
  uint8_t field[0x13] = {};
  uint8_t asa[3] = {128, 128, 128};
  uint16_t transactions = 0;
  uint8_t singles = 0;  // measurements asked of the magnetometer

  Chips() {
    inertial[0x75] = 0x68;
    inertial[0x6B] = 0x40;  // boots asleep
    field[0x00] = 0x48;
  }
  bool bypassed() const { return (inertial[0x37] & 0x02) != 0 && (inertial[0x6A] & 0x20) == 0; }
  void sample(const int16_t* seven) {
    for (uint8_t i = 0; i < 7; ++i) {
      inertial[0x3B + 2 * i] = static_cast<uint8_t>(static_cast<uint16_t>(seven[i]) >> 8);
      inertial[0x3C + 2 * i] = static_cast<uint8_t>(seven[i]);
    }
    inertial[0x3A] |= 0x01;
  }

 protected:
  BusStatus i2c_transfer(uint8_t address, const uint8_t* first, uint8_t first_count,
                         const uint8_t*, uint8_t, uint8_t* read, uint8_t read_count) override {
    ++transactions;
    if (stuck) return BusStatus::kTimeout;
    if (!present || (loose != 0 && transactions % loose == 0)) return BusStatus::kAddressNack;
    if (address == 0x68) {
      if (first_count == 2) {
        inertial[first[0]] = first[1];
        if (first[0] == 0x6B && (first[1] & 0x80) != 0) {
          inertial[0x6B] = 0x40;
          inertial[0x37] = inertial[0x19] = inertial[0x1A] = inertial[0x1B] = inertial[0x1C] = 0;
        }
      }
      for (uint8_t i = 0; i < read_count; ++i) read[i] = inertial[first[0] + i];
      if (read_count == 1 && first[0] == 0x3A) inertial[0x3A] = 0;
      return BusStatus::kOk;
    }
    if (address != 0x0C || !bypassed()) return BusStatus::kAddressNack;
    if (first_count == 2) {
      field[first[0]] = first[1];
      if (first[0] == 0x0A && first[1] == 0x01) ++singles;
    }
    for (uint8_t i = 0; i < read_count; ++i) {
      const uint8_t at = static_cast<uint8_t>(first[0] + i);
      read[i] = at < 0x10 ? field[at] : field[0x0A] == 0x0F ? asa[at - 0x10] : 0;
    }
    return BusStatus::kOk;
  }
};

// Steps until a sample is announced or `most_us` have passed; the time goes on in *now_us.
bool ready(Mpu9150& imu, Chips& chips, uint32_t* now_us, uint32_t most_us) {
  for (const uint32_t start_us = *now_us; *now_us - start_us < most_us;) {
    uint32_t wait_us = 0;
    if (imu.step(chips, *now_us, &wait_us) == Mpu9150::Event::kReady) return true;
    *now_us += wait_us;
  }
  return false;
}

void set_up(Mpu9150& imu, Chips& chips, uint32_t* now_us) {
  for (uint8_t i = 0; i < 20 && !imu.running(); ++i) {
    uint32_t wait_us = 0;
    imu.step(chips, *now_us, &wait_us);
    *now_us += wait_us;
  }
}

}  // namespace

TEST(set_up_waits_for_the_chip_and_chooses_50_hz_21_hz_1000_dps_4_g_bypass) {
  Chips chips;
  Mpu9150 imu = Mpu9150();
  uint32_t now_us = 0;
  set_up(imu, chips, &now_us);
  CHECK(imu.running());
  CHECK(now_us >= 200000);  // two waits of 100 ms
  CHECK_EQUAL(0x01, chips.inertial[0x6B]);
  CHECK_EQUAL(19, chips.inertial[0x19]);
  CHECK_EQUAL(4, chips.inertial[0x1A]);
  CHECK_EQUAL(0x10, chips.inertial[0x1B]);
  CHECK_EQUAL(0x08, chips.inertial[0x1C]);
  CHECK(chips.bypassed());
}

TEST(a_sample_comes_in_si_units) {
  Chips chips;
  Mpu9150 imu = Mpu9150();
  uint32_t now_us = 0;
  set_up(imu, chips, &now_us);
  const int16_t raw[7] = {8192, -8192, 32767, 0, -32768, 655, 1};
  chips.sample(raw);
  CHECK(ready(imu, chips, &now_us, 30000));
  float force[3], rate[3];
  CHECK(imu.read(chips, force, rate));
  CHECK_NEAR(9.80665f, force[0], 1e-4f);
  CHECK_NEAR(-9.80665f, force[1], 1e-4f);
  CHECK_NEAR(39.2254f, force[2], 1e-3f);
  CHECK_NEAR(-17.436270f, rate[0], 1e-4f);      // 999 deg/s
  CHECK_NEAR(0.3489f, rate[1], 1e-3f);          // 20 deg/s
  CHECK_NEAR(0.000532113f, rate[2], 1e-8f);     // 1 / 32.8 deg/s (data sheet)
}

TEST(a_sample_is_not_announced_twice) {
  Chips chips;
  Mpu9150 imu = Mpu9150();
  uint32_t now_us = 0;
  set_up(imu, chips, &now_us);
  const int16_t raw[7] = {};
  chips.sample(raw);
  CHECK(ready(imu, chips, &now_us, 30000));
  CHECK(!ready(imu, chips, &now_us, 60000));
}

TEST(another_chip_at_the_address_is_not_set_up) {
  Chips chips;
  chips.inertial[0x75] = 0x71;  // an MPU-9250
  Mpu9150 imu = Mpu9150();
  uint32_t now_us = 0;
  while (now_us < 3000000) {
    CHECK(!ready(imu, chips, &now_us, 1));
    CHECK(!imu.running());
    CHECK_EQUAL(0x40, chips.inertial[0x6B]);
  }
  CHECK_EQUAL(3, chips.transactions);  // once a second
}

TEST(a_sample_from_before_the_set_up_is_not_announced) {
  Chips chips;
  Mpu9150 imu = Mpu9150();
  const int16_t raw[7] = {};
  chips.sample(raw);  // at another range
  uint32_t now_us = 0;
  set_up(imu, chips, &now_us);
  CHECK(!ready(imu, chips, &now_us, 60000));
}

TEST(a_chip_that_fell_asleep_is_set_up_anew) {
  Chips chips;
  Mpu9150 imu = Mpu9150();
  uint32_t now_us = 0xFFFFFF00u;  // and the clock wraps meanwhile
  set_up(imu, chips, &now_us);
  chips.inertial[0x6B] = 0x40;  // brown-out: defaults, no more samples
  chips.inertial[0x19] = 0;
  CHECK(!ready(imu, chips, &now_us, 150000));
  CHECK(!imu.running());
  set_up(imu, chips, &now_us);
  CHECK(imu.running());
  CHECK_EQUAL(19, chips.inertial[0x19]);
  CHECK_EQUAL(0x01, chips.inertial[0x6B]);
}

TEST(a_stuck_bus_is_asked_rarely_and_counted) {
  Chips chips;
  Mpu9150 imu = Mpu9150();
  uint32_t now_us = 0;
  set_up(imu, chips, &now_us);
  chips.stuck = true;
  const uint16_t before = chips.transactions;
  CHECK(!ready(imu, chips, &now_us, 150000));
  CHECK(imu.running());
  CHECK(!ready(imu, chips, &now_us, 10000000));
  CHECK(chips.transactions - before <= 35 + 10);  // 0.175 s, then once a second
  CHECK(chips.bus_errors() >= chips.transactions - before);
  CHECK(!imu.running());
  chips.stuck = false;
  set_up(imu, chips, &now_us);
  CHECK(imu.running());
}

TEST(a_sample_that_repeats_the_former_one_is_not_used_and_the_chip_is_set_up_anew) {
  Chips chips;
  Mpu9150 imu = Mpu9150();
  uint32_t now_us = 0;
  set_up(imu, chips, &now_us);
  const int16_t raw[7] = {100, 200, 8192, 0, 1, 2, 3};
  const int16_t other[7] = {100, 201, 8192, 0, 1, 2, 3};
  float force[3], rate[3];
  chips.sample(raw);
  CHECK(ready(imu, chips, &now_us, 30000));
  CHECK(imu.read(chips, force, rate));
  for (uint8_t i = 0; i < 35; ++i) {
    CHECK(imu.running());
    chips.sample(raw);
    CHECK(ready(imu, chips, &now_us, 30000));
    CHECK(!imu.read(chips, force, rate));
    now_us += 20000;
  }
  CHECK(!imu.running());
  set_up(imu, chips, &now_us);
  CHECK(imu.running());
  chips.sample(raw);  // still
  CHECK(ready(imu, chips, &now_us, 30000));
  CHECK(!imu.read(chips, force, rate));
  chips.sample(other);
  CHECK(ready(imu, chips, &now_us, 30000));
  CHECK(imu.read(chips, force, rate));
}

TEST(a_sample_from_a_chip_that_is_not_set_up_as_it_was_is_not_used) {
  Chips chips;
  Mpu9150 imu = Mpu9150();
  uint32_t now_us = 0;
  set_up(imu, chips, &now_us);
  float force[3], rate[3];
  for (uint8_t reg = 0x37; reg <= 0x38; ++reg) {
    const int16_t raw[7] = {reg, 200, 8192, 0, 1, 2, 3};
    const uint8_t was = chips.inertial[reg];
    chips.inertial[reg] = reg == 0x37 ? 0x00 : 0xFF;
    chips.sample(raw);
    CHECK(ready(imu, chips, &now_us, 30000));
    CHECK(!imu.read(chips, force, rate));
    chips.inertial[reg] = was;
  }
}

TEST(a_loose_contact_that_spoils_every_third_transaction_stops_neither_set_up_nor_samples) {
  Chips chips;
  Mpu9150 imu = Mpu9150();
  uint32_t now_us = 0;
  set_up(imu, chips, &now_us);
  chips.stuck = true;  // before
  while (imu.running()) ready(imu, chips, &now_us, 1);
  chips.stuck = false;
  chips.loose = 3;
  const uint32_t start_us = now_us;
  for (uint8_t i = 0; i < 40 && !imu.running(); ++i) {
    uint32_t wait_us = 0;
    imu.step(chips, now_us, &wait_us);
    now_us += wait_us;
  }
  CHECK(imu.running());
  CHECK(now_us - start_us < 2500000);  // one attempt that fails costs a second
  uint8_t samples = 0;
  for (int16_t i = 0; i < 100; ++i) {
    const int16_t raw[7] = {i, 200, 8192, 0, 1, 2, 3};
    float force[3], rate[3];
    chips.sample(raw);
    if (ready(imu, chips, &now_us, 19000) && imu.read(chips, force, rate)) ++samples;
    now_us += 1000;
    CHECK(imu.running());
  }
  CHECK(samples > 30);
}

namespace {

// A magnetometer that has been set up, its chip answering at once.
void find(Ak8975& compass, Chips& chips) {
  chips.inertial[0x37] = 0x02;
  float field[3];
  for (uint8_t tick = 0; tick < 8 && !compass.running(); ++tick) compass.step(chips, field);
}

void put_field(Chips& chips, int16_t x, int16_t y, int16_t z) {
  const int16_t axes[3] = {x, y, z};
  for (uint8_t i = 0; i < 3; ++i) {
    chips.field[0x03 + 2 * i] = static_cast<uint8_t>(axes[i]);
    chips.field[0x04 + 2 * i] = static_cast<uint8_t>(static_cast<uint16_t>(axes[i]) >> 8);
  }
  chips.field[0x02] = 0x01;
}

uint8_t fields_in(Ak8975& compass, Chips& chips, uint8_t ticks, float* field) {
  uint8_t count = 0;
  for (; ticks > 0; --ticks) {
    if (compass.step(chips, field)) ++count;
  }
  return count;
}

}  // namespace

TEST(the_field_comes_adjusted_and_in_the_accelerometer_s_axes_five_times_a_second) {
  Chips chips;
  chips.asa[0] = 128;
  chips.asa[1] = 0;    // half the gain
  chips.asa[2] = 255;  // 383/256 of it
  Ak8975 compass = Ak8975();
  find(compass, chips);
  CHECK(compass.running());
  put_field(chips, 100, 200, -300);
  float field[3] = {};
  CHECK_EQUAL(5, fields_in(compass, chips, 50, field));
  CHECK_NEAR(30.0f, field[0], 1e-3f);      // y: 200 * 0.3 / 2
  CHECK_NEAR(30.0f, field[1], 1e-3f);      // x: 100 * 0.3
  CHECK_NEAR(134.648f, field[2], 1e-2f);   // -z: 300 * 0.3 * 383/256
  CHECK_EQUAL(0, compass.rejected());
}

TEST(an_overflow_or_a_data_error_gives_no_field) {
  Chips chips;
  Ak8975 compass = Ak8975();
  find(compass, chips);
  put_field(chips, 1, 1, 1);
  chips.field[0x09] = 0x08;
  float field[3];
  CHECK_EQUAL(0, fields_in(compass, chips, 20, field));
  chips.field[0x09] = 0x04;
  CHECK_EQUAL(0, fields_in(compass, chips, 20, field));
  CHECK_EQUAL(4, compass.rejected());
  chips.field[0x09] = 0;
  put_field(chips, 2, 1, 1);
  CHECK_EQUAL(2, fields_in(compass, chips, 20, field));
}

TEST(a_measurement_that_is_not_ready_gives_no_field) {
  Chips chips;
  Ak8975 compass = Ak8975();
  find(compass, chips);
  put_field(chips, 1, 1, 1);
  chips.field[0x02] = 0;
  float field[3];
  const uint16_t before = chips.transactions;
  CHECK_EQUAL(0, fields_in(compass, chips, 50, field));
  CHECK(compass.rejected() > 0);
  CHECK(chips.transactions - before <= 2 * 5);  // asked no more often for that
}

TEST(a_magnetometer_is_one_by_its_identity_and_missing_where_three_in_a_row_fail) {
  Chips chips;
  Ak8975 compass = Ak8975();
  float field[3];
  chips.field[0x00] = 0x49;
  find(compass, chips);
  CHECK(!compass.running());
  chips.field[0x00] = 0x48;
  put_field(chips, 100, 1, 1);
  CHECK(fields_in(compass, chips, 60, field) > 0);
  for (uint8_t round = 0; round < 2; ++round) {  // two fail, one comes, two fail
    chips.inertial[0x37] = 0x00;
    fields_in(compass, chips, 20, field);
    chips.inertial[0x37] = 0x02;
    put_field(chips, 1 + round, 1, 1);
    CHECK(fields_in(compass, chips, 12, field) > 0);
  }
  CHECK(compass.running());
  chips.inertial[0x37] = 0x00;
  fields_in(compass, chips, 40, field);
  CHECK(!compass.running());
  chips.inertial[0x37] = 0x02;
  fields_in(compass, chips, 60, field);
  CHECK(compass.running());
  chips.inertial[0x37] = 0x00;
  fields_in(compass, chips, 15, field);  // and none of before counts
  CHECK(compass.running());
}

TEST(without_the_bypass_the_magnetometer_is_missing_and_is_found_when_it_opens) {
  Chips chips;
  Ak8975 compass = Ak8975();
  float field[3];
  CHECK_EQUAL(0, fields_in(compass, chips, 120, field));
  CHECK(!compass.running());
  CHECK(chips.transactions <= 4);  // once a second
  chips.inertial[0x37] = 0x02;
  put_field(chips, 1, 1, 1);
  CHECK(fields_in(compass, chips, 120, field) > 0);
}

TEST(a_magnetometer_that_repeats_itself_is_noticed_within_two_seconds_until_it_changes) {
  Chips chips;
  Ak8975 compass = Ak8975();
  find(compass, chips);
  put_field(chips, 100, 200, -300);
  float field[3];
  CHECK_EQUAL(5, fields_in(compass, chips, 100, field));
  CHECK_EQUAL(0, fields_in(compass, chips, 250, field));
  CHECK(compass.rejected() >= 3);
  put_field(chips, 101, 200, -300);
  CHECK(fields_in(compass, chips, 120, field) > 0);  // it may have to be found anew first
}

RUN_TESTS()
