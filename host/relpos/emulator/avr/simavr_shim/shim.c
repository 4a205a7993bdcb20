/* SPDX-License-Identifier: GPL-3.0-or-later
 *
 * One simulated AVR board over libsimavr 1.6; see shim.h for the contract.
 *
 * What is replaced, and why (simavr 1.6):
 *  - TWI: every byte takes 9 us whatever TWBR says; SLA+W to an absent slave gives the status of a
 *    data byte; TWSTO clears at once.  Replaced by a master with the data sheet's bit time,
 *    (16 + 2 TWBR 4^TWPS) cycles, nine bits a byte, and its status codes.
 *  - UART: 11 bits a byte, a receive queue of 64 bytes.  Replaced by 8N1 timing, the chip's two-byte
 *    receive buffer plus shift register, and overruns that lose bytes and are counted.
 *  - EEPROM: writes complete at once.  Replaced by 3.4 ms, during which EEPE stays set.
 *  - Entering an interrupt takes no time.  The data sheet's 4 (ATmega2560: 5) cycles are added.
 *  - RAM is zero at power-on and kept by any reset.  Replaced by a fixed pseudo-random pattern at
 *    power-on, and by its continuation after a reset with loss of supply.
 *  - A reset forgets MCUSR, and ones written to it are set.  Replaced by the chip's: causes add up until
 *    zeros are written or power was lost.
 *  - Invalid opcodes are only printed.  Any message of simavr at error level stops the run.
 *  - sleep() slows the host down.  Replaced by nothing.
 */
#include "shim.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <simavr/avr_eeprom.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_twi.h>
#include <simavr/avr_uart.h>
#include <simavr/avr_watchdog.h>
#include <simavr/sim_avr.h>

/* Data addresses, the same on the ATmega328P and the ATmega2560. */
enum {
	A_TIFR1 = 0x36, A_TCNT1L = 0x84, A_DDRC = 0x27, A_DDRD = 0x2a, /* the port register follows its direction register */
	A_GPIOR0 = 0x3e, A_EECR = 0x3f, A_EEDR = 0x40, A_EEARL = 0x41, A_EEARH = 0x42, A_MCUSR = 0x54,
	A_TWBR = 0xb8, A_TWSR = 0xb9, A_TWDR = 0xbb, A_TWCR = 0xbc,
	A_UCSRA = 0xc0, A_UCSRB = 0xc1, A_UCSRC = 0xc2, A_UBRRL = 0xc4, A_UBRRH = 0xc5, A_UDR = 0xc6
};
enum { TWINT = 0x80, TWEA = 0x40, TWSTA = 0x20, TWSTO = 0x10, TWEN = 0x04, TWIE = 0x01 };
enum { RXC = 0x80, TXC = 0x40, UDRE = 0x20, FE = 0x10, DOR = 0x08, U2X = 0x02 };       /* UCSRA */
enum { RXCIE = 0x80, TXCIE = 0x40, UDRIE = 0x20, RXEN = 0x10, TXEN = 0x08 }; /* UCSRB */
enum { EERE = 0x01, EEPE = 0x02, EEMPE = 0x04, EERIE = 0x08 };
enum { PORF = 0x01, BORF = 0x04, WDRF = 0x08 }; /* MCUSR */

typedef enum { TWI_IDLE, TWI_ADDRESS, TWI_SEND, TWI_FETCH, TWI_UNHEARD } twi_phase;

enum { DAMAGED = 0x100 }; /* beside a received byte */

typedef struct { uint64_t cycle; uint8_t value; } record;
typedef struct { record *items; uint32_t count, room; } record_list;

struct relpos_avr {
	avr_io_t io; /* last in simavr's list of modules, so that our reset runs after all others */
	avr_t *avr;
	relpos_avr_bus bus;
	void *context;
	int failed;
	char error[200];
	uint8_t next_cause, causes; /* MCUSR across resets */
	uint64_t counter[COUNTER_COUNT];
	uint32_t static_end, lowest_sp;
	uint64_t tick_began;
	record_list marks, sent, looks, heard;
	uint16_t watched; /* data address that looks show; 0: not tracing */
	/* TWI */
	avr_int_vector_t *twi_vector;
	twi_phase phase;
	int twi_busy, bus_open;
	uint8_t twi_status;
	uint16_t scl_direction; /* address of the direction register of SCL's port */
	uint8_t scl_mask, scl_was_low, scl_clocks;
	uint8_t sda_mask, sda_held; /* by a slave, while the bus hangs */
	avr_io_read_t pin_read; /* simavr's own, of the port that SDA is in */
	void *pin_param;
	int twi_data; /* byte that appears in TWDR when the operation completes, or -1 */
	/* UART */
	avr_int_vector_t *rxc_vector, *txc_vector, *udre_vector;
	uint32_t line_baud;
	uint8_t shift, buffer;
	uint16_t received[3]; /* DAMAGED: without a stop bit */
	int shift_full, buffer_full, received_count, receiving;
	uint16_t *queue;
	uint32_t queue_head, queue_count, queue_room;
	uint64_t line_free;
	/* EEPROM */
	avr_eeprom_t *eeprom;
	uint16_t write_address;
	uint8_t write_value;
	int writing;
	uint32_t noise; /* state of the generator of what RAM holds without supply */
};

