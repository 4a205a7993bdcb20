"""The addresses that people give to what a session serves: its pages, Foxglove."""

from __future__ import annotations

import re

from relpos.errors import DataError

DEFAULT_HOST = "127.0.0.1"


def parse_listen(address: str, option: str = "--view-listen") -> tuple[str, int | None]:
    """Split HOST:PORT, HOST, :PORT or PORT; DataError where it is none of them."""
    found = re.fullmatch(
        r"(?:\[([0-9a-fA-F:.]+)\]|([^:\s/\[\]]*))(?::(\d{1,5}))?",
        f":{address}" if address.isdecimal() else address,
    )
    number = None if found is None or found[3] is None else int(found[3])
    if found is None or (number or 0) > 65535:
        raise DataError(f"{option} {address}: not HOST:PORT, like 0.0.0.0:8460")
    return found[1] or found[2] or DEFAULT_HOST, number
