#!/usr/bin/env python3
"""Order the Uno's functions in flash so that few calls need the long form: tools/flash_order.py.

A relative call (2 bytes) reaches 4 KB, any other takes 4. The linker shortens what is in reach
(--relax), so the order of the functions is worth 600 bytes. This reads the map of the last
`pio run -e uno`, looks for a better order by simulated annealing (always the same one), and writes
firmware/order.ld. A function that is not in that file is placed behind the others: run this again,
twice, when `pio run -e uno` grows by more than what was added.
"""

from __future__ import annotations

import argparse
import math
import random
import re
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
BUILD = ROOT / ".build" / "pio" / "build" / "uno"
ORDER = ROOT / "firmware" / "order.ld"
REACH = 4090  # bytes, of 4094: the map's addresses move as calls get shorter
HEAD = """\
/* Written by tools/flash_order.py: do not edit. firmware/link.py hands it to the linker, before the
   linker's own script; what belongs at the start of the flash is repeated here. */
.text :
{
  KEEP(*(.vectors))
  *(.progmem.gcc*)
  *(.trampolines*)
  *(.progmem*)
  . = ALIGN(2);
  *(.jumptables*)
  *(.lowtext*)
"""
TAIL = """\
}
"""


@dataclass
class Block:
    """Code that stays together: one function, or a library's section."""

    pattern: str
    start: int
    size: int
    calls: list[tuple[int, int]] = field(default_factory=list)  # place in it, address called


def blocks_of(map_file: Path) -> list[Block]:
    """Return the blocks of .text in the order of the map, without what has a fixed place."""
    text = map_file.read_text()
    text = text[text.index("Linker script and memory map") :]
    found: list[Block] = []
    for name, start, size, origin in re.findall(
        r"^ (\.text\S*)\s+0x([0-9a-f]+)\s+0x([0-9a-f]+) (\S.*)$", text, re.M
    ):
        if int(size, 16) == 0 or int(start, 16) >= 1 << 16:
            continue
        library = re.search(r"/(lib\w+\.a)\(", origin)
        if library:
            pattern = f"*{library.group(1)}:({name})" if name == ".text" else f"*({name})"
        else:
            # Clones are numbered anew in each build.
            whole = re.sub(r"\.(constprop|isra|part|lto_priv)\..*", "", name)
            pattern = f"*({whole} {whole}.*)"
        if found and found[-1].pattern == pattern and library:
            found[-1].size = int(start, 16) + int(size, 16) - found[-1].start
        elif name != ".text":
            found.append(Block(pattern, int(start, 16), int(size, 16)))
    return found


def read_calls(elf: Path, found: list[Block]) -> None:
    """Fill in who calls whom."""
    code = subprocess.run(
        ["avr-objdump", "-d", elf], check=True, capture_output=True, text=True
    ).stdout
    for at, target in re.findall(
        r"^\s+([0-9a-f]+):.*\tr?(?:call|jmp)\t.*; 0x([0-9a-f]+)", code, re.M
    ):
        for block in found:
            if block.start <= int(at, 16) < block.start + block.size:
                block.calls.append((int(at, 16) - block.start, int(target, 16)))


def order_of(found: list[Block], steps: int, seed: int = 1) -> tuple[list[int], int, int]:
    """Return the best order met, the long calls now and then."""
    edges = [
        (number, at, other, target - callee.start)
        for number, block in enumerate(found)
        for at, target in block.calls
        for other, callee in enumerate(found)
        if other != number and callee.start <= target < callee.start + callee.size
    ]
    caller, here, callee, there = np.array(edges).T
    offset = there - here
    sizes = np.array([block.size for block in found])
    places = np.empty(len(found), dtype=np.int64)

    def cost(order: list[int]) -> int:
        ordered = sizes[order]
        places[order] = np.cumsum(ordered) - ordered
        return int(np.count_nonzero(np.abs(places[callee] - places[caller] + offset) > REACH))

    draw = random.Random(seed)
    order = list(range(len(found)))
    now = cost(order)
    first = best = now
    best_order = order
    for step in range(steps):
        heat = 8.0 * (1.0 - step / steps) ** 2 + 0.15
        new = order.copy()
        begin = draw.randrange(len(new))
        end = begin + (1 if draw.random() < 0.6 else draw.randrange(1, 16))
        moved = new[begin:end]
        del new[begin:end]
        if draw.random() < 0.2:
            moved.reverse()
        to = draw.randrange(len(new) + 1)
        new[to:to] = moved
        then = cost(new)
        if then <= now or draw.random() < math.exp((now - then) / heat):
            order, now = new, then
            if now < best:
                best, best_order = now, order
    return best_order, first, best


def main() -> int:
    """Write the order; say what it is worth."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--elf", type=Path, default=BUILD / "firmware.elf")
    parser.add_argument("--map", type=Path, default=BUILD / "firmware.map")
    parser.add_argument("--steps", type=int, default=150_000)
    arguments = parser.parse_args()
    if not arguments.elf.exists() or not arguments.map.exists():
        print("flash_order: no map: run `pio run -e uno` first", file=sys.stderr)
        return 1
    found = blocks_of(arguments.map)
    read_calls(arguments.elf, found)
    order, before, after = order_of(found, arguments.steps)
    lines = list(dict.fromkeys(found[number].pattern for number in order))
    ORDER.write_text(HEAD + "".join(f"  {line}\n" for line in lines) + TAIL)
    print(f"long calls: {before}, then {after}: {2 * (before - after)} bytes less")
    return 0


if __name__ == "__main__":
    sys.exit(main())
