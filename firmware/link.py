"""How the boards' firmware is linked, beyond build_flags, which go to the compiler."""

import subprocess
from functools import cache
from pathlib import Path

from SCons.Script import DefaultEnvironment

env = DefaultEnvironment()


def said(*command):
    """What a tool of this build prints."""
    done = subprocess.run(
        [env.subst(word) for word in command],
        env=env["ENV"], capture_output=True, text=True, check=True,
    )  # fmt: skip
    return done.stdout


@cache
def order_of_functions():
    """The linker's option for firmware/order.ld."""
    order = Path(env.subst("$PROJECT_DIR")) / "firmware" / "order.ld"
    if "--section-ordering-file" in said("$CC", "-Wl,--help"):
        return f"-Wl,--section-ordering-file,{order}"
    # Before binutils 2.43: as a script of its own, from which later ones make a second .text.
    script = Path(env.subst("$BUILD_DIR")) / "order.ld"
    script.write_text("SECTIONS\n{\n" + order.read_text() + "}\nINSERT AFTER .rela.plt\n")
    return f"-Wl,-T,{script}"


def one_text(target, source, env):
    """Fail where there is a second .text: simulators load only one of them."""
    sections = said("$SIZETOOL", "-A", "$BUILD_DIR/firmware.elf").split("\n")
    count = sum(line.startswith(".text ") for line in sections)
    if count != 1:
        print(f"firmware/link.py: firmware.elf has {count} sections .text, not one")
    return count != 1


env.Append(
    # When it links: the compiler's name is not known before.
    RELPOS_ORDER=lambda target, source, env, for_signature: order_of_functions(),
    LINKFLAGS=[
        # A section a function also where the link compiles: the order is of sections.
        "-ffunction-sections",
        "$RELPOS_ORDER",
        "-Wl,-Map,$BUILD_DIR/firmware.map",  # read by tools/flash_order.py
    ],
)
env.Depends("$BUILD_DIR/firmware.elf", "$PROJECT_DIR/firmware/order.ld")
# Not of firmware.elf itself: that would be linked again by the next call.
env.AddPostAction("checkprogsize", one_text)
