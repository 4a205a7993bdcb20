"""Writes the computed tables of docs/hardware.md and docs/nodes.md.

    python bench/hardware.py [--check]

With --check it writes nothing and fails where a page is not as it would be written.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import node_power as power
import radio_traffic as traffic
from relpos.nodes import health, radio, settings

DOCS = Path(__file__).parents[1] / "docs"
EXAMPLE_NODE = 3


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; all columns but the first to the right where they are numbers."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def radio_lines() -> str:
    """What is typed in command mode."""
    lines = radio.command_lines(radio.parameters(EXAMPLE_NODE))
    return "```\n" + "\n".join(f"{line:10}  {words}" for line, words in lines) + "\n```"


def baud_rates() -> str:
    """Errors of the AVR's UART."""
    rows = []
    for baud in (9600, 19200, 38400, 57600, 115200):
        error = 100.0 * traffic.baud_error(baud)
        if abs(error) > 0.5:
            verdict = "too far off"
        elif traffic.load(20, traffic.ranges_a_round(20), baud).line_share > 0.8:
            verdict = "too slow for 20 nodes"
        else:
            verdict = "fits"
        motion = f"{traffic.line_ms(baud):.0f} ms"
        rows.append((str(baud), f"{error:+.2f} %", motion, verdict))
    return table(("baud", "error at 16 MHz", "a motion report takes", ""), rows)


def loads() -> str:
    """What arrives at the coordinator."""
    rows = []
    for nodes in (2, 4, 6, 7, 10, 15, 20):
        load = traffic.load(nodes, traffic.ranges_a_round(nodes))
        rows.append(
            (
                str(nodes),
                str(load.ranges_a_round),
                f"{load.bytes_s:.0f}",
                f"{100 * load.line_share:.0f} %",
                f"{100 * load.air_share:.0f} %",
            )
        )
    head = ("nodes", "ranges a node and round", "bytes/s", "of the line", "of the channel")
    return table(head, rows)


def currents() -> str:
    """What a node draws."""
    rows = [(part.name, f"{part.current_ma:.0f} mA", part.source) for part in power.UNO_NODE]
    total = power.total_ma(power.UNO_NODE)
    watts = total * power.SUPPLY_V / 1000.0
    rows.append(("**node with an Uno**", f"**{total:.0f} mA**", f"{watts:.1f} W"))
    mega = power.total_ma(power.MEGA_NODE)
    rows.append(("node with a Mega", f"{mega:.0f} mA", power.MEGA.source))
    return table(("part", "mean", "assumed because"), rows)


def batteries() -> str:
    """How long a battery lasts."""
    load_ma = power.total_ma(power.UNO_NODE)
    rows = []
    for battery in power.BATTERIES:
        burnt_w = battery.burnt_w(load_ma)
        hot = battery.efficiency is None and burnt_w > power.REGULATOR_W
        rows.append(
            (
                battery.name,
                f"{battery.life_h(load_ma):.1f} h",
                f"{burnt_w:.1f} W" + (": too hot" if hot else ""),
            )
        )
    return table(("battery", "lasts (Uno)", "burnt on the way"), rows)


def health_limits() -> str:
    """The rule of the three colours."""
    rows = (
        ("silent for", f"over {health.SILENT_S:g} s", ""),
        ("inertial sensor", "missing", ""),
        ("magnetometer, Pozyx, pressure sensor", "", "one missing"),
        (
            "frames lost",
            f"over {100.0 * health.LOSS_RED:g} %",
            f"over {100.0 * health.LOSS_YELLOW:g} %",
        ),
        (
            "supply",
            f"under {health.BATTERY_RED_V:g} V",
            f"under {health.BATTERY_YELLOW_V:g} V",
        ),
        (
            "rangings that succeed",
            "",
            f"under {100.0 * health.RANGING_YELLOW:g} % of {health.MIN_EXCHANGES} or more",
        ),
        ("neighbours", "", "none in a team of two or more"),
        ("radio's signal", "", f"under {health.RSSI_YELLOW_DBM:g} dBm"),
        ("beacon", "", "not heard"),
        (
            "restart by brown-out, watchdog, or of hidden cause",
            "",
            f"within the last {health.FRESH_START_S:g} s",
        ),
        ("50 Hz ticks missed, frames refused, bytes damaged or lost at the UART", "", "any"),
        ("stack left", "", f"under {health.MIN_STACK_BYTES} bytes"),
        ("status", "", "none heard yet"),
    )
    return table(("what", "red", "yellow"), rows)


def setting_list() -> str:
    """What `relpos node set` knows."""
    rows = []
    for one in settings.SETTINGS:
        limits = ", ".join(one.words) if one.words else one.limits() + ", or off" * one.off
        rows.append((f"`{one.name}`", one.meaning, limits))
    return table(("name", "meaning", "values"), rows)


PAGES = {
    "hardware.md": {
        "radio": radio_lines,
        "baud": baud_rates,
        "load": loads,
        "current": currents,
        "battery": batteries,
    },
    "nodes.md": {"health": health_limits, "settings": setting_list},
}
VALUES = {
    "hardware.md": {
        "usable": f"{power.USABLE:g}",
        "regulator": f"{power.REGULATOR_W:g}",
        "beacon": f"{traffic.beacon_bytes(20):.0f}",
    }
}


def render(page: str, text: str) -> str:
    """A page with its tables and values as they are computed now."""
    for name, make in PAGES[page].items():
        made = make().replace("\\", "\\\\")
        pattern = rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)"
        text, count = re.subn(pattern, rf"\g<1>{made}\n\g<2>", text, flags=re.S)
        if count != 1:
            raise SystemExit(f"{page}: the markers of '{name}' are not there once")
    for name, value in VALUES.get(page, {}).items():
        text, count = re.subn(rf"(<!--{name}-->).*?(<!---->)", rf"\g<1>{value}\g<2>", text)
        if count != 1:
            raise SystemExit(f"{page}: the value '{name}' is not there once")
    return text


def main() -> None:
    """Write, or check."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true")
    arguments = parser.parse_args()
    for page in PAGES:
        old = (DOCS / page).read_text(encoding="utf-8")
        new = render(page, old)
        if new == old:
            continue
        if arguments.check:
            sys.exit(f"docs/{page} is out of date: make pages")
        (DOCS / page).write_text(new, encoding="utf-8")


if __name__ == "__main__":
    main()