static __thread relpos_avr *current; /* for the logger, which gets only the avr_t */

static void fail(relpos_avr *e, const char *format, ...)
{
	if (!e->failed) {
		va_list arguments;
		va_start(arguments, format);
		int n = vsnprintf(e->error, sizeof e->error, format, arguments);
		va_end(arguments);
		while (n > 0 && n < (int)sizeof e->error && e->error[n - 1] <= ' ') e->error[--n] = 0;
	}
	e->failed = 1;
	e->avr->state = cpu_Crashed;
}

static void logger(avr_t *avr, const int level, const char *format, va_list arguments)
{
	relpos_avr *e = current;
	if (level != LOG_ERROR || !e || e->avr != avr) return;
	char text[160];
	vsnprintf(text, sizeof text, format, arguments);
	char plain[sizeof text];
	size_t n = 0;
	for (const char *c = text; *c; c++) { /* without terminal colours */
		if (*c == '\x1b') { while (c[1] && *c != 'm') c++; }
		else plain[n++] = *c;
	}
	plain[n] = 0;
	if (strstr(plain, "avr_sadly_crashed"))
		fail(e, "the simulated processor crashed at pc %#x", (unsigned)avr->pc);
	else
		fail(e, "%s", plain);
}

static void append(relpos_avr *e, record_list *list, uint64_t cycle, uint8_t value)
{
	if (list->count == list->room) {
		uint32_t room = list->room ? 2 * list->room : 256;
		record *items = realloc(list->items, room * sizeof *items);
		if (!items) { e->counter[COUNTER_LOST_RECORDS]++; return; }
		list->items = items;
		list->room = room;
	}
	list->items[list->count++] = (record){ cycle, value };
}

/* Interrupts of these modules are levels: they fire again after RETI while flag and enable are set. */
static void level(relpos_avr *e, avr_int_vector_t *vector, int asserted)
{
	if (asserted && !vector->pending) avr_raise_interrupt(e->avr, vector);
	else if (!asserted && vector->pending) avr_clear_interrupt(e->avr, vector);
}

static void levels(relpos_avr *e)
{
	const uint8_t *d = e->avr->data;
	level(e, e->twi_vector, (d[A_TWCR] & TWINT) && (d[A_TWCR] & TWIE));
	level(e, e->rxc_vector, (d[A_UCSRA] & RXC) && (d[A_UCSRB] & RXCIE));
	level(e, e->udre_vector, (d[A_UCSRA] & UDRE) && (d[A_UCSRB] & UDRIE));
	if (e->eeprom->ready.vector)
		level(e, &e->eeprom->ready, !(d[A_EECR] & EEPE) && (d[A_EECR] & EERIE));
}

static void on_running(struct avr_irq_t *irq, uint32_t value, void *param)
{
	(void)irq;
	relpos_avr *e = param;
	if (!value) { /* RETI */
		levels(e);
		return;
	}
	avr_t *avr = e->avr;
	const uint32_t entry = avr->address_size + 2u; /* 4 cycles, 5 with a 22-bit program counter */
	avr->cycle += entry;
	avr->run_cycle_count = avr->run_cycle_count > entry ? avr->run_cycle_count - entry : 1;
}

/* ---------------------------------------------------------------- TWI master */

static uint32_t bit_cycles(const avr_t *avr)
{
	return 16 + 2u * avr->data[A_TWBR] * (1u << (2 * (avr->data[A_TWSR] & 3)));
}

static void set_status(avr_t *avr, uint8_t status)
{
	avr->data[A_TWSR] = (uint8_t)((avr->data[A_TWSR] & 0x03) | status);
}

static void twi_begin(relpos_avr *e);

static avr_cycle_count_t twi_done(avr_t *avr, avr_cycle_count_t when, void *param)
{
	relpos_avr *e = param;
	(void)when;
	e->twi_busy = 0;
	if (avr->data[A_TWCR] & TWSTO) {
		avr->data[A_TWCR] &= (uint8_t)~TWSTO;
		set_status(avr, 0xf8);
		if (avr->data[A_TWCR] & TWSTA) twi_begin(e);
		return 0;
	}
	if (e->twi_data >= 0) avr->data[A_TWDR] = (uint8_t)e->twi_data;
	set_status(avr, e->twi_status);
	avr->data[A_TWCR] |= TWINT;
	levels(e);
	return 0;
}

