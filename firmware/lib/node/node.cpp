#include "node/node.h"

#include <stddef.h>
#include <string.h>

#include "inertial/calls.h"
#include "devices/flash.h"
#include "node/calibration.h"
#include "node/version.h"

namespace relpos {
namespace {

constexpr uint32_t kMostStepUs = 200000;   // dead reckoning takes no longer step: it starts anew
constexpr uint32_t kSilentMs = 500;        // without a sample for so long there is no motion to report
constexpr uint32_t kFieldStaleMs = 1000;
constexpr uint32_t kSilentPollUs = 500;    // two bytes at 38400 baud
constexpr uint32_t kMostWaitUs = 100000;
// From one frame to the next where it is not reported as delivered: the module answers in some 10 ms,
// with its own retries in under 100 ms.
constexpr uint16_t kTransmitStatusMs = 200;
constexpr int16_t kWeakSignalDbm = -95;    // DW1000: close to the sensitivity limit [K]
constexpr uint16_t kMotionPhaseMs = 157;   // between the reports of neighbouring ids, up to
constexpr uint16_t kMostMotionPhaseMs = 1023;
constexpr uint16_t kMostStepAgeMs = 2000;  // then it is sent without waiting for others
constexpr uint8_t kRebootBytes = 6;
// 5 V - 10 %: what the boards' 3.3 V regulators and the Pozyx are sure to work from.
constexpr uint16_t kSupplyLowMv = 4500;
// Counters of frames are reserved in blocks of so many: at a frame or two a second the EEPROM is
// written every ten minutes, and lasts for years. A start wastes what is left of a block.
constexpr uint16_t kCounterBlock = 1024;
constexpr uint8_t kCountersLeft = 64;      // then the next block: writing takes 75 ms
constexpr uint16_t kLookPeriodMs = 100;    // at the Pozyx's pressure
constexpr uint16_t kRawPeriodMs = 200;     // as often as the magnetometer is read
constexpr uint16_t kMostRawReports = 3000; // ten minutes: a lost host does not end the ranging
// Beyond what a sensor at its limit can show once a calibration has moved it: by 80 mg and 3 %, by
// 20 deg/s (data sheet limits).
constexpr float kCalibratedLimit_m_s2 = 37.0f;
constexpr float kCalibratedLimitRadS = 16.5f;
constexpr float kWearersScale = 0.05f;  // relative error of a gain that was set

// What a command may set: where it stands in the settings, and its limits.
struct Choice {
  uint8_t command, offset, bytes;
  uint16_t low, high;
};
static_assert(__is_standard_layout(Preferences), "a setting is where its offset says");
static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "settings are written a byte at a time");
const Choice kChoices[] RELPOS_FLASH = {
    {static_cast<uint8_t>(wire::CommandCode::kSetReportPeriodMs),
     offsetof(Preferences, report_period_ms), 2, 100, 60000},
    {static_cast<uint8_t>(wire::CommandCode::kSetRangingPeriodMs),
     offsetof(Preferences, ranging_period_ms), 2, 200, 60000},
    {static_cast<uint8_t>(wire::CommandCode::kSetStatusPeriodMs),
     offsetof(Preferences, status_period_ms), 2, 1000, 60000},
    {static_cast<uint8_t>(wire::CommandCode::kSetLegLengthMm), offsetof(Preferences, leg_length_mm), 2,
     400, 1400},
    {static_cast<uint8_t>(wire::CommandCode::kSetStepGainPermille),
     offsetof(Preferences, step_gain_permille), 2, 300, 5000},
    {static_cast<uint8_t>(wire::CommandCode::kSetTeamSize), offsetof(Preferences, team_size), 1, 1, 20},
    {static_cast<uint8_t>(wire::CommandCode::kSetStepReports), offsetof(Preferences, step_reports), 1, 0,
     1},
    {static_cast<uint8_t>(wire::CommandCode::kSetLed), offsetof(Preferences, led), 1, kLedOff,
     kLedHealth},
    {static_cast<uint8_t>(wire::CommandCode::kSetNodeId), offsetof(Preferences, node_id), 1, 1, 254},
    // Low above high: both are signed.
    {static_cast<uint8_t>(wire::CommandCode::kSetRangeOffsetMm),
     offsetof(Preferences, range_offset_mm), 2, static_cast<uint16_t>(-5000), 5000},
};

constexpr uint8_t flag(wire::Health health) { return static_cast<uint8_t>(health); }
constexpr uint8_t flag(wire::Quality quality) { return static_cast<uint8_t>(quality); }

}  // namespace

