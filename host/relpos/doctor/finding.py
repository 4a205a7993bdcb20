"""What was looked at, how it is, and what to do."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum


class State(StrEnum):
    """How something is."""

    WELL = "well"
    HINT = "hint"
    """Nothing is broken; it is worth knowing, or something optional is not there."""
    WRONG = "wrong"
    """A team will not work like this."""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at: ``words`` say how it is, ``remedy`` what to do about it."""

    name: str
    state: State
    words: str
    remedy: str = ""

    def to_json(self) -> dict[str, str]:
        """As `--json` shows it."""
        return {**asdict(self), "state": str(self.state)}


def well(name: str, words: str) -> Finding:
    """All is as it should be."""
    return Finding(name, State.WELL, words)


def hint(name: str, words: str, remedy: str = "") -> Finding:
    """It works, with less than it could have."""
    return Finding(name, State.HINT, words, remedy)


def wrong(name: str, words: str, remedy: str) -> Finding:
    """It does not work, and what to do."""
    return Finding(name, State.WRONG, words, remedy)
