"""Mutation testing: small faults in the sources, one at a time; a test has to notice each.

    python tests/mutants/mutants.py [--room NAME ...] [--count 20] [--seed 1]

A sample of all mutants of each room is run in a copy of the repository. Survivors are printed with
their line; those that change nothing anybody could see are explained in EXPLAINED.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 240.0
LEAST_KILLED = 0.85


@dataclass(frozen=True)
class Room:
    """Sources and the tests that have to notice: of pytest, or suites of PlatformIO."""

    sources: tuple[str, ...]
    tests: tuple[str, ...]


HOST, LIB = "host/relpos/", "firmware/lib/"
ROOMS = {
    "protocol": Room(
        (HOST + "protocol/messages.py", HOST + "protocol/framing.py"),
        ("tests/protocol", "tests/link/test_link.py", "tests/link/test_authentication.py"),
    ),
    "authentication": Room(
        (HOST + "link/authentication.py",), ("tests/link/test_authentication.py",)
    ),
    "link": Room(
        (HOST + "link/decoder.py", HOST + "link/beacon.py", HOST + "link/xbee.py"),
        ("tests/link", "tests/soak"),
    ),
    "timeline": Room((HOST + "fusion/timeline.py",), ("tests/fusion/test_timeline.py",)),
    "bank updates": Room(
        tuple(HOST + f"fusion/bank/{kind}_update.py" for kind in ("heading", "range", "detection")),
        ("tests/fusion/bank/test_bank_kernels.py", "tests/fusion/bank/test_common_terms.py"),
    ),
    "frame": Room((LIB + "wire/frame.cpp",), ("test_wire", "test_node")),
    "node": Room((LIB + "node/node.cpp", LIB + "node/settings.cpp"), ("test_node",)),
    "gait": Room((LIB + "inertial/gait.cpp",), ("test_inertial", "test_filter")),
    "filter": Room((LIB + "inertial/filter.cpp",), ("test_inertial", "test_filter")),
}
EXPLAINED = {
    "if (length < kOverhead || length > kFrameBytes) return FrameStatus::kBadLength;": (
        "no message has an empty body"
    ),
    "if counter > self.newest:": "the newest once more: its bit is set already",
    "return cls(newest, (1 << WINDOW) - 1)": "bits beyond the window are never looked at",
    "if (from > to) add_scaled(at(to, to), at(to, from), factor, 1);": (
        "no state is mixed with itself"
    ),
    "const float early_s = kEarly * (period_s_ < kFirstPeriod_s ? period_s_ : kFirstPeriod_s);": (
        "equal periods"
    ),
    "g, off = lanes.working_lines(x.shape[1]), lanes.working_lines(2 * x.shape[1])": (
        "more working space than is used"
    ),
    "while (steps_.count() > 0 && message.count < wire::kMostSteps) {": (
        "no more steps wait than a message holds"
    ),
    "and sorted_s - slowest.reported_s <= lag_s": "a short cut: all are asked behind it",
    "length = plain[0] << 8 | plain[1]": "whatever has a first byte is too long",
    "self._pushed += 1": "an order, not a number",
    "if ordered and entry < ordered[-1]:": "no two entries are equal",
    "if time_s < self._first_s:": "the same time",
    "if time_s > self._newest_s:": "the same time",
    "if motion.time_s > track.reported_s:": "the same time",
    "add_scaled(ph + kAttitude + kZ, reference_, -1.0f, kReferenced);": "kAttitude is 0",
    "if (i > j) {": "an element of the diagonal, swapped",
    "if (sampled_ && step_us > SampleClock::kGapUs) {": "a microsecond of a gap",
}
"""Line without spaces -> why no test can see its mutant."""

SWAPS: dict[type, type] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.And: ast.Or,
    ast.Or: ast.And, ast.Mod: ast.Mult, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """A changed source: its file, line, what changed, and the whole text."""

    path: str
    line: int
    what: str
    text: str


def python_mutants(path: str) -> Iterator[Mutant]:
    """Every mutant of a Python file."""
    tree = ast.parse((ROOT / path).read_text())
    inside = [node for f in ast.walk(tree) if isinstance(f, ast.FunctionDef) for s in f.body
              if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))
              for node in ast.walk(s)]  # fmt: skip
    order = {id(node): k for k, node in enumerate(ast.walk(tree))}
    for node in dict.fromkeys(inside):
        for what, change in _changes(node):
            made = copy.deepcopy(tree)
            twin = list(ast.walk(made))[order[id(node)]]
            change(twin)
            ast.fix_missing_locations(made)
            yield Mutant(path, getattr(node, "lineno", 0), what, ast.unparse(made))


def _changes(node: ast.AST) -> Iterator[tuple[str, object]]:
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        to = SWAPS[type(node.ops[0])]
        yield f"compare: {to.__name__}", lambda n: n.ops.__setitem__(0, to())
    elif isinstance(node, ast.BinOp | ast.BoolOp | ast.AugAssign) and type(node.op) in SWAPS:
        to = SWAPS[type(node.op)]
        yield f"operator: {to.__name__}", lambda n: setattr(n, "op", to())
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float, bool):
        new = not node.value if isinstance(node.value, bool) else node.value + 1
        yield f"constant: {node.value} -> {new}", lambda n: setattr(n, "value", new)
    elif isinstance(node, ast.If | ast.While):
        yield "condition negated", lambda n: setattr(n, "test", ast.UnaryOp(ast.Not(), n.test))
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield "not dropped", lambda n: setattr(n, "op", ast.UAdd())
    elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        yield "call dropped", lambda n: setattr(n, "value", ast.Constant(None))


PLAIN = [(r" < ", " <= "), (r" <= ", " < "), (r" > ", " >= "), (r" >= ", " > "), (r" == ", " != "),
         (r" != ", " == "), (r" \+ ", " - "), (r" - ", " + "), (r" \* ", " + "), (r" && ", " || "),
         (r" \|\| ", " && "), (r"\btrue\b", "false"), (r"\bfalse\b", "true"), (r" \+= ", " -= "),
         (r"\+\+(\w)", r"--\1"), (r"if \((?!!)", "if (!"), (r"\b([1-9]\d*)(?=[;,)])", r"(\1 + 1)"),
         (r"^(\s+)(\w[\w.]*\(.*\);)$", r"\1;")]  # fmt: skip


def cpp_mutants(path: str) -> Iterator[Mutant]:
    """Every mutant of a C++ file's statements, by plain operators."""
    lines = (ROOT / path).read_text().splitlines()
    for number, line in enumerate(lines):
        code = line.split("//")[0].rstrip()
        if not code.startswith("  ") or "static_assert" in code or "#" in code:
            continue
        for pattern, to in PLAIN:
            for match in re.finditer(pattern, code):
                changed = code[: match.start()] + match.expand(to) + code[match.end() :]
                text = "\n".join([*lines[:number], changed, *lines[number + 1 :]]) + "\n"
                yield Mutant(path, number + 1, changed.strip(), text)