static int32_t twi_call(relpos_avr *e, int32_t operation, int32_t value, uint64_t *stretch)
{
	int32_t result = e->bus ? e->bus(e->context, operation, value, e->avr->cycle) : 0;
	if (result < 0) return -1;
	*stretch = (uint64_t)(result >> 8) * e->avr->frequency / 1000000u;
	return result & 0xff;
}

/* Starts the operation that TWCR asks for; TWINT is clear and the bus unit free. */
static void twi_begin(relpos_avr *e)
{
	avr_t *avr = e->avr;
	const uint8_t control = avr->data[A_TWCR];
	uint64_t cycles = 9u * bit_cycles(avr), stretch = 0;
	int32_t result = 0;
	e->twi_data = -1;
	if (control & TWSTO) {
		if (e->bus_open) twi_call(e, BUS_STOP, 0, &stretch);
		stretch = 0;
		e->bus_open = 0;
		e->phase = TWI_IDLE;
		cycles = bit_cycles(avr);
	} else if (control & TWSTA) {
		e->twi_status = e->bus_open ? 0x10 : 0x08;
		e->bus_open = 1;
		e->phase = TWI_ADDRESS;
		cycles = bit_cycles(avr);
	} else switch (e->phase) {
	case TWI_IDLE:
		return;
	case TWI_ADDRESS: {
		const uint8_t address = avr->data[A_TWDR];
		result = twi_call(e, BUS_START, address, &stretch);
		const int heard = result > 0;
		e->phase = !heard ? TWI_UNHEARD : (address & 1) ? TWI_FETCH : TWI_SEND;
		e->twi_status = (address & 1) ? (heard ? 0x40 : 0x48) : (heard ? 0x18 : 0x20);
		break;
	}
	case TWI_SEND:
		result = twi_call(e, BUS_WRITE, avr->data[A_TWDR], &stretch);
		e->twi_status = result > 0 ? 0x28 : 0x30;
		break;
	case TWI_FETCH:
		result = twi_call(e, BUS_READ, (control & TWEA) != 0, &stretch);
		e->twi_data = result;
		e->twi_status = (control & TWEA) ? 0x50 : 0x58;
		break;
	case TWI_UNHEARD: /* nobody drives the line: written bytes are not acknowledged */
		e->twi_status = 0x30;
		break;
	}
	e->twi_busy = 1;
	if (result < 0) { /* the bus hangs: no completion until TWEN is cleared */
		e->sda_held = 1;
		return;
	}
	e->counter[COUNTER_TWI_BUSY_CYCLES] += cycles + stretch;
	avr_cycle_timer_register(avr, cycles + stretch, twi_done, e);
}

static void twcr_write(avr_t *avr, avr_io_addr_t address, uint8_t v, void *param)
{
	relpos_avr *e = param;
	uint8_t flag = avr->data[A_TWCR] & TWINT;
	if (v & TWINT) flag = 0;
	avr->data[address] = (uint8_t)((v & (TWEA | TWSTA | TWSTO | TWEN | TWIE)) | flag);
	if (!(v & TWEN)) {
		uint64_t unused;
		avr_cycle_timer_cancel(avr, twi_done, e);
		if (e->bus_open) twi_call(e, BUS_STOP, 0, &unused);
		e->twi_busy = e->bus_open = 0;
		e->phase = TWI_IDLE;
		avr->data[address] &= (uint8_t)~TWSTO;
		set_status(avr, 0xf8);
	} else if (!e->twi_busy && !flag) {
		twi_begin(e);
	}
	levels(e);
}

/* Clocks made by hand (DDR or PORT) while the bus unit is off: nine of them free a hanging slave. */
static void scl_moved(struct avr_irq_t *irq, uint32_t value, void *param)
{
	(void)irq; (void)value;
	relpos_avr *e = param;
	const uint8_t *d = e->avr->data;
	uint8_t low = (uint8_t)(d[e->scl_direction] & ~d[e->scl_direction + 1] & e->scl_mask);
	uint64_t unused;
	if (d[A_TWCR] & TWEN) e->scl_clocks = 0;
	else if (e->scl_was_low && !low && ++e->scl_clocks == 9) {
		e->scl_clocks = 0;
		e->sda_held = 0;
		twi_call(e, BUS_RELEASE, 0, &unused);
	}
	e->scl_was_low = low;
}

/* The firmware sees by SDA whether somebody has to be clocked free. */
static uint8_t sda_read(avr_t *avr, avr_io_addr_t address, void *param)
{
	relpos_avr *e = param;
	uint8_t v = e->pin_read ? e->pin_read(avr, address, e->pin_param) : avr->data[address];
	if (e->sda_held) v &= (uint8_t)~e->sda_mask;
	return avr->data[address] = v;
}

static void twsr_write(avr_t *avr, avr_io_addr_t address, uint8_t v, void *param)
{
	(void)param;
	avr->data[address] = (uint8_t)((avr->data[address] & 0xf8) | (v & 3));
}

