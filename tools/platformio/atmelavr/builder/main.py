"""Build and upload with the avr-gcc and avrdude that are on PATH, with the platform's own flags."""

from pathlib import Path

from SCons.Script import AlwaysBuild, Builder, Default, DefaultEnvironment

env = DefaultEnvironment()

env.Replace(
    AR="avr-gcc-ar",
    AS="avr-as",
    CC="avr-gcc",
    CXX="avr-g++",
    GDB="avr-gdb",
    OBJCOPY="avr-objcopy",
    RANLIB="avr-gcc-ranlib",
    SIZETOOL="avr-size",
    ARFLAGS=["rc"],
    SIZEPROGREGEXP=r"^(?:\.text|\.data|\.bootloader)\s+(\d+).*",
    SIZEDATAREGEXP=r"^(?:\.data|\.bss|\.noinit)\s+(\d+).*",
    SIZECHECKCMD="$SIZETOOL -A -d $SOURCES",
    PROGNAME="firmware",
    PROGSUFFIX=".elf",
)
env.Append(
    BUILDERS={
        "ElfToHex": Builder(
            action=env.VerboseAction(
                "$OBJCOPY -O ihex -R .eeprom $SOURCES $TARGET", "Building $TARGET"
            ),
            suffix=".hex",
        )
    }
)

if "nobuild" in [str(target) for target in env.get("COMMAND_LINE_TARGETS", [])]:
    elf = str(Path(env.subst("$BUILD_DIR")) / "firmware.elf")
    firmware = str(Path(env.subst("$BUILD_DIR")) / "firmware.hex")
else:
    elf = env.BuildProgram()
    firmware = env.ElfToHex("$BUILD_DIR/${PROGNAME}", elf)
    env.Depends(firmware, "checkprogsize")

AlwaysBuild(env.Alias("nobuild", firmware))
env.AddPlatformTarget(
    "size",
    elf,
    env.VerboseAction("$SIZECHECKCMD", "Calculating size $SOURCE"),
    "Program Size",
    "Calculate program size",
)

upload = env.subst("$UPLOAD_PROTOCOL") or env.BoardConfig().get("upload.protocol")
env.Replace(
    UPLOADER="avrdude",
    UPLOAD_PROTOCOL=upload,
    # -D: the bootloaders erase page by page; `wiring` needs it too.
    UPLOADERFLAGS=["-p", "$BOARD_MCU", "-c", "$UPLOAD_PROTOCOL", "-b", "$UPLOAD_SPEED", "-D"],
    UPLOADCMD='$UPLOADER $UPLOADERFLAGS -P "$UPLOAD_PORT" -U flash:w:$SOURCES:i',
)
env.AddPlatformTarget(
    "upload",
    firmware,
    [
        env.VerboseAction(env.AutodetectUploadPort, "Looking for upload port..."),
        env.VerboseAction("$UPLOADCMD", "Uploading $SOURCE"),
    ],
    "Upload",
)

Default([firmware, elf] if not isinstance(elf, str) else [firmware])
