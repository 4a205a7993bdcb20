// The node: 50 Hz dead reckoning, rounds of ranging, telemetry, commands. Everything happens in
// poll(), one bounded piece at a time; the time is an argument.
#pragma once

#include <stdint.h>

#include "board/board.h"
#include "devices/ak8975.h"
#include "devices/mpu9150.h"
#include "devices/pozyx.h"
#include "devices/xbee.h"
#include "inertial/dead_reckoning.h"
#include "node/barometer.h"
#include "node/clock.h"
#include "node/motion_totals.h"
#include "node/ranging.h"
#include "node/ring.h"
#include "node/settings.h"
#include "wire/frame.h"
#include "wire/messages.h"

namespace relpos {

// Everything of the node that starts at zero. Cleared as one block: member by member it would cost
// the Uno a kilobyte of flash.
struct NodeState : Persistent {
  static constexpr uint8_t kRememberedCommands = 4;
  static constexpr uint8_t kPendingRanges = 8;
  static constexpr uint8_t kPendingSteps = 6;

  struct PendingRange {
    uint32_t time_ms;
    uint32_t range_mm;
    int8_t rss_dbm;
    uint8_t peer;
  };
  struct PendingStep {
    uint16_t time_ms;  // low bits: it is sent within seconds
    uint16_t length_mm;
  };
  struct DoneCommand {
    uint16_t token;
    uint16_t key;  // CRC of the whole command: a token used anew for another command is another one
    int32_t value;
    uint8_t command;
    uint8_t result;
    bool known;
    bool answer_due;
  };

  Mpu9150 imu_;
  Ak8975 magnetometer_;
  Pozyx pozyx_;
  Xbee xbee_;
  NodeClock clock_;
  SampleClock sample_clock_;
  MotionTotals totals_;
  Storage store_;
  union {  // a node that reports raw samples does not range
    Ring<PendingRange, kPendingRanges> ranges_;
    float raw_[9];  // sums of specific force and angular rate, newest field
  };
  Ring<PendingStep, kPendingSteps> steps_;
  DoneCommand commands_[kRememberedCommands];
  uint32_t imu_due_us_;
  uint32_t last_sample_ms_;
  uint32_t last_field_ms_;
  uint32_t updates_;  // of the dead reckoning since its reset
  uint16_t seen_steps_;
  uint8_t quality_;  // gathered since the last motion message
  bool sampled_;  // ever
  uint32_t pozyx_due_us_;
  RangingPlan plan_;
  Barometer barometer_;
  uint16_t looked_ms_;  // at the Pozyx between exchanges
  // In the order of the status, which copies each as one.
  struct {
    uint16_t ranging_successes, ranging_failures, worst_tick_us, missed_ticks;
  } work_;
  struct {
    uint16_t dropped_ranges, dropped_steps, radio_failures, refused_frames;
  } lost_;
  uint8_t ranging_error_;  // of the newest exchange that failed
  uint16_t raw_ms_;  // of the last report, low bits as in the next ones
  uint16_t raw_reports_;  // still to be sent
  uint8_t raw_samples_;   // in the sums
  uint8_t raw_fields_;    // since the last report
  uint16_t motion_ms_;
  uint16_t status_ms_;
  uint16_t sent_ms_;
  uint32_t counter_;      // of the next frame
  uint32_t beacon_mark_;  // newest counter of a beacon; not kept over a restart or a command
  uint16_t bad_frames_;   // behind a good XBee checksum
  uint16_t refused_token_;  // of a command whose counter does not follow, while that is to be told
  bool refusal_due_;
  uint8_t next_command_;
  bool awaiting_status_;
  uint8_t frame_[wire::kFrameBytes];
  wire::ResetCause reset_cause_;
  uint8_t id_;
  uint8_t boot_;
  uint8_t reboot_step_;  // 0: no reboot asked
  bool supply_low_;
  bool led_;
  bool speaking_;
};

class Node : private NodeState {
 public:
  explicit Node(Board& board) : NodeState(), board_(board) {}

  // node_id 0: the stored one. Counts the start.
  void begin(uint32_t now_us, wire::ResetCause cause, uint8_t node_id);
  // One pass of the main loop; returns microseconds until it wants the next (0: at once).
  uint32_t poll(uint32_t now_us);

  uint8_t id() const { return id_; }

 private:
  void run_imu(uint32_t now_us);
  void tick(uint32_t now_us);
  void note_step();
  void run_ranging(uint32_t now_us);
  uint32_t between_exchanges();

  void receive_packet();
  void obey(const wire::Header& header, const uint8_t* body, uint8_t length);
  bool has_key() const;
  wire::CommandResult apply(uint8_t command, int32_t value, int32_t* in_force);
  void report_raw(uint16_t reports);
  wire::CommandResult access_bus(uint8_t* bytes);
  wire::CommandResult apply_calibration(wire::CommandCode code, int32_t value, int32_t* in_force);
  void configure_inertial();
  bool answer_due() const;
  bool run_reboot();

  bool radio_free();
  bool send_next();
  void send(wire::MessageType type, uint8_t body_bytes);
  uint8_t fill_motion(uint8_t* body);
  uint8_t fill_ranges(uint8_t* body);
  uint8_t fill_status(uint8_t* body);
  uint8_t fill_steps(uint8_t* body);
  uint8_t fill_samples(uint8_t* body);
  uint8_t fill_answer(uint8_t* body);
  void reserve_counters();
  bool steps_report_due() const;
  uint16_t now_ms() const { return static_cast<uint16_t>(clock_.ms()); }
  bool period_over(uint16_t* last_ms, uint16_t period_ms);
  void show_health();
  bool imu_silent() const;
  uint32_t wait_us(uint32_t now_us) const;
  void shorten(uint16_t last_ms, uint16_t period_ms, uint16_t* wait_ms) const;

  Board& board_;
  DeadReckoning dead_reckoning_;
};

}  // namespace relpos
