"""The guard before every request: tokens, devices with a role, hosts, headers."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from typing import Any, Protocol
from urllib.parse import parse_qsl, urlencode

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import (
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
)
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from relpos.said import Said, refusal
from relpos.view.access import Access
from relpos.view.devices import Device, Gate, Role


class Session(Protocol):
    """The session, as far as the guard asks it."""

    devices: dict[str, dict[str, Any]]

    async def ask(self, kind: str, body: Mapping[str, Any]) -> dict[str, Any] | None:
        """Hand a request on; None where no answer comes in time."""


COMMANDS = (
    "/api/invite", "/api/devices", "/api/revoke", "/api/end", "/api/sources", "/api/start",
    "/qr.svg",  # Each lets in a phone.
)  # fmt: skip
MISSION_COOKIE_S = 30 * 24 * 3600
COOKIE_S = 24 * 3600
"""A mission; each session has its own token."""

REFUSED = """<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width"><title>relpos</title>
<h1>This address needs the session's token</h1>
<p>The whole address, with the token, is printed in the terminal in which
<code>relpos</code> runs, and shown as a QR code there and on the team's page. Each session has
its own token.</p></html>"""

FORBIDDEN = Said("forbidden", "this device may not do that: ask the commander")
NOT_OURS = "This name is not this computer's: use the address that relpos has printed."

CONTENT_POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    # Safari before 15.4 does not take 'self' for a socket of the same host.
    "connect-src 'self' ws://{host} wss://{host}; object-src 'none'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)


class TokenMiddleware:
    """Requires the token: in the address once, in a cookie from then on.

    Of a mission: a code that lets in one device, and that device's own token, which has a role.
    """

    def __init__(self, app: ASGIApp, access: Access, session: Session) -> None:
        self._app = app
        self._access = access
        self._session = session
        self._gate = None if access.key is None else Gate(access.key)

    async def _admit(self, asking: HTTPConnection) -> tuple[str | None, str | None]:
        """Return the cookie of whoever asks, and the one that is new; None for those without."""
        given, kept = asking.query_params.get("token"), asking.cookies.get(self._access.cookie)
        if self._gate is None:
            new = self._access.token if self._access.fits(given) else None
            return (new or (kept if self._access.fits(kept) else None)), new
        devices = self._session.devices
        self._gate.used |= set(devices)
        self._gate.revoked = {name for name, device in devices.items() if device.get("revoked")}
        if (device := self._gate.device(kept)) is not None:
            asking.scope["device"] = device
            # Whoever is in already opens an address again: no code is needed, and none is used.
            return kept, kept if given else None
        device = self._gate.admit(given)
        if device is None:
            return None, None
        # Written down first: a code must not work again after a power cut.
        event = {"id": device.id, "role": str(device.role), "admitted_unix_s": time.time()}
        if await self._session.ask("device", event) is None:
            return None, None
        asking.scope["device"] = device
        return self._gate.token(device), self._gate.token(device)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, refuse it, or set the cookie and redirect."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        asking = HTTPConnection(scope)
        send = _with_headers(send, asking) if scope["type"] == "http" else send
        if not self._access.is_own(asking.headers.get("host", "")):
            if scope["type"] == "http":
                await PlainTextResponse(NOT_OURS, 421)(scope, receive, send)
            else:
                await send({"type": "websocket.close", "code": 4421})
            return
        token, new = await self._admit(asking)
        allowed = token is not None and _own_page(asking)
        if allowed and not role_of(asking).allows(needed_role(asking)):
            await JSONResponse(refusal(FORBIDDEN), 403)(scope, receive, send)
            return
        if scope["type"] == "websocket":
            if allowed:
                await self._app(scope, receive, send)
            else:
                # Before it is accepted: the server answers 403.
                await send({"type": "websocket.close", "code": 4401})
            return
        if not allowed:
            response: Response = HTMLResponse(REFUSED, 401)
        elif new and scope["path"] in ("/", "/phone"):
            # The address bar, histories and screenshots then show no token.
            rest = [
                (k, v)
                for k, v in parse_qsl(scope["query_string"].decode("latin-1"))
                if k != "token"
            ]
            response = RedirectResponse(scope["path"] + ("?" + urlencode(rest)) * bool(rest), 303)
        else:
            await self._app(scope, receive, send)
            return
        if allowed and new:
            response.set_cookie(
                self._access.cookie,
                new,
                max_age=COOKIE_S if self._gate is None else MISSION_COOKIE_S,
                httponly=True,
                samesite="lax",
                secure=self._access.certificate is not None,
            )
        await response(scope, receive, send)


def role_of(asking: HTTPConnection) -> Role:
    """Return what whoever asks may do: everything, but for a mission's devices."""
    device: Device | None = asking.scope.get("device")
    return Role.COMMAND if device is None else device.role


def own_id(asking: HTTPConnection) -> str:
    """Return the number of the mission's device that asks, empty for none."""
    device: Device | None = asking.scope.get("device")
    return "" if device is None else device.id


def needed_role(asking: HTTPConnection) -> Role:
    """Return the role that a request needs: looking needs none but the first."""
    if asking.scope["path"] in COMMANDS:
        return Role.COMMAND
    posts = asking.scope["type"] == "http" and asking.scope["method"] == "POST"
    return Role.ACKNOWLEDGE if posts else Role.LOOK


def _own_page(asking: HTTPConnection) -> bool:
    """Return whether the request is from our own page, by its Origin header."""
    origin = asking.headers.get("origin")
    return origin is None or origin.partition("://")[2] == asking.headers.get("host")


def _with_headers(send: Send, asking: HTTPConnection) -> Send:
    host = asking.headers.get("host", "")
    host = host if re.fullmatch(r"[\w.:\[\]-]+", host, re.ASCII) else "localhost"

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers["Content-Security-Policy"] = CONTENT_POLICY.format(host=host)
            headers["X-Content-Type-Options"] = "nosniff"
            headers["Referrer-Policy"] = "no-referrer"
            headers.setdefault("Cache-Control", "no-cache")
        await send(message)

    return sending
