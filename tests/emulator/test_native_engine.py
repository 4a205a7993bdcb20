"""The native engine on a firmware of a few lines, and the building of the library."""

import os
import shutil
from itertools import pairwise
from pathlib import Path

import pytest

from relpos.emulator.bus import I2cBus, I2cDevice
from relpos.emulator.engine import NodeClockError
from relpos.emulator.native import NativeEngine, build
from relpos.errors import DeviceError
from relpos.protocol.messages import ResetCause

HERE = Path(__file__).parent
HEADER = HERE.parents[1] / "firmware" / "lib" / "board" / "native" / "engine.h"


@pytest.fixture(scope="session")
def stub_sources(tmp_path_factory):
    """The stub beside the production header, so that it keeps to the production interface."""
    folder = tmp_path_factory.mktemp("firmware") / "lib"
    shutil.copytree(HERE / "stub_firmware", folder)
    shutil.copy(HEADER, folder / "board" / "native" / "engine.h")
    return folder


@pytest.fixture(scope="session")
def library(stub_sources, tmp_path_factory):
    return build(stub_sources, tmp_path_factory.mktemp("native"))


class Byte(I2cDevice):
    def __init__(self, value=0xA7, error=None):
        self.value = value
        self.error = error
        self.time_us = None

    def advance(self, time_us):
        self.time_us = time_us

    def read(self):
        if self.error:
            raise self.error
        return self.value


class Node:
    """An engine and what it sent: (time, text) with the polls' clocks apart."""

    def __init__(self, library, chip=None, **options):
        self.bus = I2cBus()
        if chip is not None:
            self.bus.attach(0x50, chip)
        self.eeprom = options.pop("eeprom", bytearray(b"\xff" * 256))
        self.engine = NativeEngine(
            self.bus, self.eeprom, options.pop("node", 1), library=library, **options
        )
        self.sent = []
        self.engine.on_transmit = lambda time_us, data: self.sent.append((time_us, data))

    def run(self, until_us):
        self.engine.run(until_us)
        return self

    def polls(self):
        return [int.from_bytes(d[d.index(b"P") + 1 :][:4], "little") for _, d in self.sent]

    def transmitted(self):
        return b"".join(d for _, d in self.sent)


def test_a_node_runs_when_it_asked_to_and_not_more_often(library):
    assert Node(library).run(50_000).polls() == [0, 10_000, 20_000, 30_000, 40_000, 50_000]


def test_the_nodes_clock_drifts_and_begins_at_power_on(library):
    node = Node(library, clock=NodeClockError(drift_ppm=5000.0, offset_us=7), power_on_us=300_000)
    node.run(10_300_000)
    assert node.polls()[0] == 7
    assert node.polls()[-1] == pytest.approx(10_050_000, abs=12_000)
    # What it asks for, it asks for on its own clock.
    assert len(node.polls()) == pytest.approx(1006, abs=1)


def test_the_nodes_clock_wraps_at_32_bits(library):
    node = Node(library, clock=NodeClockError(offset_us=2**32 - 15_000)).run(40_000)
    assert node.polls()[0] == 2**32 - 15_000
    assert node.polls()[2] == pytest.approx(5_000, abs=5)


def test_a_node_that_wants_to_run_at_once_does_not_stop_the_time(library):
    node = Node(library)
    node.engine.receive(b"H")
    node.run(20_000)
    assert 20 < len(node.polls()) < 1000


def test_bytes_leave_at_the_speed_of_the_line(library):
    node = Node(library).run(0)
    ((time_us, data),) = node.sent
    assert len(data) == 8  # B cause eeprom P clock
    assert time_us == pytest.approx(8 * 10 / 38400 * 1e6, abs=1)


def test_the_bus_is_driven_at_the_virtual_time_of_the_poll(library):
    chip = Byte()
    node = Node(library, chip).run(5_000)
    node.engine.receive(b"T")
    node.run(10_500)
    assert b"I\0\xa7" in node.transmitted()
    assert chip.time_us == pytest.approx(10_000, abs=2)


def test_an_absent_chip_is_an_address_nack(library):
    node = Node(library)
    node.engine.receive(b"T")
    assert b"I\1\0" in node.run(0).transmitted()


def test_an_error_in_a_chip_model_comes_out_of_the_run(library):
    node = Node(library, Byte(error=RuntimeError("chip model")))
    node.engine.receive(b"T")
    with pytest.raises(RuntimeError, match="chip model"):
        node.run(0)


def test_a_reset_starts_the_firmware_anew_and_keeps_the_eeprom(library):
    node = Node(library).run(0)
    assert node.transmitted()[:3] == b"B\1\xff"
    node.engine.receive(b"W\x42")
    node.run(10_500)
    assert node.eeprom[0] == 0x42
    node.engine.receive(b"X")
    node.sent.clear()
    node.run(200_000)
    boot = next(d for _, d in node.sent if d.startswith(b"B"))
    assert boot[:3] == bytes((ord("B"), ResetCause.COMMAND, 0x42))
    assert int.from_bytes(boot[4:8], "little") == 0  # the clock, too, begins anew
    assert node.engine.resets == 1


def test_a_clock_that_changes_its_rate_makes_no_jump(library):
    node = Node(library).run(1_000_000)
    node.engine.set_drift(1_005_000, 5000.0)
    node.run(11_005_000)
    times = node.polls()
    assert all(10_000 <= b - a < 10_100 for a, b in pairwise(times))
    assert times[-1] == pytest.approx(11_055_000, abs=12_000)


def test_a_firmware_that_refuses_to_start_is_an_error(library):
    with pytest.raises(DeviceError, match="node 99"):
        Node(library, node=99)


def test_unchanged_sources_are_not_compiled_again(stub_sources, tmp_path):
    first = build(stub_sources, tmp_path)
    stamp = first.stat().st_mtime_ns
    assert build(stub_sources, tmp_path) == first
    assert first.stat().st_mtime_ns == stamp


def test_changed_sources_give_another_library(stub_sources, tmp_path):
    first = build(stub_sources, tmp_path / "out")
    changed = tmp_path / "lib"
    shutil.copytree(stub_sources, changed)
    (changed / "board" / "native" / "more.h").write_text("// more\n")
    assert build(changed, tmp_path / "out") != first


def test_a_compile_error_is_one_line_that_names_file_and_reason(stub_sources, tmp_path):
    broken = tmp_path / "lib"
    shutil.copytree(stub_sources, broken)
    (broken / "board" / "native" / "broken.cpp").write_text("int f() { return missing; }\n")
    with pytest.raises(DeviceError, match=r"broken\.cpp:1:.*missing") as error:
        build(broken, tmp_path / "out")
    assert "\n" not in str(error.value)
    assert not list((tmp_path / "out").glob("*"))


def test_a_missing_compiler_is_named(stub_sources, tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(DeviceError, match="no-such-compiler"):
        build(stub_sources, tmp_path)


def test_a_folder_that_cannot_be_written_is_an_error(stub_sources, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DeviceError, match="cannot be written"):
        build(stub_sources, tmp_path / "file" / "native")


def test_the_arduino_board_is_not_compiled(stub_sources, tmp_path):
    with_arduino = tmp_path / "lib"
    shutil.copytree(stub_sources, with_arduino)
    (with_arduino / "board" / "arduino").mkdir()
    (with_arduino / "board" / "arduino" / "twi.cpp").write_text("#error for the AVR alone\n")
    assert os.access(build(with_arduino, tmp_path / "out"), os.R_OK)