void Node::begin(uint32_t now_us, wire::ResetCause cause, uint8_t node_id) {
  clock_.begin(now_us);
  sample_clock_.begin(now_us);
  imu_due_us_ = now_us;
  pozyx_due_us_ = now_us;

  store_.load(board_, this);
  counter_ = marks_.counter_end;
  reserve_counters();
  id_ = node_id != 0 ? node_id : settings_.node_id;
  if (id_ == 0) {
    const uint8_t stored = board_.storage_read(kStoredNodeId);
    const uint8_t complement = board_.storage_read(kStoredNodeIdComplement);
    const bool good = stored != wire::kCoordinator && stored != wire::kBroadcast &&
                      static_cast<uint8_t>(stored ^ complement) == 0xFF;
    id_ = good ? stored : kDefaultNodeId;
  }

  // A reboot on command is remembered with its token: the host may not have received the answer, and
  // repeating the command must not reboot the node again.
  uint8_t reboot[kRebootBytes];
  for (uint8_t i = 0; i < kRebootBytes; ++i) reboot[i] = board_.storage_read(kStoredReboot + i);
  const uint8_t previous = board_.storage_read(kStoredBootCount);
  reset_cause_ = cause;
  // Whatever cause the board tells (after a boot loader often none): it fits this one start, and none
  // 256 starts later.
  if (reboot[4] == previous && (reboot[5] ^ previous) == 0xFF) {
    reset_cause_ = wire::ResetCause::kCommand;
    board_.storage_write(kStoredReboot + 5, previous);
    DoneCommand& done = commands_[0];
    done.token = static_cast<uint16_t>(reboot[0] | static_cast<uint16_t>(reboot[1]) << 8);
    done.key = static_cast<uint16_t>(reboot[2] | static_cast<uint16_t>(reboot[3]) << 8);
    done.command = static_cast<uint8_t>(wire::CommandCode::kReboot);
    done.result = static_cast<uint8_t>(wire::CommandResult::kDone);
    done.known = true;
    next_command_ = 1;
  }
  boot_ = static_cast<uint8_t>(previous + 1);
  board_.storage_write(kStoredBootCount, boot_);

  pozyx_.begin(id_);
  configure_inertial();
  dead_reckoning_.reset();  // the bias begins as well known as it is configured
  // Nodes switched on together do not all speak and range at the same moment.
  motion_ms_ = static_cast<uint16_t>(
      (static_cast<uint16_t>(id_ * kMotionPhaseMs) & kMostMotionPhaseMs) - settings_.report_period_ms);
  plan_.begin(now_ms(), static_cast<uint16_t>(id_ * 257 + counter_));
  // The first status follows the first motion: it reports what is there, and the cause of the reset.
  status_ms_ = static_cast<uint16_t>(motion_ms_ + settings_.report_period_ms - settings_.status_period_ms);
  show_health();
}

uint32_t Node::poll(uint32_t now_us) {
  board_.watchdog_reset();
  clock_.advance(now_us);
  if (xbee_.step(board_)) {
    receive_packet();
    return 0;
  }
  if (reached(now_us, imu_due_us_)) {
    run_imu(now_us);
    return 0;
  }
  if (reached(now_us, pozyx_due_us_)) {
    run_ranging(now_us);
    return 0;
  }
  store_.step(board_, *this);
  if (!store_.saving()) speaking_ = true;  // the counters of this start are stored
  if (speaking_ && radio_free() && (send_next() || run_reboot())) return 0;
  show_health();
  return wait_us(now_us);
}

// Microseconds until something is due. Radio and storage in progress are looked after meanwhile.
uint32_t Node::wait_us(uint32_t now_us) const {
  uint16_t wait_ms = kMostWaitUs / 1000;
  shorten(motion_ms_, settings_.report_period_ms, &wait_ms);
  shorten(status_ms_, settings_.status_period_ms, &wait_ms);
  uint32_t wait = wait_ms * 1000UL;
  if (awaiting_status_ || store_.saving() || reboot_step_ != 0) wait = kSilentPollUs;
  if (imu_due_us_ - now_us < wait) wait = imu_due_us_ - now_us;
  if (pozyx_due_us_ - now_us < wait) wait = pozyx_due_us_ - now_us;
  return wait;
}

// What is overdue waits for something else, which is looked after anyway.
void Node::shorten(uint16_t last_ms, uint16_t period_ms, uint16_t* wait_ms) const {
  const uint16_t left_ms = static_cast<uint16_t>(period_ms - static_cast<uint16_t>(now_ms() - last_ms));
  if (left_ms < *wait_ms) *wait_ms = left_ms;
}

// Whether a period has ended. Periods that could not be kept are skipped, not made up for. None is
// longer than 60 s, and this is asked more than once in the 5 s that 16 bits have left.
bool Node::period_over(uint16_t* last_ms, uint16_t period_ms) {
  uint16_t past_ms = static_cast<uint16_t>(now_ms() - *last_ms);
  if (past_ms < period_ms) return false;
  past_ms = static_cast<uint16_t>(past_ms - period_ms);
  if (past_ms >= period_ms) past_ms = 0;
  *last_ms = static_cast<uint16_t>(now_ms() - past_ms);
  return true;
}

