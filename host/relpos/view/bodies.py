"""Bodies of requests, checked: what a browser sends may be anything."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from starlette.requests import Request

from relpos.said import Said

MAX_BODY_BYTES = 1 << 20
"""Of presses and headings, which a phone has gathered."""
MAX_EVENT_BYTES = 4096
"""Of others: a mission's journal keeps them."""
MAX_DEPTH = 8
MAX_ITEMS = 2000
"""Presses, or headings, of one request."""


class BadRequestError(Exception):
    """A request that makes no sense, in words."""


async def read_received(request: Request, limit: int, too_much: str) -> bytes:
    """Return what a request brings; BadRequestError as soon as it is more than ``limit`` bytes."""
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > limit:
            raise BadRequestError(too_much)
    return data


async def read_body(request: Request, most: int = MAX_EVENT_BYTES) -> dict[str, Any]:
    """Return the JSON object that a request brings."""
    data = await read_received(request, most, f"more than {most} bytes")
    try:
        body = json.loads(data)
        if _depth_exceeds(body, MAX_DEPTH):
            raise BadRequestError("nested too deeply")
    except (ValueError, RecursionError):  # The latter by lists within lists.
        raise BadRequestError("not JSON") from None
    if not isinstance(body, dict):
        raise BadRequestError("not a JSON object")
    return body


def _depth_exceeds(document: Any, most: int) -> bool:
    """Return whether more than so many lists and objects are within each other."""
    level = [document]
    for _ in range(most + 1):
        level = [
            inner
            for outer in level
            if isinstance(outer, dict | list)
            for inner in (outer.values() if isinstance(outer, dict) else outer)
        ]
    return bool(level)


def node_of(body: Mapping[str, Any]) -> int:
    """Return the number of a node."""
    node = body.get("node")
    if not isinstance(node, int) or isinstance(node, bool) or not 0 < node < 255:
        raise BadRequestError("node: not a number from 1 to 254")
    return node


def by_of(body: Mapping[str, Any]) -> str:
    """Who asks, as the page says; empty where it does not."""
    return "" if body.get("by") in (None, "") else text_of(body, "by", 40)


def number_of(row: Mapping[str, Any], name: str) -> float:
    """Return a finite number."""
    value = row.get(name)
    try:
        number = math.nan if isinstance(value, bool | str) else float(value)  # type: ignore[arg-type]
    except (TypeError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise BadRequestError(f"{name}: not a number")
    return number


def sigma_of(row: Mapping[str, Any]) -> float | None:
    """Return a heading's standard deviation; None where it has none."""
    if row.get("sigma_rad") is None:
        return None
    sigma_rad = number_of(row, "sigma_rad")
    if sigma_rad <= 0.0:
        raise BadRequestError("sigma_rad: not above 0")
    return sigma_rad


def text_of(row: Mapping[str, Any], name: str, most: int) -> str:
    """Return a text of 1 to ``most`` printable characters."""
    value = row.get(name)
    if not isinstance(value, str) or not 0 < len(value) <= most or not value.isprintable():
        raise BadRequestError(
            Said("text", "{field}: not 1 to {most} printable characters", field=name, most=most)
        )
    return value


def items_of(body: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    """Return a list of objects."""
    items = body.get(name)
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise BadRequestError(f"{name}: not a list of objects")
    if len(items) > MAX_ITEMS:
        raise BadRequestError(f"{name}: more than {MAX_ITEMS} at once")
    return items


def clocks_of(body: Mapping[str, Any]) -> dict[str, Any]:
    """Return the node of a phone and what its clock says."""
    sent = None if body.get("sent_unix_ms") is None else number_of(body, "sent_unix_ms")
    return {
        "node": node_of(body),
        "clock_offset_ms": number_of(body, "clock_offset_ms"),
        "sent_unix_ms": sent,
    }
