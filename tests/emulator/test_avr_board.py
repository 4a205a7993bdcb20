"""The simulated board against the ATmega data sheets: small programs whose result is known.

uart(51) is 16 MHz / 8 / 52 = 38462 baud.
"""

from __future__ import annotations

import subprocess
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from avr_programs import MISSING, Builder

from relpos.emulator.avr import BOARDS, AvrEngine, Board, Firmware, SimulatorError, read_firmware
from relpos.emulator.avr.board import BUS_HANGS, BusOperation, ResetCause
from relpos.emulator.bus import I2cBus, I2cDevice
from relpos.emulator.engine import NodeClockError

pytestmark = pytest.mark.skipif(MISSING is not None, reason=f"{MISSING} is not installed")


@pytest.fixture
def build(tmp_path: Path) -> Builder:
    return Builder(tmp_path)


def sent(board: Board) -> bytes:
    return bytes(byte for _, byte in board.take_sent())


class Registers(I2cDevice):
    """A chip with 256 registers that hold their own numbers, and an address pointer."""

    def __init__(self) -> None:
        self.conditions: list[str] = []
        self.written: list[int] = []
        self.pointer = 0
        self._first = True
        self.refuse_after: int | None = None
        self.times: list[int] = []

    def advance(self, time_us: int) -> None:
        self.times.append(time_us)

    def start(self, read: bool) -> bool:
        self.conditions.append("R" if read else "W")
        self._first = True
        return True

    def write(self, byte: int) -> bool:
        self.written.append(byte)
        if self._first:
            self.pointer = byte
        self._first = False
        return self.refuse_after is None or len(self.written) <= self.refuse_after

    def read(self) -> int:
        self.pointer = (self.pointer + 1) & 0xFF
        return self.pointer - 1

    def stop(self) -> None:
        self.conditions.append("P")


def engine(
    firmware: Firmware,
    chips: dict[int, I2cDevice],
    board: str = "uno",
    eeprom: bytearray | None = None,
) -> tuple[AvrEngine, bytearray]:
    bus = I2cBus()
    for address, chip in chips.items():
        bus.attach(address, chip)
    made = AvrEngine(BOARDS[board], firmware, bus, eeprom or bytearray(1024), 1, line_baud=0)
    out = bytearray()
    made.on_transmit = lambda _time, data: out.extend(data)
    return made, out


BURST = r"""
int main(void) {
  uart(51);
  TWBR = 12;
  uint8_t data[14], status[8], n = 0;
  GPIOR0 = 1;
  status[n++] = twi(_BV(TWSTA));
  TWDR = 0x68 << 1; status[n++] = twi(0);
  TWDR = 0x3b; status[n++] = twi(0);
  status[n++] = twi(_BV(TWSTA));
  TWDR = 0x68 << 1 | 1; status[n++] = twi(0);
  for (uint8_t i = 0; i < 13; i++) { status[n] = twi(_BV(TWEA)); data[i] = TWDR; }
  status[++n] = twi(0); data[13] = TWDR;
  twi_stop();
  GPIOR0 = 0;
  for (uint8_t i = 0; i <= n; i++) put(status[i]);
  for (uint8_t i = 0; i < 14; i++) put(data[i]);
  for (;;);
}
"""


@pytest.mark.parametrize(("name", "mmcu"), [("uno", "atmega328p"), ("mega", "atmega2560")])
def test_a_burst_after_a_repeated_start_reads_the_registers_with_the_data_sheets_status_codes(
    build: Builder, name: str, mmcu: str
) -> None:
    chip = Registers()
    board, out = engine(build(BURST, mmcu), {0x68: chip}, name)
    board.run(20_000)
    # START, SLA+W ACK, data ACK, repeated START, SLA+R ACK, data ACK, data NACK
    assert out[:7] == bytes([0x08, 0x18, 0x28, 0x10, 0x40, 0x50, 0x58])
    assert out[7:] == bytes(range(0x3B, 0x3B + 14))
    assert chip.conditions == ["W", "R", "P"]
    assert chip.written == [0x3B]
    assert chip.times == sorted(chip.times)
    board.close()


