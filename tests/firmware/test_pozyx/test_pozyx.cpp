// The driver against a chip that answers as its register map says, and that can be made to fail in
// the ways seen in the field.
#include "support/check.h"
#include "support/fake_board.h"

#include "devices/pozyx.h"

using relpos::BusStatus;
using relpos::Pozyx;

namespace {

struct Chip : FakeBoard {
  bool present = true;
  uint8_t identity = 0x43;
  uint16_t network_id = 0x6000;
  uint8_t mask = 0;
  uint8_t flags = 0;
  uint8_t code = 0;            // an exchange ends with this error
  bool silent = false;         // an exchange never ends
  uint8_t polls = 3;           // looks at INT_STATUS until it ends
  uint8_t call_status = 1;
  uint8_t info_status = 1;
  uint32_t time_ms = 1000;     // of the exchange that ends
  uint32_t stored_ms = 0;      // in the row; 0: there is none
  uint32_t before_ms = 0;      // in the row as long as no exchange has begun; 0: stored_ms
  uint32_t range_mm = 5432;
  int16_t rss_dbm = -83;

  uint32_t pressure_mpa = 101325000;
  uint8_t foreign = 0;         // at so many looks left another's exchange ends, answered by this chip

  uint16_t fails_at = 0;       // this transaction is not acknowledged
  uint16_t transactions = 0;
  uint16_t exchanges = 0;
  uint16_t asked_peer = 0;     // by DO_RANGING
  uint16_t fetched_peer = 0;   // by GETRANGEINFO
  uint8_t polls_left = 0;
  uint8_t wrong = 0;           // transactions that the chip does not know

 protected:
  BusStatus i2c_transfer(uint8_t address, const uint8_t* first, uint8_t first_count,
                         const uint8_t* second, uint8_t second_count, uint8_t* read,
                         uint8_t read_count) override {
    ++transactions;
    if (!present || address != 0x4B || transactions == fails_at) return BusStatus::kAddressNack;
    if (first_count == 1 && second_count == 0 && read_count == 1) {
      if (first[0] == 0x00) return give(read, identity);
      if (first[0] == 0x04) return give(read, code);
      if (first[0] == 0x05) {
        if (polls_left > 0 && --polls_left == 0 && !silent) {
          flags |= code != 0 ? 0x01 : 0x10;
          if (code == 0) stored_ms = time_ms;
        }
        if (foreign != 0 && polls_left == foreign) flags |= 0x10;
        const uint8_t now = flags;
        flags = 0;
        return give(read, now);
      }
    } else if (first_count == 1 && second_count == 0 && read_count == 2 && first[0] == 0x1A) {
      put(read, network_id, 2);
      return BusStatus::kOk;
    } else if (first_count == 1 && second_count == 0 && read_count == 4 && first[0] == 0x50) {
      put(read, pressure_mpa, 4);
      return BusStatus::kOk;
    } else if (first_count == 1 && second_count == 2 && read_count == 0 && first[0] == 0x1A) {
      network_id = static_cast<uint16_t>(second[0] | second[1] << 8);
      return BusStatus::kOk;
    } else if (first_count == 1 && second_count == 1 && read_count == 0 && first[0] == 0x10) {
      mask = second[0];
      return BusStatus::kOk;
    } else if (first_count == 3 && second_count == 0 && read_count == 1 && first[0] == 0xB5) {
      asked_peer = static_cast<uint16_t>(first[1] | first[2] << 8);
      ++exchanges;
      polls_left = polls;
      return give(read, call_status);
    } else if (first_count == 3 && second_count == 0 && read_count == 5 && first[0] == 0xC7) {
      const uint32_t now_ms = before_ms != 0 ? before_ms : stored_ms;
      read[0] = now_ms != 0;
      put(read + 1, now_ms, 4);
      return BusStatus::kOk;
    } else if (first_count == 3 && second_count == 0 && read_count == 11 && first[0] == 0xC7) {
      fetched_peer = static_cast<uint16_t>(first[1] | first[2] << 8);
      read[0] = stored_ms != 0 ? info_status : 0;
      const uint32_t time_ms = stored_ms;
      put(read + 1, time_ms, 4);
      put(read + 5, range_mm, 4);
      put(read + 9, static_cast<uint16_t>(rss_dbm), 2);
      return BusStatus::kOk;
    }
    ++wrong;
    return BusStatus::kDataNack;
  }

