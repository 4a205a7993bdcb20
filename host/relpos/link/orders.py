"""Values on their way to nodes, while a session runs: one at a time for each node.

Pure: bytes out, answers in, the time is an argument. Nothing blocks: a command is repeated with its
token until it is answered, between the port's other traffic.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from relpos.protocol import messages as wire

if TYPE_CHECKING:
    from relpos.link.decoder import Acknowledged
    from relpos.link.port import Link

REPEAT_S, SELDOM_S = 1.0, 10.0
"""A full frame each way takes 50 ms, storing the settings on the node 0.4 s."""
ATTEMPTS = 14
"""So often each second, then seldom: who was out of reach may come back. As in a dialogue: at 50 %
loss all of these fail once in a thousand times."""


@dataclass(slots=True)
class _Order:
    value: int
    token: int
    attempts: int = 0
    next_s: float = -math.inf


class Orders:
    """Sends values of the setting ``code`` over ``link`` until each node has answered."""

    def __init__(self, link: Link, code: wire.CommandCode) -> None:
        self._link = link
        self._code = code
        self._orders: dict[int, _Order] = {}

    def send(self, node: int, value: int) -> None:
        """Begin to send a value, in the place of what was under way to that node."""
        self._orders[node] = _Order(value, self._link.next_token())

    def give_up(self, now_s: float) -> list[int]:
        """Drop the orders that all attempts in a row have failed for; return their nodes."""
        silent = [
            n for n, o in self._orders.items() if o.attempts >= ATTEMPTS and now_s >= o.next_s
        ]
        for node in silent:
            del self._orders[node]
        return silent

    def due(self, now_s: float) -> bytes:
        """Return bytes due for the coordinator's port, by any clock that does not go back."""
        data = b""
        for node, order in self._orders.items():
            if now_s < order.next_s:
                continue
            order.attempts += 1
            order.next_s = now_s + (REPEAT_S if order.attempts <= ATTEMPTS else SELDOM_S)
            data += self._link.command(
                node,
                self._code,
                order.value,
                token=order.token,
                # A node whose radio module has another address hears only broadcasts.
                broadcast=order.attempts % 2 == 0,
            )[1]
        return data

    def answered(self, answer: Acknowledged) -> int | None:
        """Return the value that a node's answer is to, which then is no longer sent.

        None for answers to other commands, and where the node has to be asked once more.
        """
        order = self._orders.get(answer.node)
        if order is None or answer.token != order.token:
            return None
        if answer.result in (wire.CommandResult.BUSY, wire.CommandResult.COUNTER_REFUSED):
            order.token, order.next_s = self._link.next_token(), -math.inf
            return None
        return self._orders.pop(answer.node).value
