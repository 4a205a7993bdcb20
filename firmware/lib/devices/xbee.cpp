#include "devices/xbee.h"

namespace relpos {
namespace {

enum FrameType : uint8_t { kTransmit16 = 0x01, kReceive16 = 0x81, kTransmitStatus = 0x89 };
enum Special : uint8_t { kDelimiter = 0x7E, kEscape = 0x7D, kXon = 0x11, kXoff = 0x13 };

constexpr uint8_t kFlip = 0x20;         // an escaped byte travels xor this
constexpr uint8_t kLengthBytes = 2;
constexpr uint8_t kTransmitHeader = 5;  // type, frame id, destination(2), options
constexpr uint8_t kStatusBytes = 3;

bool special(uint8_t byte) {
  return byte == kDelimiter || byte == kEscape || byte == kXon || byte == kXoff;
}

}  // namespace

void XbeeSender::start(uint8_t frame_id, uint16_t destination, const uint8_t* payload,
                       uint8_t count) {
  frame_id_ = frame_id;
  destination_ = destination;
  payload_ = payload;
  count_ = count;
  position_ = 0;
  checksum_ = 0xFF;
  escaped_ = false;
  stage_ = Stage::kDelimiter;
}

uint8_t XbeeSender::body_byte() const {
  switch (position_) {
    case 0: return 0;  // frames are shorter than 256 bytes
    case 1: return static_cast<uint8_t>(kTransmitHeader + count_);
    case 2: return kTransmit16;
    case 3: return frame_id_;
    case 4: return static_cast<uint8_t>(destination_ >> 8);
    case 5: return static_cast<uint8_t>(destination_);
    case 6: return 0;  // options: acknowledged
    default: return payload_[position_ - kLengthBytes - kTransmitHeader];
  }
}

void XbeeSender::pump(Board& board) {
  if (!busy()) return;
  for (uint8_t space = board.uart_write_space(); space != 0 && busy(); --space) {
    if (stage_ == Stage::kDelimiter) {
      board.uart_write(kDelimiter);
      stage_ = Stage::kBody;
      continue;
    }
    const uint8_t byte = stage_ == Stage::kBody ? body_byte() : checksum_;
    if (special(byte) && !escaped_) {
      board.uart_write(kEscape);
      escaped_ = true;
      continue;
    }
    board.uart_write(escaped_ ? byte ^ kFlip : byte);
    escaped_ = false;
    if (stage_ == Stage::kChecksum) {
      stage_ = Stage::kNone;
      return;
    }
    if (position_ >= kLengthBytes) checksum_ = static_cast<uint8_t>(checksum_ - byte);
    if (++position_ == kLengthBytes + kTransmitHeader + count_) stage_ = Stage::kChecksum;
  }
}

uint16_t XbeeReceiver::source() const {
  return static_cast<uint16_t>(static_cast<uint16_t>(static_cast<uint16_t>(data_[1]) << 8) |
                               data_[2]);
}

XbeeReceiver::Event XbeeReceiver::feed(uint8_t byte) {
  if (byte == kDelimiter) {  // unescaped it begins a frame, always
    if (stage_ != Stage::kDelimiter) ++bad_frames_;
    stage_ = Stage::kLengthHigh;
    escape_ = false;
    return Event::kNothing;
  }
  if (stage_ == Stage::kDelimiter) return Event::kNothing;
  if (byte == kEscape && !escape_) {
    escape_ = true;
    return Event::kNothing;
  }
  if (escape_) {
    byte ^= kFlip;
    escape_ = false;
  }
  switch (stage_) {
    case Stage::kLengthHigh:
      length_ = byte;
      stage_ = Stage::kLengthLow;
      break;
    case Stage::kLengthLow:
      if (length_ != 0 || byte == 0 || byte > sizeof data_) {
        ++bad_frames_;
        stage_ = Stage::kDelimiter;
        break;
      }
      length_ = byte;
      position_ = 0;
      checksum_ = 0;
      stage_ = Stage::kData;
      break;
    case Stage::kData:
      data_[position_] = byte;
      checksum_ = static_cast<uint8_t>(checksum_ + byte);
      if (++position_ == length_) stage_ = Stage::kChecksum;
      break;
    case Stage::kChecksum:
      stage_ = Stage::kDelimiter;
      if (static_cast<uint8_t>(checksum_ + byte) == 0xFF) return finish();
      ++bad_frames_;
      break;
    case Stage::kDelimiter:
      break;
  }
  return Event::kNothing;
}

XbeeReceiver::Event XbeeReceiver::finish() {
  if (data_[0] == kReceive16 && length_ >= kReceiveHeader) return Event::kPacket;
  if (data_[0] == kTransmitStatus && length_ == kStatusBytes) return Event::kTransmitStatus;
  return Event::kNothing;  // modem status, AT responses: not for us
}

}  // namespace relpos
