"""Boot loaders that simulated boards start with, as programs for simavr."""

import shutil
import subprocess
from pathlib import Path

from relpos.emulator.avr.elf import Firmware, read_firmware
from relpos.emulator.avr.library import missing_parts

ROOT = Path(__file__).resolve().parents[2]
LOADERS = Path("/usr/share/arduino/hardware/arduino/avr/bootloaders")
OPTIBOOT = LOADERS / "optiboot/optiboot.c"
MEGA_LOADER = LOADERS / "stk500v2/stk500boot_v2_mega2560.hex"
# A fuse starts the loader at the end of flash instead of address 0.
OPTIBOOT_ADDRESS = 0x7E00
MEGA_ADDRESS = 0x3E000
ADDRESSES = {"uno": OPTIBOOT_ADDRESS, "mega": MEGA_ADDRESS}
# Where no program has been uploaded yet: an endless loop.
NO_PROGRAM = bytes.fromhex("ffcf")


def needs() -> str | None:
    """What is missing for an upload into a simulated board."""
    for command in ("avr-gcc", "avr-objcopy", "avrdude"):
        if shutil.which(command) is None:
            return f"{command} is not installed"
    if not OPTIBOOT.is_file():
        return "arduino-core-avr is not installed"
    if not (ROOT / ".venv" / "bin" / "platformio").is_file():
        return "PlatformIO is not in .venv"
    return missing_parts()


def build_optiboot(folder: Path) -> Firmware:
    """The Uno's."""
    # Built, because the image that Debian ships reaches beyond the end of flash.
    elf = folder / "optiboot.elf"
    options = "-w -Os -fno-inline-small-functions -fno-split-wide-types -mshort-calls -mrelax"
    chip = "-mmcu=atmega328p -nostartfiles -DF_CPU=16000000L"
    settings = "-DLED_START_FLASHES=0 -DBAUD_RATE=115200"
    places = f"-Wl,--section-start=.text={OPTIBOOT_ADDRESS:#x} -Wl,--section-start=.version=0x7ffe"
    arguments = f"{options} {chip} {settings} {places}".split()
    subprocess.run(["avr-gcc", *arguments, str(OPTIBOOT), "-o", str(elf)], check=True)
    image = bytearray(read_firmware(elf).flash)
    image[: len(NO_PROGRAM)] = NO_PROGRAM
    return Firmware(bytes(image), 0, 0x100, b"", {})


def place_hex(path: Path, image: bytearray) -> None:
    """Put what an Intel HEX file holds where it belongs.

    Not by avr-objcopy: Debian 13's refuses the Mega's loader.
    """
    base = 0
    for line in path.read_text().split():
        count, at, kind = int(line[1:3], 16), int(line[3:7], 16), int(line[7:9], 16)
        data = bytes.fromhex(line[9 : 9 + 2 * count])
        if kind == 2:  # extended segment address
            base = int.from_bytes(data, "big") << 4
        elif kind == 4:  # extended linear address
            base = int.from_bytes(data, "big") << 16
        elif kind == 0:
            image[base + at : base + at + count] = data


def mega_loader() -> Firmware:
    """The Mega's, as Debian ships it."""
    image = bytearray(b"\xff" * 0x40000)
    image[: len(NO_PROGRAM)] = NO_PROGRAM
    place_hex(MEGA_LOADER, image)
    return Firmware(bytes(image), 0, 0x200, b"", {})