void Node::show_health() {
  bool on = settings_.led == kLedOn;
  if (settings_.led == kLedHealth) {
    // The worst shows (docs/hardware.md): fast blinking, a sensor is missing; long on and short off,
    // the supply is low; two flashes a second, no beacon is received; one, all well.
    uint16_t turn = 1023, lit = 64;
    if (imu_silent() || !magnetometer_.running() || !pozyx_.running()) {
      turn = 255;
      lit = 128;
    } else if (supply_low_) {
      lit = 768;
    } else if (plan_.team() == 0) {
      turn = 1023 - 256;
    }
    on = (now_ms() & turn) < lit;
  }
  if (on != led_) {
    led_ = on;
    board_.led(on);
  }
}

// ---- motion ----

RELPOS_APART bool Node::imu_silent() const { return !sampled_ || clock_.ms() - last_sample_ms_ > kSilentMs; }

RELPOS_UNCLONED void Node::configure_inertial() {
  InertialConfig& config = dead_reckoning_.config();
  config.leg_length_m = static_cast<float>(settings_.leg_length_mm) * 1e-3f;
  config.step_gain = static_cast<float>(settings_.step_gain_permille) * 1e-3f;
  // A gain that was set comes from this wearer's walks or ranges.
  config.scale_sigma =
      settings_.step_gain_permille != kPopulationGainPermille ? kWearersScale : kPopulationScale;
  const int16_t sigma = settings_.calibration[wire::kGyroBiasSigma];
  if (sigma != 0) {
    config.gyro_bias_sigma_rad_s = sigma * wire::kCalibrationUnit;
    config.acceleration_limit_m_s2 = kCalibratedLimit_m_s2;
    config.angular_rate_limit_rad_s = kCalibratedLimitRadS;
  }
}

void Node::run_imu(uint32_t now_us) {
  uint32_t wait = 0;
  const bool was_running = imu_.running();
  const Mpu9150::Event event = imu_.step(board_, now_us, &wait);
  imu_due_us_ = now_us + wait;
  if (event == Mpu9150::Event::kReady) {
    board_.mark(1);
    const uint32_t start_us = board_.now_us();
    tick(now_us);
    const uint32_t took_us = board_.now_us() - start_us;
    board_.mark(0);
    if (took_us > work_.worst_tick_us) {
      work_.worst_tick_us = took_us > 0xFFFF ? 0xFFFF : static_cast<uint16_t>(took_us);
    }
  }
  // A new set-up closes and opens the bypass: the magnetometer has to be found again.
  if (was_running && !imu_.running()) magnetometer_.restart();
}

RELPOS_APART void Node::tick(uint32_t now_us) {
  ImuSample sample;
  if (!imu_.read(board_, sample.acceleration_m_s2, sample.angular_rate_rad_s)) {
    return;  // the next sample's time shows the gap
  }
  uint32_t step_us = sample_clock_.step_us(now_us);
  if (step_us > SampleClock::kGapUs) {
    const uint32_t missed = (step_us + SampleClock::kNominalUs / 2) / SampleClock::kNominalUs - 1;
    work_.missed_ticks = static_cast<uint16_t>(work_.missed_ticks + missed);
    quality_ |= flag(wire::Quality::kImuGap);
    if (step_us > kMostStepUs) {
      totals_.rebase(dead_reckoning_.displacement(),
                     static_cast<float>(clock_.ms() - last_sample_ms_) * 1e-3f);
      dead_reckoning_.reset();
      quality_ |= flag(wire::Quality::kFilterReset);
      updates_ = 0;
      seen_steps_ = 0;
      step_us = SampleClock::kNominalUs;
    }
  }
  sampled_ = true;
  last_sample_ms_ = clock_.ms();
  static_assert(sizeof sample == 6 * sizeof(float), "the two vectors are one of six");
  correct_inertial(settings_.calibration, reinterpret_cast<float*>(&sample),
                   raw_reports_ != 0 ? raw_ : nullptr);
  ++raw_samples_;
  dead_reckoning_.update(sample, static_cast<float>(step_us) * 1e-6f);
  ++updates_;

  float field_ut[3];
  // At a mid-stance a tick later: a reading and its use are 5 % of a tick, and that one is long.
  if (dead_reckoning_.displacement().last_step_tick != updates_ &&
      magnetometer_.step(board_, field_ut)) {
    if (raw_reports_ != 0) {
      memcpy(raw_ + 6, field_ut, sizeof field_ut);
      ++raw_fields_;
    }
    correct_field(settings_.calibration, field_ut);
    dead_reckoning_.magnetometer(field_ut);
    last_field_ms_ = clock_.ms();
  }

  const Displacement& now = dead_reckoning_.displacement();
  totals_.track(now);
  const uint16_t flags = now.quality_flags;
  uint8_t quality = quality_;
  if (flags & kMagneticDisturbed) quality |= flag(wire::Quality::kMagnetometerDisturbed);
  if (flags & (kAccelerationSaturated | kAngularRateSaturated)) {
    quality |= flag(wire::Quality::kSaturated);
  }
  if (flags & kForwardUnknown) quality |= flag(wire::Quality::kForwardAxisUnknown);
  if (flags & kStepDoubtful) quality |= flag(wire::Quality::kIrregularGait);
  if (flags & kBadInput) quality |= flag(wire::Quality::kImuGap);
  quality_ = quality;
  if (now.steps != seen_steps_) note_step();
}