static void plain_write(avr_t *avr, avr_io_addr_t address, uint8_t v, void *param)
{
	(void)param;
	avr->data[address] = v;
}

/* ---------------------------------------------------------------- UART 0 */

static uint32_t own_bit_cycles(const avr_t *avr)
{
	uint32_t divisor = avr->data[A_UBRRL] | (avr->data[A_UBRRH] & 0x0fu) << 8;
	return (divisor + 1) * ((avr->data[A_UCSRA] & U2X) ? 8 : 16);
}

/* Start, data, parity, stop bits as set in UCSRC. */
static uint32_t frame_bits(const avr_t *avr)
{
	const uint8_t c = avr->data[A_UCSRC];
	return 1 + (5 + ((c >> 1) & 3)) + ((c & 0x20) != 0) + 1 + ((c & 0x08) != 0);
}

/* Two UARTs understand each other within about 3 %. */
static void check_baud(relpos_avr *e)
{
	if (!e->line_baud) return;
	double own = (double)e->avr->frequency / own_bit_cycles(e->avr);
	double ratio = own / e->line_baud;
	if (ratio < 0.97 || ratio > 1.03)
		fail(e, "UART 0 is set to %.0f baud, the line is at %u", own, e->line_baud);
}

static avr_cycle_count_t transmit_done(avr_t *avr, avr_cycle_count_t when, void *param)
{
	relpos_avr *e = param;
	avr_cycle_count_t again = 0;
	append(e, &e->sent, when, e->shift);
	if (e->buffer_full) {
		e->shift = e->buffer;
		e->buffer_full = 0;
		avr->data[A_UCSRA] |= UDRE;
		again = when + (uint64_t)own_bit_cycles(avr) * frame_bits(avr);
	} else {
		e->shift_full = 0;
		if (avr->data[A_UCSRB] & TXCIE) avr_raise_interrupt(avr, e->txc_vector);
		avr->data[A_UCSRA] |= TXC;
	}
	levels(e);
	return again;
}

static void udr_write(avr_t *avr, avr_io_addr_t address, uint8_t v, void *param)
{
	relpos_avr *e = param;
	(void)address;
	if (!(avr->data[A_UCSRB] & TXEN) || e->buffer_full) return;
	check_baud(e);
	if (e->shift_full) {
		e->buffer = v;
		e->buffer_full = 1;
		avr->data[A_UCSRA] &= (uint8_t)~UDRE;
	} else {
		e->shift = v;
		e->shift_full = 1;
		avr_cycle_timer_register(avr, (uint64_t)own_bit_cycles(avr) * frame_bits(avr), transmit_done, e);
	}
	levels(e);
}

/* FE is the flag of the byte that is read next. */
static void show_damage(relpos_avr *e)
{
	uint8_t *flags = &e->avr->data[A_UCSRA];
	*flags &= (uint8_t)~FE;
	if (e->received_count && (e->received[0] & DAMAGED)) *flags |= FE;
}

static uint8_t udr_read(avr_t *avr, avr_io_addr_t address, void *param)
{
	relpos_avr *e = param;
	uint8_t v = (uint8_t)e->received[0];
	if (e->received_count) {
		e->received_count--;
		memmove(e->received, e->received + 1, 2 * sizeof *e->received);
	}
	show_damage(e);
	if (!e->received_count) avr->data[A_UCSRA] &= (uint8_t)~RXC;
	avr->data[A_UCSRA] &= (uint8_t)~DOR;
	if (e->watched) append(e, &e->heard, avr->cycle, v);
	levels(e);
	return avr->data[address] = v;
}

static void ucsra_write(avr_t *avr, avr_io_addr_t address, uint8_t v, void *param)
{
	uint8_t keep = avr->data[address] & (uint8_t)~(U2X | 0x01);
	if (v & TXC) keep &= (uint8_t)~TXC;
	avr->data[address] = (uint8_t)(keep | (v & (U2X | 0x01)));
	levels(param);
}

static void ucsrb_write(avr_t *avr, avr_io_addr_t address, uint8_t v, void *param)
{
	relpos_avr *e = param;
	avr->data[address] = v;
	if (!(v & RXEN)) {
		e->received_count = 0;
		avr->data[A_UCSRA] &= (uint8_t)~(RXC | DOR);
	}
	levels(e);
}

static uint64_t line_frame_cycles(const relpos_avr *e)
{
	const avr_t *avr = e->avr;
	if (!e->line_baud) return (uint64_t)own_bit_cycles(avr) * frame_bits(avr);
	return (uint64_t)avr->frequency * 10u / e->line_baud;
}

