/* SPDX-License-Identifier: GPL-3.0-or-later
 *
 * A flat C interface to one simulated AVR board, for foreign-function callers.
 *
 * libsimavr 1.6 provides the core, timers, ports, ADC and watchdog.  The TWI master, UART 0 and the
 * EEPROM controller are replaced by the models in shim.c, because those of simavr 1.6 have wrong
 * timing or status (see shim.c for each).  The caller owns the clock: nothing here sleeps or prints.
 */
#ifndef RELPOS_AVR_SHIM_H
#define RELPOS_AVR_SHIM_H
#include <stdint.h>

typedef struct relpos_avr relpos_avr;

enum { RELPOS_AVR_RUNNING = 0, RELPOS_AVR_FAILED = 1 };

/* Two-wire bus, called at the instant a condition or byte starts on the wire.
 *   BUS_START  value = address << 1 | read;  returns acknowledge (0 or 1)
 *   BUS_WRITE  value = byte;                 returns acknowledge (0 or 1)
 *   BUS_READ   value = 1 if the master will acknowledge the byte; returns the byte
 *   BUS_STOP   value = 0; result ignored
 *   BUS_RELEASE  nine clocks were put on SCL by hand with the bus unit off; result ignored
 * Bits 8.. of a result are microseconds for which the slave holds the clock down.
 * A negative result means that the bus hangs: the operation never completes. */
enum { BUS_START = 0, BUS_WRITE = 1, BUS_READ = 2, BUS_STOP = 3, BUS_RELEASE = 4 };
typedef int32_t (*relpos_avr_bus)(void *context, int32_t operation, int32_t value, uint64_t cycle);

enum { /* indices into the array filled by relpos_avr_counters() */
	COUNTER_CYCLE = 0,
	COUNTER_RESETS,            /* resets since creation: watchdog and relpos_avr_reset() */
	COUNTER_WATCHDOG_RESETS,
	COUNTER_LOWEST_SP,         /* lowest stack pointer since creation */
	COUNTER_UART_OVERRUNS,     /* received bytes lost because the receiver was full */
	COUNTER_UART_DEAF,         /* received bytes lost because the receiver was off */
	COUNTER_TICKS,             /* completed marked regions (GPIOR0 1 ... 0) */
	COUNTER_TICK_CYCLES_SUM,
	COUNTER_TICK_CYCLES_MAX,
	COUNTER_TWI_BUSY_CYCLES,
	COUNTER_LOST_RECORDS,      /* marks or sent bytes that could not be stored: out of memory */
	COUNTER_WORST_TICK_AT,     /* cycle at which the longest marked region began */
	COUNTER_EEPROM_WRITES,
	COUNTER_COUNT
};

/* flash: image from address 0.  static_end: first data address past the static RAM; a stack pointer
 * below it is a failure.  line_baud: speed of what is wired to UART 0, 0 = whatever the chip uses.
 * reset_cause: value of MCUSR at start.  Returns NULL if the chip is unknown or the image too big. */
relpos_avr *relpos_avr_create(const char *mmcu, const uint8_t *flash, uint32_t flash_size,
		uint32_t frequency_hz, uint32_t static_end, uint32_t line_baud, uint8_t reset_cause,
		relpos_avr_bus bus, void *context);
void relpos_avr_destroy(relpos_avr *);

/* Run until the cycle counter reaches `cycle`; ends at most one instruction later. */
int32_t relpos_avr_run(relpos_avr *, uint64_t cycle);
const char *relpos_avr_error(const relpos_avr *);
/* Reset from outside; cause becomes MCUSR.  EEPROM and RAM keep their contents, but after a loss of
 * supply (power-on, brown-out) the EEPROM byte being written is erased and the RAM holds garbage. */
void relpos_avr_reset(relpos_avr *, uint8_t cause);
/* Where resets start the program (bytes): the fuse BOOTRST's boot loader; 0 from the start. */
void relpos_avr_set_reset_vector(relpos_avr *, uint32_t address);
/* Continue at a place (bytes) of the program: as it would be after it had gone astray. */
void relpos_avr_jump(relpos_avr *, uint32_t address);

/* Queue bytes for the receiver; the first begins on the wire at `cycle` or when the wire is free.
 * Damaged ones arrive without a stop bit. */
void relpos_avr_receive(relpos_avr *, const uint8_t *bytes, uint32_t count, uint64_t cycle,
		uint8_t damaged);
/* Take up to `room` bytes sent; cycles[] = when the last stop bit ended. */
uint32_t relpos_avr_take_sent(relpos_avr *, uint64_t *cycles, uint8_t *bytes, uint32_t room);
/* Take up to `room` values written to GPIOR0 and the cycles of the writes. */
uint32_t relpos_avr_take_marks(relpos_avr *, uint64_t *cycles, uint8_t *values, uint32_t room);

/* From now on keep what relpos_avr_take_looks() and relpos_avr_take_heard() give. */
void relpos_avr_trace(relpos_avr *, uint16_t watched);
/* Take up to `room` records of reads of TIFR1: each is three, the low and the high byte of timer 1 as the
 * program read it last, and the byte of RAM that is watched. */
uint32_t relpos_avr_take_looks(relpos_avr *, uint64_t *cycles, uint8_t *values, uint32_t room);
/* Take up to `room` bytes that the program fetched from the receiver. */
uint32_t relpos_avr_take_heard(relpos_avr *, uint64_t *cycles, uint8_t *values, uint32_t room);

uint32_t relpos_avr_eeprom_size(const relpos_avr *);
void relpos_avr_eeprom_get(const relpos_avr *, uint8_t *out, uint32_t count);
void relpos_avr_eeprom_set(relpos_avr *, const uint8_t *in, uint32_t count);
/* Supply of the chip and its converter from now on; 5000 mV from the start. */
void relpos_avr_set_supply(relpos_avr *, uint32_t millivolts);
/* Clock of the board from now on; the cycle counter goes on. */
void relpos_avr_set_frequency(relpos_avr *, uint32_t frequency_hz);
void relpos_avr_data_get(const relpos_avr *, uint16_t address, uint8_t *out, uint16_t count);
/* As if the program stored it: what a write to a register does, happens. */
void relpos_avr_data_set(relpos_avr *, uint16_t address, uint8_t value);

void relpos_avr_counters(const relpos_avr *, uint64_t out[COUNTER_COUNT]);
uint32_t relpos_avr_ram_end(const relpos_avr *);
#endif
