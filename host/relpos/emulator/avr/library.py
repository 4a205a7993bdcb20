"""Builds the simavr shim when needed and declares its functions to ctypes."""

from __future__ import annotations

import ctypes
import hashlib
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

from relpos import paths
from relpos.errors import RelposError

_SHIM = Path(__file__).parent / "simavr_shim"
_COMPILE = ["-std=gnu11", "-O2", "-fPIC", "-shared", "-Wall", "-Wextra"]
_HEADER = Path("/usr/include/simavr/sim_avr.h")


NOT_INSTALLED = (
    "simulated boards are in relpos's repository alone, not in the installed package: take "
    "--board native, or clone the repository"
)
"""The shim is under the GPL and stays out of the wheel, which is under the MIT licence."""


class SimulatorError(RelposError):
    """The simulated board cannot be made, or what ran on it failed."""


BusCallback = ctypes.CFUNCTYPE(
    ctypes.c_int32, ctypes.c_void_p, ctypes.c_int32, ctypes.c_int32, ctypes.c_uint64
)


def missing_parts() -> str | None:
    """Name what is missing to simulate AVR boards, or return None."""
    if shutil.which("cc") is None:
        return "a C compiler (cc)"
    if not _HEADER.is_file():
        return "simavr's library (Debian: libsimavr-dev)"
    return None


def _build() -> Path:
    if not _SHIM.is_dir():
        raise SimulatorError(NOT_INSTALLED)
    sources = [_SHIM / "shim.c", _SHIM / "shim.h"]
    digest = hashlib.sha256(" ".join(_COMPILE).encode())
    for source in sources:
        digest.update(source.read_bytes())
    target = paths.build_folder() / "avr" / f"simavr_shim-{digest.hexdigest()[:16]}.so"
    if target.is_file():
        return target
    missing = missing_parts()
    if missing is not None:
        raise SimulatorError(f"cannot simulate AVR boards: {missing} is not installed")
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        made = Path(folder) / "shim.so"
        command = ["cc", *_COMPILE, "-o", str(made), str(sources[0]), "-lsimavr"]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode:
            lines = result.stderr.strip().splitlines() or ["no message"]
            raise SimulatorError(f"cannot compile the simavr shim: {lines[0]}")
        made.replace(target)  # atomic: two processes may build at once
    return target


@cache
def load() -> ctypes.CDLL:
    """Compile if needed and load the shim; its functions get their argument types."""
    try:
        library = ctypes.CDLL(str(_build()))
    except OSError as error:
        raise SimulatorError(f"cannot load the simavr shim: {error}") from error
    board, u8, u16, u32, u64 = (
        ctypes.c_void_p,
        ctypes.c_uint8,
        ctypes.c_uint16,
        ctypes.c_uint32,
        ctypes.c_uint64,
    )
    text, u64s = ctypes.c_char_p, ctypes.POINTER(u64)
    out = ctypes.c_void_p
    signatures: dict[str, tuple[object, list[object]]] = {
        "create": (board, [text, text, u32, u32, u32, u32, u8, BusCallback, ctypes.c_void_p]),
        "destroy": (None, [board]),
        "run": (ctypes.c_int32, [board, u64]),
        "error": (text, [board]),
        "reset": (None, [board, u8]),
        "set_reset_vector": (None, [board, u32]),
        "jump": (None, [board, u32]),
        "receive": (None, [board, text, u32, u64, u8]),
        "take_sent": (u32, [board, u64s, out, u32]),
        "take_marks": (u32, [board, u64s, out, u32]),
        "trace": (None, [board, u16]),
        "take_looks": (u32, [board, u64s, out, u32]),
        "take_heard": (u32, [board, u64s, out, u32]),
        "eeprom_size": (u32, [board]),
        "eeprom_get": (None, [board, out, u32]),
        "eeprom_set": (None, [board, text, u32]),
        "set_supply": (None, [board, u32]),
        "set_frequency": (None, [board, u32]),
        "data_get": (None, [board, u16, out, u16]),
        "data_set": (None, [board, u16, u8]),
        "counters": (None, [board, u64s]),
        "ram_end": (u32, [board]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(library, f"relpos_avr_{name}")
        function.restype = result
        function.argtypes = arguments
    return library
