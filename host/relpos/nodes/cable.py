"""A node on its USB cable: the host takes the XBee module's place at the node's UART.

The microcontroller's one UART serves the USB cable or the XBee, as the shield's switch says; in
either case the node speaks API frames. Here its transmit requests become frames received by the
coordinator, and what the host would give its coordinator becomes frames received by the node, so
that everything that speaks with a coordinator's port speaks with a cable.
"""

from __future__ import annotations

from relpos.link import xbee
from relpos.link.port import open_port
from relpos.protocol import messages as wire

CABLE_DBM = 0
"""Signal strength that is told of what came through the cable."""
DELIVERED = 0


class CablePort:
    """Looks like a coordinator's serial port to :class:`relpos.link.dialogue.NodeDialogue`.

    Opening it restarts an Arduino (its USB chip pulls the reset line): what the node had counted is
    lost, as at any start. ``heard`` counts the frames that came from the node.
    """

    def __init__(self, port: str) -> None:
        self.port = port
        self.heard = 0
        self._device = open_port(port)
        self._from_node = xbee.Parser()
        self._from_host = xbee.Parser()
        self._waiting = bytearray()

    @property
    def in_waiting(self) -> int:
        """Bytes for the host that are there; or such of the node's that may become some."""
        return len(self._waiting) or int(self._device.in_waiting)

    def read(self, size: int = 1) -> bytes:
        """At most ``size`` bytes as a coordinator would give them; few or none after a timeout."""
        if not self._waiting:
            self._listen()
        data = bytes(self._waiting[:size])
        del self._waiting[:size]
        return data

    def write(self, data: bytes) -> int:
        """Bytes for a coordinator: what it would transmit reaches the node."""
        for frame in self._from_host.feed(data):
            if isinstance(frame, xbee.Transmit16):
                received = xbee.Receive16(wire.COORDINATOR, CABLE_DBM, frame.data)
                self._device.write(xbee.encode(received))
        return len(data)

    def _listen(self) -> None:
        data = self._device.read(max(1, self._device.in_waiting))
        for frame in self._from_node.feed(data):
            if not isinstance(frame, xbee.Transmit16):
                continue
            self.heard += 1
            # The node does not send the next frame before it knows what became of this one.
            if frame.frame_id:
                status = xbee.TransmitStatus(frame.frame_id, DELIVERED)
                self._device.write(xbee.encode(status))
            # Its module's address is not known here; the frame inside says whose it is.
            self._waiting += xbee.encode(xbee.Receive16(0, CABLE_DBM, frame.data))

    def close(self) -> None:
        """Close the cable's port."""
        self._device.close()
