#if defined(ARDUINO)

#include "uart.h"
#include "inertial/calls.h"

#include <avr/interrupt.h>
#include <avr/io.h>

namespace relpos {
namespace uart {
namespace {

constexpr uint32_t kBaud = 38400;
// 16 MHz / 8 / 52 = 38462 baud, 0.16 % fast. Without double speed the divisor is the same to the
// half, 26, and so is the error; double speed samples fewer times a bit but errs no more.
constexpr uint16_t kDivisor = (F_CPU / 8 + kBaud / 2) / kBaud - 1;

// A tick of 9 ms lets 35 bytes arrive.
constexpr uint8_t kReceiveBytes = 64;
// Between two passes of the loop at most a tick: what runs dry meanwhile is only a pause.
constexpr uint8_t kWriteBytes = 16;
static_assert((kReceiveBytes & (kReceiveBytes - 1)) == 0, "rings turn over by a mask");
static_assert((kWriteBytes & (kWriteBytes - 1)) == 0, "rings turn over by a mask");

volatile uint8_t received[kReceiveBytes];
volatile uint8_t received_head, received_tail;  // head: next to write
volatile uint8_t written[kWriteBytes];
volatile uint8_t written_head, written_tail;
UartErrors counts;

}  // namespace

void begin() {
  UCSR0A = _BV(U2X0);
  UBRR0 = kDivisor;
  UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
  UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
}

uint8_t write_space() {
  return static_cast<uint8_t>(written_tail - written_head - 1) & (kWriteBytes - 1);
}

RELPOS_APART void write(uint8_t byte) {
  const uint8_t head = written_head;
  written[head] = byte;
  written_head = static_cast<uint8_t>(head + 1) & (kWriteBytes - 1);
  UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0) | _BV(UDRIE0);
}

int16_t read() {
  const uint8_t tail = received_tail;
  if (tail == received_head) return -1;
  const uint8_t byte = received[tail];
  received_tail = static_cast<uint8_t>(tail + 1) & (kReceiveBytes - 1);
  return byte;
}

bool waiting() { return received_tail != received_head; }

UartErrors errors() {
  cli();
  const UartErrors now = counts;
  sei();
  return now;
}

}  // namespace uart
}  // namespace relpos

#if defined(__AVR_ATmega2560__)
#define RELPOS_RECEIVED_VECTOR USART0_RX_vect
#define RELPOS_EMPTY_VECTOR USART0_UDRE_vect
#else
#define RELPOS_RECEIVED_VECTOR USART_RX_vect
#define RELPOS_EMPTY_VECTOR USART_UDRE_vect
#endif

ISR(RELPOS_RECEIVED_VECTOR) {
  using namespace relpos::uart;
  const uint8_t flags = UCSR0A;  // of the byte: read first
  const uint8_t byte = UDR0;
  if ((flags & _BV(FE0)) != 0) {
    ++counts.damaged;
    return;
  }
  const uint8_t head = received_head;
  const uint8_t next = static_cast<uint8_t>(head + 1) & (kReceiveBytes - 1);
  const bool full = next == received_tail;
  if (full || (flags & _BV(DOR0)) != 0) ++counts.lost;
  if (full) return;
  received[head] = byte;
  received_head = next;
}

ISR(RELPOS_EMPTY_VECTOR) {
  using namespace relpos::uart;
  const uint8_t tail = written_tail;
  UDR0 = written[tail];
  const uint8_t next = static_cast<uint8_t>(tail + 1) & (kWriteBytes - 1);
  written_tail = next;
  if (next == written_head) UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
}

#endif