 private:
  static BusStatus give(uint8_t* read, uint8_t value) {
    *read = value;
    return BusStatus::kOk;
  }
  static void put(uint8_t* out, uint32_t value, uint8_t count) {
    for (; count > 0; --count, value >>= 8) *out++ = static_cast<uint8_t>(value);
  }
};

// Calls the driver whenever it is due; the clock wraps on the way.
struct Bench {
  Chip chip;
  Pozyx pozyx = Pozyx();
  Pozyx::Result result = {0, false, 0, 0, 0};
  uint32_t now_us = 0xFFFFFF00u;
  uint32_t elapsed_us = 0;
  uint8_t most_at_once = 0;    // transactions in one step

  // Until the driver is done or idle, at most so long. True when it is done.
  bool run(uint32_t for_us) {
    const uint32_t start_us = now_us;
    for (;;) {
      uint32_t wait_us = 0;
      const uint16_t before = chip.transactions;
      const Pozyx::Event event = pozyx.step(chip, now_us, &wait_us, &result);
      const uint8_t count = static_cast<uint8_t>(chip.transactions - before);
      if (count > most_at_once) most_at_once = count;
      elapsed_us = now_us - start_us;
      if (event == Pozyx::Event::kDone) return true;
      if (wait_us == Pozyx::kIdleUs) return false;
      now_us += wait_us > 0 ? wait_us : 300;  // a pass of the loop
      if (now_us - start_us > for_us) return false;
    }
  }
  void set_up() {
    pozyx.begin(0x0107);
    run(2000000);
  }
  bool exchange(uint16_t peer) { return pozyx.range(peer) && run(1000000); }
};

}  // namespace

TEST(the_chip_is_left_alone_for_250_ms_after_power_up) {
  Bench bench;
  bench.pozyx.begin(0x0107);
  bench.run(249000);
  CHECK_EQUAL(0, bench.chip.transactions);
  CHECK(!bench.pozyx.running());
}

TEST(an_early_call_is_no_earlier_access) {
  Bench bench;
  uint32_t wait_us = 0;
  bench.pozyx.begin(0x0107);
  bench.pozyx.step(bench.chip, 100, &wait_us, &bench.result);
  bench.pozyx.step(bench.chip, 50100, &wait_us, &bench.result);
  CHECK_EQUAL(200000, wait_us);
  CHECK_EQUAL(0, bench.chip.transactions);
}

TEST(set_up_gives_the_network_id_and_the_interrupts) {
  Bench bench;
  bench.set_up();
  CHECK(bench.pozyx.running());
  CHECK(bench.pozyx.ready());
  CHECK_EQUAL(0x0107, bench.chip.network_id);
  CHECK_EQUAL(0x11, bench.chip.mask & 0x11);
  CHECK_EQUAL(0, bench.chip.wrong);
  CHECK_EQUAL(1, bench.most_at_once);
}

TEST(nothing_is_ranged_before_set_up) {
  Bench bench;
  CHECK(!bench.pozyx.range(2));
  bench.pozyx.begin(0x0107);
  CHECK(!bench.pozyx.range(2));
  bench.run(100000);
  CHECK(!bench.pozyx.range(2));
}

TEST(an_absent_chip_is_looked_for_until_it_comes) {
  Bench bench;
  bench.chip.present = false;
  bench.pozyx.begin(0x0107);
  bench.run(5000000);
  CHECK(!bench.pozyx.running());
  CHECK_EQUAL(5, bench.chip.transactions);  // 0.25 s, then once a second
  CHECK_EQUAL(5, bench.chip.bus_errors());
  uint32_t wait_us = 0;
  bench.pozyx.step(bench.chip, bench.now_us - 2000, &wait_us, &bench.result);  // too early
  CHECK_EQUAL(5, bench.chip.transactions);
  bench.chip.present = true;
  bench.run(2000000);
  CHECK(bench.pozyx.ready());
}

TEST(another_chip_at_the_address_is_not_a_pozyx) {
  Bench bench;
  bench.chip.identity = 0x42;
  bench.set_up();
  CHECK(!bench.pozyx.running());
  CHECK_EQUAL(0x6000, bench.chip.network_id);
}

