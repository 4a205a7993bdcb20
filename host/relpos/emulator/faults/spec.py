"""A fault as it is asked for: ``TARGET:BEHAVIOUR[:KEY=VALUE,...]``, parsed and checked."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from relpos.errors import RelposError

from .table import BY_NAME, FAULTS, REFUSED, TARGETS, Fault


class FaultError(RelposError):
    """A fault that does not exist or makes no sense; the message lists what is allowed."""


@dataclass(frozen=True, slots=True)
class FaultSpec:
    """A fault that is to happen: to ``node`` (None: all), while ``from_s <= t < to_s``."""

    fault: Fault
    node: int | None = None
    from_s: float = 0.0
    to_s: float = math.inf
    values: Mapping[str, float | str] = field(default_factory=dict)

    def number(self, name: str, otherwise: float | None = None) -> float:
        """A key's number, given or default; ``otherwise`` where the fault has no such key."""
        if otherwise is not None and name not in self.fault.key_names():
            return otherwise
        value = self._value(name)
        assert not isinstance(value, str)
        return value

    def choice(self, name: str) -> str:
        """A key's word, given or default."""
        value = self._value(name)
        assert isinstance(value, str)
        return value

    def _value(self, name: str) -> float | str:
        if name in self.values:
            return self.values[name]
        return next(key.default for key in self.fault.keys if key.name == name)

    @property
    def from_us(self) -> int:
        """Begin, in virtual microseconds."""
        return round(self.from_s * 1e6)

    @property
    def to_us(self) -> int | None:
        """End, in virtual microseconds; None: never."""
        return None if math.isinf(self.to_s) else round(self.to_s * 1e6)

    def active(self, time_us: int) -> bool:
        """Whether it lasts at that moment."""
        return self.from_us <= time_us and (self.to_us is None or time_us < self.to_us)


def _known(words: Iterable[str]) -> str:
    return ", ".join(words)


def parse_fault(text: str, nodes: Sequence[int] | None = None) -> FaultSpec:
    """One SPEC. ``nodes`` are those that there are, where that is known.

    Raises :class:`FaultError`, one line that says what is allowed.
    """
    target, _, rest = text.partition(":")
    behaviour, _, keys = rest.partition(":")
    if target not in TARGETS:
        raise FaultError(f"fault '{text}': unknown target '{target}': {_known(TARGETS)}")
    allowed = [f.behaviour for f in FAULTS if f.target == target]
    fault = BY_NAME.get((target, behaviour))
    if fault is None:
        reason = REFUSED.get((target, behaviour))
        if not behaviour:
            why = "no behaviour given"
        elif reason is not None:
            why = f"refused: {reason}"
        else:
            why = f"{target} has no '{behaviour}'"
            near = difflib.get_close_matches(behaviour, allowed, 1)
            why += f" (did you mean '{near[0]}'?)" if near else ""
        raise FaultError(f"fault '{text}': {why}; {target} can be {_known(allowed)}")
    given: dict[str, str] = {}
    for pair in keys.split(",") if keys else ():
        name, equals, value = pair.partition("=")
        if not equals or not value:
            raise FaultError(f"fault '{text}': '{pair}' is not KEY=VALUE")
        if name not in fault.key_names():
            raise FaultError(
                f"fault '{text}': {fault.name} takes no '{name}'; "
                f"its keys: {_known(fault.key_names()) or 'none'}"
            )
        if name in given:
            raise FaultError(f"fault '{text}': '{name}' is given twice")
        given[name] = value
    return _spec(text, fault, given, nodes)


def _spec(
    text: str, fault: Fault, given: Mapping[str, str], nodes: Sequence[int] | None
) -> FaultSpec:
    values: dict[str, float | str] = {}
    for key in fault.keys:
        if key.name in given:
            word = given[key.name]
            if key.choices:
                if word not in key.choices:
                    raise FaultError(
                        f"fault '{text}': {key.name} is one of {_known(key.choices)}, not '{word}'"
                    )
                values[key.name] = word
            else:
                values[key.name] = _number(text, key.name, word, key.low, key.high)
    node = None
    if "node" in given:
        node = int(_number(text, "node", given["node"], 0, 254, whole=True))
        if node == 0 and not fault.coordinator:
            raise FaultError(
                f"fault '{text}': node 0 is the coordinator, which has no {fault.name}"
            )
        if node and nodes is not None and node not in nodes:
            raise FaultError(
                f"fault '{text}': there is no node {node}; nodes: {_known(map(str, nodes))}"
            )
    from_s = _number(text, "from", given["from"], 0.0, 86_400.0) if "from" in given else 0.0
    to_s = _number(text, "to", given["to"], 0.0, 86_400.0) if "to" in given else math.inf
    if to_s <= from_s:
        raise FaultError(f"fault '{text}': it ends at {to_s:g} s, before it begins at {from_s:g} s")
    if fault.momentary and "from" not in given:
        raise FaultError(f"fault '{text}': {fault.name} happens at a moment: give from=SECONDS")
    return FaultSpec(fault, node, from_s, to_s, values)


def _number(
    text: str, name: str, word: str, low: float, high: float, *, whole: bool = False
) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not low <= value <= high or (whole and value != int(value)):
        kind = "a whole number" if whole else "a number"
        raise FaultError(f"fault '{text}': {name} is {kind} from {low:g} to {high:g}, not '{word}'")
    return value


def parse_faults(
    faults: Iterable[str | FaultSpec], nodes: Sequence[int] | None = None
) -> list[FaultSpec]:
    """Every SPEC of them; what is a FaultSpec already stays as it is."""
    return [f if isinstance(f, FaultSpec) else parse_fault(f, nodes) for f in faults]


def help_text() -> str:
    """The vocabulary as a command's help shows it: one paragraph a target."""
    parts = ["SPEC is TARGET:BEHAVIOUR[:KEY=VALUE,...], its times from and to in seconds."]
    for target, meaning in TARGETS.items():
        behaviours = []
        for fault in FAULTS:
            if fault.target == target:
                keys = [k for k in fault.key_names() if k not in ("node", "from", "to")]
                behaviours.append(fault.behaviour + (f" ({', '.join(keys)})" if keys else ""))
        parts.append(f"{target} - {meaning}: {', '.join(behaviours)}.")
    return "\n\n".join(parts)
