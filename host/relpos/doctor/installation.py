"""Checks of the installation: Python, extras, kernels, tools, key, disk, browser, clock."""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from relpos import extras, paths
from relpos.doctor.computer import Computer
from relpos.doctor.finding import Finding, hint, well, wrong
from relpos.errors import RelposError
from relpos.version import __version__

MEGABYTE = 1_000_000
ROOM_TOO_LITTLE = 200 * MEGABYTE
ROOM_LITTLE = 2000 * MEGABYTE
COUNTERS_BEGIN = 2024
COUNTERS_END = 2041
"""Frames to the nodes use the time as their counter (docs/protocol.md)."""
BROWSERS = (
    "firefox", "chromium", "chromium-browser", "google-chrome", "google-chrome-stable",
    "microsoft-edge", "brave-browser",
)  # fmt: skip
APT = "sudo apt-get install -y"


def look(computer: Computer, key_file: Path | None, out: Path) -> Iterator[Finding]:
    """Run all checks except those of ports; ``out`` is the folder for recordings."""
    yield _python()
    yield from _extras()
    yield _kernels(computer)
    yield from _tools(computer)
    yield _key(key_file)
    yield _room(computer, out)
    yield _browser(computer)
    yield from _clock(computer)


def _python() -> Finding:
    where = paths.repository()
    version = platform.python_version()
    words = f"relpos {__version__}, {f'in {where}' if where else 'installed'}; Python {version}"
    if sys.maxsize < 2**32:
        return wrong("python", f"{words}, 32 bit", "install a 64-bit Python, which numba needs")
    return well("python", words)


def _extras() -> Iterator[Finding]:
    for extra, purpose in extras.PURPOSES.items():
        needed, lacking = extras.requirements(extra), extras.missing(extra)
        name = f"extra {extra}"
        if lacking:
            words = f"not installed: {', '.join(lacking)}; without it: no {purpose}"
            yield hint(name, words, extras.install_line(lacking))
        elif needed:
            yield well(name, f"installed: {purpose}")
        else:
            yield hint(name, "its requirements are unknown: this relpos is not installed")


# -- compiled kernels ------------------------------------------------------------------------------


def _kernels(computer: Computer) -> Finding:
    from relpos.fusion import ROOMS, kernel_cache

    name = "estimators"
    folder = kernel_cache.root(computer.environment("NUMBA_CACHE_DIR"))
    if kernel_cache.refused:
        folder = kernel_cache.refused[0]
    if kernel_cache.refused or not computer.may_write(folder):
        return wrong(
            name,
            f"compiled code cannot be stored in {folder}: every start compiles again",
            "choose a folder that you can write: export NUMBA_CACHE_DIR=FOLDER",
        )
    if not kernel_cache.is_complete({room for rooms in ROOMS.values() for room in rooms}, folder):
        return hint(
            name,
            "not compiled yet: the first start takes half a minute longer",
            "relpos doctor --prepare",
        )
    return well(name, "compiled")


def prepare(progress: Callable[[str, int, int], None] = lambda stage, done, total: None) -> None:
    """Compile the kernels of every estimator, so that no session waits for them."""
    from relpos import fusion

    waiting = [name for name in fusion.SETTINGS if not fusion.is_compiled(name)]
    for done, name in enumerate(waiting):
        progress("compiling", done, len(waiting))
        fusion.warm_up(name)


# -- tools -----------------------------------------------------------------------------------------


def _tools(computer: Computer) -> Iterator[Finding]:
    compiler = computer.environment("CXX") or "g++"
    if computer.which(compiler):
        yield well("g++", _version(computer, compiler))
    else:
        yield hint(
            "g++",
            f"{compiler} is missing: no emulated nodes (`relpos demo`, `emulate`, `deadreckon`)",
            f"{APT} g++",
        )
    yield _platformio(computer)
    for command, package, purpose in (
        ("avr-gcc", "gcc-avr avr-libc arduino-core-avr", "compiler of the boards' firmware"),
        ("avrdude", "avrdude", "writes the firmware into a board"),
    ):
        if computer.which(command):
            yield well(command, _version(computer, command))
        else:
            yield hint(
                command,
                f"missing ({purpose}): PlatformIO downloads its own",
                f"{APT} {package}",
            )


