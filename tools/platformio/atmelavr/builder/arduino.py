"""The Arduino framework from Debian's arduino-core-avr, with the flags of PlatformIO's platform."""

import sys
from pathlib import Path

from SCons.Script import DefaultEnvironment

CORE = Path("/usr/share/arduino/hardware/arduino/avr")

env = DefaultEnvironment()
board = env.BoardConfig()
if not CORE.is_dir():
    sys.stderr.write(f"Error: no Arduino core in {CORE}: apt-get install arduino-core-avr\n")
    env.Exit(1)

env.Append(
    ASFLAGS=["-mmcu=$BOARD_MCU"],
    ASPPFLAGS=["-x", "assembler-with-cpp"],
    CFLAGS=["-std=gnu11", "-fno-fat-lto-objects"],
    CCFLAGS=["-Os", "-Wall", "-ffunction-sections", "-fdata-sections", "-flto", "-mmcu=$BOARD_MCU"],
    CXXFLAGS=["-fno-exceptions", "-fno-threadsafe-statics", "-fpermissive", "-std=gnu++11"],
    CPPDEFINES=[
        ("F_CPU", "$BOARD_F_CPU"),
        "ARDUINO_ARCH_AVR",
        ("ARDUINO", 10808),
        # gcc 5.4 hides it from C++11, and Debian's core asks for it.
        ("DECIMAL_DIG", "__DECIMAL_DIG__"),
    ],
    LINKFLAGS=["-Os", "-mmcu=$BOARD_MCU", "-Wl,--gc-sections", "-flto", "-fuse-linker-plugin"],
    LIBS=["m"],
    CPPPATH=[
        str(CORE / "cores" / board.get("build.core")),
        str(CORE / "variants" / board.get("build.variant")),
    ],
    LIBSOURCE_DIRS=[str(CORE / "libraries")],
)
env.Prepend(
    LIBS=[
        env.BuildLibrary(
            str(Path("$BUILD_DIR") / "FrameworkArduino"),
            str(CORE / "cores" / board.get("build.core")),
        )
    ]
)
