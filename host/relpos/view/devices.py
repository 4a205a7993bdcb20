"""Who may see a mission's pages: devices with a role each, let in by a code that works once.

Tokens are signed by the mission's key, so that they hold in its next session; a token says nothing
that anybody could alter. A code (an invitation) is good for one device within five minutes.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
import time
from dataclasses import dataclass, field
from enum import StrEnum

INVITATION_S = 300.0


class Role(StrEnum):
    """What a device may do; each may do all that those before it may."""

    LOOK = "look"
    ACKNOWLEDGE = "acknowledge"
    COMMAND = "command"

    def allows(self, needed: Role) -> bool:
        """Return whether the role is enough for what needs ``needed``."""
        order = list(Role)
        return order.index(self) >= order.index(needed)


@dataclass(frozen=True)
class Device:
    """A browser that was let in."""

    id: str
    role: Role


@dataclass
class Gate:
    """Signs and checks; ``used`` codes and ``revoked`` devices come from the mission's journal."""

    key: bytes
    used: set[str] = field(default_factory=set)
    revoked: set[str] = field(default_factory=set)

    def invite(self, role: Role, now_s: float | None = None, by: str = "") -> str:
        """Return a new code for a device of that role; shutting out device ``by`` ends it."""
        expires = int((time.time() if now_s is None else now_s) + INVITATION_S)
        return self._signed("i", f"{secrets.token_hex(8)}.{role}.{expires}.{by}")

    def admit(self, code: str | None, now_s: float | None = None) -> Device | None:
        """Return the device that an unused code lets in; the code is used from then on."""
        parts = self._read("i", code)
        if parts is None or parts[0] in self.used or not self.revoked.isdisjoint(parts[3:]):
            return None
        if float(parts[2]) < (time.time() if now_s is None else now_s):
            return None
        self.used.add(parts[0])
        # The device is known by its code's number: used codes and devices are one list.
        return Device(parts[0], Role(parts[1]))

    def token(self, device: Device) -> str:
        """Return the token of a device."""
        return self._signed("d", f"{device.id}.{device.role}")

    def device(self, token: str | None) -> Device | None:
        """Return the device of a token; None for one that is not ours, or revoked."""
        parts = self._read("d", token)
        if parts is None or parts[0] in self.revoked:
            return None
        return Device(parts[0], Role(parts[1]))

    def _signed(self, kind: str, said: str) -> str:
        return f"{kind}.{said}.{self._tag(kind, said)}"

    def _tag(self, kind: str, said: str) -> str:
        text = f"relpos {kind} {said}".encode()
        return hmac.new(self.key, text, hashlib.sha256).hexdigest()[:32]

    def _read(self, kind: str, token: str | None) -> list[str] | None:
        if token is None or len(token) > 200 or not token.isascii():
            return None
        said, _, tag = token.removeprefix(f"{kind}.").rpartition(".")
        right = hmac.compare_digest(self._tag(kind, said).encode(), tag.encode())
        return said.split(".") if right and token.startswith(f"{kind}.") else None
