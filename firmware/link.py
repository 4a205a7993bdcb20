"""How the boards' firmware is linked, beyond build_flags, which go to the compiler."""

from SCons.Script import DefaultEnvironment

env = DefaultEnvironment()
env.Append(
    LINKFLAGS=[
        # A section a function also where the link compiles: the order below is of sections.
        "-ffunction-sections",
        "-Wl,-T,$PROJECT_DIR/firmware/order.ld",
        "-Wl,-Map,$BUILD_DIR/firmware.map",  # read by tools/flash_order.py
    ]
)
env.Depends("$BUILD_DIR/firmware.elf", "$PROJECT_DIR/firmware/order.ld")
