"""`relpos node check`: a healthy node is right in every line, and each fault is named by one."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from relpos.cli import node_dialogue
from relpos.emulator.avr.library import missing_parts
from relpos.emulator.faults import FAULTS
from relpos.emulator.pozyx import FUNCTION_STRETCH_US
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.errors import DeviceError
from relpos.link import dialogue, port
from relpos.link.decoder import Acknowledged
from relpos.link.dialogue import open_dialogue
from relpos.link.port import Link
from relpos.nodes import cable as cable_module
from relpos.nodes.bringup import NodeCheck, bus_access, check, inertial, radio
from relpos.nodes.bringup import finding as finding_names
from relpos.nodes.cable import CablePort
from relpos.protocol import messages as wire
from support.command import relpos
from support.emulated_line import EmulatedCable, EmulatedLine

MISSING = missing_parts()
ROOT = Path(__file__).resolve().parents[2]
SPACING_M = 5.0
SEED = 3


@contextmanager
def emulated(
    monkeypatch: pytest.MonkeyPatch, *faults: str, **team: object
) -> Iterator[EmulatedLine]:
    """The port of two nodes on a bench, on whose clock the check runs."""
    config = TeamConfig("bench", 2, 120.0, SEED, faults=faults, **team)  # type: ignore[arg-type]
    with EmulatedTeam(config) as made:
        line = EmulatedLine(made)
        line.clock_of(monkeypatch, dialogue, port, bus_access, check, radio)
        made.run(3_000_000)
        yield line


@contextmanager
def checked(
    monkeypatch: pytest.MonkeyPatch, *faults: str, cable: bool = True, **team: object
) -> Iterator[NodeCheck]:
    """A check of node 1, over its cable or by radio."""
    with emulated(monkeypatch, *faults, **team) as line:
        device = plugged_in(monkeypatch, line) if cable else line
        node = open_dialogue(device, 1, Link())
        yield NodeCheck(node, cable=cable, peer=2 if cable else None, distance_m=SPACING_M)


def plugged_in(monkeypatch: pytest.MonkeyPatch, line: EmulatedLine) -> CablePort:
    """The cable of node 1."""
    with monkeypatch.context() as patched:
        patched.setattr(cable_module, "open_port", lambda _: EmulatedCable(line.team, 1))
        return CablePort("PORT")


@pytest.mark.parametrize(
    ("imu", "cable"),
    [
        ("mpu9150", False),
        ("mpu9250", True),
        pytest.param("mpu9150", True, marks=pytest.mark.soak),
        pytest.param("mpu9250", False, marks=pytest.mark.soak),
    ],
)
def test_a_healthy_node_is_right_in_every_line(
    monkeypatch: pytest.MonkeyPatch, imu: str, cable: bool
) -> None:
    with checked(monkeypatch, imu=imu, cable=cable) as node:
        findings = list(node.findings())
    assert [finding for finding in findings if finding.right is False] == []
    unchecked = [finding.part for finding in findings if finding.right is None]
    assert unchecked == ([finding_names.RADIO] if cable else [])
    parts = {finding.part for finding in findings}
    assert parts == {value for name, value in vars(finding_names).items() if name.isupper()}
    assert node.figures["range_m"] == pytest.approx(SPACING_M, abs=1.0)
    assert node.figures["sample_rate_hz"] == pytest.approx(50.0, rel=0.02)


def test_a_builder_checks_a_node_over_its_cable_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    with emulated(monkeypatch, "xbee:off:node=1") as line:
        monkeypatch.setattr(node_dialogue, "open_device", lambda *_: plugged_in(monkeypatch, line))
        done = relpos("node", "check", "PORT", "--cable")
    assert done.exit_code == 0, done.stdout + done.stderr
    assert "WRONG" not in done.stdout
    assert "started by external" in done.stdout
    assert "-      XBee radio" in done.stdout
    assert re.search("-      ranging .*--peer", done.stdout)
    assert done.stdout.endswith("node 1 is ready\n")


CASES = (
    ("imu:off", "inertial sensor", "no answer"),
    ("imu:stuck", "samples", "never change"),
    ("imu:garbage:value=random", "inertial sensor", "differently"),
    ("imu:garbage:value=zeros", "inertial sensor", "0x00"),
    ("imu:garbage:value=ones", "inertial sensor", "0xFF"),
    ("imu:wrong:value=25", "gyroscope", "at rest"),
    ("imu:slow", "samples", "2[45].* a second"),
    ("imu:delayed", "samples", "ms late"),
    ("imu:intermittent", "inertial sensor", "not answered"),
    ("imu:brownout:from=34", "inertial sensor", "has restarted"),
    ("magnetometer:off", "compass", "no answer"),
    ("magnetometer:stuck", "compass", "never change"),
    ("magnetometer:garbage:value=random", "compass", "differently"),
    ("magnetometer:wrong", "compass", "a field of"),
    ("magnetometer:slow", "compass", "not ready in time"),
    ("magnetometer:intermittent", "compass", "not answered"),
    ("pozyx:off", "Pozyx", "no answer"),
    ("pozyx:stuck", "ranging", "no new distance"),
    ("pozyx:garbage:value=random", "Pozyx", "differently"),
    ("pozyx:wrong", "ranging", "laid out: 5 m"),
    ("pozyx:slow", "ranging", "takes over"),
    ("pozyx:delayed", "ranging", "takes over"),
    ("pozyx:intermittent", "Pozyx", "not answered"),
    ("pozyx:inverted", "ranging", "success as failure"),
    ("pozyx:brownout:from=16", "Pozyx", "has restarted"),
    ("xbee:stuck", "XBee radio", "takes no command"),
    ("xbee:wrong", "XBee radio", "not confirmed"),
    ("xbee:slow", "XBee radio", "not confirmed"),
    ("xbee:delayed", "XBee radio", "round trip takes 3"),
    ("xbee:intermittent", "XBee radio", "to be repeated"),
    ("xbee:bitflip", "XBee radio", "to be repeated"),
    ("xbee:truncate", "XBee radio", "to be repeated"),
    ("xbee:duplicate", "XBee radio", "to be repeated"),
    ("xbee:brownout:from=12", "XBee radio", "unasked"),
    ("bus:stuck:line=scl", "I2C bus", "no chip answers"),
    ("bus:stuck:line=sda,from=30", "I2C bus", "failed during the check"),
    ("bus:nack", "I2C bus", "at several chips"),
    ("bus:nack:part=data", "I2C bus", "at several chips"),
)
"""A fault, and the line that names it: its part, and words of what was found."""
BY_RADIO = [case for case in CASES if case[0].startswith("xbee")]
BY_CABLE = [case for case in CASES if case not in BY_RADIO]
LATER_BY_RADIO = {"from=30": "from=34"}
"""That check takes longer."""


def find(
    monkeypatch: pytest.MonkeyPatch,
    case: tuple[str, str, str],
    imu: str = "mpu9150",
    cable: bool = True,
) -> str | None:
    """Check a node with that fault until the line comes, before which none is wrong; its remedy."""
    fault, part, words = case
    keys = fault.split(":")[2:]
    spec = ":".join((*fault.split(":")[:2], ",".join((*keys, "node=1"))))
    with checked(monkeypatch, spec, imu=imu, cable=cable) as node:
        named = next((f for f in node.findings() if f.right is False), None)
    assert named is not None
    assert named.part == part, named
    assert re.search(words, named.found), named
    assert named.remedy
    return named.remedy


@pytest.mark.parametrize("case", BY_CABLE, ids=[case[0] for case in BY_CABLE])
def test_each_fault_of_chips_and_bus_is_named(
    monkeypatch: pytest.MonkeyPatch, case: tuple[str, str, str]
) -> None:
    find(monkeypatch, case)


def test_a_gyroscope_that_the_firmware_would_never_see_at_rest_is_to_be_calibrated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    remedy = find(monkeypatch, ("imu:wrong:value=12", "gyroscope", "at rest"))
    assert remedy == "calibrate it: relpos node calibrate"


@pytest.mark.parametrize("case", BY_RADIO, ids=[case[0] for case in BY_RADIO])
def test_each_fault_of_the_radio_is_named(
    monkeypatch: pytest.MonkeyPatch, case: tuple[str, str, str]
) -> None:
    find(monkeypatch, case, cable=False)


@pytest.mark.soak
@pytest.mark.parametrize("case", BY_CABLE, ids=[case[0] for case in BY_CABLE])
def test_each_fault_of_chips_and_bus_is_named_by_radio_too(
    monkeypatch: pytest.MonkeyPatch, case: tuple[str, str, str]
) -> None:
    fault, *words = case
    for by_cable, by_radio in LATER_BY_RADIO.items():
        fault = fault.replace(by_cable, by_radio)
    find(monkeypatch, (fault, *words), cable=False)


@pytest.mark.soak
@pytest.mark.parametrize("case", [c for c in CASES if c[0].startswith(("imu", "magnetometer"))])
def test_each_fault_of_the_successor_is_named(
    monkeypatch: pytest.MonkeyPatch, case: tuple[str, str, str]
) -> None:
    find(monkeypatch, case, "mpu9250")


@pytest.mark.parametrize(("imu", "built_for"), [("mpu9250", "mpu9150"), ("mpu9150", "mpu9250")])
def test_firmware_for_the_other_sensor_is_told(
    monkeypatch: pytest.MonkeyPatch, imu: str, built_for: str
) -> None:
    with checked(monkeypatch, imu=imu, built_for=built_for) as node:
        told = next(f for f in node.findings() if f.right is False)
    assert told.part == finding_names.IMU
    assert told.remedy == f"relpos node flash --imu {imu}"


@pytest.mark.parametrize(("address", "part"), [(0x68, "inertial sensor"), (0x4B, "Pozyx")])
def test_a_chip_at_its_other_address_is_told(
    monkeypatch: pytest.MonkeyPatch, address: int, part: str
) -> None:
    with checked(monkeypatch) as node:
        cable = node._bus._dialogue._port._device  # type: ignore[attr-defined]
        chips = cable.team.nodes[1].bus.devices
        chips[address ^ 1] = chips.pop(address)
        told = next(f for f in node.findings() if f.right is False)
    assert (told.part, told.found) == (part, f"no answer at 0x{address:02X}")
    assert re.search("AD0|jumper", told.remedy)


def test_a_check_that_is_interrupted_in_the_self_tests_restarts_the_node(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with checked(monkeypatch) as node:
        device: Any = node._dialogue._port
        read, write = device.read, bus_access.BusAccess.write

        def interrupted(size: int = 1) -> bytes:
            device.read = read
            raise KeyboardInterrupt

        def begin(bus: bus_access.BusAccess, address: int, register: int, value: int) -> Any:
            done = write(bus, address, register, value)
            if (register, value) == (inertial.GYRO_CONFIG, inertial.ON):
                device.read = interrupted
            return done

        monkeypatch.setattr(bus_access.BusAccess, "write", begin)
        boot = node._dialogue.boot()
        with pytest.raises(KeyboardInterrupt):
            list(node.findings())
        assert node._dialogue.boot() != boot
        assert node._bus.byte(0x68, inertial.GYRO_CONFIG) != inertial.ON


def test_firmware_that_knows_no_transactions_is_told() -> None:
    class Old:
        node = 3

        def command(self, code: wire.CommandCode, value: int) -> Acknowledged:
            return Acknowledged(3, 1, code, wire.CommandResult.UNKNOWN_COMMAND, value)

    with pytest.raises(DeviceError, match="node flash"):
        bus_access.BusAccess(Old()).byte(0x68, 0x75)  # type: ignore[arg-type]


def test_each_fault_of_a_part_that_is_checked_has_a_test() -> None:
    tested = {":".join(case[0].split(":")[:2]) for case in CASES}
    parts = ("imu", "magnetometer", "pozyx", "xbee", "bus")
    # A module that is off, or whose line is noise, is not heard at all.
    unheard = {"xbee:off", "xbee:garbage"}
    assert tested | unheard == {fault.name for fault in FAULTS if fault.target in parts}


@pytest.mark.parametrize("fault", ["xbee:off", "xbee:garbage"])
def test_a_node_that_is_not_heard_is_told(monkeypatch: pytest.MonkeyPatch, fault: str) -> None:
    with (
        pytest.raises(DeviceError, match="node 1 is not heard"),
        checked(monkeypatch, f"{fault}:node=1", cable=False),
    ):
        pass


@pytest.mark.skipif(MISSING is not None, reason=str(MISSING))
def test_the_page_shows_a_builders_session_on_a_simulated_uno_with_weak_pull_ups(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    report = tmp_path / "report.json"
    add = EmulatedTeam._add

    def add_peer(team: EmulatedTeam, walker: Any, config: TeamConfig, errors: object) -> None:
        """The node that is only ranged with runs on this computer: half the time."""
        board = "uno" if walker.node == 1 else "native"
        add(team, walker, replace(config, board=board), errors)  # type: ignore[arg-type]

    monkeypatch.setattr(EmulatedTeam, "_add", add_peer)
    with emulated(monkeypatch) as line:
        line.team.nodes[1].bus.rise_ns = 700
        monkeypatch.setattr(node_dialogue, "open_device", lambda *_: line)
        done = relpos("node", "check", "PORT", "--node", 1, "--distance", 5, "--report", report)
    assert done.exit_code == 1
    page = (ROOT / "docs" / "nodes.md").read_text()
    shown = page.partition("<!-- check -->\n```\n")[2].partition("```\n<!-- /check -->")[0]
    # In words to the letter; figures depend on the compiler a little.
    number = re.compile(r"\d+(?:\.\d+)?")
    assert number.sub("#", done.stdout) == number.sub("#", shown)
    measured, printed = ([float(word) for word in number.findall(s)] for s in (done.stdout, shown))
    assert measured == pytest.approx(printed, rel=0.15, abs=3.0)
    written = json.loads(report.read_text())
    assert [line["part"] for line in written["findings"] if not line["right"]] == ["I2C bus"]
    # The emulated bus takes whole microseconds, of nine rises each.
    assert written["figures"]["bus_rise_ns"] == pytest.approx(700.0, abs=1000.0 / 9.0)
    for stretch_us in written["figures"]["pozyx_stretch_us"]:
        assert stretch_us == pytest.approx(FUNCTION_STRETCH_US, abs=10.0)
