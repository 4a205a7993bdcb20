"""The whole system under random faults, watched by the oracle.

    python tests/soak/soak.py [--hours 0.5] [--seed N] [--estimator bank] [--kills]
    python tests/soak/soak.py --emulated-hours 8 --nodes 10 [--seconds 4800]

Each episode is one seed: a team of 2 to 10 emulated nodes with faults of the whole vocabulary, and
hosts one after the other at its port: with right and wrong clocks, with and without memory, under
full disks, replayed and altered frames, commands, and guests of the page. Each tenth kills real
processes (kills.py), with ``--kills`` each. With ``--seed`` one episode is run: the command that a
violation prints. ``--emulated-hours`` counts the team's own time, which goes on as quickly as the
computer can.
"""

from __future__ import annotations

import argparse
import errno
import gc
import random
import resource
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

sys.path.extend(map(str, Path(__file__).parents[:2]))

import kills
from oracle import Air, CheckedDecoder, Watch, check_outcome, require

from relpos import fusion
from relpos.emulator.air import STEP_US
from relpos.emulator.faults import FAULTS
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.link import xbee
from relpos.link.beacon import HostBeacons
from relpos.link.port import Link
from relpos.live.composer import Composer
from relpos.live.files import FileSink
from relpos.live.fusion_thread import FusionThread
from relpos.live.inputs import Received
from relpos.live.requests import Request
from relpos.live.session import LiveSession
from relpos.live.sinks import Sink
from relpos.protocol import messages as wire
from relpos.runs import Description, load_run
from relpos.simulation.team import SCENARIOS

RIGHT_UNIX_S = 1.8e9
CLOCKS_S = (0.0, 0.0, 0.0, 315e6, -1.8e9, 86_400.0, -3600.0)
BLOCK_S = 90.0
"""Up to five faults begin in each."""
MEMORY_MB = 300
"""By how much the least of ten episodes in a row may be more than that of the first ten."""


class SoakInput:
    """A host at an emulated team's port, in virtual time, beside which somebody sends again."""

    name = "soak"
    is_now = True
    recorded_unix_s = None

    def __init__(self, team, air, rng, until_s, clock_s, newest) -> None:
        self.team, self.rng, self.until_s = team, rng, until_s
        self.link = Link(
            key=team.key, clock=lambda: max(RIGHT_UNIX_S + clock_s + self.now_s(), 0.0)
        )
        self.link.decoder = CheckedDecoder(air, (team.key,), newest)
        self.link.counters_before = dict(newest)
        self._beacons = HostBeacons(self.link)
        self._heard: list[bytes] = []
        self._said: list[bytes] = []
        self._waiting: list[tuple[int, bytes]] = []
        self.fusion: FusionThread | None = None

    def read(self, timeout_s):
        if self._waiting:
            time_us, data = self._waiting.pop(0)
            arrival_s = time_us * 1e-6
            observations = self.link.feed(data, arrival_s)
            self._heard.append(data)
            self._attack(arrival_s)
            return Received(arrival_s, data, observations)
        while self.fusion.failure is None and not self.fusion._inbox.empty():
            time.sleep(0.001)
        self._waiting = self.team.run(self.team.time_us + STEP_US)
        data = self._beacons.due(self.now_s())
        if self.rng.random() < 0.02 and self.link.decoder.nodes:
            node = self.rng.choice(list(self.link.decoder.nodes))
            code = self.rng.choice([c for c in wire.CommandCode if c.name.startswith("SET_STEP")])
            data += self.link.command(node, code, self.rng.randrange(-5, 3000))[1]
        if data:
            self._said.append(data)
            self.team.send(data)
        elif self._said and self.rng.random() < 0.02:
            self.team.send(self.rng.choice(self._said))
        return None

    def _attack(self, arrival_s) -> None:
        """Frames once more, altered, cut, and of nobody; whatever comes of them is refused."""
        if self.rng.random() > 0.2:
            return
        data = bytearray(self.rng.choice(self._heard[-500:]))
        kind = self.rng.randrange(4)
        if kind == 1:
            data[self.rng.randrange(len(data))] ^= 1 << self.rng.randrange(8)
        elif kind == 2:
            del data[self.rng.randrange(len(data)) :]
        elif kind == 3:
            body = self.rng.randbytes(self.rng.randrange(70))
            data = bytearray(xbee.encode(xbee.Receive16(self.rng.randrange(256), -40, body)))
        observations = self.link.feed(bytes(data), arrival_s)
        if kind in (0, 3):  # an altered byte may be the module's own, such as the signal strength
            require(not observations, "nothing is taken from an attacker", observations)

    def now_s(self):
        return self.team.time_us * 1e-6

    def learn(self, estimate):
        pass

    def call_out(self, nodes):
        pass

    def called_out(self):
        return []

    def remarks(self):
        new, self.link.decoder.remarks = self.link.decoder.remarks, []
        return new

    def trouble(self):
        return None

    def over(self):
        return self.now_s() >= self.until_s and not self._waiting

    def counters(self):
        return self.link.summary()

    def close(self):
        pass


