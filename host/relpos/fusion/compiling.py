"""What the processes do that :mod:`relpos.fusion.machine_code` starts: compile what they are told.

Each line of the input is a kernel's name (:mod:`relpos.fusion.kernel_types`), or ``rehearse`` and
an estimator's; it is answered by a line once that is compiled and kept on disk.
"""

from __future__ import annotations

import gc
import importlib
import sys
from contextlib import suppress
from typing import Any

from numba import types
from numba.core.errors import NumbaError

from relpos import fusion
from relpos.fusion.kernel_types import TYPES

_PLAIN = {"f": types.float64, "i": types.int64, "u": types.uint64, "b": types.boolean}


def types_of(kernel: str) -> tuple[Any, ...]:
    """Give numba's types of a kernel's arguments."""
    return tuple(
        types.Array(_PLAIN[code[0]], int(code[1]), "C") if len(code) > 1 else _PLAIN[code]
        for code in TYPES[kernel].split()
    )


def compile_kernel(kernel: str) -> None:
    """Compile one kernel, with all that it calls; it is then kept on disk."""
    module, function = kernel.split(".")
    dispatcher: Any = getattr(importlib.import_module(f"relpos.fusion.{module}"), function)
    dispatcher.compile(types_of(kernel))


def work() -> None:
    """Do what the input says, line by line, to its end."""
    # The compiler makes millions of objects and keeps most: looking for garbage frees little.
    gc.disable()
    for line in sys.stdin:
        match line.split():
            case ["rehearse", estimator]:
                fusion.rehearse(estimator)
            case [kernel]:
                # What is not as the list says is left to the rehearsal.
                with suppress(NumbaError, AttributeError, KeyError):
                    compile_kernel(kernel)
        # Whoever does not wait for the rest no longer listens.
        with suppress(OSError):
            print(line, end="", flush=True)
