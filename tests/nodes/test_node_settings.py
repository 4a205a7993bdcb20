"""What people write to set a node, and what is refused before anything is sent."""

import re
from pathlib import Path

import pytest

from relpos.nodes.settings import BY_NAME, SETTINGS, parse_changes
from relpos.protocol.messages import CommandCode

ROOT = Path(__file__).resolve().parents[2]


def changes(*words):
    return [(change.setting.name, change.raw) for change in parse_changes(words)]


def test_names_and_values_come_in_pairs_or_with_an_equals_sign():
    assert changes("led", "off", "leg-length=0.9", "ranging_period", "off") == [
        ("led", 0),
        ("leg-length", 900),
        ("ranging-period", 0),
    ]


def test_a_stature_stands_for_its_leg_length():
    # Winter: hip to floor is 0.530 of the stature.
    assert changes("stature", "1.80") == [("leg-length", 954)]


def test_a_word_that_only_newer_firmware_knows_is_shown_as_its_number():
    assert [BY_NAME["led"].shown(raw) for raw in (2, 3)] == ["health", "3"]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("leg", "1"), "no setting"),
        (("led",), "no value"),
        (("led", "blue"), "off, on, health"),
        (("report-period", "0.05"), "between 0.1 and 60 s"),
        (("ranging-period", "0.1"), "or off"),
        (("step-gain", "much"), "not a number"),
        (("team-size", "3.5"), "whole steps of 1"),
        (("leg-length", "nan"), "between"),
        (("stature", "180"), "between 1 and 2.4 m"),
        (("stature", "tall"), "stature 'tall': not a number"),
        (("led", "on", "leg-length", "9"), "between 0.4 and 1.4 m"),
    ],
)
def test_a_setting_that_cannot_be_set_is_reported(words, complaint):
    with pytest.raises(ValueError, match=complaint):
        parse_changes(words)


def test_limits_are_those_of_the_firmware():
    source = (ROOT / "firmware/lib/node/node.cpp").read_text()
    table = source[source.index("kChoices[]") :]
    number = r"(?:static_cast<uint16_t>\()?(-?\w+)\)?"
    entry = rf"CommandCode::k(\w+)\),[^,]*,[^,]*,\s*\d,\s*{number},\s*{number}\}}"
    words = {"kLedOff": 0, "kLedHealth": 2}
    limits = {
        name: [words[x] if x in words else int(x) for x in low_high]
        for name, *low_high in re.findall(entry, table)
    }
    for setting in SETTINGS:
        name = "".join(part.title() for part in CommandCode(setting.code).name.split("_"))
        high = len(setting.words) - 1 if setting.words else setting.high * setting.per_unit
        low = 0 if setting.words else setting.low * setting.per_unit
        assert limits[name] == pytest.approx([low, high]), setting.name
