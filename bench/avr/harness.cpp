// One filter on the ATmega328P, fed over UART 0 at 1 Mbaud: a record comes in (six floats, three of
// the field, whether that is new), the filter is updated between two marks in GPIOR0, its output
// goes back. Between records the chip sleeps, so no interrupt falls inside the marks.
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <stdint.h>

#include "filter.h"

namespace {

struct Record {
  bench::Sample sample;
  float field_ut[3];
  uint8_t field_is_new;
};
static_assert(sizeof(Record) == 37, "bench/avr/filters.py packs it so");

Record record;
volatile uint8_t came;

bool wait() {
  cli();
  const bool whole = came == sizeof record;
  if (!whole) {
    sleep_enable();
    sei();  // takes effect behind the next instruction: no byte slips in between
    sleep_cpu();
    sleep_disable();
  }
  sei();
  return whole;
}

void send(const uint8_t* bytes, uint8_t count) {
  for (; count != 0; --count) {
    while ((UCSR0A & _BV(UDRE0)) == 0) {
    }
    UDR0 = *bytes++;
  }
}

}  // namespace

ISR(USART_RX_vect) { reinterpret_cast<uint8_t*>(&record)[came++] = UDR0; }

int main() {
  UCSR0A = _BV(U2X0);
  UBRR0 = F_CPU / 8 / 1000000 - 1;
  UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
  set_sleep_mode(SLEEP_MODE_IDLE);
  bench::begin();
  for (;;) {
    while (!wait()) {
    }
    came = 0;
    GPIOR0 = 1;
    if (record.field_is_new != 0) {
      bench::update(record.sample, record.field_ut);
    } else {
      bench::update(record.sample);
    }
    GPIOR0 = 0;
    float values[bench::kOutputs];
    bench::output(values);
    send(reinterpret_cast<const uint8_t*>(values), sizeof values);
  }
}