@pytest.mark.parametrize(("divider", "prescaler"), [(12, 0), (72, 0), (18, 1)])
def test_a_fourteen_byte_burst_takes_the_bit_time_that_the_registers_set(
    build: Builder, divider: int, prescaler: int
) -> None:
    program = BURST.replace("TWBR = 12;", f"TWBR = {divider}; TWSR = {prescaler};")
    board, _ = engine(build(program), {0x68: Registers()})
    board.run(20_000)
    bit_cycles = 16 + 2 * divider * 4**prescaler  # ATmega328P data sheet, 22.5.2
    # 17 bytes of 9 bits, START, repeated START, STOP; then about 30 cycles of polling a byte.
    expected = (17 * 9 + 3) * bit_cycles + 20 * 30
    assert board.board.counters().tick_cycles_max == pytest.approx(expected, rel=0.03)
    board.close()


WIRE = Path("/usr/share/arduino/hardware/arduino/avr/libraries/Wire/src/utility")


@pytest.mark.skipif(not WIRE.is_dir(), reason="arduino-core-avr is not installed")
def test_arduinos_own_interrupt_driven_driver_reads_fourteen_bytes_in_524_microseconds(
    build: Builder, tmp_path: Path
) -> None:
    core = WIRE.parents[3]
    program = r"""
#include <stdbool.h>
#include "Arduino.h"
#include "twi.h"
/* What twi.c needs of the Arduino core. */
void digitalWrite(uint8_t pin, uint8_t value) { (void)pin; (void)value; }
void pinMode(uint8_t pin, uint8_t mode) { (void)pin; (void)mode; }
unsigned long micros(void) { return 0; }
int main(void) {
  uint8_t reg = 0x3b, data[14];
  uart(51);
  twi_init(); twi_setFrequency(400000); sei();
  for (uint8_t turn = 0; turn < 2; turn++) {
    GPIOR0 = 1;
    twi_writeTo(0x68, &reg, 1, 1, 0);
    twi_readFrom(0x68, data, 14, 1);
    while (TWCR & _BV(TWSTO));
    GPIOR0 = 0;
  }
  for (uint8_t i = 0; i < 14; i++) put(data[i]);
  put(twi_writeTo(0x22, &reg, 1, 1, 1));
  for (;;);
}
"""
    firmware = build(
        program, "atmega328p", str(WIRE / "twi.c"), "-DARDUINO=10819", f"-I{WIRE}",
        f"-I{core / 'cores' / 'arduino'}", f"-I{core / 'variants' / 'standard'}",
    )  # fmt: skip
    board, out = engine(firmware, {0x68: Registers()})
    board.run(20_000)
    assert out[:14] == bytes(range(0x3B, 0x3B + 14))
    assert out[14:] == b"\x02"  # twi.c: address was not acknowledged
    counters = board.board.counters()
    assert counters.ticks == 2
    # With gcc 5.4; gcc 14.2 makes its interrupt quicker: 507.
    assert counters.tick_cycles_max / 16 == pytest.approx(524, rel=0.05)
    board.close()


def test_an_absent_chip_gives_the_status_of_an_unacknowledged_address(build: Builder) -> None:
    program = r"""
int main(void) {
  uart(51);
  TWBR = 12;
  twi(_BV(TWSTA)); TWDR = 0x22 << 1; put(twi(0)); twi_stop();
  twi(_BV(TWSTA)); TWDR = 0x22 << 1 | 1; put(twi(0)); twi_stop();
  twi(_BV(TWSTA)); TWDR = 0x68 << 1; put(twi(0)); TWDR = 1; put(twi(0)); TWDR = 2; put(twi(0));
  twi_stop();
  for (;;);
}
"""
    chip = Registers()
    chip.refuse_after = 1
    board, out = engine(build(program), {0x68: chip})
    board.run(10_000)
    assert out == bytes([0x20, 0x48, 0x18, 0x28, 0x30])
    board.close()


def test_a_hanging_bus_never_completes_until_nine_clocks_are_given_by_hand(build: Builder) -> None:
    program = r"""
int main(void) {
  uart(51);
  TWBR = 12;
  for (uint8_t turn = 0; turn < 2; turn++) {
    TWCR = _BV(TWINT) | _BV(TWSTA) | _BV(TWEN); while (!(TWCR & _BV(TWINT)));
    TWDR = 0x68 << 1; TWCR = _BV(TWINT) | _BV(TWEN);
    _delay_ms(1);
    put(TWCR & _BV(TWINT) ? TWSR & 0xf8 : 0xee);
    TWCR = 0;
    for (uint8_t i = 0; i < 9; i++) { DDRC |= 0x20; _delay_us(5); DDRC &= ~0x20; _delay_us(5); }
  }
  for (;;);
}
"""
    hanging = True

    def bus(operation: BusOperation, value: int, cycle: int) -> int:
        nonlocal hanging
        if operation == BusOperation.RELEASE:
            hanging = False
        return BUS_HANGS if hanging and operation == BusOperation.START else 1

    with Board(BOARDS["uno"], build(program), bus) as board:
        board.run(160_000)
        assert sent(board) == bytes([0xEE, 0x18])


