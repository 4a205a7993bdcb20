#if defined(ARDUINO) && !defined(RELPOS_VIRTUAL_BOARD)

#include "arduino_board.h"

#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

#include "twi.h"
#include "uart.h"

namespace {

// Set before the C runtime clears the memory, hence not part of it.
uint8_t reset_flags __attribute__((section(".noinit")));
// Turns of the timer since the watchdog was last fed, above a number that memory hardly holds by chance.
// It outlives a reset: many boot loaders clear MCUSR, and then this alone tells what the watchdog did.
constexpr uint16_t kFed = 0xA500;
volatile uint16_t unfed __attribute__((section(".noinit")));
constexpr uint8_t kWatchdogTurns = 2;  // of .26 s: never between two passes of the loop, in 0.9 s always

// The board's LED, of both the same port: digitalWrite and its tables are 350 bytes of flash.
#if defined(__AVR_ATmega2560__)
constexpr uint8_t kLed = _BV(PB7);
#else
constexpr uint8_t kLed = _BV(PB5);
#endif

// The 1.1 V reference measured against the supply: the reading rises as the supply falls.
#if defined(__AVR_ATmega2560__)
constexpr uint8_t kMeasureReference = _BV(REFS0) | 0x1E;
#else
constexpr uint8_t kMeasureReference = _BV(REFS0) | 0x0E;
#endif
constexpr uint8_t kConvert = _BV(ADEN) | _BV(ADSC) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0);
constexpr uint32_t kReferenceMv = 1100;  // of a piece 1.0 to 1.2 V (data sheet)

constexpr uint8_t kPaint = 0xC5;
// Timer 1 is the clock: 16 bits of 4 us, the high ones counted. Sleeping is worth its while from a
// millisecond on; at most half a turn, so that the alarm is never behind the counter.
constexpr uint8_t kMicrosecondsACount = 4;
constexpr uint32_t kWorthSleepingUs = 1000;
constexpr uint32_t kMostSleepUs = 100000;
volatile uint16_t turns;

}  // namespace

extern "C" {

extern uint8_t __heap_start;  // the end of the static memory

// The watchdog stays armed at 15 ms through the reset it causes, and armed at all where reset() jumped
// here: off at once. The stack is painted to see how far it reaches.
void relpos_before_main(void) __attribute__((naked, used, section(".init3")));
void relpos_before_main(void) {
  reset_flags = MCUSR;
  MCUSR = 0;
  wdt_disable();
  for (uint8_t* at = &__heap_start; at <= reinterpret_cast<uint8_t*>(RAMEND); ++at) *at = kPaint;
}

}  // extern "C"

namespace relpos {

void ArduinoBoard::begin() {
  wdt_enable(WDTO_1S);
  TCCR1B = _BV(CS11) | _BV(CS10);  // 16 MHz / 64
  TIMSK1 = _BV(TOIE1) | _BV(OCIE1A);
  twi::begin();
  uart::begin();
  ADMUX = kMeasureReference;
  ADCSRA = kConvert;
  DDRB |= kLed;
  set_sleep_mode(SLEEP_MODE_IDLE);
  sei();
}

wire::ResetCause ArduinoBoard::reset_cause() const {
  // A brown-out leaves its mark on the way up, too: the weaker causes come first.
  if ((reset_flags & _BV(WDRF)) != 0) return wire::ResetCause::kWatchdog;
  if ((reset_flags & _BV(PORF)) != 0) return wire::ResetCause::kPowerOn;
  if ((reset_flags & _BV(BORF)) != 0) return wire::ResetCause::kBrownOut;
  if ((reset_flags & _BV(EXTRF)) != 0) return wire::ResetCause::kExternal;
  // A boot loader has cleared it. A button cannot be told from a dip of the supply.
  const uint16_t turned = unfed - kFed;
  if (turned >= kWatchdogTurns && turned < 0x100) return wire::ResetCause::kWatchdog;
  return wire::ResetCause::kUnknown;
}

void ArduinoBoard::idle(uint32_t wait_us) {
  if (wait_us < kWorthSleepingUs) return;
  if (wait_us > kMostSleepUs) wait_us = kMostSleepUs;
  OCR1A = static_cast<uint16_t>(TCNT1 + static_cast<uint16_t>(wait_us / kMicrosecondsACount));
  // What came since the node looked would be slept over: looked at again with interrupts off, which
  // are allowed behind the instruction that follows sei().
  cli();
  if (!uart::waiting()) {
    sleep_enable();
    sei();
    sleep_cpu();
    sleep_disable();
  }
  sei();
}

BusStatus Board::i2c_transfer(uint8_t address, const uint8_t* first, uint8_t first_count,
                              const uint8_t* second, uint8_t second_count, uint8_t* read,
                              uint8_t read_count) {
  return twi::transfer(address, first, first_count, second, second_count, read, read_count);
}

uint8_t Board::uart_write_space() { return uart::write_space(); }
void Board::uart_write(uint8_t byte) { uart::write(byte); }
int16_t Board::uart_read() { return uart::read(); }
UartErrors Board::uart_errors() { return uart::errors(); }

uint8_t Board::storage_read(uint16_t at) {
  return eeprom_read_byte(reinterpret_cast<const uint8_t*>(at));
}

// A byte takes 3.4 ms; the loop goes on meanwhile.
void Board::storage_write(uint16_t at, uint8_t value) {
  eeprom_update_byte(reinterpret_cast<uint8_t*>(at), value);
}
bool Board::storage_ready() { return eeprom_is_ready(); }

uint32_t Board::now_us() {
  const uint8_t flags = SREG;
  cli();
  const uint16_t low = TCNT1;
  uint16_t high = turns;
  // A turn that has not been counted yet, unless it came after the reading.
  if ((TIFR1 & _BV(TOV1)) != 0 && low < 0x8000) ++high;
  SREG = flags;
  return (static_cast<uint32_t>(high) << 16 | low) * kMicrosecondsACount;
}
void Board::watchdog_reset() {
  wdt_reset();
  unfed = kFed;
}
void Board::led(bool on) {
  if (on) {
    PORTB |= kLed;
  } else {
    PORTB &= static_cast<uint8_t>(~kLed);
  }
}

// A jump to the start, with what interrupts or moves by itself off. Not by the watchdog: the Mega's boot
// loader of 2011 leaves it armed and never comes back.
void Board::reset() {
  cli();
  TIMSK1 = 0;
  UCSR0B = 0;
  TWCR = 0;
  asm volatile("jmp 0");
  __builtin_unreachable();
}

uint16_t Board::free_stack() {
  const uint8_t* at = &__heap_start;
  while (at < reinterpret_cast<const uint8_t*>(SP) && *at == kPaint) ++at;
  return static_cast<uint16_t>(at - &__heap_start);
}

// Each call fetches the conversion that the previous one began: 0.1 ms need not be waited for, and
// the reference has long settled.
uint16_t Board::supply_mv() {
  const uint16_t reading = ADC;
  ADCSRA = kConvert;
  return reading == 0 ? 0 : static_cast<uint16_t>(kReferenceMv * 1024 / reading);
}

void Board::mark(uint8_t value) { GPIOR0 = value; }

}  // namespace relpos

ISR(TIMER1_OVF_vect) {
  ++turns;
  ++unfed;
}
EMPTY_INTERRUPT(TIMER1_COMPA_vect)  // the alarm's work is done by waking

#endif