class FullDisk(Sink):
    """A sink that fails at some moment, as no sink should."""

    def __init__(self, after: int) -> None:
        self._left = after

    def observed(self, arrival_s, observations):
        self._left -= 1
        if self._left < 0:
            raise OSError(errno.ENOSPC, "No space left on device")


def guests(rng: random.Random):
    """Requests as they come from the page's process: well-formed, with any content."""

    def ask() -> list[Request]:
        if rng.random() > 0.02:
            return []
        kind = rng.choice(["name", "acknowledge", "shelve", "presses", "headings"])
        node = rng.randrange(0, 12)
        clocks = {"node": node, "clock_offset_ms": rng.uniform(-1e6, 1e6),
                  "sent_unix_ms": 1e3 * (time.time() + rng.uniform(-1e5, 1e5))}  # fmt: skip
        at_ms = 1e3 * time.time() + rng.choice([0.0, -1e3, 1e6, -1e12, 1e300])
        bodies = {
            "name": {"node": node, "name": f"Kim {rng.randrange(5)}"},
            "acknowledge": {"node": node, "by": "Kim"},
            "shelve": {"node": node, "by": "", "seconds": rng.choice([0.0, 60.0, 1e300])},
            "presses": {**clocks, "presses": [{"id": str(rng.random()), "landmark": "17",
                                               "unix_ms": at_ms}]},
            "headings": {**clocks, "headings": [{"unix_ms": at_ms, "heading_rad": 1.0,
                                                 "sigma_rad": rng.choice([0.2, 1e-300, 1e300])}]},
        }  # fmt: skip
        return [Request(1, kind, time.time(), bodies[kind])]

    return ask


def random_faults(rng: random.Random, nodes: int, seconds: float) -> list[str]:
    """SPECs of the vocabulary for that team, up to five in each BLOCK_S."""
    specs = []
    starts = [block * BLOCK_S for block in range(max(round(seconds / BLOCK_S), 1))]
    chosen = [(s, fault) for s in starts for fault in rng.sample(list(FAULTS), rng.randrange(6))]
    for start_s, fault in chosen:
        names = fault.key_names()
        from_s = start_s + rng.uniform(3.0, min(seconds, BLOCK_S))
        values: dict[str, object] = {
            "node": rng.randrange(1, nodes + 1),
            "from": f"{from_s:.2f}",
            "to": f"{from_s + rng.uniform(1.0, 30.0):.2f}",
        }
        values |= {k.name: rng.choice(k.choices) for k in fault.keys if k.choices}
        given = [f"{name}={values[name]}" for name in names if name in values]
        specs.append(fault.name + (":" + ",".join(given) if given else ""))
    return specs


def sessions(rng: random.Random, seconds: float) -> Iterator[float]:
    """When each host ends."""
    at_s = 0.0
    while at_s < seconds:
        at_s += rng.uniform(8.0, seconds)
        yield min(at_s, seconds)


@dataclass(frozen=True)
class Done:
    """An episode without a violation: a line about it, and the team's time that passed."""

    line: str
    team_s: float