def test_a_stretched_clock_delays_the_byte_by_just_that_time(build: Builder) -> None:
    taken = []
    for stretch_us in (0, 100):
        with Board(
            BOARDS["uno"],
            build(BURST),
            lambda op, v, c, s=stretch_us: 1 | (s << 8 if op == BusOperation.START else 0),
        ) as board:
            board.run(400_000)
            taken.append(board.counters().tick_cycles_max)
    assert taken[1] - taken[0] == pytest.approx(2 * 1600, abs=16)


ECHO = r"""
int main(void) {
  uart(51);
  for (;;) { while (!(UCSR0A & _BV(RXC0))); put(UDR0); }
}
"""


def test_bytes_at_38400_baud_come_in_and_go_out_at_ten_bits_each(build: Builder) -> None:
    message = bytes(range(100))
    with Board(BOARDS["uno"], build(ECHO), line_baud=38400) as board:
        board.run(1000)
        board.receive(message, 16_000)
        board.run(800_000)
        echoed = board.take_sent()
    assert bytes(byte for _, byte in echoed) == message
    seconds = (echoed[-1][0] - echoed[0][0]) / 16e6
    assert seconds == pytest.approx(99 * 10 / 38400, rel=0.003)
    assert echoed[0][0] / 16e6 == pytest.approx(1e-3 + 2 * 10 / 38400, rel=0.01)


def test_interrupt_driven_sending_and_receiving_loses_nothing(build: Builder) -> None:
    program = r"""
static volatile uint8_t ring[64], head, tail;
ISR(USART_RX_vect) { ring[head++ & 63] = UDR0; UCSR0B |= _BV(UDRIE0); }
ISR(USART_UDRE_vect) { UDR0 = ring[tail++ & 63]; if (tail == head) UCSR0B &= ~_BV(UDRIE0); }
int main(void) { uart(51); UCSR0B |= _BV(RXCIE0); sei(); for (;;); }
"""
    message = bytes(range(256)) * 2
    with Board(BOARDS["uno"], build(program), line_baud=38400) as board:
        board.run(1000)
        board.receive(message)
        board.run(16_000 * 150)
        assert sent(board) == message
        assert board.counters().uart_overruns == 0


def test_a_receiver_that_is_not_read_keeps_three_bytes_and_counts_the_rest_as_lost(
    build: Builder,
) -> None:
    program = r"""
int main(void) { uart(51); _delay_ms(10); while (UCSR0A & _BV(RXC0)) put(UDR0); for (;;); }
"""
    with Board(BOARDS["uno"], build(program), line_baud=38400) as board:
        board.run(1000)
        board.receive(b"abcdefgh")
        board.run(16_000 * 20)
        assert sent(board) == b"abc"
        assert board.counters().uart_overruns == 5


def test_a_wrong_baud_rate_is_an_error_and_not_silence(build: Builder) -> None:
    program = "int main(void) { uart(16); put(1); for (;;); }"
    with (
        Board(BOARDS["uno"], build(program), line_baud=38400) as board,
        pytest.raises(SimulatorError, match=r"117647 baud, the line is at 38400"),
    ):
        board.run(16_000)


def test_marks_count_known_instructions_to_the_cycle(build: Builder) -> None:
    # The delay loop: LDI 1; 250 times DEC 1 + BRNE 2, the last BRNE 1; the second OUT adds its 1.
    program = r"""
int main(void) {
  asm volatile("ldi r24, 1\n ldi r25, 0\n"
      "out %0, r24\n out %0, r25\n"
      "out %0, r24\n nop\n nop\n nop\n out %0, r25\n"
      "out %0, r24\n ldi r18, 250\n 1: dec r18\n brne 1b\n out %0, r25\n"
      :: "I"(_SFR_IO_ADDR(GPIOR0)) : "r18", "r24", "r25");
  for (;;);
}
"""
    with Board(BOARDS["uno"], build(program)) as board:
        board.run(16_000)
        marks = board.take_marks()
        counters = board.counters()
    assert [value for _, value in marks] == [1, 0] * 3
    assert [marks[i + 1][0] - marks[i][0] for i in (0, 2, 4)] == [1, 4, 1 + 1 + 250 * 3 - 1]
    assert counters.ticks == 3
    assert counters.tick_cycles_sum == 1 + 4 + 751
    assert counters.tick_cycles_max == 751
    assert counters.worst_tick_at_cycle == marks[4][0]