def _version(computer: Computer, command: str) -> str:
    # avrdude prints its version only with its help, and on stderr.
    lines = computer.output_of(command, "--version").splitlines() if command != "avrdude" else []
    return lines[0] if lines else "found"


def _platformio(computer: Computer) -> Finding:
    from relpos.nodes import upload

    name = "PlatformIO"
    try:
        project = paths.firmware_project()
    except RelposError as error:
        return wrong(name, str(error), "reinstall relpos from its wheel or its repository")
    try:
        command = upload.platformio(project, computer.which)
    except RelposError:
        return hint(
            name,
            "missing: no `relpos node flash` from this computer",
            "pipx install platformio",
        )
    return well(name, command[0])


# -- the rest --------------------------------------------------------------------------------------


def _key(key_file: Path | None) -> Finding:
    from relpos.link.authentication import SeenCounters, read_key

    name = "team's key"
    if key_file is None:
        return hint(
            name,
            "no key file: nodes use the public default key of every new node",
            "relpos node flash --key-file team.key --new, then export "
            "RELPOS_KEY_FILE=$PWD/team.key",
        )
    try:
        read_key(key_file)
        SeenCounters.beside(key_file).load()
    except RelposError as error:
        return wrong(name, str(error), "give the nodes' key file: --key-file")
    if sys.platform != "win32" and key_file.stat().st_mode & 0o077:
        return wrong(name, f"{key_file}: others can read it", f"chmod 600 {key_file}")
    return well(name, f"{key_file}, readable only by you")


def _room(computer: Computer, out: Path) -> Finding:
    name = "room for recordings"
    where = out.resolve()
    if not computer.may_write(where):
        return wrong(
            name,
            f"{where} cannot be written",
            "change to a folder of your own, or choose one with --out",
        )
    free = computer.free_bytes(where)
    words = f"{free / 1e9:.1f} GB free for {where}"
    remedy = "free some space, or record to another disk: --out DIR"
    if free < ROOM_TOO_LITTLE:
        return wrong(name, words, remedy)
    return hint(name, words, remedy) if free < ROOM_LITTLE else well(name, words)


def _browser(computer: Computer) -> Finding:
    name = "browser"
    found = next((b for b in BROWSERS if computer.which(b)), None)
    elsewhere = "`--view-listen 0.0.0.0` shows the page on other devices, `--terminal` here"
    if computer.platform in ("win32", "darwin"):
        return well(name, "the system's")
    if found is None:
        return hint(name, f"none found here; {elsewhere}", f"{APT} firefox-esr")
    if not (computer.environment("DISPLAY") or computer.environment("WAYLAND_DISPLAY")):
        return hint(name, f"{found}, but this session has no screen; {elsewhere}")
    return well(name, found)


def _clock(computer: Computer) -> Iterator[Finding]:
    now = computer.now()
    offset = now.strftime("%z")
    words = f"{now:%Y-%m-%d %H:%M:%S}, {now.tzname()} (UTC{offset[:3]}:{offset[3:]})"
    if not COUNTERS_BEGIN <= now.year < COUNTERS_END:
        yield wrong(
            "clock",
            f"{words}: nodes use the time as the frames' counter and reject this one",
            "set date and time, best by a time server: sudo timedatectl set-ntp true",
        )
    elif (
        computer.output_of("timedatectl", "show", "--property=NTPSynchronized")
        .strip()
        .endswith("=no")
    ):
        yield hint(
            "clock",
            f"{words}, not synchronised: after a clock goes back, nodes reject commands until it "
            "has caught up",
            "sudo timedatectl set-ntp true, while there is a network",
        )
    else:
        yield well("clock", words)
    if not computer.sleeps_on():
        yield hint(
            "sleep",
            "this system has no clock that counts on while it sleeps: restart a session after "
            "sleep",
            "keep the laptop awake during a mission",
        )