void Node::note_step() {
  const Displacement& now = dead_reckoning_.displacement();
  seen_steps_ = now.steps;
  if (settings_.step_reports == 0) return;
  const uint32_t age_ms = (updates_ - now.last_step_tick) * (SampleClock::kNominalUs / 1000);
  PendingStep step;
  step.time_ms = static_cast<uint16_t>(clock_.ms() - age_ms);
  step.length_mm = static_cast<uint16_t>(scaled(now.last_step_length_m, 1000));
  if (!steps_.push(step)) ++lost_.dropped_steps;
}

// ---- ranging ----

RELPOS_SHARED void Node::run_ranging(uint32_t now_us) {
  uint32_t wait = 0;
  Pozyx::Result result;
  if (pozyx_.ready()) {
    wait = between_exchanges();
  } else if (pozyx_.step(board_, now_us, &wait, &result) == Pozyx::Event::kDone) {
    plan_.done(result.success);
    if (result.success) {
      ++work_.ranging_successes;
      PendingRange pending;
      pending.time_ms = clock_.ms();
      pending.range_mm = result.range_mm;
      pending.rss_dbm = result.rss_dbm;
      pending.peer = result.peer;
      if (raw_reports_ != 0 || !ranges_.push(pending)) ++lost_.dropped_ranges;
    } else {
      ++work_.ranging_failures;
      ranging_error_ = result.error;
    }
  }
  pozyx_due_us_ = now_us + (wait < kMostWaitUs ? wait : kMostWaitUs);
}

// The next exchange where it is time for one, else a look at pressure or identity. Microseconds
// until it has to be asked again.
uint32_t Node::between_exchanges() {
  uint16_t wait_ms = kLookPeriodMs;
  if (settings_.ranging_period_ms != 0 && raw_reports_ == 0) {
    const uint8_t peer =
        plan_.next(now_ms(), id_, settings_.team_size, settings_.ranging_period_ms, &wait_ms);
    if (peer != 0) {
      pozyx_.range(peer);
      return 0;
    }
  }
  if (static_cast<uint16_t>(now_ms() - looked_ms_) >= kLookPeriodMs) {
    looked_ms_ = now_ms();
    uint32_t pressure_mpa;
    if (pozyx_.look(board_, &pressure_mpa)) barometer_.add(pressure_mpa);
  }
  return wait_ms * 1000UL;
}

// ---- commands ----

// Verified first: a frame that is damaged, forged, of another team or old touches nothing.
RELPOS_APART void Node::receive_packet() {
  const uint8_t* frame = xbee_.received();
  const uint8_t length = xbee_.received_length();
  wire::Header header;
  const bool beacon = frame[wire::kTypeAt] == static_cast<uint8_t>(wire::MessageType::kBeacon);
  const wire::FrameStatus status =
      wire::open(frame, length, beacon ? keys_ + wire::kKeyBytes : keys_, &header);
  if (status != wire::FrameStatus::kGood) {
    ++*(status == wire::FrameStatus::kBadTag ? &lost_.refused_frames : &bad_frames_);
    return;
  }
  if (header.node != id_ && header.node != wire::kBroadcast) return;
  if (!beacon && header.type != wire::MessageType::kCommand &&
      header.type != wire::MessageType::kNewKey) {
    return;
  }
  uint32_t* mark = beacon ? &beacon_mark_ : &marks_.command;
  const uint8_t* body = frame + wire::kHeaderBytes;
  const uint8_t body_bytes = static_cast<uint8_t>(length - wire::kOverhead);
  // Modulo 2^32: counters never end. Nothing was ever taken: whatever comes first is new.
  const uint32_t skipped = header.counter - *mark - 1;
  if (*mark != 0 && skipped >= wire::kMostJump) {
    ++lost_.refused_frames;
    // The host goes on from the mark that it is told, whatever its clock says.
    if (!beacon && header.counter != *mark && body_bytes >= sizeof refused_token_) {
      memcpy(&refused_token_, body, sizeof refused_token_);
      refusal_due_ = true;
    }
    return;
  }
  // A record that a restart waits for is not changed while it is written.
  if (!beacon && reboot_step_ != 0) return;
  *mark = header.counter;
  if (beacon) {
    wire::Beacon message;
    if (wire::decode(body, body_bytes, &message)) plan_.beacon(now_ms(), message, id_);
    pozyx_due_us_ = board_.now_us();
  } else {
    beacon_mark_ = 0;  // so a host whose beacons are refused brings them back
    obey(header, body, body_bytes);
    store_.save(Record::kMarks);  // before the answer, also to a repetition
  }
}

