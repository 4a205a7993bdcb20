"""An emulated team in a process of its own, behind a pseudo-terminal, for a live session.

The session does not lose time to the emulation, and knows only where the team starts.
"""

from __future__ import annotations

import multiprocessing
import signal
from typing import TYPE_CHECKING, Any

from relpos.errors import DeviceError, RelposError, interrupts_kept
from relpos.measurements import Prior

from .pty import require_pseudo_terminals
from .serving import team_at_terminal
from .team import TeamConfig

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

ENDING_S = 5.0


class EmulatorProcess:
    """The team at ``port`` until its walk ends or ``close``; ``priors`` is its known start.

    The walk begins when the port is opened. DeviceError where the team cannot be emulated.
    """

    def __init__(self, config: TeamConfig, speed: float = 1.0) -> None:
        require_pseudo_terminals()
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        self._pipe: Connection = ours
        self._process = context.Process(
            target=_serve, args=(config, speed, theirs), name="relpos emulator", daemon=True
        )
        with interrupts_kept():
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

    def __enter__(self) -> EmulatorProcess:
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


def _serve(config: TeamConfig, speed: float, pipe: Connection) -> None:
    """Body of the process: ends with the walk, or when the other end of the pipe is closed."""
    # Ctrl-C in the terminal is for the session.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with team_at_terminal(config, speed) as (team, terminal):
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