def test_the_deepest_stack_is_that_of_a_known_recursion(build: Builder) -> None:
    # Each level: a return address of 2 bytes and one pushed register.
    program = r"""
int main(void) {
  asm volatile("ldi r24, %0\n rcall deeper\n rjmp .\n"
      "deeper: push r24\n dec r24\n breq 1f\n rcall deeper\n 1: pop r24\n ret\n" :: "M"(LEVELS));
  for (;;);
}
"""
    depths = []
    for levels in (1, 100):
        with Board(BOARDS["uno"], build(program, "atmega328p", f"-DLEVELS={levels}")) as board:
            board.run(16_000)
            depths.append(board.deepest_stack_bytes)
    assert depths[1] - depths[0] == 99 * 3
    assert depths[0] == 2 + 2 + 1  # the call of main, the call of the first level, its register


def test_an_interrupt_on_top_of_the_deepest_point_counts_as_stack(build: Builder) -> None:
    program = r"""
ISR(TIMER0_OVF_vect, ISR_NAKED) { asm volatile("push r0\n pop r0\n reti"); }
int main(void) {
  volatile uint8_t block[200]; block[0] = 1;
  if (WITH) { TIMSK0 = 1; TCCR0B = 1; sei(); }
  for (;;) (void)block[0];
}
"""
    depths = []
    for wanted in (0, 1):
        with Board(BOARDS["uno"], build(program, "atmega328p", f"-DWITH={wanted}")) as board:
            board.run(16_000)
            depths.append(board.deepest_stack_bytes)
    assert depths[0] >= 200
    assert depths[1] == depths[0] + 3


def test_a_stack_that_reaches_the_variables_is_an_error_that_names_the_place(
    build: Builder,
) -> None:
    program = r"""
volatile uint8_t variables[1000];
__attribute__((noinline)) int deeper(int n) {
  volatile uint8_t b[30]; b[n & 7] = n; return deeper(n + 1) + b[3]; }
int main(void) { variables[5] = 1; for (;;) deeper(0); }
"""
    with Board(BOARDS["uno"], build(program)) as board:
        with pytest.raises(SimulatorError, match="stack grew into static data at pc 0x"):
            board.run(160_000)
        assert 0 < board.deepest_stack_bytes - (2048 - 1000) < 60  # seen within one call


@pytest.mark.parametrize(
    ("accident", "message"),
    [
        ('asm volatile(".word 0x0001");', "Invalid Opcode"),
        ("((void (*)(void))0x3000)();", "simulated processor crashed"),  # into erased flash
        ('cli(); SMCR = 1; asm volatile("sleep");', "slept with interrupts off"),
        ("*(volatile uint8_t *)0x900 = 1;", "Invalid write address"),
    ],
)
def test_an_accident_of_the_program_is_an_error(
    build: Builder, accident: str, message: str
) -> None:
    program = "int main(void) { uart(51); put(7); _delay_ms(1); ACCIDENT for (;;); }"
    with Board(BOARDS["uno"], build(program.replace("ACCIDENT", accident))) as board:
        with pytest.raises(SimulatorError, match=message):
            board.run(160_000)
        assert sent(board) == b"\x07"  # what was sent before is kept


def test_two_runs_of_one_program_are_identical_to_the_byte_and_cycle(build: Builder) -> None:
    program = r"""
static volatile uint8_t ticks;
ISR(TIMER0_OVF_vect) { ticks++; GPIOR0 = ticks; }
int main(void) {
  uart(51); TWBR = 12; TCCR0B = 2; TIMSK0 = 1; sei();
  for (;;) {
    twi(_BV(TWSTA)); TWDR = 0x68 << 1 | 1; twi(0); twi(0); put(TWDR ^ ticks ^ TCNT0); twi_stop();
  }
}
"""
    firmware = build(program)
    runs = []
    for step_us in (100_000, 137):  # however the host cuts the time
        chip = Registers()
        board, out = engine(firmware, {0x68: chip})
        for until in range(step_us, 100_001, step_us):
            board.run(until)
        board.run(100_000)
        runs.append((bytes(out), board.board.take_marks(), chip.times))
        board.close()
    assert len(runs[0][0]) > 100
    assert runs[0] == runs[1]


