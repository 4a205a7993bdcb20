"""The radio link: serial bytes of an XBee coordinator to observations, and commands back.

``xbee`` parses Digi's API frames, ``decoder`` verifies the project's own messages inside and turns
them into observations, ``clock`` maps each node's clock to the host's by a lower convex hull, and
``authentication`` rejects forged and repeated frames. ``port.Link`` joins these without any I/O;
the functions beside it read and write the serial port. ``beacon`` schedules the team's slots,
``orders`` sends settings to nodes meanwhile (learned step lengths, LEDs), and ``dialogue`` commands
to one node until it answers. docs/protocol.md describes the messages; begin with ``port``, then
``decoder``.
"""
