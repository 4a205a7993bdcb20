"""Where an AVR .elf is, and what it puts into flash, RAM and EEPROM.

avr-ld keeps the three address spaces apart by offsets: data memory from 0x800000, EEPROM from
0x810000, fuses and other marks above that; program memory is at 0.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from relpos import paths
from relpos.emulator.avr.library import NOT_INSTALLED, SimulatorError

ENVIRONMENTS = {
    "uno": "uno",
    "mega": "megaatmega2560",
    "uno-mpu9250": "uno_mpu9250",
    "mega-mpu9250": "megaatmega2560_mpu9250",
}
"""PlatformIO's, of each board with each sensor."""

_DATA = 0x800000
_EEPROM = 0x810000
_FUSES = 0x820000
_MACHINE_AVR = 83
_ALLOCATED = 2
_LOAD = 1
_SYMBOLS = 2
_VARIABLE = 1


@dataclass(frozen=True)
class Firmware:
    """A linked AVR program."""

    flash: bytes
    """Image of program memory from address 0: code, constants and start values of variables."""
    static_ram_bytes: int
    """.data, .bss and .noinit together."""
    static_end: int
    """First data address that no variable occupies; the stack may grow down to here."""
    eeprom: bytes
    """Start values of the EEPROM from address 0, often empty."""
    variables: Mapping[str, int]
    """Data address of every variable in RAM, by its name as the linker knows it."""

    @property
    def flash_bytes(self) -> int:
        """Bytes of program memory used."""
        return len(self.flash)


def build_folders() -> list[Path]:
    """Where PlatformIO has built: tools/pio in .build/pio, a user's own, other compiler in .pio.

    SimulatorError in an installed package, which has neither.
    """
    root = paths.repository()
    if root is None:
        raise SimulatorError(NOT_INSTALLED)
    theirs = root / ".pio" / "build"
    here = [f for f in (paths.build_folder() / "pio" / "build", theirs) if f.is_dir()]
    return here or [theirs]


def default_build_folder() -> Path:
    """The first of :func:`build_folders`."""
    return build_folders()[0]


def find_firmware(board: str, folder: Path) -> Path:
    """The board's .elf under PlatformIO's build folder; SimulatorError where it is not built."""
    path = folder / ENVIRONMENTS[board] / "firmware.elf"
    if not path.is_file():
        raise SimulatorError(f"there is no firmware for the {board} at {path}: run `make firmware`")
    return path


def read_firmware(path: Path) -> Firmware:
    """Read a linked .elf; raises SimulatorError where it is missing or is no AVR program."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise SimulatorError(f"cannot read the firmware {path}: {error.strerror}") from error
    try:
        return _parse(raw)
    except (struct.error, IndexError, ValueError) as error:
        raise SimulatorError(f"{path} is not an AVR program: {error}") from error


def _parse(raw: bytes) -> Firmware:
    if raw[:6] != b"\x7fELF\x01\x01":
        raise ValueError("no 32-bit little-endian ELF header")
    (machine,) = struct.unpack_from("<H", raw, 18)
    if machine != _MACHINE_AVR:
        raise ValueError(f"made for machine {machine}, not AVR")
    program_offset, section_offset = struct.unpack_from("<II", raw, 28)
    program_size, program_count, section_size, section_count = struct.unpack_from("<HHHH", raw, 42)
    if section_offset + section_count * section_size > len(raw):
        raise ValueError("the file is truncated")

    flash = bytearray()
    eeprom = bytearray()
    for i in range(program_count):
        kind, offset, _, physical, size = struct.unpack_from(
            "<IIIII", raw, program_offset + i * program_size
        )
        if kind != _LOAD or not size:
            continue
        content = raw[offset : offset + size]
        if len(content) != size:
            raise ValueError("the file is truncated")
        if physical < _DATA:
            _place(flash, physical, content)
        elif _EEPROM <= physical < _FUSES:
            _place(eeprom, physical - _EEPROM, content)
    if not flash:
        raise ValueError("it holds no code")

    static_bytes = 0
    static_end = 0
    for i in range(section_count):
        fields = struct.unpack_from("<IIIIII", raw, section_offset + i * section_size)
        _, kind, flags, address, _, size = fields
        in_data = flags & _ALLOCATED and _DATA <= address < _EEPROM
        if kind and in_data and size:
            static_bytes += size
            static_end = max(static_end, address + size - _DATA)
    variables = {}
    for i in range(section_count):
        fields = struct.unpack_from("<IIIIIII", raw, section_offset + i * section_size)
        _, kind, _, _, offset, size, strings = fields
        if kind != _SYMBOLS:
            continue
        (names,) = struct.unpack_from("<I", raw, section_offset + strings * section_size + 16)
        for at in range(offset, offset + size, 16):
            name, value, _, info = struct.unpack_from("<IIIB", raw, at)
            if info & 0xF == _VARIABLE and _DATA <= value < _EEPROM:
                end = raw.index(b"\0", names + name)
                variables[raw[names + name : end].decode("ascii")] = value - _DATA
    return Firmware(bytes(flash), static_bytes, static_end, bytes(eeprom), variables)


def _place(image: bytearray, at: int, content: bytes) -> None:
    if len(image) < at + len(content):
        image.extend(b"\xff" * (at + len(content) - len(image)))
    image[at : at + len(content)] = content
