"""A node on its USB cable: the host takes the XBee module's place at the node's UART.

The microcontroller's only UART serves the USB cable or the XBee, by the shield's switch; in both
cases the node sends API frames. Here its transmit requests become frames received by the
coordinator, and the host's transmit requests become frames received by the node, so that code for
a coordinator's port works with a cable, too.
"""

from __future__ import annotations

from relpos.link import xbee
from relpos.link.port import open_port
from relpos.protocol import messages as wire

CABLE_DBM = 0
"""Signal strength reported for frames from the cable."""
DELIVERED = 0


class CablePort:
    """Looks like a coordinator's serial port to :class:`relpos.link.dialogue.NodeDialogue`.

    Opening it restarts an Arduino (its USB chip pulls the reset line), so the node's totals are
    lost. ``heard`` counts the node's frames.
    """

    by_cable = True
    """First keys may be given: nobody listens."""

    def __init__(self, port: str) -> None:
        self.port = port
        self.heard = 0
        self._device = open_port(port)
        self._from_node = xbee.Parser()
        self._from_host = xbee.Parser()
        self._waiting = bytearray()

    @property
    def in_waiting(self) -> int:
        """Number of bytes for the host, or of bytes of the node that may become some."""
        return len(self._waiting) or int(self._device.in_waiting)

    def read(self, size: int = 1) -> bytes:
        """Return at most ``size`` bytes as a coordinator would send them; fewer after a timeout."""
        if not self._waiting:
            self._listen()
        data = bytes(self._waiting[:size])
        del self._waiting[:size]
        return data

    def write(self, data: bytes) -> int:
        """Pass what a coordinator would transmit to the node."""
        for frame in self._from_host.feed(data):
            if isinstance(frame, xbee.Transmit16):
                received = xbee.Receive16(
                    wire.COORDINATOR, CABLE_DBM, frame.data, wire.CABLE_OPTIONS
                )
                self._device.write(xbee.encode(received))
        return len(data)

    def _listen(self) -> None:
        data = self._device.read(max(1, self._device.in_waiting))
        for frame in self._from_node.feed(data):
            if not isinstance(frame, xbee.Transmit16):
                continue
            self.heard += 1
            # The node waits for this status before it sends the next frame.
            if frame.frame_id:
                status = xbee.TransmitStatus(frame.frame_id, DELIVERED)
                self._device.write(xbee.encode(status))
            # The module's address is unknown here; the frame inside names the node.
            self._waiting += xbee.encode(xbee.Receive16(0, CABLE_DBM, frame.data))

    def close(self) -> None:
        """Close the cable's port."""
        self._device.close()