static avr_cycle_count_t receive_done(avr_t *avr, avr_cycle_count_t when, void *param)
{
	relpos_avr *e = param;
	uint16_t byte = e->queue[e->queue_head];
	e->queue_head = (e->queue_head + 1) % e->queue_room;
	e->queue_count--;
	e->line_free = when;
	if (!(avr->data[A_UCSRB] & RXEN)) {
		e->counter[COUNTER_UART_DEAF]++;
	} else {
		check_baud(e);
		if (e->received_count == 3) {
			e->counter[COUNTER_UART_OVERRUNS]++;
			avr->data[A_UCSRA] |= DOR;
		} else {
			e->received[e->received_count++] = byte;
			show_damage(e);
			avr->data[A_UCSRA] |= RXC;
		}
		levels(e);
	}
	e->receiving = e->queue_count > 0;
	return e->receiving ? when + line_frame_cycles(e) : 0;
}

void relpos_avr_receive(relpos_avr *e, const uint8_t *bytes, uint32_t count, uint64_t cycle,
		uint8_t damaged)
{
	if (e->queue_count + count > e->queue_room) {
		uint32_t room = 2 * (e->queue_count + count);
		uint16_t *queue = malloc(room * sizeof *queue);
		if (!queue) { e->counter[COUNTER_LOST_RECORDS] += count; return; }
		for (uint32_t i = 0; i < e->queue_count; i++)
			queue[i] = e->queue[(e->queue_head + i) % e->queue_room];
		free(e->queue);
		e->queue = queue;
		e->queue_head = 0;
		e->queue_room = room;
	}
	for (uint32_t i = 0; i < count; i++)
		e->queue[(e->queue_head + e->queue_count++) % e->queue_room] = (uint16_t)(bytes[i] | (damaged ? DAMAGED : 0));
	if (!e->receiving && e->queue_count) {
		uint64_t begin = cycle > e->line_free ? cycle : e->line_free;
		uint64_t end = begin + line_frame_cycles(e), now = e->avr->cycle;
		e->receiving = 1;
		avr_cycle_timer_register(e->avr, end > now ? end - now : 0, receive_done, e);
	}
}

/* ---------------------------------------------------------------- EEPROM */

static avr_cycle_count_t eempe_clear(avr_t *avr, avr_cycle_count_t when, void *param)
{
	(void)when; (void)param;
	avr->data[A_EECR] &= (uint8_t)~EEMPE;
	return 0;
}

static avr_cycle_count_t eeprom_done(avr_t *avr, avr_cycle_count_t when, void *param)
{
	relpos_avr *e = param;
	(void)when;
	e->eeprom->eeprom[e->write_address] = e->write_value;
	e->writing = 0;
	e->counter[COUNTER_EEPROM_WRITES]++;
	avr->data[A_EECR] &= (uint8_t)~EEPE;
	levels(e);
	return 0;
}

static void eecr_write(avr_t *avr, avr_io_addr_t address, uint8_t v, void *param)
{
	relpos_avr *e = param;
	const uint8_t old = avr->data[address];
	const uint16_t at = (uint16_t)((avr->data[A_EEARL] | avr->data[A_EEARH] << 8) % e->eeprom->size);
	uint8_t now = (uint8_t)((v & (0x30 | EERIE)) | (old & (EEPE | EEMPE)));
	if (old & EEPE) now = (uint8_t)((now & ~0x30) | (old & 0x30)); /* mode locked while writing */
	if ((v & EEMPE) && !(v & EEPE)) {
		now |= EEMPE;
		avr_cycle_timer_register(avr, 4 + 2, eempe_clear, e); /* counted after the 2-cycle write */
	}
	if ((v & EEPE) && (old & EEMPE) && !(old & EEPE)) {
		const uint8_t mode = v & 0x30, cell = e->eeprom->eeprom[at];
		e->write_address = at;
		e->write_value = mode == 0x10 ? 0xff
			: mode == 0x20 ? (uint8_t)(cell & avr->data[A_EEDR]) : avr->data[A_EEDR];
		e->writing = 1;
		now = (uint8_t)((now | EEPE) & ~EEMPE);
		avr_cycle_timer_register(avr, (uint64_t)avr->frequency * (mode ? 18 : 34) / 10000u,
				eeprom_done, e);
		avr->cycle += 2; /* the CPU is halted */
	}
	if ((v & EERE) && !(old & EEPE)) {
		avr->data[A_EEDR] = e->eeprom->eeprom[at];
		avr->cycle += 4;
	}
	avr->data[address] = now;
	levels(e);
}

/* ---------------------------------------------------------------- marks, stack, reset */

static void mark_write(avr_t *avr, avr_io_addr_t address, uint8_t v, void *param)
{
	relpos_avr *e = param;
	const uint8_t old = avr->data[address];
	avr->data[address] = v;
	append(e, &e->marks, avr->cycle, v);
	if (v == 1) e->tick_began = avr->cycle;
	else if (v == 0 && old == 1) {
		uint64_t taken = avr->cycle - e->tick_began;
		e->counter[COUNTER_TICKS]++;
		e->counter[COUNTER_TICK_CYCLES_SUM] += taken;
		if (taken > e->counter[COUNTER_TICK_CYCLES_MAX]) {
			e->counter[COUNTER_TICK_CYCLES_MAX] = taken;
			e->counter[COUNTER_WORST_TICK_AT] = e->tick_began;
		}
	}
}

