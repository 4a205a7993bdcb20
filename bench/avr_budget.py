"""What the whole firmware costs on each board, measured on the simulator.

    python bench/avr_budget.py [--board uno] [--seconds 60] [--filters]

The firmware .elf runs with register-level chips under a walking member of a team of six: every
report, ranging round, magnetometer reading and command of normal service happens. Exit status 1
where a budget is exceeded or the firmware did not do its work. With ``--filters`` also what the
inertial library and two published orientation filters take alone on the Uno's chip.
"""

from __future__ import annotations

import argparse
import re
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, TimeElapsedColumn
from rich.table import Table

from avr import filters
from avr.service import Service
from relpos.emulator.avr import BOARDS, SimulatorError, read_firmware
from relpos.emulator.avr.elf import ENVIRONMENTS, build_folders, find_firmware
from relpos.errors import RelposError

TICK_CYCLES = 320_000
"""One 50 Hz tick at 16 MHz."""
STEP_US = 250_000


@dataclass(frozen=True)
class Budget:
    """The most that a board's firmware may take."""

    flash_bytes: int
    ram_bytes: int
    """Static RAM and deepest stack together."""
    worst_tick_share: float
    mean_tick_share: float


BUDGETS = {
    # Half a kilobyte less than the Uno's boot loader leaves, an eighth of one less than its RAM.
    "uno": Budget(31 * 1024, 1920, 0.45, 0.25),
    # The Mega holds the same firmware: its own limits less its boot loader and the same reserve.
    "mega": Budget(248 * 1024, 8192 - (2048 - 1920), 0.45, 0.25),
}
BUDGETS |= {f"{board}-mpu9250": budget for board, budget in BUDGETS.items()}


@dataclass(frozen=True)
class Cost:
    """What one board's firmware took in one run."""

    board: str
    seconds: float
    flash_bytes: int
    static_ram_bytes: int
    stack_bytes: int
    ticks: int
    mean_tick_cycles: float
    worst_tick_cycles: int
    worst_tick_at_s: float
    work: str
    """What the firmware did meanwhile, in words."""
    faults: tuple[str, ...]
    """Why the run does not count, or past which budget it is."""

    @property
    def ram_bytes(self) -> int:
        """Static RAM and deepest stack."""
        return self.static_ram_bytes + self.stack_bytes

    @property
    def worst_tick_share(self) -> float:
        """Of the 20 ms between two ticks."""
        return self.worst_tick_cycles / TICK_CYCLES

    @property
    def mean_tick_share(self) -> float:
        """Of the 20 ms between two ticks."""
        return self.mean_tick_cycles / TICK_CYCLES


def compiler(elf: Path) -> str:
    """Return what the program was compiled with, as its compiler has written it there."""
    found = re.search(rb"GCC: \(GNU\) ([0-9.]+)", elf.read_bytes())
    return f"avr-gcc {found[1].decode()}" if found else "an unknown compiler"


def measure(
    board: str,
    elf: Path,
    seconds: float,
    seed: int = 1,
    progress: Callable[[float], None] = lambda _seconds: None,
) -> Cost:
    """Run the firmware for so many seconds of normal service and measure what it takes."""
    firmware = read_firmware(elf)
    kind = BOARDS[board.partition("-")[0]]
    with Service(kind, firmware, seconds, seed, successor="-" in board) as service:
        until_us = 0
        while until_us < seconds * 1e6:
            until_us = min(until_us + STEP_US, round(seconds * 1e6))
            service.run(until_us)
            progress(until_us / 1e6)
        counters = service.engine.board.counters()
        stack = service.engine.board.deepest_stack_bytes
        work, faults = service.work_done()
    limits = BUDGETS[board]
    worst = counters.tick_cycles_max
    mean = counters.tick_cycles_sum / max(counters.ticks, 1)
    ram = firmware.static_ram_bytes + stack
    past = list(faults)
    if counters.ticks < 0.9 * 50 * (seconds - 2.0):
        past.append(f"only {counters.ticks} ticks in {seconds:g} s")
    if firmware.flash_bytes > limits.flash_bytes:
        past.append(f"flash {firmware.flash_bytes} B is past {limits.flash_bytes} B")
    if ram > limits.ram_bytes:
        past.append(f"static RAM and deepest stack {ram} B are past {limits.ram_bytes} B")
    if worst > limits.worst_tick_share * TICK_CYCLES:
        past.append(f"worst tick {worst} cycles is past {limits.worst_tick_share:.0%} of 20 ms")
    if mean > limits.mean_tick_share * TICK_CYCLES:
        past.append(f"mean tick {mean:.0f} cycles is past {limits.mean_tick_share:.0%} of 20 ms")
    return Cost(
        board=board,
        seconds=seconds,
        flash_bytes=firmware.flash_bytes,
        static_ram_bytes=firmware.static_ram_bytes,
        stack_bytes=stack,
        ticks=counters.ticks,
        mean_tick_cycles=mean,
        worst_tick_cycles=worst,
        worst_tick_at_s=counters.worst_tick_at_cycle / kind.frequency_hz,
        work=work,
        faults=tuple(past),
    )