TEST(an_exchange_gives_distance_and_signal_strength) {
  Bench bench;
  bench.set_up();
  CHECK(bench.exchange(0x0005));
  CHECK_EQUAL(5, bench.result.peer);
  CHECK(bench.result.success);
  CHECK_EQUAL(5432, bench.result.range_mm);
  CHECK_EQUAL(-83, bench.result.rss_dbm);
  CHECK_EQUAL(0, bench.result.error);
  CHECK_EQUAL(5, bench.chip.asked_peer);
  CHECK_EQUAL(5, bench.chip.fetched_peer);
  CHECK_EQUAL(0, bench.chip.wrong);
  CHECK_EQUAL(1, bench.most_at_once);
  CHECK(bench.pozyx.ready());
}

TEST(a_second_exchange_waits_for_the_first) {
  Bench bench;
  bench.set_up();
  CHECK(bench.pozyx.range(2));
  CHECK(!bench.pozyx.ready());
  CHECK(bench.pozyx.running());
  CHECK(!bench.pozyx.range(3));
  CHECK(bench.run(1000000));
  CHECK_EQUAL(2, bench.chip.asked_peer);
}

TEST(signal_strength_is_clamped_not_wrapped) {
  Bench bench;
  bench.set_up();
  bench.chip.rss_dbm = -300;
  CHECK(bench.exchange(2));
  CHECK_EQUAL(-128, bench.result.rss_dbm);
  bench.chip.rss_dbm = 8192;
  bench.chip.time_ms += 50;
  CHECK(bench.exchange(2));
  CHECK_EQUAL(127, bench.result.rss_dbm);
}

TEST(an_error_of_the_chip_is_reported_with_its_code) {
  Bench bench;
  bench.set_up();
  bench.chip.code = 0x12;
  CHECK(bench.exchange(3));
  CHECK(!bench.result.success);
  CHECK_EQUAL(3, bench.result.peer);
  CHECK_EQUAL(0x12, bench.result.error);
  CHECK_EQUAL(0, bench.result.range_mm);
  CHECK_EQUAL(0, bench.chip.fetched_peer);
  CHECK(bench.pozyx.ready());
}

TEST(errors_of_the_chip_are_no_reason_to_set_it_up_anew) {
  Bench bench;
  bench.set_up();
  bench.chip.code = 0x17;
  for (uint8_t i = 0; i < 20; ++i) CHECK(bench.exchange(3));
  CHECK(bench.pozyx.ready());
}

TEST(silence_ends_after_100_ms) {
  Bench bench;
  bench.set_up();
  bench.chip.silent = true;
  CHECK(bench.exchange(3));
  CHECK(!bench.result.success);
  CHECK_EQUAL(Pozyx::kTimedOut, bench.result.error);
  CHECK(bench.elapsed_us >= 100000 && bench.elapsed_us < 103000);
  CHECK(bench.pozyx.ready());
}

TEST(a_flag_from_before_the_exchange_ends_nothing) {
  Bench bench;
  bench.set_up();
  bench.chip.flags = 0x10;
  bench.chip.silent = true;
  CHECK(bench.exchange(3));
  CHECK_EQUAL(Pozyx::kTimedOut, bench.result.error);
  bench.chip.flags = 0x01;
  bench.chip.silent = false;
  CHECK(bench.exchange(3));
  CHECK(bench.result.success);
}

TEST(a_call_that_is_refused_is_reported_with_the_chips_own_code) {
  Bench bench;
  bench.set_up();
  bench.chip.call_status = 0;
  bench.chip.code = 0x15;  // busy
  CHECK(bench.exchange(3));
  CHECK(!bench.result.success);
  CHECK_EQUAL(0x15, bench.result.error);
  CHECK(bench.pozyx.ready());
}

TEST(a_refused_call_ends_the_exchange) {
  Bench bench;
  bench.set_up();
  bench.chip.call_status = 0;
  CHECK(bench.exchange(3));
  CHECK_EQUAL(Pozyx::kRefused, bench.result.error);
  bench.chip.call_status = 1;
  bench.chip.info_status = 0;
  CHECK(bench.exchange(3));
  CHECK(!bench.result.success);
  CHECK_EQUAL(Pozyx::kTimedOut, bench.result.error);
}

TEST(garbage_is_not_a_distance) {
  const uint32_t garbage[] = {167772160, 0, 200000, 0xFFFFFFFF};
  Bench bench;
  bench.set_up();
  for (uint8_t i = 0; i < 4; ++i) {
    bench.chip.range_mm = garbage[i];
    bench.chip.time_ms += 50;
    CHECK(bench.exchange(3));
    CHECK(!bench.result.success);
    CHECK_EQUAL(Pozyx::kImplausible, bench.result.error);
    CHECK_EQUAL(0, bench.result.range_mm);
  }
  bench.chip.range_mm = 199999;
  bench.chip.time_ms += 50;
  CHECK(bench.exchange(3));
  CHECK(bench.result.success);
}