void Node::obey(const wire::Header& header, const uint8_t* body, uint8_t length) {
  const bool new_key = header.type == wire::MessageType::kNewKey;
  if (length != (new_key ? wire::kNewKeyBytes : wire::kCommandBytes)) {
    ++bad_frames_;
    return;
  }
  wire::Command command;
  const bool known = !new_key && wire::decode(body, length, &command);
  const uint16_t key = wire::crc16(body, length);
  if (!known) {
    command.token = static_cast<uint16_t>(body[0] | static_cast<uint16_t>(body[1]) << 8);
    command.command = new_key ? static_cast<uint8_t>(wire::CommandCode::kSetKey) : body[2];
    command.value = 0;
  }
  for (DoneCommand& done : commands_) {
    if (done.known && done.token == command.token && done.key == key) {
      done.answer_due = true;
      return;
    }
  }
  DoneCommand& done = commands_[next_command_];
  if (done.known && done.answer_due) {  // four answers wait: the host will ask again
    ++bad_frames_;
    return;
  }
  if (++next_command_ == kRememberedCommands) next_command_ = 0;
  done.token = command.token;
  done.key = key;
  done.command = command.command;
  done.value = command.value;
  wire::CommandResult result = wire::CommandResult::kUnknownCommand;
  if (new_key) {
    result = wire::CommandResult::kCableOnly;
    if (xbee_.by_cable() || has_key()) {  // else everybody could read it, or give one
      wire::unmask_keys(header.counter, body, keys_);
      store_.save(Record::kKeys);
      result = wire::CommandResult::kDone;
    }
  } else if (known) {
    result = apply(command.command, command.value, &done.value);
  }
  done.result = static_cast<uint8_t>(result);
  done.known = true;
  done.answer_due = true;
}

RELPOS_APART bool Node::has_key() const {
  for (uint8_t i = 0; i < wire::kKeyBytes; ++i) {
    if (keys_[i] != 0) return true;
  }
  return false;
}

wire::CommandResult Node::apply(uint8_t command, int32_t value, int32_t* in_force) {
  const wire::CommandCode code = static_cast<wire::CommandCode>(command);
  if (code >= wire::CommandCode::kSetRawReports && code <= wire::CommandCode::kReadCalibration) {
    return apply_calibration(code, value, in_force);
  }
  if (code == wire::CommandCode::kAccessBus) {
    return access_bus(reinterpret_cast<uint8_t*>(in_force));
  }
  if (code == wire::CommandCode::kRestoreDefaults) {
    Storage::restore_defaults(&settings_);
    store_.save(Record::kSettings);
  }
  if (code == wire::CommandCode::kReboot || code == wire::CommandCode::kRestoreDefaults) {
    reboot_step_ = 1;
  }
  const Choice* choice = kChoices;
  while (flash_byte(&choice->command) != command) {
    if (++choice == kChoices + sizeof kChoices / sizeof kChoices[0]) {
      return wire::CommandResult::kDone;  // PING and REBOOT set nothing
    }
  }
  uint8_t* setting =
      reinterpret_cast<uint8_t*>(static_cast<Preferences*>(&settings_)) + flash_byte(&choice->offset);
  const bool wide = flash_byte(&choice->bytes) == 2;
  uint16_t before = setting[0];
  if (wide) before = static_cast<uint16_t>(before | static_cast<uint16_t>(setting[1]) << 8);
  *in_force = before;
  int32_t low = flash_word(&choice->low);
  const uint16_t high = flash_word(&choice->high);
  if (low > high) {
    low = static_cast<int16_t>(low);
    *in_force = static_cast<int16_t>(before);
  }
  // A period of 0 stops the ranging.
  const bool off = value == 0 && code == wire::CommandCode::kSetRangingPeriodMs;
  if (!off && (value < low || value > high)) {
    return wire::CommandResult::kOutOfRange;
  }
  if (value != *in_force) {
    *in_force = value;
    setting[0] = static_cast<uint8_t>(value);
    if (wide) setting[1] = static_cast<uint8_t>(value >> 8);
    if (code == wire::CommandCode::kSetLegLengthMm ||
        code == wire::CommandCode::kSetStepGainPermille) {
      ++settings_.gain_version;
      configure_inertial();
    }
    store_.save(Record::kSettings);
  }
  if (code == wire::CommandCode::kSetNodeId) reboot_step_ = 1;  // everything begins with it
  // A new period counts from now.
  if (code == wire::CommandCode::kSetReportPeriodMs) motion_ms_ = now_ms();
  if (code == wire::CommandCode::kSetStatusPeriodMs) status_ms_ = now_ms();
  if (settings_.step_reports == 0) steps_.clear();
  return wire::CommandResult::kDone;
}