def test_the_host_owns_the_clock_within_one_instruction(build: Builder) -> None:
    with Board(BOARDS["uno"], build(ECHO)) as board:
        for until in range(1000, 50_000, 777):
            board.run(until)
            assert 0 <= board.cycle - until <= 4


def test_a_sleeping_processor_wakes_at_its_timer(build: Builder) -> None:
    program = r"""
#include <avr/sleep.h>
ISR(TIMER1_COMPA_vect) { GPIOR0++; }
int main(void) {
  OCR1A = 16000 - 1; TCCR1B = _BV(WGM12) | _BV(CS10); TIMSK1 = _BV(OCIE1A); sei();
  for (;;) sleep_mode();
}
"""
    with Board(BOARDS["uno"], build(program)) as board:
        board.run(16_000 * 100 + 8000)
        cycles = [cycle for cycle, _ in board.take_marks()]
    assert len(cycles) == 100
    assert all(abs(b - a - 16_000) <= 4 for a, b in pairwise(cycles))


def test_the_eeprom_keeps_what_was_written_and_takes_its_time(build: Builder) -> None:
    program = r"""
int main(void) {
  uart(51);
  put(eeprom_read_byte((uint8_t *)5));
  GPIOR0 = 1;
  eeprom_write_byte((uint8_t *)5, eeprom_read_byte((uint8_t *)5) + 1);
  eeprom_write_byte((uint8_t *)1023, 0x42);
  eeprom_busy_wait();
  GPIOR0 = 0;
  put(eeprom_read_byte((uint8_t *)5));
  for (;;);
}
"""
    firmware = build(program)
    eeprom = bytearray(b"\xff" * 5 + b"\x10" + b"\xff" * 1018)
    for before in (0x10, 0x11):
        board, out = engine(firmware, {}, eeprom=eeprom)
        board.run(20_000)
        assert out == bytes([before, before + 1])
        assert board.board.counters().tick_cycles_max == pytest.approx(2 * 0.0034 * 16e6, rel=0.01)
        board.close()
    assert eeprom[5] == 0x12
    assert eeprom[1023] == 0x42
    assert eeprom[:5] == b"\xff" * 5


def test_a_power_cut_while_writing_leaves_the_eeprom_cell_erased(build: Builder) -> None:
    program = "int main(void) { eeprom_write_byte((uint8_t *)0, 0x42); for (;;); }"
    for cause, left in ((ResetCause.BROWN_OUT, 0xFF), (ResetCause.EXTERNAL, 0x42)):
        with Board(BOARDS["uno"], build(program)) as board:
            board.load_eeprom(b"\x07")
            board.run(16_000)
            assert board.eeprom()[0] == 0x07
            board.reset(cause)
            assert board.eeprom()[0] == left


WATCHDOG = r"""
int main(void) {
  uint8_t cause = MCUSR; MCUSR = 0; wdt_disable();
  uart(51); put(cause);
  if (cause & _BV(WDRF)) for (;;);
  wdt_enable(WDTO_30MS);
  for (uint8_t i = 0; i < 10; i++) { _delay_ms(20); wdt_reset(); }
  for (;;);
}
"""


@pytest.mark.parametrize(("name", "mmcu"), [("uno", "atmega328p"), ("mega", "atmega2560")])
def test_a_watchdog_reset_happens_and_the_program_sees_its_cause(
    build: Builder, name: str, mmcu: str
) -> None:
    with Board(BOARDS[name], build(WATCHDOG, mmcu)) as board:
        board.run(16_000 * 215)
        assert sent(board) == bytes([ResetCause.POWER_ON])
        assert board.counters().watchdog_resets == 0
        board.run(16_000 * 300)
        assert sent(board) == bytes([ResetCause.WATCHDOG])
        assert board.counters().watchdog_resets == 1


