// Digi XBee 802.15.4 in API mode with escapes (AP=2), 16-bit addresses.
#pragma once

#include <stdint.h>

#include "board/board.h"
#include "wire/frame.h"

namespace relpos {

// Streams without waiting and without a second buffer: the sender's bytes are escaped straight into
// the UART; of what comes only RF payloads are kept. Zeroed memory is the start: make it as `Xbee()`.
class Xbee {
 public:
  // Of what comes down new keys are the longest. A whole frame's room would cost 13 bytes of RAM.
  static constexpr uint8_t kMostPayload = wire::kOverhead + wire::kNewKeyBytes;
  static_assert(wire::kNewKeyBytes >= wire::kCommandBytes && wire::kNewKeyBytes >= wire::kBeaconBytes,
                "the longest");

  bool busy() const { return sending_; }
  // Begins a TX16 request. The data must stay unchanged until !busy(). False while busy().
  bool send(uint16_t destination, const uint8_t* data, uint8_t length);
  // The module has not reported that the last request was delivered.
  bool undelivered() const { return undelivered_; }
  // Pushes what fits into the UART and reads what has come, up to the end of the first RF payload.
  // True where there is one: received(), received_length() and by_cable() hold until the next step.
  bool step(Board& board);
  const uint8_t* received() const { return payload_; }
  uint8_t received_length() const { return payload_length_; }
  // The host speaks in the module's place: no module sets these options, and no sender can.
  bool by_cable() const { return options_ == wire::kCableOptions; }
  uint16_t bad_frames() const { return bad_frames_; }    // checksum, length, broken off; wraps

 private:
  enum class Part : uint8_t { kNone, kLengthHigh, kLengthLow, kData, kChecksum };

  void push(Board& board);
  uint8_t next_byte() const;
  bool take(uint8_t byte);
  void take_data(uint8_t byte);
  bool finish();
  void reject();

  const uint8_t* data_;
  uint16_t destination_;
  uint8_t position_;  // in the outgoing frame, delimiter included, escapes not
  uint8_t data_length_;
  uint8_t frame_id_;
  uint8_t sent_sum_;
  bool sending_;
  bool sent_escape_;
  bool undelivered_;

  Part part_;
  bool took_escape_;
  uint8_t type_;
  uint8_t sum_;
  uint8_t payload_length_;
  uint16_t length_;  // of the incoming frame data
  uint16_t index_;   // in it
  uint8_t options_;
  uint16_t bad_frames_;
  uint8_t payload_[kMostPayload];
};

}  // namespace relpos
