"""Calls people out by their nodes' LEDs: steadily on for who is to leave, else the node's signs.

Pure, as :mod:`relpos.link.step_scale`: bytes out, answers in, the time is an argument.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from relpos.protocol import messages as wire

if TYPE_CHECKING:
    from relpos.link.decoder import Acknowledged
    from relpos.link.port import Link

LED_ON, LED_HEALTH = 1, 2
"""Steadily on; the node's own signs (docs/hardware.md)."""
REPEAT_S, SELDOM_S = 1.0, 10.0
ATTEMPTS = 14
"""So often each second, then seldom: who was out of reach may come back."""


@dataclass(slots=True)
class _Order:
    """A value on its way to a node."""

    value: int
    token: int
    attempts: int = 0
    next_s: float = -math.inf


class LedOrders:
    """Sends the orders over ``link`` until each node has answered."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._called: frozenset[int] = frozenset()
        self._orders: dict[int, _Order] = {}
        self._lit: list[int] = []

    def call_out(self, nodes: Iterable[int]) -> None:
        """Light these nodes' LEDs, and end it at those that were lit before."""
        nodes = frozenset(nodes)
        for node in nodes ^ self._called:
            value = LED_ON if node in nodes else LED_HEALTH
            self._orders[node] = _Order(value, self._link.next_token())
        self._called = nodes

    def lit(self) -> list[int]:
        """Return the nodes that have confirmed since the last call that their LED is on."""
        lit, self._lit = self._lit, []
        return lit

    def due(self, now_s: float) -> bytes:
        """Return bytes due for the coordinator's port, by any clock that does not go back."""
        data = b""
        for node, order in self._orders.items():
            if now_s < order.next_s:
                continue
            order.attempts += 1
            order.next_s = now_s + (REPEAT_S if order.attempts < ATTEMPTS else SELDOM_S)
            data += self._link.command(
                node,
                wire.CommandCode.SET_LED,
                order.value,
                token=order.token,
                # A node whose radio module has another address hears only broadcasts.
                broadcast=order.attempts % 2 == 0,
            )[1]
        return data

    def handle(self, answer: Acknowledged) -> None:
        """Process a node's answer; answers to other commands are ignored."""
        order = self._orders.get(answer.node)
        if order is None or answer.token != order.token:
            return
        if answer.result in (wire.CommandResult.BUSY, wire.CommandResult.COUNTER_REFUSED):
            order.token, order.next_s = self._link.next_token(), -math.inf
            return
        del self._orders[answer.node]
        if answer.result == wire.CommandResult.DONE and order.value == LED_ON:
            self._lit.append(answer.node)
