"""`relpos doctor`: what it says of a computer and a port that are not as they should be."""

import json
import os
import subprocess
import sys
import time
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import pytest

from relpos import extras
from relpos.doctor import devices, installation
from relpos.doctor.computer import Computer, SerialPort
from relpos.emulator.pty import PseudoTerminal
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.emulator.xbee import XbeeModule
from relpos.errors import DeviceError
from relpos.fusion import ROOMS, kernel_cache
from relpos.link import xbee
from relpos.link.authentication import write_new_key
from relpos.nodes import radio
from support.command import relpos
from support.pulled_out import pulled_out

PORT = "/dev/ttyUSB0"
CH340 = SerialPort(PORT, "USB Serial", 0x1A86, 0x7523)


class Pretended(Computer):
    """A well-kept laptop; attributes say what is different."""

    platform = "linux"
    commands = ("g++", "pio", "avr-gcc", "avrdude", "firefox")
    running = ("systemd",)
    listed = (CH340,)
    usable = True
    group = "dialout"
    joined = False
    held = ()
    free = 50_000_000_000
    writable = True
    time = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)
    answers: dict[str, str] = {}  # noqa: RUF012
    variables = {"DISPLAY": ":0"}  # noqa: RUF012

    def __init__(self, **differences):
        for name, value in differences.items():
            assert hasattr(self, name), name
            setattr(self, name, value)

    def which(self, name):
        return f"/usr/bin/{name}" if name in self.commands else None

    def output_of(self, *command):
        return next((answer for words, answer in self.answers.items() if words in command), "")

    def processes(self):
        return dict(enumerate(self.running, 1))

    def holders(self, device):
        return list(self.held)

    def ports(self):
        return list(self.listed)

    def exists(self, device):
        return any(p.device == device for p in self.listed)

    def may_use(self, device):
        return self.usable

    def group_of(self, device):
        return self.group

    def has_group_after_login(self, group):
        return self.joined

    def user(self):
        return "kim"

    def free_bytes(self, folder):
        return self.free

    def may_write(self, folder):
        return self.writable

    def now(self):
        return self.time

    def environment(self, name):
        return self.variables.get(name, "")


def finding(findings, name):
    """(state, words, remedy) of the only finding of that name."""
    (found,) = (f for f in findings if f.name == name)
    assert "\n" not in found.words + found.remedy
    return str(found.state), found.words, found.remedy


def installed(tmp_path, key_file=None, **differences):
    return list(installation.look(Pretended(**differences), key_file, tmp_path))


def ports(port=None, **differences):
    # The doctor does not open an unusable port.
    return list(devices.look(Pretended(**differences), port, lambda *_: pytest.fail("opened")))


# -- the installation ------------------------------------------------------------------------------


def test_a_missing_extra_is_a_hint_with_the_line_that_installs_it(tmp_path, monkeypatch):
    lacking = {"view": ["starlette>=0.40"]}
    monkeypatch.setattr(extras, "missing", lambda extra: lacking.get(extra, []))
    findings = installed(tmp_path)
    state, words, remedy = finding(findings, "extra view")
    assert state == "hint"
    assert "live page" in words
    assert remedy.endswith("-m pip install 'starlette>=0.40'")
    assert finding(findings, "extra recording")[0] == "well"


@pytest.mark.parametrize(
    ("missing", "name", "remedy"),
    [("g++", "g++", "g++"), ("pio", "PlatformIO", "pipx install platformio"),
     ("avr-gcc", "avr-gcc", "gcc-avr"), ("avrdude", "avrdude", "avrdude")],
)  # fmt: skip
def test_a_missing_tool_is_a_hint_with_its_package(missing, name, remedy, tmp_path, monkeypatch):
    monkeypatch.setattr("relpos.paths.firmware_project", lambda: tmp_path)
    commands = tuple(c for c in Pretended.commands if c != missing)
    state, _, remedy_text = finding(installed(tmp_path, commands=commands), name)
    assert state == "hint"
    assert remedy in remedy_text
    assert finding(installed(tmp_path), name)[0] == "well"


