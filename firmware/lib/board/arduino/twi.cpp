#if defined(ARDUINO)

#include "twi.h"

#include <avr/io.h>
#include <util/delay.h>

namespace relpos {
namespace twi {
namespace {

#if defined(__AVR_ATmega2560__)
constexpr uint8_t kSda = _BV(PD1);
constexpr uint8_t kScl = _BV(PD0);
#define RELPOS_TWI_PORT PORTD
#define RELPOS_TWI_DDR DDRD
#define RELPOS_TWI_PIN PIND
#else
constexpr uint8_t kSda = _BV(PC4);
constexpr uint8_t kScl = _BV(PC5);
#define RELPOS_TWI_PORT PORTC
#define RELPOS_TWI_DDR DDRC
#define RELPOS_TWI_PIN PINC
#endif

// For long wires or weak pull-ups: -DRELPOS_TWI_HZ=100000.
#ifndef RELPOS_TWI_HZ
#define RELPOS_TWI_HZ 400000
#endif
constexpr uint32_t kBitRate = RELPOS_TWI_HZ;
// Of timer 1, the board's clock, for a transaction: the longest, 18 bytes read, takes half of it.
constexpr uint16_t kMostCounts = 400000UL * (1000 / 4) / kBitRate;
constexpr uint16_t kMostStretchCounts = Board::kMostStretchUs / 4;

enum Status : uint8_t {  // TWSR without the prescaler
  kStart = 0x08,
  kRepeatedStart = 0x10,
  kAddressWriteAck = 0x18,
  kAddressWriteNack = 0x20,
  kDataWriteAck = 0x28,
  kDataWriteNack = 0x30,
  kAddressReadAck = 0x40,
  kAddressReadNack = 0x48,
  kDataReadAck = 0x50,
  kDataReadNack = 0x58
};

uint16_t deadline;  // of the transaction, by the clock

bool late() { return static_cast<int16_t>(TCNT1 - deadline) > 0; }

// Starts what `control` asks for and waits. 0 (no status of a master) where the deadline passes.
uint8_t run(uint8_t control) {
  TWCR = static_cast<uint8_t>(control | _BV(TWINT) | _BV(TWEN));
  while ((TWCR & _BV(TWINT)) == 0) {
    if (late()) return 0;
  }
  return TWSR & 0xF8;
}

BusStatus open(uint8_t address_and_direction) {
  const uint8_t begun = run(_BV(TWSTA));
  if (begun != kStart && begun != kRepeatedStart) return BusStatus::kTimeout;
  TWDR = address_and_direction;
  switch (run(0)) {
    case kAddressWriteAck:
    case kAddressReadAck:
      return BusStatus::kOk;
    case kAddressWriteNack:
    case kAddressReadNack:
      return BusStatus::kAddressNack;
    default:  // silence, or arbitration lost to noise: there is no other master
      return BusStatus::kTimeout;
  }
}

BusStatus write(uint8_t address, const uint8_t* bytes, uint8_t count) {
  const BusStatus opened = open(static_cast<uint8_t>(address << 1));
  if (opened != BusStatus::kOk) return opened;
  for (; count != 0; --count) {
    TWDR = *bytes++;
    const uint8_t sent = run(0);
    if (sent == kDataWriteNack) return BusStatus::kDataNack;
    if (sent != kDataWriteAck) return BusStatus::kTimeout;
  }
  return BusStatus::kOk;
}

BusStatus read_bytes(uint8_t address, uint8_t* bytes, uint8_t count) {
  const BusStatus opened = open(static_cast<uint8_t>(address << 1 | 1));
  if (opened != BusStatus::kOk) return opened;
  for (; count != 0; --count) {
    const uint8_t got = run(count > 1 ? _BV(TWEA) : 0);
    if (got != (count > 1 ? kDataReadAck : kDataReadNack)) return BusStatus::kTimeout;
    *bytes++ = TWDR;
  }
  return BusStatus::kOk;
}

// A slave that was cut off in the middle of a byte holds SDA until it has clocked it out: nine
// clocks by hand, then a stop.
void recover() {
  TWCR = 0;
  RELPOS_TWI_PORT |= kSda | kScl;
  for (uint8_t i = 0; i < 9 && (RELPOS_TWI_PIN & kSda) == 0; ++i) {
    RELPOS_TWI_PORT &= static_cast<uint8_t>(~kScl);  // without the pull-up, then driven low
    RELPOS_TWI_DDR |= kScl;
    _delay_us(5);
    RELPOS_TWI_DDR &= static_cast<uint8_t>(~kScl);
    RELPOS_TWI_PORT |= kScl;
    _delay_us(5);
  }
  RELPOS_TWI_PORT &= static_cast<uint8_t>(~kSda);
  RELPOS_TWI_DDR |= kSda;
  _delay_us(5);
  RELPOS_TWI_DDR &= static_cast<uint8_t>(~kSda);  // SDA rises with SCL high: stop
  RELPOS_TWI_PORT |= kSda;
  TWCR = _BV(TWEN);
}

}  // namespace

void begin() {
  RELPOS_TWI_PORT |= kSda | kScl;
  TWSR = 0;
  TWBR = static_cast<uint8_t>((F_CPU / kBitRate - 16) / 2);
  TWCR = _BV(TWEN);
}

BusStatus transfer(uint8_t address, const uint8_t* first, uint8_t first_count,
                   const uint8_t* second, uint8_t second_count, uint8_t* read,
                   uint8_t read_count) {
  deadline = TCNT1 + kMostCounts;
  if (address == Board::kStretchingAddress) deadline += kMostStretchCounts;
  BusStatus status = BusStatus::kOk;
  if (first_count != 0 || read_count == 0) status = write(address, first, first_count);
  if (status == BusStatus::kOk && second_count != 0) {
    status = write(address, second, second_count);
  }
  if (status == BusStatus::kOk && read_count != 0) {
    status = read_bytes(address, read, read_count);
  }
  if (status == BusStatus::kTimeout) {
    recover();
    return status;
  }
  TWCR = _BV(TWINT) | _BV(TWEN) | _BV(TWSTO);
  while ((TWCR & _BV(TWSTO)) != 0) {
    if (late()) {
      recover();
      return BusStatus::kTimeout;
    }
  }
  return status;
}

}  // namespace twi
}  // namespace relpos

#endif
