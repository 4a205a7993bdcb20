"""What can be set on a node: names and units for people, codes and raw values for the wire."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from relpos.calibration.steps import LEG_OF_STATURE
from relpos.protocol.messages import CommandCode


@dataclass(frozen=True)
class Setting:
    """One setting: ``low`` to ``high`` in ``unit``; raw value = value x ``per_unit``.

    The node's own limits are the same (firmware/lib/node/node.cpp); they are known here so that a
    wrong value is refused before anything is sent. ``words`` names values; ``off`` means 0.
    """

    name: str
    code: CommandCode
    meaning: str
    unit: str = ""
    per_unit: float = 1.0
    low: float = 0.0
    high: float = 1.0
    words: tuple[str, ...] = ()
    off: bool = False

    def raw(self, text: str) -> int:
        """Raw value of what a user has written. ValueError says what is wrong with it."""
        if self.words:
            if text.lower() in self.words:
                return self.words.index(text.lower())
            raise ValueError(f"{self.name} '{text}': one of {', '.join(self.words)}")
        if self.off and text.lower() == "off":
            return 0
        try:
            value = float(text)
        except ValueError:
            raise ValueError(f"{self.name} '{text}': not a number") from None
        if self.off and value == 0.0:
            return 0
        if not self.low <= value <= self.high:
            or_off = ", or off" if self.off else ""
            raise ValueError(f"{self.name} {text}: {self.limits()}{or_off}")
        raw = round(value * self.per_unit)
        if abs(raw - value * self.per_unit) > 1e-6:
            step = f"{1.0 / self.per_unit:g}"
            raise ValueError(f"{self.name} {text}: whole steps of {step} {self.unit}".rstrip())
        return raw

    def limits(self) -> str:
        """Between which values, in words."""
        return f"between {self.low:g} and {self.high:g} {self.unit}".rstrip()

    def shown(self, raw: int) -> str:
        """A raw value for people."""
        if self.words:
            return self.words[raw] if 0 <= raw < len(self.words) else str(raw)
        if self.off and raw == 0:
            return "off"
        return f"{raw / self.per_unit:.6g} {self.unit}".rstrip()


SETTINGS: tuple[Setting, ...] = (
    Setting(
        "report-period",
        CommandCode.SET_REPORT_PERIOD_MS,
        "time between two motion reports",
        "s", 1000, 0.1, 60.0,
    ),
    Setting(
        "ranging-period",
        CommandCode.SET_RANGING_PERIOD_MS,
        "time between two rounds of ranging",
        "s", 1000, 0.2, 60.0, off=True,
    ),
    Setting(
        "status-period",
        CommandCode.SET_STATUS_PERIOD_MS,
        "time between two status reports",
        "s", 1000, 1.0, 60.0,
    ),
    Setting(
        "leg-length",
        CommandCode.SET_LEG_LENGTH_MM,
        "hip to floor of the wearer",
        "m", 1000, 0.4, 1.4,
    ),
    Setting(
        "step-gain",
        CommandCode.SET_STEP_GAIN_PERMILLE,
        "the wearer's step length over the step model's",
        "", 1000, 0.3, 5.0,
    ),
    Setting(
        "team-size",
        CommandCode.SET_TEAM_SIZE,
        "ids that are ranged while no beacon is heard: 1 to this",
        "", 1, 1, 20,
    ),
    Setting(
        "step-reports",
        CommandCode.SET_STEP_REPORTS,
        "report every single step",
        words=("off", "on"),
    ),
    Setting(
        "led",
        CommandCode.SET_LED,
        "what the board's LED shows",
        words=("off", "on", "health"),
    ),
    Setting(
        "range-offset",
        CommandCode.SET_RANGE_OFFSET_MM,
        "its share of what its ranges are too long by; the host subtracts it",
        "m", 1000, -5.0, 5.0,
    ),
)  # fmt: skip
BY_NAME = {setting.name: setting for setting in SETTINGS}
STATURE_M = (1.0, 2.4)


@dataclass(frozen=True)
class Change:
    """A setting and the raw value that it is to have."""

    setting: Setting
    raw: int


def parse_changes(words: Sequence[str]) -> list[Change]:
    """Changes from NAME VALUE NAME VALUE .. or NAME=VALUE, in any mixture.

    ``stature`` (metres) stands for the leg length that goes with it. ValueError where a name is
    unknown, a value is missing or will not do; nothing is half understood.
    """
    changes: list[Change] = []
    rest = list(words)
    while rest:
        name, equals, value = rest.pop(0).partition("=")
        name = name.lower().replace("_", "-")
        if name != "stature" and name not in BY_NAME:
            known = ", ".join((*BY_NAME, "stature"))
            raise ValueError(f"'{name}' is no setting; there are {known}")
        if not equals:
            if not rest:
                raise ValueError(f"{name}: no value given")
            value = rest.pop(0)
        if name == "stature":
            changes.append(_stature(value))
        else:
            setting = BY_NAME[name]
            changes.append(Change(setting, setting.raw(value)))
    return changes


def _stature(text: str) -> Change:
    try:
        stature_m = float(text)
    except ValueError:
        raise ValueError(f"stature '{text}': not a number") from None
    if not STATURE_M[0] <= stature_m <= STATURE_M[1]:
        raise ValueError(f"stature {text}: between {STATURE_M[0]:g} and {STATURE_M[1]:g} m")
    return Change(BY_NAME["leg-length"], round(1000.0 * (LEG_OF_STATURE * stature_m)))