def test_kernels_are_ready_once_every_room_has_been_compiled(tmp_path):
    environment = {"NUMBA_CACHE_DIR": str(tmp_path)}
    state, _, remedy = finding(installed(tmp_path, variables=environment), "estimators")
    assert (state, remedy) == ("hint", "relpos doctor --prepare")
    rooms = {room for named in ROOMS.values() for room in named}
    for room in rooms:
        folder = kernel_cache.folder(kernel_cache.FUSION / room, tmp_path)
        folder.mkdir()
        (folder / "complete").touch()
    assert finding(installed(tmp_path, variables=environment), "estimators")[0] == "well"


def test_kernels_that_cannot_be_kept_are_wrong(tmp_path):
    state, _, remedy = finding(installed(tmp_path, writable=False), "estimators")
    assert state == "wrong"
    assert "NUMBA_CACHE_DIR" in remedy


@pytest.mark.parametrize("disk", ["read-only", "full"])
def test_kernels_that_a_home_refuses_are_wrong(tmp_path, disk):
    full = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
    if disk == "read-only":
        (tmp_path / "home").touch()  # no folder can be made in it, not even by root
    program = (full if disk == "full" else "") + (
        "from pathlib import Path\nfrom relpos.doctor import computer, installation\n"
        "print(*installation.look(computer.Computer(), None, Path('.')), sep='\\n')\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=environment | {"XDG_CACHE_HOME": str(tmp_path / "home")},
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    assert f"cannot be stored in {tmp_path}/home/relpos/kernels" in done.stdout


def test_a_folder_in_another_user_s_closed_folder_cannot_be_written(monkeypatch):
    def closed(path):
        if path != Path("/closed") and path != Path("/"):
            raise PermissionError(path)
        return True

    monkeypatch.setattr(Path, "exists", closed)
    monkeypatch.setattr(Path, "is_dir", lambda _: True)
    monkeypatch.setattr(os, "access", lambda path, _: path == Path("/"))
    assert not Computer().may_write(Path("/closed/folder/of/records"))


def test_processes_whose_names_are_cut_amid_a_letter_are_listed(tmp_path):
    program = tmp_path / ("ü" * 9)
    program.symlink_to("/bin/sleep")
    with subprocess.Popen([program, "60"]) as process:
        try:
            until_s = time.monotonic() + 10.0
            # A process has its program's name a moment after it has begun.
            while "üüü" not in (name := Computer().processes()[process.pid]):
                assert time.monotonic() < until_s, name
        finally:
            process.kill()


def test_the_program_that_has_a_file_open_is_found_among_all(tmp_path):
    with (tmp_path / "port").open("w"):
        (holder,) = Computer().holders(str(tmp_path / "port"))
    assert holder.endswith(f" ({os.getpid()})")
    assert Computer().holders(str(tmp_path / "port")) == []


def test_a_command_that_fails_has_said_nothing():
    assert Computer().output_of("sh", "-c", "echo heard") == "heard\n"
    assert Computer().output_of("sh", "-c", "echo heard; exit 1") == ""
    assert Computer().output_of("/no/such/command") == ""


def test_a_compiler_of_ones_own_is_looked_for(tmp_path):
    _, words, _ = finding(installed(tmp_path, variables={"CXX": "clang++"}), "g++")
    assert "clang++ is missing" in words


def test_the_key_has_to_be_one_and_to_be_the_owners_alone(tmp_path):
    assert finding(installed(tmp_path), "team's key")[0] == "hint"
    key = tmp_path / "team.key"
    state, words, _ = finding(installed(tmp_path, key), "team's key")
    assert (state, "no key can be read" in words) == ("wrong", True)
    write_new_key(key)
    assert finding(installed(tmp_path, key), "team's key")[0] == "well"
    key.chmod(0o644)
    state, _, remedy = finding(installed(tmp_path, key), "team's key")
    assert (state, remedy) == ("wrong", f"chmod 600 {key}")
    key.chmod(0o600)
    (tmp_path / "team.key.seen").write_text("garbage")
    assert finding(installed(tmp_path, key), "team's key")[0] == "wrong"


@pytest.mark.parametrize(
    ("free", "state"), [(10_000_000, "wrong"), (1_000_000_000, "hint"), (5_000_000_000, "well")]
)
def test_free_space_for_recordings_is_checked(free, state, tmp_path):
    assert finding(installed(tmp_path, free=free), "room for recordings")[0] == state


def test_a_folder_that_cannot_be_written_is_wrong(tmp_path):
    assert finding(installed(tmp_path, writable=False), "room for recordings")[0] == "wrong"


def test_a_missing_browser_or_screen_is_a_hint_that_names_alternatives(tmp_path):
    for differences in ({"commands": ()}, {"variables": {}}):
        state, words, _ = finding(installed(tmp_path, **differences), "browser")
        assert state == "hint"
        assert "--view-listen" in words
        assert "--terminal" in words
    for differences in (
        {"variables": {"WAYLAND_DISPLAY": "w"}},
        {"platform": "darwin", "commands": ()},
    ):
        assert finding(installed(tmp_path, **differences), "browser")[0] == "well"


def test_a_clock_before_the_counters_is_wrong_and_an_unsynchronised_one_is_a_hint(tmp_path):
    early = datetime(1970, 1, 1, tzinfo=UTC)
    assert finding(installed(tmp_path, time=early), "clock")[0] == "wrong"
    answers = {"timedatectl": "NTPSynchronized=no\n"}
    assert finding(installed(tmp_path, answers=answers), "clock")[0] == "hint"
    state, words, _ = finding(installed(tmp_path), "clock")
    assert state == "well"
    assert "2026-11-21 12:00:00, UTC (UTC+00:00)" in words


# -- ports -----------------------------------------------------------------------------------------


def test_every_port_on_usb_is_named_with_its_adapter():
    state, words, _ = finding(ports(), f"port {PORT}")
    assert state == "well"
    assert "CH340" in words


def test_no_port_is_a_hint_unless_one_was_named():
    assert finding(ports(listed=()), "serial ports")[0] == "hint"
    state, words, _ = finding(ports("/dev/ttyUSB1"), "port /dev/ttyUSB1")
    assert state == "wrong"
    assert f"plugged in: {PORT}" in words


@pytest.mark.parametrize(
    ("differences", "remedy"),
    [({}, "sudo usermod -aG dialout kim, then log out and in"),
     ({"joined": True}, "log out and in"), ({"group": "root"}, f"sudo chmod a+rw {PORT}")],
)  # fmt: skip
def test_a_port_that_may_not_be_used_is_wrong(differences, remedy):
    state, _, remedy_text = finding(ports(PORT, usable=False, **differences), f"port {PORT}")
    assert state == "wrong"
    assert remedy_text.startswith(remedy)


def test_the_program_that_holds_a_port_is_named():
    state, words, _ = finding(ports(PORT, held=["screen (42)"]), f"port {PORT}")
    assert state == "wrong"
    assert "screen (42)" in words


def test_services_that_take_new_ports_are_named():
    found = ports(running=("ModemManager", "brltty"))
    assert finding(found, "ModemManager")[0] == "hint"
    assert finding(found, "brltty")[0] == "wrong"
    for what in ("DEVICE", "PORT"):
        answers = {"udevadm": f"ID_MM_{what}_IGNORE=1\n"}
        ignored = ports(running=("ModemManager",), answers=answers)
        assert [f.name for f in ignored] == [f"port {PORT}"]


# -- the module ------------------------------------------------------------------------------------


class Wire:
    """A serial port with a module behind it, or with nothing."""

    def __init__(self, module, port, baud):
        self.module, self.port, self.baudrate = module, port, baud
        self.waiting = bytearray()
        self.closed = False

    @property
    def in_waiting(self):
        return len(self.waiting)

    def read(self, size):
        if not self.waiting:
            time.sleep(0.005)  # a port waits for its bytes
        data = bytes(self.waiting[:size])
        del self.waiting[:size]
        return data

    def reset_input_buffer(self):
        self.waiting.clear()

    def write(self, data):
        if self.module is not None:
            self.module.on_serial = lambda _, answer: self.waiting.extend(answer)
            self.module.from_serial(0, data)

    def close(self):
        self.closed = True


def coordinator_finding(changes, monkeypatch):
    """Return the finding for a coordinator with these settings; None: nothing answers."""
    monkeypatch.setattr("relpos.nodes.radio.GUARD_S", 0.001)
    monkeypatch.setattr("relpos.nodes.radio.ANSWER_S", 0.01)
    module = None
    if changes is not None:
        module = XbeeModule(0, 1, None, lambda *_: None)
        for command, value in changes.items():
            module.from_serial(0, xbee.encode(xbee.AtCommand(0, command, value)))
    opened = []

    def open_port(port, baud):
        opened.append(Wire(module, port, baud))
        return opened[-1]

    found = list(devices.look(Pretended(), PORT, open_port))
    assert opened
    assert all(wire.closed for wire in opened)
    return finding(found, "coordinator")


def test_a_module_that_is_set_up_is_well(monkeypatch):
    assert coordinator_finding({}, monkeypatch)[0] == "well"


def test_each_setting_that_differs_is_named_with_the_command_that_sets_it(monkeypatch):
    state, words, remedy = coordinator_finding({b"MY": b"\x00\x07", b"SM": b"\x04"}, monkeypatch)
    assert state == "wrong"
    assert "MY=7 instead of 0" in words
    assert "SM=4 instead of 0" in words
    assert remedy == f"relpos node radio {PORT} --coordinator"


def test_another_network_is_a_hint(monkeypatch):
    state, words, _ = coordinator_finding({b"ID": b"\x12\x34"}, monkeypatch)
    assert state == "hint"
    assert "ID=1234 instead of 3332" in words


def test_a_module_from_the_shelf_is_wrong(monkeypatch):
    class Shelf:
        def from_serial(self, _, data):
            if data == b"+++":
                self.on_serial(0, b"OK\r")

    monkeypatch.setattr(radio, "GUARD_S", 0.001)
    monkeypatch.setattr(radio, "ANSWER_S", 0.01)
    state, words, remedy = finding(
        devices.look(Pretended(), PORT, partial(Wire, Shelf())), "coordinator"
    )
    assert state == "wrong"
    assert "without API frames: factory settings" in words
    assert remedy == f"relpos node radio {PORT} --coordinator"


def test_a_port_with_no_module_is_wrong(monkeypatch):
    state, words, _ = coordinator_finding(None, monkeypatch)
    assert state == "wrong"
    assert "no XBee module answers" in words


def test_a_port_that_does_not_open_is_wrong():
    def open_port(port, baud):
        raise DeviceError(f"{port}: cannot open the serial port: another program has it open")

    found = list(devices.look(Pretended(), PORT, open_port))
    assert finding(found, "coordinator")[:2] == (
        "wrong", f"{PORT}: cannot open the serial port: another program has it open",
    )  # fmt: skip


def test_an_adapter_that_is_pulled_out_meanwhile_is_wrong(monkeypatch):
    monkeypatch.setattr(radio, "GUARD_S", 0.01)
    with pulled_out() as path:
        computer = Pretended(listed=(SerialPort(path, "", None, None),))
        state, words, _ = finding(devices.look(computer, path), "coordinator")
    assert state == "wrong"
    assert f"{path}: the port vanished" in words


# -- the command -----------------------------------------------------------------------------------


doctor = partial(relpos, "doctor")


def test_an_emulated_coordinator_is_well_for_the_command(tmp_path):
    with EmulatedTeam(TeamConfig("paper", 1, 60.0, 1)) as team, PseudoTerminal(team) as terminal:
        terminal.start()
        report = json.loads(doctor(terminal.path, "--out", str(tmp_path), "--json").stdout)
    assert [f["state"] for f in report["findings"] if f["name"] == "coordinator"] == ["well"]


def test_the_exit_status_is_1_where_something_is_wrong(tmp_path, monkeypatch):
    monkeypatch.setattr("relpos.doctor.computer.Computer", partial(Pretended, listed=()))
    fine = doctor("--out", str(tmp_path))
    assert fine.exit_code == 0, fine.output
    assert fine.output.splitlines()[-1].startswith("nothing wrong")
    bad = doctor(PORT, "--out", str(tmp_path))
    assert bad.exit_code == 1
    assert "wrong  port /dev/ttyUSB0" in bad.output
    assert bad.output.splitlines()[-1].startswith("1 wrong")
    report = json.loads(doctor(PORT, "--out", str(tmp_path), "--json").stdout)
    assert report["well"] is False
