// XBee module in API mode with escapes (AP=2), 802.15.4 firmware, this node's 16-bit address set.
#pragma once

#include <stdint.h>

#include "board/board.h"

namespace relpos {

// Sending: the frame stays with the caller; it is escaped on the fly into the UART as space allows.
class XbeeSender {
 public:
  bool busy() const { return stage_ != Stage::kNone; }
  // Starts a TX16 request with acknowledgement. The payload must stay until busy() is false.
  // frame_id 0: no transmit status wanted.
  void start(uint8_t frame_id, uint16_t destination, const uint8_t* payload, uint8_t count);
  void pump(Board& board);

 private:
  enum class Stage : uint8_t { kNone, kDelimiter, kBody, kChecksum };

  uint8_t body_byte() const;

  const uint8_t* payload_ = nullptr;
  uint16_t destination_ = 0;
  uint8_t count_ = 0;
  uint8_t frame_id_ = 0;
  uint8_t position_ = 0;  // in length and frame data
  uint8_t checksum_ = 0;
  bool escaped_ = false;  // the escape byte is out, the byte itself is not
  Stage stage_ = Stage::kNone;
};

// Receiving: bytes in, checked packets out; after garbage it finds the next delimiter.
class XbeeReceiver {
 public:
  enum class Event : uint8_t { kNothing, kPacket, kTransmitStatus };

  static constexpr uint8_t kMostPayload = 34;  // a command with authentication has 28

  Event feed(uint8_t byte);
  // Of the last packet (RX16), until the next feed().
  uint16_t source() const;
  const uint8_t* payload() const { return data_ + kReceiveHeader; }
  uint8_t payload_count() const { return static_cast<uint8_t>(length_ - kReceiveHeader); }
  // Of the last transmit status.
  uint8_t status_frame_id() const { return data_[1]; }
  uint8_t status() const { return data_[2]; }
  uint16_t bad_frames() const { return bad_frames_; }  // cut off, too long or damaged; wraps

 private:
  static constexpr uint8_t kReceiveHeader = 5;  // type, source(2), rssi, options
  enum class Stage : uint8_t { kDelimiter, kLengthHigh, kLengthLow, kData, kChecksum };

  Event finish();

  uint8_t data_[kReceiveHeader + kMostPayload];
  uint8_t length_ = 0;
  uint8_t position_ = 0;
  uint8_t checksum_ = 0;
  bool escape_ = false;
  Stage stage_ = Stage::kDelimiter;
  uint16_t bad_frames_ = 0;
};

}  // namespace relpos