def mutants_of(room: Room) -> list[Mutant]:
    """All mutants of a room."""
    return [
        mutant
        for path in room.sources
        for mutant in (python_mutants if path.endswith(".py") else cpp_mutants)(path)
    ]


def complaint(copy_of: Path, room: Room, patience_s: float = PATIENCE_S) -> str:
    """What the room's tests say in that copy where they fail, or do not end; else nothing."""
    if room.sources[0].endswith(".py"):
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-x",
            *room.tests,
        ]
        command += ["--no-header", "-W", "ignore"]
    else:
        chosen = [word for test in room.tests for word in ("-f", test)]
        command = [str(copy_of / "tools" / "pio"), "test", "-e", "native_sanitized", *chosen]
    environment = os.environ | {"PYTHONPATH": str(copy_of / "host"), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(command, cwd=copy_of, capture_output=True, timeout=patience_s,
                              check=False, env=environment)  # fmt: skip
    except subprocess.TimeoutExpired:
        return "they do not end"
    return (done.stdout + done.stderr).decode(errors="replace")[-1500:] if done.returncode else ""


def run_room(name: str, count: int, seed: int, copy_of: Path) -> tuple[int, int]:
    """(killed, tried) of a sample of the room's mutants."""
    room = ROOMS[name]
    found = mutants_of(room)
    began_s = time.monotonic()
    if words := complaint(copy_of, room):
        raise SystemExit(f"{name}: its tests fail without any mutant: {words}")
    patience_s = min(20.0 + 8.0 * (time.monotonic() - began_s), PATIENCE_S)
    sample = random.Random(seed).sample(found, min(count, len(found)))
    killed = explained = 0
    for mutant in sample:
        place = copy_of / mutant.path
        before = place.read_text()
        place.write_text(mutant.text)
        try:
            noticed = complaint(copy_of, room, patience_s) != ""
        finally:
            place.write_text(before)
        line = (ROOT / mutant.path).read_text().splitlines()[mutant.line - 1].strip()
        killed += noticed
        if not noticed:
            why = EXPLAINED.get(line)
            explained += why is not None
            end = f" ({why})" if why else ""
            print(
                f"  survived: {mutant.path}:{mutant.line}: {mutant.what}: {line}{end}", flush=True
            )
    tried = len(sample) - explained
    print(f"{name}: {killed} of {tried} killed, {explained} explained, of {len(found)}", flush=True)
    return killed, tried


def main() -> int:
    """Sample every room."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--room", nargs="*", choices=list(ROOMS), default=list(ROOMS))
    parser.add_argument("--count", type=int, default=20, help="mutants of each room")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        copy_of = Path(folder) / "relpos"
        ignore = shutil.ignore_patterns(
            ".git", ".venv*", ".pio", "out", "*.pyc", "fuzz", "docs-out"
        )
        shutil.copytree(ROOT, copy_of, ignore=ignore, symlinks=True)
        (copy_of / ".venv").symlink_to(ROOT / ".venv")
        totals = [
            run_room(name, arguments.count, arguments.seed, copy_of) for name in arguments.room
        ]
    killed, tried = (sum(column) for column in zip(*totals, strict=True))
    print(f"together: {killed} of {tried} killed, {100.0 * killed / max(tried, 1):.0f} %")
    return killed < LEAST_KILLED * tried


if __name__ == "__main__":
    sys.exit(main())
