"""Sends step scales that an estimator has learned from ranges to the nodes, as step gains.

A node's step length is proportional to its gain (docs/deadreckoning.md). An estimator that learns
``step_scale`` (true over reported length) gives the factor. The motion's ``gain_version`` marks a
change, after which the estimator learns again.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from relpos.calibration.steps import MAX_CHANGE, scaled_gain_permille
from relpos.errors import DataError
from relpos.link.authentication import of_node
from relpos.link.orders import Orders
from relpos.protocol import messages as wire
from relpos.said import Said

if TYPE_CHECKING:
    from relpos.link.decoder import Acknowledged
    from relpos.link.port import Link

WORTH_SENDING = 0.03
"""Least relative change: one walk repeats to 5 % in the same person, and each change is a write to
the node's EEPROM."""
KNOWN_WELL = 0.025
"""Largest standard deviation of a scale that is sent; the estimator learns the remainder."""
AGAIN_AFTER_S = 120.0
"""Until the next change of the same node, in measurement time: the estimator learns again."""
IMPOSSIBLE = -(2**31)
"""Out of the setting's range: changes nothing, and the answer brings the gain in force."""


class StepScaleSender:
    """Sends learned step scales to nodes over ``link``; ``remarks`` are messages for the user."""

    def __init__(self, link: Link) -> None:
        self._orders = Orders(link, wire.CommandCode.SET_STEP_GAIN_PERMILLE)
        self._scales: dict[int, float] = {}
        """Of the nodes that a dialogue is under way with: it reads the gain, then sets it."""
        self._settled_s: dict[int, float] = {}
        self.remarks: list[str] = []
        self.sent = 0
        """Number of learned gains that nodes have confirmed."""

    def learn(self, node: int, scale: float, sigma: float, time_s: float) -> None:
        """Begin to send a node's learned step scale, if the change is large and certain enough."""
        if node in self._scales:
            return
        if time_s < self._settled_s.get(node, -math.inf) + AGAIN_AFTER_S:
            return
        # A larger change is not the wearer's step.
        if not 1.0 / MAX_CHANGE <= scale <= MAX_CHANGE:
            return
        if sigma <= KNOWN_WELL and abs(math.log(scale)) >= WORTH_SENDING:
            self._scales[node] = scale
            self._orders.send(node, IMPOSSIBLE)
            self._settled_s[node] = time_s

    def due(self, now_s: float) -> bytes:
        """Return bytes due for the coordinator's port, by any clock that does not go back."""
        for node in self._orders.give_up(now_s):
            self.remarks.append(
                Said(
                    "steps-unanswered",
                    "node {node}: steps are counted {off}; it does not answer, so they stay so",
                    node=str(node),
                    off=_percent(self._scales.pop(node)),
                )
            )
        return self._orders.due(now_s)

    def handle(self, answer: Acknowledged) -> None:
        """Process a node's answer; answers to other commands are ignored."""
        value = self._orders.answered(answer)
        if value is None:
            return
        if value == IMPOSSIBLE and answer.result == wire.CommandResult.OUT_OF_RANGE:
            self._set_gain(answer.node, answer.value)
            return
        off = _percent(self._scales.pop(answer.node))
        if answer.result == wire.CommandResult.DONE and answer.value == value:
            self.sent += 1
            self.remarks.append(
                Said(
                    "steps-right",
                    "node {node}: steps were counted {off} and are right now, by the measured "
                    "ranges; nothing to do",
                    node=str(answer.node),
                    off=off,
                )
            )
        else:
            self.remarks.append(
                Said(
                    "steps-refused",
                    "node {node}: steps are counted {off}; it refuses a step gain of {gain:.3f} "
                    "({result})",
                    node=str(answer.node),
                    off=off,
                    gain=value / 1000,
                    result=answer.result.name.lower().replace("_", " "),
                )
            )

    def _set_gain(self, node: int, before_permille: int) -> None:
        try:
            gain = scaled_gain_permille(before_permille, self._scales[node])
        except DataError as error:
            del self._scales[node]
            self.remarks.append(of_node(node, str(error)))
            return
        if gain == before_permille:
            del self._scales[node]
            return
        self._orders.send(node, gain)


def _percent(scale: float) -> Said:
    """Return how wrong a step's length is that has to be multiplied by ``scale``."""
    off = 100.0 * (1.0 / scale - 1.0)
    if off > 0.0:
        return Said("too-long", "{percent:.0f} % too long", percent=off)
    return Said("too-short", "{percent:.0f} % too short", percent=-off)
