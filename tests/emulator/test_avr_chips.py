"""A program on the simulated board talks to the register-level chips as to real ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from avr_programs import MISSING, Builder

from relpos.emulator.ak8975 import Ak8975
from relpos.emulator.avr import BOARDS, AvrEngine
from relpos.emulator.bus import I2cBus
from relpos.emulator.mpu9150 import Mpu9150
from relpos.emulator.pozyx import Pozyx
from relpos.emulator.surroundings import Surroundings

pytestmark = pytest.mark.skipif(MISSING is not None, reason=f"{MISSING} is not installed")

DRIVER = r"""
static uint8_t begin(uint8_t address) { twi(_BV(TWSTA)); TWDR = address; return twi(0); }
static void byte(uint8_t b) { TWDR = b; twi(0); }
static void write1(uint8_t chip, uint8_t reg, uint8_t value) {
  begin(chip << 1); byte(reg); byte(value); twi_stop(); }
static void read_n(uint8_t chip, uint8_t reg, uint8_t n) {
  begin(chip << 1); byte(reg); begin(chip << 1 | 1);
  while (n--) { twi(n ? _BV(TWEA) : 0); put(TWDR); }
  twi_stop(); }
"""


class SilentChannel:
    """Air in which no tag answers."""

    def __init__(self) -> None:
        self.wanted: list[tuple[int, int]] = []

    def begin_exchange(self, initiator: Pozyx, destination: int, time_us: int) -> None:
        self.wanted.append((destination, time_us))


def run(elf_program: str, tmp_path: Path, seconds: float) -> tuple[bytes, I2cBus, SilentChannel]:
    still = np.tile([9.80665, 0.0, 0.0], (100, 1))
    around = Surroundings(
        rate_hz=200.0,
        specific_force_m_s2=still,
        angular_rate_rad_s=np.zeros((100, 3)),
        magnetic_field_ut=np.tile([0.0, 20.0, -40.0], (100, 1)),
        pressure_pa=np.full(100, 101325.0),
    )
    compass = Ak8975(around, None, lambda: inertial.bypassed())
    inertial = Mpu9150(around, None, {0x0C: compass})
    bus, air = I2cBus(), SilentChannel()
    bus.attach(0x68, inertial)
    bus.attach(0x0C, compass.host_side())
    bus.attach(0x4B, Pozyx(7, air, around))
    engine = AvrEngine(
        BOARDS["uno"], Builder(tmp_path)(DRIVER + elf_program), bus, bytearray(16), 7
    )
    out = bytearray()
    engine.on_transmit = lambda _time, data: out.extend(data)
    engine.run(round(seconds * 1e6))
    engine.close()
    return bytes(out), bus, air


def test_the_inertial_chip_shows_one_g_and_the_compass_only_behind_the_bypass(
    tmp_path: Path,
) -> None:
    out, _, _ = run(
        r"""
int main(void) {
  uart(51); TWBR = 12;
  read_n(0x68, 0x75, 1);
  put(begin(0x0c << 1)); twi_stop();
  write1(0x68, 0x6b, 0x01); write1(0x68, 0x1a, 4); write1(0x68, 0x19, 19);
  write1(0x68, 0x1c, 0x08); write1(0x68, 0x37, 0x02);
  put(begin(0x0c << 1)); twi_stop();
  read_n(0x0c, 0x00, 1);
  _delay_ms(200);
  read_n(0x68, 0x3b, 14);
  write1(0x0c, 0x0a, 1); _delay_ms(10); read_n(0x0c, 0x02, 8);
  for (;;);
}
""",
        tmp_path,
        0.3,
    )
    assert out[:4] == bytes([0x68, 0x20, 0x18, 0x48])
    acceleration = np.frombuffer(out[4:10], dtype=">i2") / 8192.0
    assert acceleration == pytest.approx([1.0, 0.0, 0.0], abs=2e-3)
    assert np.frombuffer(out[12:18], dtype=">i2") == pytest.approx([0, 0, 0], abs=1)
    assert out[18] == 0x01  # data ready
    field = np.frombuffer(out[19:25], dtype="<i2") * 0.3
    assert field == pytest.approx([20.0, 0.0, 40.0], abs=0.3)  # chip axes


def test_the_tag_takes_a_register_after_a_repeated_write_start_and_holds_the_clock(
    tmp_path: Path,
) -> None:
    out, bus, air = run(
        r"""
int main(void) {
  uart(51); TWBR = 12;
  put(begin(0x4b << 1)); twi_stop();               /* booting: not acknowledged */
  _delay_ms(260);
  read_n(0x4b, 0x00, 1);
  read_n(0x4b, 0x1a, 2);
  begin(0x4b << 1); byte(0x1a); begin(0x4b << 1); byte(0x34); byte(0x12); twi_stop();
  read_n(0x4b, 0x1a, 2);
  begin(0x4b << 1); byte(0xb5); byte(0x09); byte(0x00);
  GPIOR0 = 1; begin(0x4b << 1 | 1); GPIOR0 = 0;
  twi(0); put(TWDR); twi_stop();
  for (;;);
}
""",
        tmp_path,
        0.3,
    )
    assert out == bytes([0x20, 0x43, 7, 0, 0x34, 0x12, 1])
    assert [destination for destination, _ in air.wanted] == [9]
    assert 0.26e6 < air.wanted[0][1] < 0.27e6
    assert sum(bus.counts.values()) == 6
