"""Step lengths that the ranges have taught, sent back to the nodes as step gains.

A node's step length is proportional to its gain (docs/deadreckoning.md); an estimator that learns
``step_scale`` (true over reported length) knows what to multiply it with. A change is seen in
the motion's ``gain_version``, from which on an estimator learns anew.

Pure: bytes out, answers in, the time is an argument. Nothing waits: a command is repeated with its
token until it is answered, between everything else that the port has to do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from relpos.calibration.steps import MOST_CHANGE, scaled_gain_permille
from relpos.errors import DataError
from relpos.protocol import messages as wire

if TYPE_CHECKING:
    from relpos.link.decoder import Acknowledged
    from relpos.link.live import Link

WORTH_SENDING = 0.03
"""Least relative change: one walk repeats to 5 % in the same person, and each change is a write to
the node's EEPROM."""
KNOWN_WELL = 0.025
"""Largest standard deviation of a scale that is sent: the estimator goes on with what is left."""
AGAIN_AFTER_S = 120.0
"""Until the next change of the same node, in measurement time: an estimator has begun anew."""
REPEAT_S = 1.0
"""A full frame each way takes 50 ms, storing the settings on the node 0.4 s."""
ATTEMPTS = 14
"""As in a dialogue: where half of all frames are lost, all fail once in a thousand times."""
IMPOSSIBLE = -(2**31)
"""Out of the setting's range: changes nothing, and the answer brings the gain in force."""


@dataclass(slots=True)
class _Dialogue:
    """First the gain in force is asked for, then the new one is set."""

    scale: float
    token: int
    value: int = IMPOSSIBLE
    attempts: int = 0
    next_s: float = -math.inf


class StepScaleSender:
    """Tells nodes their learned step scales over ``link``; ``remarks`` is what a user may hear."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._dialogues: dict[int, _Dialogue] = {}
        self._settled_s: dict[int, float] = {}
        self.remarks: list[str] = []
        self.sent = 0
        """Gains that are in force on a node now because of what was learned."""

    def learn(self, node: int, scale: float, sigma: float, time_s: float) -> None:
        """Take a node's learned step scale; begin a dialogue where it is worth one."""
        if node in self._dialogues:
            return
        if time_s < self._settled_s.get(node, -math.inf) + AGAIN_AFTER_S:
            return
        # Beyond that it was not the wearer's step that was learned.
        if not 1.0 / MOST_CHANGE <= scale <= MOST_CHANGE:
            return
        if sigma <= KNOWN_WELL and abs(math.log(scale)) >= WORTH_SENDING:
            self._dialogues[node] = _Dialogue(scale, self._link.next_token())
            self._settled_s[node] = time_s

    def due(self, now_s: float) -> bytes:
        """Bytes for the coordinator's port now, of any clock that does not go back."""
        data = b""
        for node, talk in list(self._dialogues.items()):
            if now_s < talk.next_s:
                continue
            if talk.attempts >= ATTEMPTS:
                del self._dialogues[node]
                self.remarks.append(
                    f"node {node} does not answer: it keeps its step length, which the ranges say "
                    f"is to be multiplied by {talk.scale:.3f}"
                )
                continue
            talk.attempts += 1
            talk.next_s = now_s + REPEAT_S
            # A node whose radio module has another address hears only what is sent to everybody.
            data += self._link.command(
                node,
                wire.CommandCode.SET_STEP_GAIN_PERMILLE,
                talk.value,
                token=talk.token,
                broadcast=talk.attempts % 2 == 0,
            )[1]
        return data

    def take(self, answer: Acknowledged) -> None:
        """Take a node's answer; answers to anybody else's commands are left alone."""
        talk = self._dialogues.get(answer.node)
        if talk is None or answer.token != talk.token:
            return
        if answer.result == wire.CommandResult.BUSY:
            talk.token, talk.next_s = self._link.next_token(), -math.inf
            return
        if talk.value == IMPOSSIBLE and answer.result == wire.CommandResult.OUT_OF_RANGE:
            self._ask_for(answer.node, talk, answer.value)
            return
        del self._dialogues[answer.node]
        if answer.result == wire.CommandResult.DONE and answer.value == talk.value:
            self.sent += 1
            self.remarks.append(
                f"node {answer.node}: steps are taken {talk.scale:.3f} times as long from now on, "
                f"as the ranges say (step gain {talk.value / 1000:.3f})"
            )
        else:
            self.remarks.append(
                f"node {answer.node} refuses a step gain of {talk.value / 1000:.3f} "
                f"({answer.result.name.lower().replace('_', ' ')})"
            )

    def _ask_for(self, node: int, talk: _Dialogue, before_permille: int) -> None:
        try:
            gain = scaled_gain_permille(before_permille, talk.scale)
        except DataError as error:
            del self._dialogues[node]
            self.remarks.append(f"node {node}: {error}")
            return
        if gain == before_permille:
            del self._dialogues[node]
            return
        talk.value, talk.attempts = gain, 0
        talk.token, talk.next_s = self._link.next_token(), -math.inf
