"""The computed figures of the hardware pages, derived anew, and the pages held to them."""

import re
import runpy
from pathlib import Path

import pytest

import node_power as power
import radio_traffic as traffic
from relpos.protocol import messages as wire

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("page", ["hardware.md", "nodes.md"])
def test_a_page_shows_what_is_computed(page):
    render = runpy.run_path(str(ROOT / "bench" / "hardware.py"))["render"]
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    assert render(page, text) == text, "make pages"


def test_baud_errors_are_those_of_the_dividers():
    # UBRR at double speed, from the ATmega328P's data sheet table for 16 MHz.
    assert traffic.baud_error(38400) == pytest.approx(16e6 / 8 / 52 / 38400 - 1)
    assert traffic.baud_error(115200) == pytest.approx(16e6 / 8 / 17 / 115200 - 1)
    assert abs(traffic.baud_error(38400)) < 0.005 < abs(traffic.baud_error(57600))


def test_a_motion_report_takes_the_bytes_that_it_has():
    # Header 9, body 45, CRC 2, tag 8; 9 bytes of XBee frame; 1 of 64 bytes is escaped.
    assert traffic.packet_bytes(wire.MOTION.fixed_size) == 9 + 45 + 2 + 8
    assert traffic.serial_bytes(wire.MOTION.fixed_size) == pytest.approx(73 * (1 + 1 / 64))


def test_twenty_nodes_fit_the_coordinators_line_and_the_channel():
    load = traffic.load(20, traffic.ranges_a_round(20))
    assert load.line_share < 0.75
    assert load.air_share < 0.35
    assert load.bytes_s == pytest.approx(load.line_share * 3840)


def test_the_plan_of_the_slots_is_the_firmwares():
    header = (ROOT / "firmware/lib/node/ranging.h").read_text()
    constants = dict(re.findall(r"constexpr \w+ (k\w+) = (\d+);", header))
    assert round(1000 * traffic.EXCHANGE_S) == int(constants["kExchangeMs"])
    assert int(constants["kAllInARound"]) == traffic.ALL_IN_A_ROUND


def test_a_battery_lasts_by_its_energy_or_by_its_charge():
    switching = power.Battery("", 1000.0, 3.7, 0.8)
    # 3.7 Wh x 0.8 x 0.9 usable, at 1 W.
    assert switching.life_h(200.0) == pytest.approx(3.7 * 0.8 * 0.9 / 1.0)
    assert switching.burnt_w(200.0) == pytest.approx(1.0 / 0.8 - 1.0)
    linear = power.Battery("", 1000.0, 7.4, None)
    assert linear.life_h(200.0) == pytest.approx(0.9 * 1000.0 / 200.0)
    assert linear.burnt_w(200.0) == pytest.approx(2.4 * 0.2)


def test_a_resting_microcontroller_draws_what_idle_mode_does():
    assert power.microcontroller_ma(0.0) == power.ATMEGA_IDLE_MA
    assert power.microcontroller_ma(1.0) == power.ATMEGA_ACTIVE_MA
