"""Ranging of teams of 2 to 20, with the coordinator's slots and without, in the collision model.

    python bench/ranging/slots.py [--nodes 2 7 12 20] [--seconds 60] [--loss 0.02 0.5] [--json]

Everybody walks laps of a small room, all in reach of all. "slotted" is with beacons, "unslotted"
without any: the nodes' fallback, the baseline. Exchanges and gaps are those on the air; what of it
comes to the host through its radio link stands apart. docs/ranging.md has the table.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace

from relpos.emulator.air import ExchangeRecord, Outcome
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.link.port import BAUD, Link
from relpos.measurements import Range
from relpos.simulation.team import Scenario
from relpos.simulation.world import RadioChannel, UwbChannel, World

ROOM_M = (6.0, 4.0)
SETTLE_S = 25.0
"""By then 20 people have left the common start, where the noise hides a distance."""
NODES = (2, 7, 12, 20)
LOSSES = (RadioChannel().loss_probability, 0.5)
WANTED_GAP_S = 10.0

Pair = tuple[int, int]


@dataclass(frozen=True)
class Figures:
    """What one run showed over ``seconds`` after the start. Shares are of all exchanges."""

    nodes: int
    slotted: bool
    loss: float
    seconds: float
    exchanges: int
    ranged: int
    collided: int
    undetected: int
    absent: int
    free_of_collision: float
    """Share of the exchanges that no other spoilt: the success of the slots."""
    longest_gap_s: float
    """Of the pair that waited longest for a range, by either of the two."""
    median_gap_s: float
    """Of each pair's longest."""
    pairs_within_10_s: float
    fewest_ranges: int
    """Ranges that the node with the fewest began with success."""
    most_ranges: int
    host_ranges: int
    host_longest_gap_s: float
    line_load: float
    """Share of the coordinator's serial line, towards the host, that is taken."""


def crowd(loss: float, detection: float | None) -> Scenario:
    """A small room; ``detection``: probability of every range, None for the world's own."""
    uwb = UwbChannel()
    if detection is not None:
        uwb = replace(uwb, detection_near=detection, detection_far=detection)
    radio = replace(RadioChannel(), loss_probability=loss)
    return Scenario(
        path_m=ROOM_M,
        speed_m_s=(0.9, 1.1),
        spacing_m=0.9,
        still_s=2.0,
        world=World(size_m=ROOM_M, uwb=uwb, radio=radio),
    )


def longest_gaps(
    ranges: Iterable[tuple[float, Pair]], pairs: Iterable[Pair], begin_s: float, end_s: float
) -> list[float]:
    """Each pair's longest time without a range, those from the begin and to the end included."""
    times: dict[Pair, list[float]] = {pair: [begin_s] for pair in pairs}
    for time_s, (one, other) in sorted(ranges):
        if begin_s <= time_s <= end_s:
            times[min(one, other), max(one, other)].append(time_s)
    return sorted(
        max(after - before for before, after in itertools.pairwise([*row, end_s]))
        for row in times.values()
    )


def measure(
    nodes: int,
    *,
    slotted: bool,
    loss: float = LOSSES[0],
    seconds: float = 60.0,
    seed: int = 1,
    detection: float | None = None,
) -> Figures:
    """Run one team; the same arguments give the same figures."""
    end_s = SETTLE_S + seconds
    records: list[ExchangeRecord] = []
    received: list[tuple[float, Pair]] = []
    byte_count = 0
    link = Link()
    with EmulatedTeam(
        TeamConfig(crowd(loss, detection), nodes, end_s, seed, beacons=slotted)
    ) as team:
        team.uwb.on_end = records.append
        for time_us, data in team.stream():
            byte_count += len(data) if time_us >= SETTLE_S * 1e6 else 0
            received += [
                (o.time_s, (o.node, o.peer))
                for o in link.feed(data, time_us * 1e-6)
                if isinstance(o, Range)
            ]
        ids = sorted(team.nodes)
    kept = [r for r in records if r.begin_us >= SETTLE_S * 1e6]
    outcomes = Counter(r.outcome for r in kept)
    pairs = list(itertools.combinations(ids, 2))
    ranged = [r for r in kept if r.outcome is Outcome.RANGED]
    gaps = longest_gaps(
        ((r.end_us * 1e-6, (r.initiator, r.destination)) for r in ranged), pairs, SETTLE_S, end_s
    )
    host_gaps = longest_gaps(received, pairs, SETTLE_S, end_s)
    by_node = Counter(dict.fromkeys(ids, 0))
    by_node.update(r.initiator for r in ranged)
    return Figures(
        nodes=nodes,
        slotted=slotted,
        loss=loss,
        seconds=seconds,
        exchanges=len(kept),
        ranged=len(ranged),
        collided=outcomes[Outcome.COLLIDED],
        undetected=outcomes[Outcome.UNDETECTED],
        absent=outcomes[Outcome.ABSENT],
        free_of_collision=1.0 - outcomes[Outcome.COLLIDED] / len(kept) if kept else 0.0,
        longest_gap_s=gaps[-1],
        median_gap_s=gaps[len(gaps) // 2],
        pairs_within_10_s=sum(gap <= WANTED_GAP_S for gap in gaps) / len(gaps),
        fewest_ranges=min(by_node.values()),
        most_ranges=max(by_node.values()),
        host_ranges=sum(time_s >= SETTLE_S for time_s, _ in received),
        host_longest_gap_s=host_gaps[-1],
        line_load=byte_count * 10.0 / BAUD / seconds,
    )


def table(rows: Sequence[Figures]) -> str:
    """Markdown, a row a run."""
    head = (
        "| nodes | slots | radio loss | exchanges/s | free of collision | not detected | ranges/s |"
        " longest gap: worst pair, median | pairs within 10 s | ranges a node: least, most |"
        " at the host: ranges/s, longest gap | line |\n" + "|---" * 12 + "|"
    )
    lines = [
        f"| {f.nodes} | {'yes' if f.slotted else 'no'} | {f.loss:.0%} "
        f"| {f.exchanges / f.seconds:.1f} | {f.free_of_collision:.1%} "
        f"| {f.undetected / max(f.exchanges, 1):.0%} | {f.ranged / f.seconds:.1f} "
        f"| {f.longest_gap_s:.1f} s, {f.median_gap_s:.1f} s | {f.pairs_within_10_s:.0%} "
        f"| {f.fewest_ranges}, {f.most_ranges} "
        f"| {f.host_ranges / f.seconds:.1f}, {f.host_longest_gap_s:.1f} s | {f.line_load:.0%} |"
        for f in rows
    ]
    return "\n".join([head, *lines])


def main() -> None:
    """Read the arguments, measure, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--nodes", type=int, nargs="+", default=NODES)
    parser.add_argument("--loss", type=float, nargs="+", default=LOSSES)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--detection", type=float, help="probability of every range (default: by distance)"
    )
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    rows = [
        measure(
            nodes,
            slotted=slotted,
            loss=loss,
            seconds=given.seconds,
            seed=given.seed,
            detection=given.detection,
        )
        for nodes in given.nodes
        for loss in given.loss
        for slotted in (True, False)
    ]
    print(json.dumps([asdict(row) for row in rows], indent=2) if given.json else table(rows))


if __name__ == "__main__":
    main()
