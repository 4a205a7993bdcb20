"""Typed settings of estimators and scenarios: documented defaults, bounds, clear errors."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from typing import Any, TypeVar, cast

from relpos.errors import RelposError

T = TypeVar("T")

_LOG = logging.getLogger(__name__)


def setting(default: float, text: str, low: float, high: float) -> Any:
    """Declare a dataclass field that ``--set`` may change; whole where the default is an int."""
    return field(default=default, metadata={"text": text, "low": low, "high": high})


@dataclass(frozen=True, slots=True)
class SettingInfo:
    """What a help text says of one key."""

    key: str
    default: float
    text: str
    low: float
    high: float


def describe(settings_class: type[Any]) -> list[SettingInfo]:
    """List the keys of a settings class in their order."""
    return [
        SettingInfo(f.name, cast("float", f.default), **f.metadata) for f in fields(settings_class)
    ]


def parse(settings_class: type[T], values: Mapping[str, object], owner: str) -> T:
    """Build settings from key -> number or text; raise RelposError naming what is wrong.

    Keys of the class attribute ``FORMER`` (key -> the value that is fixed now) are accepted still,
    left out, and told.
    """
    former: Mapping[str, float] = getattr(settings_class, "FORMER", {})
    known = {info.key: info for info in describe(settings_class)}
    parsed: dict[str, float | int] = {}
    for key, given in values.items():
        if key in former:
            tell_former(owner, key, former[key])
            continue
        if key not in known:
            raise RelposError(f"{owner} has no setting '{key}': one of {', '.join(known)}")
        info = known[key]
        try:
            value = float(str(given))
        except ValueError:
            raise RelposError(f"setting {key}: '{given}' is not a number") from None
        if not info.low <= value <= info.high:
            raise RelposError(f"setting {key}: {given} is not within {info.low:g} to {info.high:g}")
        if isinstance(info.default, int):
            if value != int(value):
                raise RelposError(f"setting {key}: {given} is not a whole number")
            value = int(value)
        parsed[key] = value
    return settings_class(**parsed)


@cache
def tell_former(owner: str, key: str, fixed: float) -> None:
    """Say once that a setting is none any more."""
    _LOG.warning("%s: %s is no setting any more, and left out; it is %g", owner, key, fixed)