// One transaction, for `relpos node check`. The value's bytes are address, register, a parameter, and how
// many are written (low half) and read; then the last two that were read, and how long it took.
wire::CommandResult Node::access_bus(uint8_t* bytes) {
  uint8_t answer[17] = {};
  const uint8_t counts = bytes[3];
  bytes[3] = 0;  // a Pozyx's peer has two bytes
  uint8_t* last = answer + (counts >> 4);
  const uint16_t start_us = static_cast<uint16_t>(board_.now_us());
  const BusStatus status =
      board_.transfer(bytes[0], bytes + 1, counts & 3, nullptr, 0, answer + 2, counts >> 4);
  const uint16_t took_us = static_cast<uint16_t>(board_.now_us()) - start_us;
  memcpy(bytes, last, 2);
  memcpy(bytes + 2, &took_us, 2);
  return status == BusStatus::kOk ? wire::CommandResult::kDone : wire::CommandResult::kNoAnswer;
}

RELPOS_APART void Node::report_raw(uint16_t reports) {
  if (raw_reports_ == 0) lost_.dropped_ranges += ranges_.count();
  raw_reports_ = reports;
  raw_samples_ = raw_fields_ = 0;
  memset(&ranges_, 0, sizeof ranges_);  // and the sums
}

wire::CommandResult Node::apply_calibration(wire::CommandCode code, int32_t value,
                                            int32_t* in_force) {
  if (code == wire::CommandCode::kSetRawReports) {
    if (static_cast<uint32_t>(value) > kMostRawReports) return wire::CommandResult::kOutOfRange;
    report_raw(static_cast<uint16_t>(value));
    return wire::CommandResult::kDone;
  }
  if (store_.saving() || !board_.storage_ready()) return wire::CommandResult::kBusy;
  if (code == wire::CommandCode::kCommitCalibration) {
    if (!store_.commit(board_, &settings_, static_cast<uint16_t>(value))) {
      return wire::CommandResult::kOutOfRange;
    }
    reboot_step_ = 1;  // once it is stored and answered: everything begins with it
    return wire::CommandResult::kDone;
  }
  if (static_cast<uint32_t>(value) >> 16 >= wire::kCalibrationWords) {
    return wire::CommandResult::kOutOfRange;
  }
  const uint8_t index = static_cast<uint8_t>(value >> 16);
  if (code == wire::CommandCode::kSetCalibration) {
    store_.stage(index, static_cast<uint16_t>(value));
  } else {
    *in_force = settings_.calibration[index];
  }
  return wire::CommandResult::kDone;
}

bool Node::answer_due() const {
  if (refusal_due_) return true;
  for (const DoneCommand& done : commands_) {
    if (done.answer_due) return true;
  }
  return false;
}

// Behind the answer: writes down whose command it was, a byte a poll and last what makes it count, then
// restarts.
bool Node::run_reboot() {
  if (reboot_step_ == 0 || store_.saving()) return false;
  if (reboot_step_ > kRebootBytes) {
    board_.reset();
    reboot_step_ = 0;  // where the board outlives its reset
    return false;
  }
  // The newest: since a restart is asked for, no other is taken.
  const DoneCommand* reboot =
      &commands_[(next_command_ == 0 ? kRememberedCommands : next_command_) - 1];
  const uint8_t bytes[kRebootBytes] = {
      static_cast<uint8_t>(reboot->token), static_cast<uint8_t>(reboot->token >> 8),
      static_cast<uint8_t>(reboot->key), static_cast<uint8_t>(reboot->key >> 8), boot_,
      static_cast<uint8_t>(~boot_)};
  const uint8_t at = static_cast<uint8_t>(reboot_step_ - 1);
  if (!board_.storage_ready()) return false;
  board_.storage_write(kStoredReboot + at, bytes[at]);
  ++reboot_step_;
  return true;
}

// ---- telemetry ----

// The module takes the next frame once the last one was delivered. After one that was not, or
// without a report, it gets no frame for a while: where the channel is full, more would make it worse.
bool Node::radio_free() {
  if (xbee_.busy()) return false;
  if (!xbee_.undelivered()) awaiting_status_ = false;
  if (!awaiting_status_) return true;
  if (static_cast<uint16_t>(now_ms() - sent_ms_) < kTransmitStatusMs) return false;
  awaiting_status_ = false;
  ++lost_.radio_failures;
  return true;
}

