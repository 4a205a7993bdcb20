"""Writes docs/reliability.md: every fault of the vocabulary, injected and measured.

    python bench/reliability.py [--output docs/reliability.md] [FAULT ...]

With names of faults it prints their rows and writes nothing.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Collection, Iterator
from pathlib import Path

import fault_runs
from fault_runs import Outcome, compare
from relpos.emulator.faults import TARGETS, Fault

PAGE = Path(__file__).parents[1] / "docs" / "reliability.md"

HEAD = f"""# What goes wrong, and what then?

| promise | measured 2026-11-25 | by |
|---|---|---|
| nothing from outside ends a session | 152 random episodes, ten nodes for 8 h, 1.5 h \
with `bank`, 4,800 s at once, 160,000 bodies: 0 open | `make soak` |
| no forged, altered, replayed frame counts | 10,000,033 frames: 0 taken | `make soak` |
| a kill takes 1 s with `--record`, else 2 s | 269 kills: 1.001, 0.3 s | `soak.py --kills` |
| parsers fail in their own errors alone | by coverage: node 103,754,564, \
host 27,634,597: 0 open | `make fuzz` |
| covariances stay positive, numbers finite | 10^6 motions each: bank, smoother, particle filter; \
node: 10^6 samples: 0 open | `make soak` |
| tests notice faults in what is trusted | killed: gait 15/15, authentication 28/28, \
protocol 20/20, link 20/20, timeline 19/19, filter 17/17, \
bank 20/20, frame 19/19, node 19/19 | `make mutants` |
| no clock, theft or replay locks out or commands | [security](security.md) | `make test` |

Others (2026): PX4
[`mavsdk_test_runner.py`](https://docs.px4.io/main/en/test_and_ci/integration_testing_mavsdk);
ArduPilot [`run_coverage.py`](https://ardupilot.org/dev/docs/coverage-analysis.html); MAVLink
[signing](https://mavlink.io/en/guide/message_signing.html), 48-bit tags, one key; Klipper
[`test_klippy.py`](https://www.klipper3d.org/Debugging.html). No such figures were found.

## Each fault

By `bench/reliability.py` (`make pages`). Faults of `relpos emulate --fault`
(`host/relpos/emulator/faults/table.py`), each with a test
(`tests/emulator/test_faults_behaviour.py`).

{fault_runs.NODES} native boards walk {fault_runs.SECONDS:g} s, seed {fault_runs.SEED}, all in
reach, no frame lost otherwise. What lasts, lasts from {fault_runs.BEGIN_S:g} to
{fault_runs.END_S:g} s, at node {fault_runs.NODE}; compared with the same team without.

- **time to recover**: from the fault's end to the first whole report of what was disturbed.
- **motion lost**: path that the host never got (negative: more than without the fault);
  at a restart with its duration.
- **worst range**: largest error in the team (noise alone: {{noise:.2f}} m).
- **seen**: counters, flags, link counts beyond those without it.

"""
COLUMNS = (
    "fault",
    "what goes wrong",
    "what node and host do",
    "time to recover",
    "motion lost",
    "worst range",
    "seen",
)


def row(fault: Fault, outcome: Outcome, before: Fault | None) -> str:
    """One line of the table; what it has in common with the fault ``before`` is not repeated."""
    recovery = outcome.recovery_s
    words = "never" if recovery is None else f"{recovery:.1f} s"
    lost = outcome.lost_m
    way = "-" if math.isnan(lost) else f"{lost if abs(lost) >= 0.005 else 0.0:.2f} m"
    if outcome.restarts:
        way += f" in {outcome.lost_s:.1f} s"
    cells = (
        f"`{outcome.spec}`",
        "" if before is fault else fault.meaning,
        "" if before is not None and before.must == fault.must else fault.must,
        words,
        way,
        f"{outcome.worst_range_error_m:.2f} m",
        ", ".join(outcome.seen()) or "-",
    )
    return table_line(cells)


def table_line(cells: tuple[str, ...]) -> str:
    """Cells between bars."""
    return "| " + " | ".join(cells) + " |\n"


def rows(names: Collection[str] = TARGETS) -> Iterator[str]:
    """Lines of those targets or faults, as they stand in the whole table."""
    before: Fault | None = None
    for target in TARGETS:
        for fault, spec in fault_runs.specs():
            if fault.target == target:
                if target in names or fault.name in names:
                    yield row(fault, compare(spec), before)
                before = fault


def page() -> str:
    """All of it."""
    noise_m = max(map(abs, fault_runs.undisturbed().range_errors_m()))
    head = HEAD.format(noise=noise_m) + table_line(COLUMNS) + "|---" * len(COLUMNS) + "|\n"
    return head + "".join(rows())


def main() -> None:
    """Write the page, or print single rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("faults", nargs="*", metavar="FAULT", help="print these rows alone")
    parser.add_argument("--output", type=Path, default=PAGE)
    arguments = parser.parse_args()
    if arguments.faults:
        print(*rows(arguments.faults), sep="", end="")
        return
    arguments.output.write_text(page(), encoding="utf-8")
    print(f"{arguments.output.name}: {len(fault_runs.specs())} faults")


if __name__ == "__main__":
    main()
