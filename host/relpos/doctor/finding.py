"""The result of one check: its name, state, description and remedy."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    """The state of what was checked."""

    WELL = "well"
    HINT = "hint"
    """Nothing is broken; something optional is missing, or worth knowing."""
    WRONG = "wrong"
    """A team does not work in this state."""


@dataclass(frozen=True)
class Finding:
    """One check's result: ``words`` describe the state, ``remedy`` says what to do."""

    name: str
    state: State
    words: str
    remedy: str = ""


def well(name: str, words: str) -> Finding:
    """Return a finding without a problem."""
    return Finding(name, State.WELL, words)


def hint(name: str, words: str, remedy: str = "") -> Finding:
    """Return a finding that reduces what works."""
    return Finding(name, State.HINT, words, remedy)


def wrong(name: str, words: str, remedy: str) -> Finding:
    """Return a finding that keeps a team from working, with its remedy."""
    return Finding(name, State.WRONG, words, remedy)