static uint8_t tifr1_read(avr_t *avr, avr_io_addr_t address, void *param)
{
	relpos_avr *e = param;
	append(e, &e->looks, avr->cycle, avr->data[A_TCNT1L]);
	append(e, &e->looks, avr->cycle, avr->data[A_TCNT1L + 1]);
	append(e, &e->looks, avr->cycle, avr->data[e->watched]);
	return avr->data[address];
}

static inline void look_at_stack(relpos_avr *e)
{
	const uint8_t *d = e->avr->data;
	if (!d[R_SPH]) return; /* half set during a reset; RAM begins at 0x100 */
	uint32_t sp = d[R_SPL] | (uint32_t)d[R_SPH] << 8;
	if (sp < e->lowest_sp) {
		e->lowest_sp = sp;
		if (sp + 1 < e->static_end)
			fail(e, "the stack grew into static data at pc %#x: SP %#x, static data end at %#x",
					(unsigned)e->avr->pc, (unsigned)sp, (unsigned)e->static_end);
	}
}

/* The stack pointer changes in two halves.  PUSH, CALL and the like write low then high; compiled
 * prologues write SPH then SPL with OUT.  Look only when both halves are in place. */
static inline int is_out(const avr_t *avr)
{
	return (avr->flash[avr->pc + 1] & 0xf8) == 0xb8;
}

static void spl_write(avr_t *avr, avr_io_addr_t address, uint8_t v, void *param)
{
	avr->data[address] = v;
	if (is_out(avr)) look_at_stack(param);
}

static void sph_write(avr_t *avr, avr_io_addr_t address, uint8_t v, void *param)
{
	avr->data[address] = v;
	if (!is_out(avr)) look_at_stack(param);
}

static void mcusr_write(avr_t *avr, avr_io_addr_t address, uint8_t v, void *param)
{
	relpos_avr *e = param;
	e->causes &= v;
	avr->data[address] = e->causes;
}

static avr_cycle_count_t reached(avr_t *avr, avr_cycle_count_t when, void *param)
{
	(void)avr; (void)when; (void)param;
	return 0; /* its being due is what ends the burst */
}

static void no_sleep(avr_t *avr, avr_cycle_count_t how_long)
{
	(void)avr; (void)how_long;
}

static void on_reset(avr_io_t *io)
{
	relpos_avr *e = (relpos_avr *)io;
	avr_t *avr = e->avr;
	uint64_t unused;
	uint8_t *d = avr->data;
	if (d[A_MCUSR] & WDRF) e->counter[COUNTER_WATCHDOG_RESETS]++;
	e->counter[COUNTER_RESETS]++;
	if (e->bus_open) twi_call(e, BUS_STOP, 0, &unused);
	if (e->writing) { /* completes, unless power was lost: then the cell is only erased */
		e->eeprom->eeprom[e->write_address] = (e->next_cause & (PORF | BORF)) ? 0xff : e->write_value;
		e->writing = 0;
		e->counter[COUNTER_EEPROM_WRITES]++;
	}
	if (e->next_cause & PORF) e->causes = 0;
	e->causes |= (uint8_t)((d[A_MCUSR] & WDRF) | e->next_cause);
	d[A_MCUSR] = e->causes;
	e->next_cause = 0;
	d[A_EECR] = 0;
	d[A_TWCR] = 0;
	d[A_TWSR] = 0xf8;
	d[A_UCSRA] = UDRE;
	d[A_UCSRB] = 0; /* simavr leaves the transmitter on */
	d[A_UCSRC] = 0x06;
	e->phase = TWI_IDLE;
	e->twi_busy = e->bus_open = 0;
	e->shift_full = e->buffer_full = e->received_count = 0;
	/* the reset has emptied simavr's timers: what is on the wire still arrives */
	if (e->receiving) avr_cycle_timer_register(avr, line_frame_cycles(e), receive_done, e);
	avr->run_cycle_limit = 1u << 20; /* run in bursts up to the next timer */
}

static void scramble(relpos_avr *e)
{
	avr_t *avr = e->avr;
	uint32_t noise = e->noise;
	for (uint32_t a = avr->ioend + 1; a <= avr->ramend; a++) {
		noise ^= noise << 13; noise ^= noise >> 17; noise ^= noise << 5;
		avr->data[a] = (uint8_t)noise;
	}
	e->noise = noise;
}