@pytest.mark.parametrize("cause", list(ResetCause))
def test_the_causes_of_resets_add_up_until_zeros_are_written_or_power_was_lost(
    build: Builder, cause: ResetCause
) -> None:
    program = """int main(void) {
      uart(51); put(MCUSR); if (MCUSR & _BV(BORF)) MCUSR = ~_BV(BORF); put(MCUSR); for (;;); }"""
    with Board(BOARDS["uno"], build(program), reset_cause=cause) as board:
        for again in (ResetCause.BROWN_OUT, ResetCause.EXTERNAL, ResetCause.POWER_ON):
            board.run(board.cycle + 16_000)
            board.reset(again)
        board.run(board.cycle + 16_000)
        seen = sent(board)
    rest = cause & ~ResetCause.BROWN_OUT
    both = cause | ResetCause.BROWN_OUT
    assert seen[0] == cause
    assert seen[2:4] == bytes([both if cause is not ResetCause.BROWN_OUT else cause, rest])
    assert seen[4:6] == bytes([rest | ResetCause.EXTERNAL] * 2)
    assert seen[6:] == bytes([ResetCause.POWER_ON] * 2)


def test_ram_is_not_zero_at_power_on(build: Builder) -> None:
    program = r"""
uint8_t kept[64] __attribute__((section(".noinit")));
int main(void) { uart(51); for (uint8_t i = 0; i < 64; i++) put(kept[i]); for (;;); }
"""
    with Board(BOARDS["uno"], build(program)) as board:
        board.run(16_000 * 20)
        assert len(set(sent(board))) > 30


@pytest.mark.parametrize("cause", list(ResetCause))
def test_ram_outlives_a_reset_and_not_a_loss_of_supply(build: Builder, cause: ResetCause) -> None:
    program = r"""
uint8_t kept[64] __attribute__((section(".noinit")));
int main(void) {
  uart(51);
  for (uint8_t i = 0; i < 64; i++) { put(kept[i]); kept[i] = i; }
  for (;;);
}
"""
    with Board(BOARDS["uno"], build(program)) as board:
        board.run(16_000 * 20)
        sent(board)
        board.reset(cause)
        board.run(16_000 * 40)
        found = sent(board)
    if cause in (ResetCause.POWER_ON, ResetCause.BROWN_OUT):
        assert sum(a == b for a, b in zip(found, range(64), strict=True)) < 10
    else:
        assert found == bytes(range(64))


def test_a_crystal_that_changes_its_rate_makes_no_jump_of_the_clock(build: Builder) -> None:
    firmware = build("int main(void) { for (;;) { GPIOR0 = 1; _delay_ms(10); GPIOR0 = 0; } }")
    board = AvrEngine(BOARDS["uno"], firmware, I2cBus(), bytearray(1024), 1)
    board.run(1_000_000)
    board.set_drift(1_000_000, 5000.0)
    board.run(2_000_000)
    assert board.board.cycle == pytest.approx(16e6 * (1.0 + 1.005), abs=4)
    board.set_drift(2_000_000, 0.0)
    board.run(3_000_000)
    assert board.board.cycle == pytest.approx(16e6 * (2.0 + 1.005), abs=4)
    board.close()


def test_static_ram_and_flash_agree_with_avr_size(build: Builder, tmp_path: Path) -> None:
    program = r"""
volatile uint8_t zeroed[100]; volatile uint16_t set[10] = {1, 2, 3};
uint8_t left[7] __attribute__((section(".noinit")));
int main(void) { for (;;) { zeroed[1] = set[1]; left[0]++; asm volatile("" :: "r"(left)); } }
"""
    firmware = build(program)
    result = subprocess.run(
        ["avr-size", "-A", str(next(tmp_path.glob("*.elf")))],
        capture_output=True,
        text=True,
        check=True,
    )
    sizes = {
        line.split()[0]: int(line.split()[1])
        for line in result.stdout.splitlines()
        if line.startswith(".")
    }
    assert firmware.static_ram_bytes == sizes[".data"] + sizes[".bss"] + sizes[".noinit"]
    assert firmware.static_ram_bytes >= 127
    assert firmware.static_end == 0x100 + firmware.static_ram_bytes
    assert firmware.flash_bytes == sizes[".text"] + sizes[".data"]