def episode(
    seed: int, estimator: str, out: Path, nodes: int | None = None, seconds: float | None = None
) -> Done:
    """Run one, of that many nodes and seconds or of random ones.

    ViolationError where a promise is broken.
    """
    rng = random.Random(seed)
    any_nodes, any_seconds = rng.choice((2, 3, 3, 4, 5, 6, 10)), rng.uniform(25.0, 90.0)
    nodes, seconds = nodes or any_nodes, seconds or any_seconds
    keyed = rng.random() < 0.7
    config = TeamConfig(
        rng.choice([name for name in SCENARIOS if name not in ("turntable", "bench")]),
        nodes, seconds, seed,
        faults=random_faults(rng, nodes, seconds),
        key=rng.randbytes(16) if keyed else wire.DEFAULT_KEY,
    )  # fmt: skip
    newest: dict[int, int] = {}
    hosts = estimates = 0
    with EmulatedTeam(config) as team:
        air = Air(team)
        for number, until_s in enumerate(sessions(rng, seconds)):
            source = SoakInput(team, air, rng, until_s, rng.choice(CLOCKS_S), newest)
            thread = FusionThread(lambda priors: fusion.make(estimator, priors), common=True)
            source.fusion = thread
            folder, watch = out / f"{seed}-{number}", Watch(guests(rng), team.nodes)
            sinks: list[Sink] = [watch, FileSink(folder, Description(name="soak"))]
            said: list[str] = []
            full = rng.random() < 0.2
            if full:
                sinks.append(FullDisk(rng.randrange(200)))
            session = LiveSession(
                source, thread, Composer(), sinks, pace=source.now_s, remark=said.append
            )
            for _ in session.run():
                pass
            outcome = session.finish()
            if watch.broken:
                raise watch.broken[0]
            check_outcome(outcome, said)
            source.link.decoder.check_counts()
            if outcome.received:
                run = load_run(folder / "received")
                require(run.measurements is not None, "what was received can be read")
            newest |= source.link.newest_counters()
            hosts += 1
            estimates += watch.estimates
    frames = len(air.accepted)
    line = (
        f"{nodes} nodes, {seconds:.0f} s, {len(config.faults)} faults, {hosts} hosts, "
        f"{frames} frames, {estimates} estimates"
    )
    return Done(line, seconds)


def main() -> int:
    """Run episodes until the time is over, or the one that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, help="by the clock; 0.5 where nothing is said")
    parser.add_argument("--emulated-hours", type=float, help="by the team's clock")
    parser.add_argument("--nodes", type=int, help="of each team")
    parser.add_argument("--seconds", type=float, help="of each team")
    parser.add_argument("--seed", type=int, help="one episode")
    parser.add_argument("--first", type=int, default=1, help="seed of the first episode")
    parser.add_argument("--estimator", default="bank")
    parser.add_argument("--kills", action="store_true", help="episodes of kills alone")
    given = parser.parse_args()
    began_s, team_s = time.monotonic(), 0.0
    seed = given.first if given.seed is None else given.seed
    done, broken, used_mb = 0, [], []
    while True:
        with tempfile.TemporaryDirectory() as folder:
            try:
                if given.kills or seed % 10 == 0:
                    line = kills.episode(seed, Path(folder))
                else:
                    one = episode(seed, given.estimator, Path(folder), given.nodes, given.seconds)
                    line, team_s = one.line, team_s + one.team_s
                print(f"seed {seed}: {line}", flush=True)
            except Exception:
                traceback.print_exc()
                print(f"seed {seed}: VIOLATION; again: {again(seed, given)}", flush=True)
                broken.append(seed)
        done += 1
        gc.collect()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        used_mb.append(pages * resource.getpagesize() >> 20)
        if done > 20 and min(used_mb[-10:]) > min(used_mb[:10]) + MEMORY_MB:
            print(f"seed {seed}: VIOLATION: memory grows: {used_mb} MB")
            broken.append(seed)
            break
        seed += 1
        past_h = (time.monotonic() - began_s) / 3600.0
        if given.seed is not None or over(given, past_h, team_s / 3600.0):
            break
    print(
        f"{done} episodes, {team_s / 3600.0:.2f} h of teams in {60 * past_h:.0f} min, "
        f"at most {max(used_mb)} MB, {len(broken)} violations {broken or ''}"
    )
    return 1 if broken else 0


def over(given: argparse.Namespace, past_h: float, team_h: float) -> bool:
    """Whether the time that was asked for is over."""
    if given.emulated_hours is not None:
        return team_h >= given.emulated_hours
    return past_h >= (0.5 if given.hours is None else given.hours)


def again(seed: int, given: argparse.Namespace) -> str:
    """The command that repeats an episode."""
    command = f"python tests/soak/soak.py --seed {seed} --estimator {given.estimator}"
    for name in ("nodes", "seconds"):
        if (value := getattr(given, name)) is not None:
            command += f" --{name} {value}"
    return command + " --kills" * given.kills


if __name__ == "__main__":
    sys.exit(main())
