"""Calls people out by their nodes' LEDs: steadily on for who is to leave, else the node's signs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from relpos.link.orders import Orders
from relpos.protocol import messages as wire

if TYPE_CHECKING:
    from relpos.link.decoder import Acknowledged
    from relpos.link.port import Link

LED_ON, LED_HEALTH = 1, 2
"""Steadily on; the node's own signs (docs/hardware.md)."""


class LedOrders:
    """Sends the orders over ``link`` until each node has answered, seldom to who is silent."""

    def __init__(self, link: Link) -> None:
        self._called: frozenset[int] = frozenset()
        self._orders = Orders(link, wire.CommandCode.SET_LED)
        self._lit: list[int] = []

    def call_out(self, nodes: Iterable[int]) -> None:
        """Light these nodes' LEDs, and end it at those that were lit before."""
        nodes = frozenset(nodes)
        for node in nodes ^ self._called:
            self._orders.send(node, LED_ON if node in nodes else LED_HEALTH)
        self._called = nodes

    def lit(self) -> list[int]:
        """Return the nodes that have confirmed since the last call that their LED is on."""
        lit, self._lit = self._lit, []
        return lit

    def due(self, now_s: float) -> bytes:
        """Return bytes due for the coordinator's port, by any clock that does not go back."""
        return self._orders.due(now_s)

    def handle(self, answer: Acknowledged) -> None:
        """Process a node's answer; answers to other commands are ignored."""
        value = self._orders.answered(answer)
        if value == LED_ON and answer.result == wire.CommandResult.DONE:
            self._lit.append(answer.node)
