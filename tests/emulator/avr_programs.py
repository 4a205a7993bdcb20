"""Compiles small C programs for the tests of the simulated boards."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

from relpos.emulator.avr import Firmware, read_firmware
from relpos.emulator.avr.library import missing_parts

MISSING = missing_parts() or (None if shutil.which("avr-gcc") else "avr-gcc (Debian: gcc-avr)")
"""What these tests need and this machine has not."""

HEAD = r"""
#include <avr/io.h>
#include <avr/interrupt.h>
#include <avr/eeprom.h>
#include <avr/wdt.h>
#include <util/delay.h>
static inline void uart(uint8_t divisor) {
  UCSR0A = _BV(U2X0); UBRR0 = divisor; UCSR0B = _BV(TXEN0) | _BV(RXEN0); }
static inline void put(uint8_t b) { while (!(UCSR0A & _BV(UDRE0))); UDR0 = b; }
static inline uint8_t twi(uint8_t c) {
  TWCR = c | _BV(TWINT) | _BV(TWEN); while (!(TWCR & _BV(TWINT))); return TWSR & 0xf8; }
static inline void twi_stop(void) {
  TWCR = _BV(TWINT) | _BV(TWSTO) | _BV(TWEN); while (TWCR & _BV(TWSTO)); }
"""


class Builder:
    """Compiles C programs for a chip, behind HEAD."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def elf(self, program: str, mmcu: str = "atmega328p", *options: str) -> Path:
        """Path of the linked program."""
        number = len(list(self.folder.glob("*.c")))
        source = self.folder / f"p{number}.c"
        source.write_text(HEAD + program)
        elf = source.with_suffix(".elf")
        command = [
            "avr-gcc", f"-mmcu={mmcu}", "-DF_CPU=16000000UL", "-Os", "-std=gnu11", *options,
            "-o", str(elf), str(source),
        ]  # fmt: skip
        subprocess.run(command, check=True, env={**os.environ, "LC_ALL": "C"})
        return elf

    def __call__(self, program: str, mmcu: str = "atmega328p", *options: str) -> Firmware:
        """Compile and read."""
        return read_firmware(self.elf(program, mmcu, *options))