def table(costs: Sequence[Cost], compiled_with: str) -> Table:
    """Costs beside budgets, one column a board."""
    shown = Table(title=f"Firmware on simavr, {compiled_with}")
    shown.add_column("")
    for cost in costs:
        shown.add_column(cost.board, justify="right")

    def row(label: str, cell: Callable[[Cost, Budget], str]) -> None:
        shown.add_row(label, *(cell(cost, BUDGETS[cost.board]) for cost in costs))

    row("flash", lambda c, b: f"{c.flash_bytes} of {b.flash_bytes} B")
    row("static RAM", lambda c, _: f"{c.static_ram_bytes} B")
    row("deepest stack", lambda c, _: f"{c.stack_bytes} B")
    row("RAM together", lambda c, b: f"{c.ram_bytes} of {b.ram_bytes} B")
    row("ticks", lambda c, _: f"{c.ticks} in {c.seconds:g} s")
    row(
        "mean tick",
        lambda c, b: (
            f"{c.mean_tick_cycles:.0f} cycles, {c.mean_tick_share:.1%} of {b.mean_tick_share:.0%}"
        ),
    )
    row(
        "worst tick",
        lambda c, b: (
            f"{c.worst_tick_cycles} cycles, {c.worst_tick_share:.1%} of {b.worst_tick_share:.0%}"
        ),
    )
    row("worst tick at", lambda c, _: f"{c.worst_tick_at_s:.2f} s")
    return shown


PARTS = {
    "covariance": "error filter: covariance of 12 states, and the field's reference",
    "inertial": "dead reckoning without it: state, step, displacement",
    "gait": "gait detector and forward axis",
    "imu": "MPU-9150 and AK8975",
    "pozyx": "Pozyx",
    "xbee": "XBee, with the frame that comes in",
    "frame": "frame that goes out",
    "ranges": "ranges that wait to be sent",
    "steps": "steps that wait to be sent",
    "commands": "commands that were obeyed",
    "settings": "settings and calibration",
    "totals": "running totals",
    "node": "rest of the node: clocks, counters, times",
    "board": "outside the node: UART rings, clock, constants",
}
"""What ``bench/avr/ram_parts.cpp`` calls the parts of the static RAM; the last is the remainder."""


def ram_plan(cost: Cost) -> dict[str, int]:
    """Bytes of each of PARTS and of the stack; together they are the cost's RAM."""
    parts = filters.ram_parts()
    parts["board"] = cost.static_ram_bytes - parts["node"]
    parts["inertial"] -= parts["covariance"] + parts["gait"]
    inside = set(PARTS) - {"node", "board"}
    parts["node"] -= sum(parts[part] for part in inside)
    return {**{PARTS[part]: parts[part] for part in PARTS}, "deepest stack": cost.stack_bytes}


def plan_table(cost: Cost) -> Table:
    """Where the RAM goes."""
    shown = Table(title=f"RAM of the {cost.board}, {cost.ram_bytes} B")
    shown.add_column("")
    shown.add_column("B", justify="right")
    for part, size in ram_plan(cost).items():
        shown.add_row(part, str(size))
    return shown


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, and return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python bench/avr_budget.py",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--board", action="append", choices=sorted(BUDGETS), help="default: all")
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="length of the walk (default 60)"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the walk and the chips' errors")
    parser.add_argument("--build", type=Path, default=None, help="PlatformIO's build folder")
    parser.add_argument(
        "--filters", action="store_true", help="the plan of the RAM, and filters alone on the chip"
    )
    given = parser.parse_args(arguments)
    boards: list[str] = given.board or list(BUDGETS)
    console = Console()
    more: list[Table] = []
    faults: list[str] = []
    try:
        folders: list[Path] = [given.build] if given.build else build_folders()
        if not 5.0 <= given.seconds <= 3600.0:
            raise SimulatorError(f"a walk lasts 5 to 3600 seconds, not {given.seconds:g}")
        for folder in folders:
            # A user's own build has the boards that the user has built.
            here = [
                b for b in boards if folder == folders[0] or (folder / ENVIRONMENTS[b]).is_dir()
            ]
            files = {board: find_firmware(board, folder) for board in here}
            if not files:
                continue
            costs = _measure_all(files, given.seconds, given.seed)
            console.print(table(costs, compiler(files[here[0]])))
            for cost in costs:
                console.print(f"{cost.board}: {cost.work}", highlight=False)
            faults += [f"{cost.board}: {fault}" for cost in costs for fault in cost.faults]
            if given.filters and folder == folders[0]:
                more = [plan_table(cost) for cost in costs if cost.board == "uno"]
        if given.filters:
            more.append(filters.comparison(given.seconds, given.seed))
    except RelposError as error:
        print(f"budget: {error}", file=sys.stderr)
        return 1
    for shown in more:
        console.print(shown)
    for fault in faults:
        print(f"budget: {fault}", file=sys.stderr)
    return 1 if faults else 0


def _measure_all(files: dict[str, Path], seconds: float, seed: int) -> list[Cost]:
    lock = threading.Lock()
    with (
        Progress(
            *Progress.get_default_columns(), TimeElapsedColumn(), console=Console(stderr=True)
        ) as bars,
        ThreadPoolExecutor(len(files)) as pool,  # the simulation itself runs outside Python's lock
    ):
        tasks = {board: bars.add_task(f"simulating {board}", total=seconds) for board in files}

        def one(board: str) -> Cost:
            def show(done: float) -> None:
                with lock:
                    bars.update(tasks[board], completed=done)

            return measure(board, files[board], seconds, seed, show)

        return list(pool.map(one, files))


if __name__ == "__main__":
    sys.exit(main())
