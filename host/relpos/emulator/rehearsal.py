"""An emulated team in a process of its own, behind a pseudo-terminal, for a live session.

The session is not disturbed by what emulating costs, and knows of the team what a leader knows:
where it starts.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from relpos.errors import DeviceError, RelposError
from relpos.measurements import Prior

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

ENDING_S = 5.0


@dataclass(frozen=True)
class Cast:
    """Who is to be emulated, how; see :class:`~relpos.emulator.team.EmulatedTeam`."""

    nodes: int
    seconds: float
    scenario: str = "paper"
    seed: int = 0
    board: str = "native"
    faults: Sequence[str] = ()
    speed: float = 1.0


class Rehearsal:
    """The team at ``port`` until its walk ends or ``close``; ``priors`` is its known start.

    The walk begins when the port is opened. DeviceError where the team cannot be emulated.
    """

    def __init__(self, cast: Cast) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        self._pipe: Connection = ours
        self._process = context.Process(
            target=_play, args=(cast, theirs), name="relpos emulator", daemon=True
        )
        self._process.start()
        theirs.close()
        try:
            answer: Any = ours.recv()
        except EOFError:
            answer = "its process ended"
        if isinstance(answer, str):
            self.close()
            raise DeviceError(f"the team cannot be emulated: {answer}")
        self.port: str = answer[0]
        self.priors: tuple[Prior, ...] = answer[1]

    def __enter__(self) -> Rehearsal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def over(self) -> bool:
        """Whether the walk has ended; where its port has vanished, that is not yet the answer."""
        self._process.join(ENDING_S)
        return not self._process.is_alive()

    def close(self) -> None:
        """End it."""
        self._pipe.close()
        self._process.join(ENDING_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _play(cast: Cast, pipe: Connection) -> None:
    """Body of the process: ends with the walk, or when the other end of the pipe is closed."""
    from relpos.emulator.pty import PseudoTerminal
    from relpos.emulator.team import EmulatedTeam

    # Ctrl-C in the terminal is for the session.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    marked = cast.speed != 1.0
    try:
        with (
            EmulatedTeam(
                cast.scenario,
                cast.nodes,
                cast.seconds,
                cast.seed,
                cast.board,
                faults=cast.faults,
                beacons=marked,
            ) as team,
            PseudoTerminal(team, speed=cast.speed, mark_time=marked) as terminal,
        ):
            terminal.start()
            pipe.send((terminal.path, tuple(team.priors())))
            while not terminal.finished:
                if pipe.poll(0.2):
                    return
            terminal.drain()
            terminal.join()
    except (EOFError, BrokenPipeError):
        return
    except RelposError as error:
        pipe.send(str(error))
    except Exception as error:
        pipe.send(f"{type(error).__name__}: {error}")