TEST(another_s_exchange_that_this_chip_answers_meanwhile_costs_nothing) {
  const uint32_t rows_ms[] = {0, 900};
  for (const uint32_t stored_ms : rows_ms) {
    Bench bench;
    bench.set_up();
    bench.chip.stored_ms = stored_ms;
    bench.chip.foreign = 2;
    bench.chip.polls = 6;
    CHECK(bench.exchange(3));
    CHECK(bench.result.success);
    CHECK_EQUAL(5432, bench.result.range_mm);
  }
}

TEST(between_exchanges_the_pressure_is_read_and_the_identity_watched) {
  Bench bench;
  bench.set_up();
  uint8_t pressures = 0;
  uint32_t pressure_mpa = 0;
  for (uint8_t i = 0; i < 16; ++i) {
    if (!bench.pozyx.look(bench.chip, &pressure_mpa)) continue;
    ++pressures;
    CHECK_EQUAL(101325000, pressure_mpa);
  }
  CHECK_EQUAL(14, pressures);
  CHECK(bench.pozyx.ready());
  for (uint8_t i = 0; i < 8; ++i) {  // one look at the identity that fails is no restart
    if (i == 7) bench.chip.fails_at = static_cast<uint16_t>(bench.chip.transactions + 1);
    CHECK_EQUAL(i < 7, bench.pozyx.look(bench.chip, &pressure_mpa));
  }
  CHECK(bench.pozyx.ready());
  bench.chip.network_id = 0x6000;  // it has restarted
  for (uint8_t i = 0; i < 8 && bench.pozyx.ready(); ++i) bench.pozyx.look(bench.chip, &pressure_mpa);
  CHECK(!bench.pozyx.running());
  bench.run(1000000);
  CHECK_EQUAL(0x0107, bench.chip.network_id);
}

TEST(a_chip_that_vanishes_between_exchanges_is_missed_and_found_again) {
  Bench bench;
  bench.set_up();
  bench.chip.present = false;
  uint32_t pressure_mpa = 0;
  for (uint8_t i = 0; i < 5; ++i) CHECK(!bench.pozyx.look(bench.chip, &pressure_mpa));
  CHECK(!bench.pozyx.running());
  bench.run(2000000);
  CHECK(!bench.pozyx.running());
  bench.chip.present = true;
  bench.run(2000000);
  CHECK(bench.pozyx.ready());
}

TEST(a_distance_is_not_given_twice) {
  Bench bench;
  bench.set_up();
  CHECK(bench.exchange(3));
  CHECK(bench.result.success);
  CHECK(bench.exchange(3));
  CHECK(!bench.result.success);
  CHECK_EQUAL(Pozyx::kTimedOut, bench.result.error);
  CHECK(bench.pozyx.ready());
  bench.chip.time_ms += 1;
  CHECK(bench.exchange(3));
  CHECK(bench.result.success);
}

TEST(an_older_distance_flagged_as_new_by_inverted_flags_is_refused) {
  Bench bench;
  bench.set_up();
  bench.chip.code = 0x12;
  CHECK(bench.exchange(3));
  CHECK(!bench.result.success);
  bench.chip.stored_ms = 1500;  // another's exchange with this chip
  bench.chip.code = 0;
  bench.chip.time_ms = 1500;    // of this one nothing is stored, but FUNC raised
  CHECK(bench.exchange(3));
  CHECK(!bench.result.success);
  CHECK_EQUAL(Pozyx::kTimedOut, bench.result.error);
  bench.chip.time_ms = 1600;
  CHECK(bench.exchange(3));
  CHECK(bench.result.success);
}

TEST(the_row_of_another_peer_is_no_distance_to_this_one) {
  Bench bench;
  bench.set_up();
  bench.chip.time_ms = 5000;
  CHECK(bench.exchange(3));
  CHECK(bench.result.success);
  bench.chip.before_ms = 2000;  // that of peer 4
  CHECK(bench.exchange(4));     // FUNC, then 3's row again, seen in the field
  CHECK(!bench.result.success);
  bench.chip.time_ms = 5050;
  CHECK(bench.exchange(4));
  CHECK(bench.result.success);
}