int32_t relpos_avr_run(relpos_avr *e, uint64_t cycle)
{
	avr_t *avr = e->avr;
	uint64_t resets = e->counter[COUNTER_RESETS];
	current = e;
	if (avr->cycle < cycle) avr_cycle_timer_register(avr, cycle - avr->cycle, reached, e);
	while (!e->failed && avr->cycle < cycle) {
		avr_run(avr);
		if (e->counter[COUNTER_RESETS] != resets) { /* a reset loses the timer that ends the burst */
			resets = e->counter[COUNTER_RESETS];
			if (avr->cycle < cycle) avr_cycle_timer_register(avr, cycle - avr->cycle, reached, e);
		}
		if (avr->state == cpu_Done) fail(e, "the firmware slept with interrupts off");
		else if (avr->state == cpu_Crashed) fail(e, "the simulated processor crashed");
	}
	avr_cycle_timer_cancel(avr, reached, e);
	return e->failed ? RELPOS_AVR_FAILED : RELPOS_AVR_RUNNING;
}

static void hook_write(relpos_avr *e, uint16_t address, avr_io_write_t callback)
{
	e->avr->io[AVR_DATA_TO_IO(address)].w.c = callback;
	e->avr->io[AVR_DATA_TO_IO(address)].w.param = e;
}

static void hook_read(relpos_avr *e, uint16_t address, avr_io_read_t callback)
{
	e->avr->io[AVR_DATA_TO_IO(address)].r.c = callback;
	e->avr->io[AVR_DATA_TO_IO(address)].r.param = callback ? e : NULL;
}

relpos_avr *relpos_avr_create(const char *mmcu, const uint8_t *flash, uint32_t flash_size,
		uint32_t frequency_hz, uint32_t static_end, uint32_t line_baud, uint8_t reset_cause,
		relpos_avr_bus bus, void *context)
{
	avr_global_logger_set(logger);
	avr_t *avr = avr_make_mcu_by_name(mmcu);
	if (!avr) return NULL;
	relpos_avr *e = calloc(1, sizeof *e);
	if (!e) return NULL;
	avr_init(avr);
	e->avr = avr;
	e->bus = bus;
	e->context = context;
	e->static_end = static_end;
	e->line_baud = line_baud;
	e->lowest_sp = avr->ramend;
	if (flash_size > avr->flashend + 1) {
		avr_terminate(avr);
		free(avr);
		free(e);
		return NULL;
	}
	avr_loadcode(avr, (uint8_t *)flash, flash_size, 0);
	avr->frequency = frequency_hz;
	avr->vcc = avr->avcc = avr->aref = 5000;
	avr->sleep = no_sleep;
	for (char name = '0'; name <= '3'; name++) {
		uint32_t none = 0; /* neither slow the host down when polled nor print */
		avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS(name), &none);
	}
	e->noise = 0x2545f491;
	scramble(e);
	avr_twi_t *twi = avr->io[AVR_DATA_TO_IO(A_TWCR)].w.param;
	avr_uart_t *uart = avr->io[AVR_DATA_TO_IO(A_UDR)].w.param;
	e->eeprom = avr->io[AVR_DATA_TO_IO(A_EECR)].w.param;
	e->twi_vector = &twi->twi;
	e->rxc_vector = &uart->rxc;
	e->txc_vector = &uart->txc;
	e->udre_vector = &uart->udrc;
	hook_write(e, A_TWCR, twcr_write);
	hook_write(e, A_TWSR, twsr_write);
	hook_write(e, A_TWDR, plain_write);
	hook_read(e, A_TWDR, NULL);
	hook_write(e, A_UDR, udr_write);
	hook_read(e, A_UDR, udr_read);
	hook_write(e, A_UCSRA, ucsra_write);
	hook_read(e, A_UCSRA, NULL);
	hook_write(e, A_UCSRB, ucsrb_write);
	hook_write(e, A_UBRRL, plain_write);
	hook_write(e, A_EECR, eecr_write);
	hook_write(e, A_GPIOR0, mark_write);
	hook_write(e, A_MCUSR, mcusr_write);
	hook_write(e, R_SPL, spl_write);
	hook_write(e, R_SPH, sph_write);
	for (int i = 0; i < avr->interrupts.vector_count; i++)
		avr_irq_register_notify(avr->interrupts.vector[i]->irq + AVR_INT_IRQ_RUNNING, on_running, e);
	const int mega = avr->ramend > 0x8ff;
	e->scl_direction = mega ? A_DDRD : A_DDRC; /* PD0 on the Mega, PC5 on the Uno */
	e->scl_mask = mega ? 0x01 : 0x20;
	e->sda_mask = mega ? 0x02 : 0x10; /* PD1, PC4 */
	const avr_io_addr_t pin = AVR_DATA_TO_IO(e->scl_direction - 1);
	e->pin_read = avr->io[pin].r.c;
	e->pin_param = avr->io[pin].r.param;
	avr->io[pin].r.c = sda_read;
	avr->io[pin].r.param = e;
	for (uint16_t a = e->scl_direction; a <= e->scl_direction + 1; a++)
		avr_irq_register_notify(avr_iomem_getirq(avr, a, NULL, AVR_IOMEM_IRQ_ALL), scl_moved, e);
	e->io.kind = "relpos";
	e->io.reset = on_reset;
	e->io.avr = avr;
	avr_io_t *last = avr->io_port;
	while (last->next) last = last->next;
	last->next = &e->io;
	e->next_cause = reset_cause;
	avr_reset(avr);
	e->counter[COUNTER_RESETS] = 0;
	return e;
}

