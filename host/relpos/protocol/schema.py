"""What a wire message is made of: construct fields that know their unit, scale and range.

A field is a construct integer wrapped in a :class:`Quantity`, so one declaration serves the
Python codec, the generated C++ and the generated documentation. On the wire every number is a
little-endian integer; ``per_unit`` counts of it make one unit, hence SI value = raw / per_unit.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import construct as cs

Value = float | int
Record = Mapping[str, Any]


class OutOfRangeError(ValueError):
    """A value outside what its field may carry: which field, the value, the limits."""


_WIDTHS: dict[str, tuple[Any, int, bool]] = {
    "u8": (cs.Int8ul, 1, False),
    "i8": (cs.Int8sl, 1, True),
    "u16": (cs.Int16ul, 2, False),
    "i16": (cs.Int16sl, 2, True),
    "u24": (cs.Int24ul, 3, False),
    "u32": (cs.Int32ul, 4, False),
    "i32": (cs.Int32sl, 4, True),
}


SCALES = {
    "mm": ("m", 1000),
    "cm": ("m", 100),
    "mm2": ("m^2", 1_000_000),
    "10um_s2": ("m/s^2", 100_000),
    "100urad": ("rad", 10_000),
    "100urad2": ("rad^2", 100_000_000),
    "10urad_s": ("rad/s", 100_000),
    "ms": ("s", 1000),
    "us": ("s", 1_000_000),
    "mv": ("V", 1000),
    "10pt": ("uT", 100_000),
}
"""How the name of a wire's integer ends -> the unit of its value, and how many make one."""


class Quantity(cs.Adapter):  # type: ignore[type-arg]
    """A construct integer with a name on both sides, a unit, a scale, limits and a meaning.

    ``raw_name`` is the integer's where that counts another unit; :data:`SCALES` knows which.
    """

    def __init__(
        self,
        name: str,
        wire: str,
        meaning: str,
        *,
        raw_name: str | None = None,
        unit: str = "",
        per_unit: int = 1,
        low: int | None = None,
        high: int | None = None,
        wraps: bool = False,
        values: type[enum.IntEnum] | type[enum.IntFlag] | None = None,
    ) -> None:
        subcon, self.byte_count, self.signed = _WIDTHS[wire]
        super().__init__(subcon)
        bits = 8 * self.byte_count
        full_low, full_high = (
            (-(1 << bits - 1), (1 << bits - 1) - 1) if self.signed else (0, (1 << bits) - 1)
        )
        self.label = name
        self.wire = wire
        self.meaning = meaning
        self.raw_name = raw_name or name
        if raw_name is not None:
            ends = (scale for end, scale in SCALES.items() if raw_name.endswith(f"_{end}"))
            unit, per_unit = next(ends)
        self.unit = unit
        self.per_unit = per_unit
        self.low = full_low if low is None else low
        self.high = full_high if high is None else high
        self.wraps = wraps
        self.values = values
        if wraps and (self.low, self.high) != (full_low, full_high):
            raise ValueError(f"{name}: a counter that wraps uses the whole width of {wire}")
        if values is not None and issubclass(values, enum.IntFlag):
            self.high = sum(values)
        elif values is not None:
            self.low, self.high = min(values), max(values)

    @property
    def modulus(self) -> int:
        """Number of distinct raw values; wrapping counters count modulo this."""
        return 1 << 8 * self.byte_count

    def check(self, raw: int) -> int:
        """Return ``raw`` where it is allowed, else raise :class:`OutOfRangeError`."""
        if not self.low <= raw <= self.high:
            raise OutOfRangeError(
                f"{self.label}: raw value {raw} is outside {self.low}..{self.high}"
            )
        return raw

    def wrap(self, raw: int) -> int:
        """``raw`` modulo the width, as the wire's signed or unsigned integer."""
        raw %= self.modulus
        return raw - self.modulus if self.signed and raw >= self.modulus // 2 else raw

    def to_raw(self, value: Value) -> int:
        """SI value to wire integer, rounded to nearest; counters wrap, others must fit."""
        raw = round(value * self.per_unit)
        return self.wrap(raw) if self.wraps else self.check(raw)

    def difference(self, newer: Value, older: Value) -> float:
        """``newer - older`` of a counter that may have wrapped in between, in SI units.

        Right as long as the true difference is under half the width either way; an unsigned
        counter's difference is taken as signed, so that reordering shows as negative.
        """
        raw = (round(newer * self.per_unit) - round(older * self.per_unit)) % self.modulus
        if raw >= self.modulus // 2:
            raw -= self.modulus
        return raw / self.per_unit

    def _encode(self, obj: Value, context: Any, path: str) -> int:
        return self.to_raw(obj)

    def _decode(self, obj: int, context: Any, path: str) -> Value:
        raw = self.check(int(obj))
        return raw if self.per_unit == 1 else raw / self.per_unit


@dataclass(frozen=True)
class Entries:
    """A repeated record at the end of a message, preceded by its one-byte count."""

    name: str
    singular: str
    fields: Sequence[Quantity]
    most: int


class Message:
    """One message type: its number, its fields in wire order, and the codec made from them."""

    def __init__(
        self,
        number: int,
        name: str,
        meaning: str,
        fields: Sequence[Quantity],
        entries: Entries | None = None,
    ) -> None:
        self.number = number
        self.name = name
        self.meaning = meaning
        self.fields = tuple(fields)
        self.entries = entries
        self.field = {f.label: f for f in self.fields}
        subcons = [cs.Renamed(f, newname=f.label) for f in self.fields]
        if entries is not None:
            record = cs.Struct(*(cs.Renamed(f, newname=f.label) for f in entries.fields))
            subcons.append(cs.Renamed(cs.PrefixedArray(cs.Int8ul, record), newname=entries.name))
        self.body: Any = cs.Struct(*subcons)

    @property
    def fixed_size(self) -> int:
        """Bytes of the body without its entries, their count included."""
        return sum(f.byte_count for f in self.fields) + (1 if self.entries else 0)

    @property
    def entry_size(self) -> int:
        """Bytes of one entry; 0 where the message has none."""
        return sum(f.byte_count for f in self.entries.fields) if self.entries else 0

    @property
    def most_bytes(self) -> int:
        """Bytes of the longest body."""
        return self.fixed_size + (self.entry_size * self.entries.most if self.entries else 0)

    def build(self, values: Record) -> bytes:
        """Body bytes of ``values`` (SI units). Raises :class:`OutOfRangeError`, KeyError."""
        if self.entries is not None and len(values[self.entries.name]) > self.entries.most:
            raise OutOfRangeError(
                f"{self.name}: {len(values[self.entries.name])} {self.entries.name}, "
                f"at most {self.entries.most} fit"
            )
        return bytes(self.body.build(dict(values)))

    def length_fits(self, body: bytes) -> bool:
        """Whether ``body`` has exactly the bytes that this message's layout asks for."""
        if self.entries is None:
            return len(body) == self.fixed_size
        if len(body) < self.fixed_size:
            return False
        count = body[self.fixed_size - 1]
        return count <= self.entries.most and len(body) == self.fixed_size + count * self.entry_size

    def parse(self, body: bytes) -> dict[str, Any]:
        """Values (SI units) of a body of fitting length. Raises :class:`OutOfRangeError`."""
        container = self.body.parse(body)
        values: dict[str, Any] = {f.label: container[f.label] for f in self.fields}
        if self.entries is not None:
            values[self.entries.name] = [
                {f.label: entry[f.label] for f in self.entries.fields}
                for entry in container[self.entries.name]
            ]
        return values