// Motion and status are written when they are sent, so they cannot wait in a queue and be dropped;
// ranges wait in a ring that gives up the oldest. They come last: they alone can fill the air. So can
// motion, where the radio's reports do not arrive and a frame takes 200 ms: every other frame at most.
RELPOS_APART bool Node::send_next() {
  uint8_t* body = frame_ + wire::kHeaderBytes;
  const bool after_motion =
      frame_[wire::kTypeAt] == static_cast<uint8_t>(wire::MessageType::kMotion);
  if (answer_due() && !store_.saving()) {  // acknowledged once it is done for good
    send(wire::MessageType::kAcknowledgement, fill_answer(body));
  } else if (!after_motion && period_over(&motion_ms_, settings_.report_period_ms)) {
    send(wire::MessageType::kMotion, fill_motion(body));
  } else if (period_over(&status_ms_, settings_.status_period_ms)) {
    send(wire::MessageType::kStatus, fill_status(body));
  } else if (steps_report_due()) {
    send(wire::MessageType::kSteps, fill_steps(body));
  } else if (raw_reports_ != 0 && period_over(&raw_ms_, kRawPeriodMs)) {
    send(wire::MessageType::kSamples, fill_samples(body));
  } else if (ranges_.count() >= wire::kMostRanges ||
             (ranges_.count() > 0 &&
              (plan_.resting() || !pozyx_.running() || settings_.ranging_period_ms == 0))) {
    send(wire::MessageType::kRanges, fill_ranges(body));
  } else if (period_over(&motion_ms_, settings_.report_period_ms)) {  // nothing else waits
    send(wire::MessageType::kMotion, fill_motion(body));
  } else {
    return false;
  }
  return true;
}

void Node::send(wire::MessageType type, uint8_t body_bytes) {
  if (body_bytes == 0) {  // a value out of its range: nothing is better than something wrong
    ++lost_.radio_failures;
    return;
  }
  wire::Header header;
  header.type = type;
  header.node = id_;
  header.boot = boot_;
  header.counter = counter_++;
  const uint8_t length = wire::seal(header, body_bytes, keys_, frame_);
  if (marks_.counter_end - counter_ < kCountersLeft) reserve_counters();
  awaiting_status_ = true;
  sent_ms_ = now_ms();
  xbee_.send(wire::kCoordinator, frame_, length);
}

RELPOS_APART void Node::reserve_counters() {
  marks_.counter_end += kCounterBlock;
  store_.save(Record::kMarks);
}

uint8_t Node::fill_motion(uint8_t* body) {
  const Displacement& now = dead_reckoning_.displacement();
  wire::Motion motion = {};
  totals_.fill(now, &motion);
  const bool silent = imu_silent();
  const bool field = clock_.ms() - last_field_ms_ <= kFieldStaleMs;
  // The totals end with the last sample, not with this moment.
  motion.time_ms = !silent ? last_sample_ms_ : clock_.ms();
  if (field && now.magnetic_heading_valid) {
    motion.magnetic_heading_100urad =
        static_cast<int16_t>(scaled(now.magnetic_heading_rad, 10000));
    quality_ |= flag(wire::Quality::kMagnetometerValid);
  }
  if (pozyx_.running() && barometer_.ready()) {
    const int32_t height_cm = static_cast<int32_t>(scaled(barometer_.height_m(), 100));
    motion.height_cm = static_cast<int16_t>(height_cm);
    if (motion.height_cm == height_cm) quality_ |= flag(wire::Quality::kHeightValid);
  }
  if (silent) quality_ |= flag(wire::Quality::kImuGap);
  wire::MotionState state = now.moving ? wire::MotionState::kMoving : wire::MotionState::kStanding;
  if (silent || !now.initialised) state = wire::MotionState::kStarting;
  motion.state = static_cast<uint8_t>(state);
  motion.gain_version = settings_.gain_version;
  motion.quality = quality_;
  quality_ = 0;
  return wire::encode(motion, body);
}

uint8_t Node::fill_ranges(uint8_t* body) {
  wire::Ranges message;
  message.time_ms = clock_.ms();
  message.count = 0;
  while (ranges_.count() > 0 && message.count < wire::kMostRanges) {
    const PendingRange pending = ranges_.pop();
    const uint32_t age_ms = message.time_ms - pending.time_ms;
    if (age_ms > 0xFFFF) {
      ++lost_.dropped_ranges;
      continue;
    }
    wire::RangeEntry& entry = message.entries[message.count++];
    entry.peer = pending.peer;
    entry.range_mm = pending.range_mm;
    entry.rss_dbm = pending.rss_dbm;
    entry.age_ms = static_cast<uint16_t>(age_ms);
    entry.quality = pending.rss_dbm < kWeakSignalDbm
                        ? static_cast<uint8_t>(wire::RangeQuality::kWeakSignal)
                        : 0;
  }
  return wire::encode(message, body);
}

