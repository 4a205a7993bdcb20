"""The body of the page's server's process.

It stands alone: a new process imports the module that its body is in, and beside the session's
half (:mod:`relpos.view.web`) that would be the estimators, 35 MB and most of its start.
"""

from __future__ import annotations

import socket

from relpos.view.access import Access


def serve(listener: socket.socket, channel: socket.socket, access: Access) -> None:
    """Serve what comes through ``channel`` to the browsers of ``listener`` until it closes.

    The listener listens already: browsers that come while the process is restarted wait.
    """
    from relpos.view import server

    server.run(listener, channel, access)
