"""An emulated team at a serial port: served until it ends, or recorded as a run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

from relpos.link.port import Link, observe
from relpos.measurements import Event, Measurement, Status, Step
from relpos.runs import Description, NodeInfo, Run

from .pty import PseudoTerminal, require_pseudo_terminals
from .team import EmulatedTeam, TeamConfig

UNLIMITED_S = 1800.0
"""Walk prepared where none was asked for: for six walkers half an hour takes 6 s and 0.6 GB."""


@contextmanager
def team_at_terminal(
    config: TeamConfig, speed: float
) -> Iterator[tuple[EmulatedTeam, PseudoTerminal]]:
    """A team behind a pseudo-terminal; ``speed`` 0 is as fast as the reader takes it.

    At other speeds than 1 time frames mark the virtual time (see ``pty``) and the team sends its
    beacons itself, which a host cannot time.
    """
    require_pseudo_terminals()
    marked = speed != 1.0
    with (
        EmulatedTeam(replace(config, beacons=marked)) as team,
        PseudoTerminal(team, speed=speed, mark_time=marked) as terminal,
    ):
        yield team, terminal


def serve_team(config: TeamConfig, speed: float, announce: Callable[[str], None]) -> None:
    """Serve the team behind a pseudo-terminal until its walk ends or Ctrl-C.

    ``announce(path)`` is called once the pseudo-terminal is there.
    """
    with team_at_terminal(config, speed) as (_, terminal):
        announce(terminal.path)
        terminal.serve()


def record_team(config: TeamConfig) -> Run:
    """Record the team's whole walk through a real serial port.

    The bytes go through a pseudo-terminal and pyserial as from a real coordinator, as fast as they
    are read; each arrives at its virtual time, so that the same config gives the same run.
    """
    require_pseudo_terminals()
    link = Link()
    measurements: list[Measurement] = []
    statuses: list[Status] = []
    steps: list[Step] = []
    with EmulatedTeam(replace(config, beacons=True)) as team:
        with PseudoTerminal(team, speed=0.0) as terminal, terminal.open_port() as port:
            terminal.start()
            for batch in observe(port, link, port.virtual_time_s):
                for observation in batch:
                    if isinstance(observation, Status):
                        statuses.append(observation)
                    elif isinstance(observation, Step):
                        steps.append(observation)
                    elif not isinstance(observation, Event):
                        measurements.append(observation)
                if port.exhausted:
                    break
            terminal.join()
        priors, building = team.priors(), team.world.building
        return Run(
            name=f"{config.scenario}-{config.board}-{config.seed}",
            description=Description(
                source=f"relpos demo --board {config.board} --scenario {config.scenario} "
                f"--nodes {config.nodes} --seconds {config.seconds:g} --seed {config.seed}"
                + "".join(f" --fault {fault}" for fault in config.faults),
                heading_known=True,
                priors=tuple(priors),
                nodes={
                    node: NodeInfo(stature_m=walker.person.stature_m)
                    for node, walker in team.walkers.items()
                },
                floors_m=() if building is None else building.floors_m,
            ),
            events=tuple(team.episodes()),
            measurements=tuple(sorted(measurements, key=lambda m: m.time_s)),
            statuses=tuple(sorted(statuses, key=lambda s: s.time_s)),
            steps=tuple(sorted(steps, key=lambda s: s.time_s)),
            truth=tuple(team.truth()),
            counters={name: int(count) for name, count in link.summary().items()},
        )