TEST(a_chip_clock_that_wraps_goes_on) {
  Bench bench;
  bench.set_up();
  bench.chip.time_ms = 0x7FFFFFF0;
  CHECK(bench.exchange(3) && bench.result.success);
  bench.chip.time_ms = 0xFFFFFFE0;
  CHECK(bench.exchange(3) && bench.result.success);
  bench.chip.time_ms = 5;
  CHECK(bench.exchange(3) && bench.result.success);
}

TEST(a_first_distance_is_taken_whatever_the_chip_s_clock_shows) {
  Bench bench;
  bench.set_up();
  bench.chip.time_ms = 0x90000000;  // after 28 days
  CHECK(bench.exchange(3) && bench.result.success);
}

TEST(a_chip_that_stays_silent_is_set_up_anew) {
  Bench bench;
  bench.set_up();
  bench.chip.mask = 0;
  bench.chip.silent = true;
  for (uint8_t i = 0; i < 5; ++i) CHECK(bench.exchange(3));
  CHECK(!bench.pozyx.ready());
  bench.run(1000000);
  CHECK(bench.pozyx.ready());
  CHECK_EQUAL(0x11, bench.chip.mask & 0x11);
}

TEST(a_chip_that_drops_off_the_bus_is_set_up_anew_and_counted) {
  Bench bench;
  bench.set_up();
  CHECK(bench.pozyx.range(4));
  uint32_t wait_us = 0;
  for (uint8_t i = 0; i < 3; ++i) {  // the exchange is under way
    bench.pozyx.step(bench.chip, bench.now_us, &wait_us, &bench.result);
  }
  bench.chip.present = false;
  CHECK(bench.run(1000000));
  CHECK(!bench.result.success);
  CHECK_EQUAL(4, bench.result.peer);
  CHECK_EQUAL(Pozyx::kBusFailed, bench.result.error);
  CHECK(!bench.pozyx.running());
  CHECK_EQUAL(5, bench.chip.bus_errors());
  CHECK(!bench.run(2500000));
  CHECK(!bench.pozyx.running());
  bench.chip.present = true;
  bench.run(1500000);
  CHECK(bench.exchange(4));
  CHECK(bench.result.success);
}

TEST(a_transaction_that_fails_elsewhere_than_in_a_poll_ends_the_exchange) {
  const uint8_t which[] = {1, 2, 3, 7};  // before, clear, call; behind three polls, fetch
  for (const uint8_t failing : which) {
    Bench bench;
    bench.set_up();
    bench.chip.fails_at = static_cast<uint16_t>(bench.chip.transactions + failing);
    CHECK(bench.exchange(4));
    CHECK(!bench.result.success);
    CHECK_EQUAL(Pozyx::kBusFailed, bench.result.error);
    CHECK_EQUAL(bench.chip.fails_at, bench.chip.transactions);
  }
}

TEST(failures_count_in_a_row_alone) {
  enum End { kDistance, kError, kSetUp };
  for (uint8_t end = kDistance; end <= kSetUp; ++end) {
    Bench bench;
    bench.set_up();
    for (uint8_t round = 0; round < 2; ++round) {
      bench.chip.silent = true;
      for (uint8_t i = 0; i < (end == kSetUp && round == 0 ? 5 : 4); ++i) CHECK(bench.exchange(3));
      CHECK_EQUAL(end != kSetUp || round != 0, bench.pozyx.ready());
      bench.chip.silent = false;
      if (end == kSetUp) {
        bench.run(1000000);
        continue;
      }
      bench.chip.code = end == kError ? 0x12 : 0;
      bench.chip.time_ms += 100;
      CHECK(bench.exchange(3));
      CHECK_EQUAL(end == kDistance, bench.result.success);
      bench.chip.code = 0;
    }
    CHECK(bench.pozyx.ready());
  }
}

TEST(one_failed_poll_loses_no_distance) {
  Bench bench;
  bench.set_up();
  CHECK(bench.pozyx.range(4));
  uint32_t wait_us = 0;
  for (uint8_t i = 0; i < 4; ++i) {
    bench.chip.present = i < 3;
    bench.pozyx.step(bench.chip, bench.now_us, &wait_us, &bench.result);
  }
  CHECK_EQUAL(5000, wait_us);  // a stuck bus costs six milliseconds each time
  bench.chip.present = true;
  CHECK(bench.run(1000000));
  CHECK(bench.result.success);
  CHECK_EQUAL(1, bench.chip.bus_errors());
}

RUN_TESTS()