def test_a_drifting_crystal_stretches_the_nodes_time(build: Builder) -> None:
    firmware = build("int main(void) { for (;;) { GPIOR0 = 1; _delay_ms(10); GPIOR0 = 0; } }")
    cycles = []
    for ppm in (0.0, 50.0):
        board = AvrEngine(
            BOARDS["uno"], firmware, I2cBus(), bytearray(1024), 1, clock=NodeClockError(ppm)
        )
        board.run(1_000_000)
        cycles.append(board.board.cycle)
        board.close()
    assert cycles[0] == pytest.approx(16_000_000, abs=4)
    assert cycles[1] == pytest.approx(16_000_800, abs=4)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no 32-bit little-endian ELF header"),
        (b"\x7fELF\x01\x01" + bytes(60), "made for machine 0, not AVR"),
        (b"\x7fELF\x01\x01", "is not an AVR program"),
    ],
)
def test_a_file_that_is_no_firmware_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "firmware.elf"
    path.write_bytes(content)
    with pytest.raises(SimulatorError, match=message):
        read_firmware(path)


def test_a_missing_firmware_is_named(tmp_path: Path) -> None:
    with pytest.raises(SimulatorError, match=r"cannot read the firmware .*firmware.elf: No such"):
        read_firmware(tmp_path / "firmware.elf")


def test_a_truncated_firmware_is_an_error_wherever_it_is_cut(
    build: Builder, tmp_path: Path
) -> None:
    build(ECHO)
    whole = next(tmp_path.glob("*.elf")).read_bytes()
    for length in range(0, len(whole), 41):
        path = tmp_path / "cut.elf"
        path.write_bytes(whole[:length])
        with pytest.raises(SimulatorError):
            read_firmware(path)


def test_bytes_before_power_on_are_lost_and_counted(build: Builder) -> None:
    bus = I2cBus()
    board = AvrEngine(
        BOARDS["uno"], build(ECHO), bus, bytearray(1024), 1, power_on_us=50_000, line_baud=38400
    )
    transmitted: list[tuple[int, bytes]] = []
    board.on_transmit = lambda time_us, data: transmitted.append((time_us, data))
    board.run(20_000)
    board.receive(b"early")
    board.run(60_000)
    board.receive(b"!")
    board.run(70_000)
    board.close()
    assert board.lost_while_off == 5
    assert [data for _, data in transmitted] == [b"!"]
    assert transmitted[0][0] == pytest.approx(60_000 + 2 * 260, abs=10)


def test_boards_in_different_threads_do_not_disturb_each_other(build: Builder) -> None:
    good, bad = build(ECHO), build('int main(void) { asm volatile(".word 1"); for (;;); }')

    def one(number: int) -> str:
        with Board(BOARDS["uno"], bad if number % 2 else good) as board:
            try:
                board.run(1_600_000)
            except SimulatorError as error:
                return str(error)
            return "ran"

    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(one, range(16)))
    assert results[::2] == ["ran"] * 8
    assert all("Invalid Opcode" in result for result in results[1::2])


CYCLES = {  # ATmega328P and ATmega2560 data sheets, instruction set summary: (16-bit PC, 22-bit PC)
    "nop": (1, 1),
    "mul r18, r19": (2, 2),
    "adiw r26, 1": (2, 2),
    "push r18\n pop r18": (4, 4),
    "lds r18, 0x200": (2, 2),
    "sts 0x200, r18": (2, 2),
    "ld r18, X": (2, 2),
    "ld r18, -X": (2, 2),
    "ldd r18, Z+3": (2, 2),
    "st X+, r18": (2, 2),
    "lpm r18, Z": (3, 3),
    "rjmp 1f\n 1:": (2, 2),
    "jmp 1f\n 1:": (3, 3),
    "rcall 1f\n rjmp 2f\n 1: ret\n 2:": (3 + 4 + 2, 4 + 5 + 2),
    "call 1f\n rjmp 2f\n 1: ret\n 2:": (4 + 4 + 2, 5 + 5 + 2),
    "ldi r30, pm_lo8(1f)\n ldi r31, pm_hi8(1f)\n icall\n rjmp 2f\n 1: ret\n 2:": (
        2 + 3 + 4 + 2,
        2 + 4 + 5 + 2,
    ),
    "sbi 0x05, 0": (2, 2),
    "in r18, 0x3f": (1, 1),
    "sbrc r25, 0\n nop": (2, 2),  # r25 is 0: skips one word
    "sbrs r25, 0\n nop": (2, 2),
    "sbrc r25, 0\n jmp 0": (3, 3),  # skips two words
    "cpse r25, r25\n nop": (2, 2),
    "cp r25, r25\n breq 1f\n 1:": (1 + 2, 1 + 2),
    "cp r25, r25\n brne 1f\n 1:": (1 + 1, 1 + 1),
}


