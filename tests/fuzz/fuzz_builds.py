"""Builds of the firmware's fuzzers: random scripts by g++, by coverage with clang's libFuzzer."""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
VECTORS = ROOT / "protocol" / "vectors" / "frames.json"
FOLDER = ROOT / ".build" / "fuzz"
SANITIZED = (
    "-std=gnu++11", "-g", "-O2", "-Wall", "-Wextra", "-Werror",
    "-fno-sanitize-recover=all", "-fno-omit-frame-pointer",
)  # fmt: skip
RANDOM = ("g++", "-fsanitize=address,undefined", "-DRELPOS_RANDOM")
GUIDED = ("clang++", "-fsanitize=address,undefined", "-fsanitize=fuzzer")


def golden_frames():
    """Name, message, key and bytes of every golden frame."""
    return [
        (v["name"], v["message"], bytes.fromhex(v["key"]), bytes.fromhex(v["hex"]))
        for v in json.loads(VECTORS.read_text())
    ]


def golden_header():
    def array(data):
        return "{" + ", ".join(map(str, data)) + "}"

    rows = [
        f"    {{{array(key)}, {array(data)}, {len(data)}}}," for _, _, key, data in golden_frames()
    ]
    return "\n".join(
        [
            "#pragma once",
            "#include <stdint.h>",
            "struct GoldenFrame {",
            "  uint8_t key[16];",
            "  uint8_t bytes[66];",
            "  uint8_t length;",
            "};",
            "static const GoldenFrame kGolden[] = {",
            *rows,
            "};",
            f"static const uint8_t kGoldenFrames = {len(rows)};",
            "",
        ]
    )


def build(compiler, harness="node_fuzzer.cpp"):
    """Compile a harness with the firmware where either has changed; returns the program."""
    library = ROOT / "firmware" / "lib"
    support = ROOT / "tests" / "firmware"
    here = Path(__file__).parent
    harness = here / harness
    sources = [
        path
        for path in library.rglob("*.cpp")
        if "arduino" not in path.parts and path.parent.name != "native"
    ]
    if harness.name == "wire_fuzzer.cpp":  # what it has no use for would only slow it
        sources = [p for p in sources if p.parent.name == "wire" or p.stem in ("xbee", "settings")]
    units = [*sorted(sources), harness]
    header = golden_header()
    command = [compiler[0], *SANITIZED, *compiler[1:]]
    digest = hashlib.sha256("\0".join([*command, header]).encode())
    headers = [here / "references.h", support / "support" / "fake_board.h"]
    for path in [*units, *sorted(library.rglob("*.h")), *headers]:
        digest.update(path.read_bytes())
    folder = FOLDER / digest.hexdigest()[:16]
    program = folder / "fuzzer"
    if program.is_file():
        return program
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "golden_frames.h").write_text(header)
    includes = ["-I", library, "-I", support, "-I", folder, "-I", here]

    def compile_one(unit):
        made = folder / f"{unit.parent.name}-{unit.stem}.{os.getpid()}.o"
        # The search follows the firmware's branches, not its own harness's.
        part = [word for word in command if unit != harness or "fuzzer" not in word]
        subprocess.run([*part, *includes, "-c", "-o", made, unit], check=True)
        return made

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        objects = list(pool.map(compile_one, units))
    linked = folder / f"linked.{os.getpid()}"
    subprocess.run([*command, "-o", linked, *objects], check=True)
    linked.replace(program)
    for path in objects:
        path.unlink()
    return program


def totals(output):
    """The counts of the closing line of a run."""
    lines = [line for line in output.splitlines() if line.startswith("frames ")]
    assert lines, output[-4000:]
    return {name.strip(): int(count) for name, count in re.findall(r"([a-z ]+) (\d+)", lines[-1])}


def check_that_only_the_crc_lets_noise_through(count):
    """2^-16 of the noise passes the CRC by itself; the bound is that of six standard deviations."""
    expected = count["noise"] / 2**16
    assert count["crc of noise"] <= expected + 6 * expected**0.5 + 3
    # Fewer of what is damaged: the CRC sees every one, two and three bits and every 16 in a row.
    assert count["crc of mutants"] <= count["mutants"] / 2**16 + 10
