"""Who may see the live page: the session's token, its cookie, addresses, a certificate."""

from __future__ import annotations

import errno
import hashlib
import ipaddress
import re
import secrets
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from relpos.errors import DeviceError
from relpos.extras import missing_extra
from relpos.live.addresses import parse_listen
from relpos.view.devices import Gate, Role

DEFAULT_PORT = 8460
LIBRARIES = ("segno", "starlette", "uvicorn", "websockets")
"""What every page needs."""
LOOK_S = 0.1
"""How often a taken port is tried again."""
TOKEN_BYTES = 16
"""128 bits: they cannot be guessed, and the QR code stays coarse enough for a wet screen."""


@dataclass(frozen=True)
class Certificate:
    """A key and its chain, as PEM."""

    key_pem: bytes
    chain_pem: bytes


@dataclass(frozen=True)
class Access:
    """Address and token of one session's pages; ``hosts`` are the names it is reached by."""

    port: int
    hosts: tuple[str, ...]
    token: str = field(default_factory=lambda: secrets.token_urlsafe(TOKEN_BYTES))
    certificate: Certificate | None = None
    key: bytes | None = None
    """A mission's: then devices have tokens of their own (:mod:`relpos.view.devices`)."""

    folder: Path | None = None
    """A mission's: plans are kept there."""

    @property
    def cookie(self) -> str:
        """Name of the cookie: cookies are shared by all ports of a host, sessions are not.

        A mission's holds at another port, too.
        """
        if self.key is not None:
            return f"relpos-{hashlib.sha256(self.key).hexdigest()[:8]}"
        return f"relpos-{self.port}"

    @property
    def reachable(self) -> bool:
        """Whether anybody but this computer can reach it."""
        return not _is_loopback(self.hosts[0])

    def url(self, path: str = "/", role: Role = Role.COMMAND, by: str = "") -> str:
        """Address of a page with the session's token, or a mission's with a code for one device.

        ``by`` is the device that asks for the code.
        """
        token = self.token if self.key is None else Gate(self.key).invite(role, by=by)
        scheme = "http" if self.certificate is None else "https"
        host = f"[{self.hosts[0]}]" if ":" in self.hosts[0] else self.hosts[0]
        return f"{scheme}://{host}:{self.port}{path}?{urlencode({'token': token})}"

    def is_own(self, host: str) -> bool:
        """Return whether a Host header names this computer.

        A name of somebody else's that leads here (DNS rebinding) would make their page ours.
        """
        found = re.fullmatch(r"(?:\[(.*)\]|([^\[\]:]*))(?::\d*)?", host)
        if found is None:
            return False
        name = (found[1] or found[2] or "").lower().removesuffix(".local")
        if not found[1] and name in (
            "localhost",
            socket.gethostname().lower(),
            *(h.lower().removesuffix(".local") for h in self.hosts),
        ):
            return True
        try:
            return ipaddress.ip_address(name).version == (6 if found[1] else 4)
        except ValueError:
            return False

    def fits(self, token: str | None) -> bool:
        """Whether it is this session's; takes the same time whatever it is."""
        return token is not None and secrets.compare_digest(token.encode(), self.token.encode())


class Allowance:
    """What each visitor may send: ``burst`` items at once, and ``per_s`` again every second."""

    MOST_VISITORS = 1000

    def __init__(
        self, per_s: float, burst: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._per_s, self._burst, self._clock = per_s, burst, clock
        self._left: dict[str, tuple[float, float]] = {}

    def take(self, visitor: str, count: int) -> bool:
        """Return whether the visitor may send so many, and count them if so."""
        now_s = self._clock()
        left, at_s = self._left.pop(visitor, (self._burst, now_s))
        left = min(left + (now_s - at_s) * self._per_s, self._burst)
        allowed = count <= left
        self._left[visitor] = (left - count if allowed else left), now_s
        if len(self._left) > self.MOST_VISITORS:
            del self._left[next(iter(self._left))]
        return allowed


def check_libraries() -> None:
    """Raise RelposError where a library of the pages is not installed."""
    for library in LIBRARIES:
        if find_spec(library) is None:
            raise missing_extra(library, "view")


def listen(
    address: str | None, usual: int = DEFAULT_PORT, patience_s: float = 0.0
) -> tuple[socket.socket, Access]:
    """Listen at HOST:PORT, or on this computer alone where none is given.

    A port that is taken may become free within ``patience_s``. One that was asked for and stays
    taken is a DeviceError; where none was asked for, it is the ``usual`` one, or another.
    """
    host, asked = parse_listen(address or "")
    port = usual if asked is None else asked
    try:
        family, _, _, _, where = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except OSError as error:
        raise DeviceError(f"{host}: cannot listen there: {error.strerror or error}") from None
    end_s = time.monotonic() + patience_s
    while True:
        try:
            listener = _bind(family, where)
            break
        except OSError as error:
            if error.errno == errno.EADDRINUSE and time.monotonic() < end_s:
                time.sleep(LOOK_S)
            elif asked is None and where[1] != 0:
                where = (where[0], 0, *where[2:])
            else:
                raise DeviceError(
                    f"{host}:{port}: cannot listen there: {error.strerror or error}"
                ) from None
    return listener, Access(int(listener.getsockname()[1]), hosts_of(host))


def _bind(family: int, where: tuple[Any, ...]) -> socket.socket:
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        exclusive = getattr(socket, "SO_EXCLUSIVEADDRUSE", None)
        if exclusive is not None:
            # Windows: SO_REUSEADDR would let a second session take the same port there.
            listener.setsockopt(socket.SOL_SOCKET, exclusive, 1)
        else:
            # A session that has just ended leaves connections in TIME_WAIT.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(where)
        listener.listen(128)
    except OSError:
        listener.close()
        raise
    return listener


def hosts_of(host: str) -> tuple[str, ...]:
    """Names that lead here, the one to print first."""
    if host not in ("0.0.0.0", "::", ""):
        return (host,)
    own = own_address()
    return tuple(
        dict.fromkeys((*(() if own is None else (own,)), socket.gethostname(), "localhost"))
    )


def own_address() -> str | None:
    """This computer's address in the network it would reach others by; None without any."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Of a range for documentation; a datagram socket that connects sends nothing.
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return None
        address: str = probe.getsockname()[0]
    return None if _is_loopback(address) else address


def make_certificate(hosts: tuple[str, ...]) -> Certificate:
    """A certificate made on the spot: browsers warn once, phones then give their compass."""
    try:
        import trustme
    except ImportError:
        raise missing_extra("trustme", "view") from None
    made = trustme.CA().issue_cert(*dict.fromkeys((*hosts, "localhost", "127.0.0.1")))
    chain = b"".join(blob.bytes() for blob in made.cert_chain_pems)
    return Certificate(made.private_key_pem.bytes(), chain)


def qr_svg(text: str) -> str:
    """A QR code as an SVG image."""
    import io

    import segno

    image = io.BytesIO()
    segno.make(text, error="m").save(image, kind="svg", scale=8, border=4, light="#fff")
    return image.getvalue().decode()


def qr_terminal(text: str) -> str:
    """A QR code in block characters."""
    import io

    import segno

    drawing = io.StringIO()
    segno.make(text, error="l").terminal(drawing, compact=True, border=2)
    return drawing.getvalue()


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