@pytest.mark.parametrize(("name", "mmcu"), [("uno", "atmega328p"), ("mega", "atmega2560")])
def test_instructions_take_the_cycles_of_the_data_sheet(
    build: Builder, name: str, mmcu: str
) -> None:
    body = "".join(
        f'asm volatile("ldi r26, 0\\n ldi r27, 3\\n ldi r30, 0\\n ldi r31, 3\\n ldi r25, 0\\n'
        f' ldi r24, 1\\n out 0x1e, r24\\n {escaped}\\n out 0x1e, r25\\n"\n'
        f'::: "r18", "r19", "r24", "r25", "r26", "r27", "r30", "r31", "r0", "r1");'
        for escaped in (code.replace("\n", "\\n") for code in CYCLES)
    )
    column = 0 if name == "uno" else 1
    with Board(BOARDS[name], build(f"int main(void) {{ {body} for (;;); }}", mmcu)) as board:
        board.run(16_000)
        marks = [cycle for cycle, _ in board.take_marks()]
    taken = [end - begin - 1 for begin, end in zip(marks[::2], marks[1::2], strict=True)]
    expected = {code: both[column] for code, both in CYCLES.items()}
    assert dict(zip(CYCLES, taken, strict=True)) == expected


@pytest.mark.parametrize(
    ("name", "mmcu", "cost"), [("uno", "atmega328p", 4 + 3 + 4), ("mega", "atmega2560", 5 + 3 + 5)]
)
def test_an_interrupt_costs_entry_jump_and_return(
    build: Builder, name: str, mmcu: str, cost: int
) -> None:
    program = r"""
ISR(TIMER1_COMPA_vect, ISR_NAKED) { asm volatile("reti"); }
int main(void) {
  OCR1A = 200; TCCR1B = _BV(WGM12) | _BV(CS10); TIMSK1 = WITH ? _BV(OCIE1A) : 0; TCNT1 = 0; sei();
  asm volatile("ldi r24, 1\n ldi r25, 0\n out 0x1e, r24\n .rept 300\n nop\n .endr\n out 0x1e, r25\n"
      ::: "r24", "r25");
  for (;;);
}
"""
    taken = []
    for wanted in (0, 1):
        with Board(BOARDS[name], build(program, mmcu, f"-DWITH={wanted}")) as board:
            board.run(1600)
            taken.append(board.counters().tick_cycles_max)
    assert taken[0] == 301
    assert taken[1] - taken[0] == cost


CORE = Path("/usr/share/arduino/hardware/arduino/avr")


@pytest.mark.skipif(not CORE.is_dir(), reason="arduino-core-avr is not installed")
@pytest.mark.parametrize(
    ("name", "mmcu", "variant"), [("uno", "atmega328p", "standard"), ("mega", "atmega2560", "mega")]
)
def test_arduinos_micros_follows_the_cycles_and_never_steps_back(
    build: Builder, name: str, mmcu: str, variant: str
) -> None:
    program = r"""
#include <stdbool.h>
#include "Arduino.h"
int main(void) {
  init();
  uint32_t last = 0; uint8_t backwards = 0;
  uart(51);
  for (uint16_t turn = 0; turn < 3000; turn++) {
    GPIOR0 = 7;
    uint32_t now = micros();
    if (now < last) backwards++;
    last = now;
    if (!(turn % 500)) { put(now); put(now >> 8); put(now >> 16); put(now >> 24); }
  }
  put(backwards);
  for (;;);
}
"""
    firmware = build(
        program, mmcu, str(CORE / "cores" / "arduino" / "wiring.c"), "-DARDUINO=10819",
        "-Wl,--gc-sections", "-ffunction-sections",
        f"-I{CORE / 'cores' / 'arduino'}", f"-I{CORE / 'variants' / variant}",
    )  # fmt: skip
    with Board(BOARDS[name], firmware) as board:
        board.run(1_600_000)
        out = sent(board)
        marks = [cycle for cycle, value in board.take_marks() if value == 7]
    assert len(out) == 6 * 4 + 1
    assert out[-1] == 0
    stamps = np.frombuffer(out[:-1], dtype="<u4").astype(float)
    true = np.array(marks[::500]) / 16.0
    drift = (stamps - stamps[0]) - (true - true[0])
    assert np.abs(drift).max() <= 8.0  # micros() counts in steps of 4
