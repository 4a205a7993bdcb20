#include "devices/xbee.h"
#include "inertial/calls.h"

namespace relpos {
namespace {

constexpr uint8_t kDelimiter = 0x7E;
constexpr uint8_t kEscape = 0x7D;
constexpr uint8_t kEscapeFlip = 0x20;
constexpr uint8_t kXon = 0x11;
constexpr uint8_t kXoff = 0x13;

enum FrameType : uint8_t {
  kTransmit16 = 0x01,
  kReceive64 = 0x80,
  kReceive16 = 0x81,
  kTransmitStatus = 0x89,
};

constexpr uint8_t kTransmit16Header = 5;  // type, frame id, destination, options
constexpr uint8_t kReceive16Header = 5;   // type, source, signal strength, options
constexpr uint8_t kReceive64Header = 11;
constexpr uint8_t kTransmitStatusBytes = 3;  // type, frame id, status
constexpr uint8_t kFirstData = 3 + kTransmit16Header;  // in the outgoing frame

bool needs_escape(uint8_t byte) {
  return byte == kDelimiter || byte == kEscape || byte == kXon || byte == kXoff;
}

bool is_payload(uint8_t type) { return type == kReceive16 || type == kReceive64; }

uint8_t header_bytes(uint8_t type) {
  return type == kReceive16 ? kReceive16Header : kReceive64Header;
}

}  // namespace

bool Xbee::send(uint16_t destination, const uint8_t* data, uint8_t length) {
  if (sending_) return false;
  data_ = data;
  data_length_ = length;
  destination_ = destination;
  position_ = 0;
  sent_sum_ = 0;
  // 0 would ask for no status.
  if (++frame_id_ == 0) frame_id_ = 1;
  sending_ = true;
  undelivered_ = true;
  return true;
}

RELPOS_SHARED uint8_t Xbee::next_byte() const {
  if (position_ >= kFirstData) {
    const uint8_t at = static_cast<uint8_t>(position_ - kFirstData);
    return at < data_length_ ? data_[at] : static_cast<uint8_t>(0xFF - sent_sum_);
  }
  switch (position_) {
    case 0: return kDelimiter;
    case 1: return 0;  // of the length, the high byte
    case 2: return static_cast<uint8_t>(kTransmit16Header + data_length_);
    case 3: return kTransmit16;
    case 4: return frame_id_;
    case 5: return static_cast<uint8_t>(destination_ >> 8);
    case 6: return static_cast<uint8_t>(destination_);
    default: return 0;  // options: acknowledged
  }
}

void Xbee::push(Board& board) {
  uint8_t space = board.uart_write_space();
  while (sending_ && space > 0) {
    --space;
    const uint8_t byte = next_byte();
    const bool escaped = position_ > 0 && needs_escape(byte);
    if (escaped && !sent_escape_) {
      board.uart_write(kEscape);
      sent_escape_ = true;
      continue;
    }
    board.uart_write(escaped ? static_cast<uint8_t>(byte ^ kEscapeFlip) : byte);
    sent_escape_ = false;
    if (position_ >= 3) sent_sum_ = static_cast<uint8_t>(sent_sum_ + byte);
    sending_ = position_++ < kFirstData + data_length_;
  }
}

bool Xbee::step(Board& board) {
  push(board);
  for (;;) {
    const int16_t byte = board.uart_read();
    if (byte < 0) return false;
    if (take(static_cast<uint8_t>(byte))) return true;
  }
}

RELPOS_APART void Xbee::reject() {
  ++bad_frames_;
  part_ = Part::kNone;
}

RELPOS_SHARED bool Xbee::take(uint8_t byte) {
  if (byte == kDelimiter) {  // always a frame's start, here also the end of one broken off
    if (part_ != Part::kNone) ++bad_frames_;
    part_ = Part::kLengthHigh;
    took_escape_ = false;
    return false;
  }
  if (byte == kEscape) {
    took_escape_ = true;
    return false;
  }
  if (took_escape_) {
    byte ^= kEscapeFlip;
    took_escape_ = false;
  }
  switch (part_) {
    case Part::kNone:
      break;
    case Part::kLengthHigh:
      length_ = static_cast<uint16_t>(static_cast<uint16_t>(byte) << 8);
      part_ = Part::kLengthLow;
      break;
    case Part::kLengthLow:
      length_ = static_cast<uint16_t>(length_ | byte);
      index_ = 0;
      sum_ = 0;
      payload_length_ = 0;
      part_ = Part::kData;
      if (length_ == 0) reject();
      break;
    case Part::kData:
      sum_ = static_cast<uint8_t>(sum_ + byte);
      take_data(byte);
      if (part_ == Part::kData && ++index_ == length_) part_ = Part::kChecksum;
      break;
    case Part::kChecksum:
      sum_ = static_cast<uint8_t>(sum_ + byte);
      return finish();
  }
  return false;
}

RELPOS_SHARED void Xbee::take_data(uint8_t byte) {
  if (index_ == 0) {
    type_ = byte;
    const uint16_t payload_bytes = static_cast<uint16_t>(length_ - header_bytes(byte));
    // One too short for its header wraps.
    const bool bad_length = is_payload(byte) && payload_bytes > kMostPayload;
    const bool bad_status = byte == kTransmitStatus && length_ != kTransmitStatusBytes;
    if (bad_length || bad_status) reject();
  } else if (type_ == kTransmitStatus) {
    payload_[index_ - 1] = byte;  // frame id, status
  } else if (is_payload(type_)) {
    const uint8_t header = header_bytes(type_);
    if (index_ >= header) {
      payload_[payload_length_++] = byte;
    } else {
      options_ = byte;  // the header's last
    }
  }
}

RELPOS_UNCLONED bool Xbee::finish() {
  if (sum_ != 0xFF) {
    reject();
    return false;
  }
  part_ = Part::kNone;
  if (is_payload(type_)) return true;
  if (type_ != kTransmitStatus) {
    ++bad_frames_;  // asked for by nobody: the module reports its own restart
  } else if (payload_[0] == frame_id_ && payload_[1] == 0) {
    undelivered_ = false;
  }
  return false;
}

}  // namespace relpos