void relpos_avr_destroy(relpos_avr *e)
{
	if (!e) return;
	e->bus = NULL;
	for (avr_io_t *io = e->avr->io_port; io; io = io->next)
		if (io->next == &e->io) io->next = NULL;
	avr_terminate(e->avr);
	free(e->avr);
	free(e->looks.items);
	free(e->heard.items);
	free(e->marks.items);
	free(e->sent.items);
	free(e->queue);
	free(e);
}

void relpos_avr_reset(relpos_avr *e, uint8_t cause)
{
	current = e;
	e->next_cause = cause;
	avr_reset(e->avr);
	if (cause & (PORF | BORF)) scramble(e);
}

void relpos_avr_set_reset_vector(relpos_avr *e, uint32_t address)
{
	e->avr->reset_pc = address;
	if (!e->avr->cycle) e->avr->pc = address;
}

void relpos_avr_jump(relpos_avr *e, uint32_t address)
{
	e->avr->pc = address;
	e->avr->state = cpu_Running;
}

const char *relpos_avr_error(const relpos_avr *e) { return e->error; }

static uint32_t take(record_list *list, uint64_t *cycles, uint8_t *values, uint32_t room)
{
	uint32_t count = list->count < room ? list->count : room;
	for (uint32_t i = 0; i < count; i++) {
		cycles[i] = list->items[i].cycle;
		values[i] = list->items[i].value;
	}
	memmove(list->items, list->items + count, (list->count - count) * sizeof *list->items);
	list->count -= count;
	return count;
}

uint32_t relpos_avr_take_sent(relpos_avr *e, uint64_t *cycles, uint8_t *bytes, uint32_t room)
{
	return take(&e->sent, cycles, bytes, room);
}

uint32_t relpos_avr_take_marks(relpos_avr *e, uint64_t *cycles, uint8_t *values, uint32_t room)
{
	return take(&e->marks, cycles, values, room);
}

void relpos_avr_trace(relpos_avr *e, uint16_t watched)
{
	e->watched = watched;
	hook_read(e, A_TIFR1, tifr1_read);
}

uint32_t relpos_avr_take_looks(relpos_avr *e, uint64_t *cycles, uint8_t *values, uint32_t room)
{
	return take(&e->looks, cycles, values, room);
}

uint32_t relpos_avr_take_heard(relpos_avr *e, uint64_t *cycles, uint8_t *values, uint32_t room)
{
	return take(&e->heard, cycles, values, room);
}

uint32_t relpos_avr_eeprom_size(const relpos_avr *e) { return e->eeprom->size; }

void relpos_avr_eeprom_get(const relpos_avr *e, uint8_t *out, uint32_t count)
{
	memcpy(out, e->eeprom->eeprom, count < e->eeprom->size ? count : e->eeprom->size);
}

void relpos_avr_eeprom_set(relpos_avr *e, const uint8_t *in, uint32_t count)
{
	memcpy(e->eeprom->eeprom, in, count < e->eeprom->size ? count : e->eeprom->size);
}

void relpos_avr_data_get(const relpos_avr *e, uint16_t address, uint8_t *out, uint16_t count)
{
	for (uint32_t i = 0; i < count; i++)
		out[i] = address + i <= e->avr->ramend ? e->avr->data[address + i] : 0;
}

void relpos_avr_data_set(relpos_avr *e, uint16_t address, uint8_t value)
{
	avr_t *avr = e->avr;
	current = e;
	if (address > avr->ramend) return;
	if (address >= 32 && address <= avr->ioend && avr->io[AVR_DATA_TO_IO(address)].w.c)
		avr->io[AVR_DATA_TO_IO(address)].w.c(avr, address, value,
				avr->io[AVR_DATA_TO_IO(address)].w.param);
	else
		avr->data[address] = value;
}

void relpos_avr_set_frequency(relpos_avr *e, uint32_t frequency_hz)
{
	e->avr->frequency = frequency_hz;
}

void relpos_avr_counters(const relpos_avr *e, uint64_t out[COUNTER_COUNT])
{
	memcpy(out, e->counter, sizeof e->counter);
	out[COUNTER_CYCLE] = e->avr->cycle;
	out[COUNTER_LOWEST_SP] = e->lowest_sp;
}

void relpos_avr_set_supply(relpos_avr *e, uint32_t millivolts)
{
	e->avr->vcc = e->avr->avcc = e->avr->aref = millivolts;
}

uint32_t relpos_avr_ram_end(const relpos_avr *e) { return e->avr->ramend; }