uint8_t Node::fill_status(uint8_t* body) {
  wire::Status status = {};
  status.time_ms = clock_.ms();
  status.firmware_major = kFirmwareMajor;
  status.firmware_minor = kFirmwareMinor;
  status.firmware_patch = kFirmwarePatch;
  status.uptime_s = clock_.ms() / 1000;
  status.reset_cause = static_cast<uint8_t>(reset_cause_);
  status.battery_mv = board_.supply_mv();
  supply_low_ = static_cast<uint16_t>(status.battery_mv - 1) < kSupplyLowMv - 1;  // 0: not measured
  status.bus_errors = board_.bus_errors();
  static_assert(offsetof(wire::Status, missed_ticks) - offsetof(wire::Status, ranging_successes) ==
                        sizeof work_ - sizeof work_.missed_ticks &&
                    offsetof(wire::Status, refused_frames) - offsetof(wire::Status, dropped_ranges) ==
                        sizeof lost_ - sizeof lost_.refused_frames,
                "counters in the message's order");
  memcpy(&status.ranging_successes, &work_, sizeof work_);
  memcpy(&status.dropped_ranges, &lost_, sizeof lost_);
  status.free_stack_bytes = board_.free_stack();
  status.bad_frames = static_cast<uint16_t>(bad_frames_ + xbee_.bad_frames());
  const UartErrors uart = board_.uart_errors();
  status.damaged_bytes = uart.damaged;
  status.lost_bytes = uart.lost;
  status.ranging_error = ranging_error_;
  status.range_offset_mm = settings_.range_offset_mm;
  uint8_t health = 0;
  if (!imu_silent()) health |= flag(wire::Health::kImu);
  if (magnetometer_.running()) health |= flag(wire::Health::kMagnetometer);
  if (pozyx_.running()) health |= flag(wire::Health::kPozyx);
  if (pozyx_.running() && barometer_.ready()) health |= flag(wire::Health::kPressure);
  plan_.age(now_ms());
  status.neighbours = plan_.neighbours();
  status.team = plan_.team();
  if (status.team != 0) health |= flag(wire::Health::kBeacon);
  if (has_key()) health |= flag(wire::Health::kKeySet);
  status.health = health;
  work_.worst_tick_us = 0;
  return wire::encode(status, body);
}

bool Node::steps_report_due() const {
  if (steps_.count() == 0) return false;
  const uint16_t age_ms = static_cast<uint16_t>(now_ms() - steps_.oldest().time_ms);
  return steps_.count() >= kPendingSteps / 2 || age_ms > kMostStepAgeMs;
}

uint8_t Node::fill_steps(uint8_t* body) {
  wire::Steps message;
  message.time_ms = clock_.ms();
  message.count = 0;
  while (steps_.count() > 0 && message.count < wire::kMostSteps) {
    const PendingStep step = steps_.pop();
    wire::StepEntry& entry = message.entries[message.count++];
    entry.age_ms = static_cast<uint16_t>(static_cast<uint16_t>(message.time_ms) - step.time_ms);
    entry.length_mm = step.length_mm;
  }
  return wire::encode(message, body);
}

uint8_t Node::fill_samples(uint8_t* body) {
  wire::Samples message;
  message.time_ms = last_sample_ms_;
  message.samples = raw_samples_;
  message.field_readings = raw_fields_;
  static_assert(offsetof(wire::Samples, samples) - sizeof raw_ ==
                    offsetof(wire::Samples, acceleration_x_10um_s2),
                "nine values in a row");
  int32_t* out = &message.acceleration_x_10um_s2;
  for (const float value : raw_) *out++ = static_cast<int32_t>(scaled(value, 100000));
  report_raw(raw_reports_ - 1);
  return wire::encode(message, body);
}

uint8_t Node::fill_answer(uint8_t* body) {
  if (refusal_due_) {
    refusal_due_ = false;
    wire::Acknowledgement answer;
    answer.token = refused_token_;
    answer.command = 0xFF;  // whichever it was: it was not read
    answer.result = static_cast<uint8_t>(wire::CommandResult::kCounterRefused);
    answer.value = static_cast<int32_t>(marks_.command);
    return wire::encode(answer, body);
  }
  for (DoneCommand& done : commands_) {
    if (!done.answer_due) continue;
    done.answer_due = false;
    wire::Acknowledgement answer;
    answer.token = done.token;
    answer.command = done.command;
    answer.result = done.result;
    answer.value = done.value;
    return wire::encode(answer, body);
  }
  return 0;
}

}  // namespace relpos
