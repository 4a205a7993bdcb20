"""`relpos node` from outside, through a port behind which an emulated team is."""

import json
import os
import re
import signal
import subprocess
import sys
from contextlib import contextmanager, suppress
from functools import partial

import pytest

from relpos.cli import node_dialogue, node_set, node_watch
from relpos.emulator.avr.library import missing_parts
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.link import dialogue
from relpos.link import port as link_port
from relpos.link.authentication import write_new_key
from relpos.link.port import open_port
from support.command import relpos
from support.emulated_line import EmulatedLine

RELPOS = [sys.executable, "-m", "relpos.cli.main"]


@contextmanager
def emulated(nodes, board="native", speed=4, seed=3, key=None):
    """Path of the pseudo-terminal behind which the team is."""
    command = [*RELPOS, "emulate", "--nodes", nodes, "--scenario", "straight", "--board", board]
    command += ["--speed", speed, "--seconds", 600, "--seed", seed]
    command += [] if key is None else ["--key-file", key]
    emulator = subprocess.Popen(
        [*map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        yield re.search(r"/dev/\S+", emulator.stdout.readline())[0]
    finally:
        emulator.send_signal(signal.SIGTERM)
        emulator.wait(30)


@pytest.fixture(scope="module")
def port():
    with emulated(2) as path:
        yield path


@pytest.fixture(scope="module")
def line():
    with EmulatedTeam(TeamConfig("straight", 3, 600.0, 3)) as team:
        yield EmulatedLine(team)


@pytest.fixture
def team(line, monkeypatch):
    """Name of a port behind which a team is on its own clock, which is the commands', too."""
    for module in (node_dialogue, node_set, node_watch):
        monkeypatch.setattr(module, "open_device", lambda *_: line)
    line.clock_of(monkeypatch, dialogue, link_port, node_set, node_watch)
    return line.port


node = partial(relpos, "node")


def test_list_shows_every_node(team):
    done = node("list", team, "--seconds", 14, "--json")
    assert done.exit_code == 0, done.stderr
    rows = json.loads(done.stdout)["nodes"]
    assert [row["node"] for row in rows] == [1, 2, 3]
    for row in rows:
        assert re.fullmatch(r"\d+\.\d+\.\d+", row["firmware"])
        assert row["battery_v"] == pytest.approx(5.0, abs=0.03)
        assert row["uptime_s"] >= 0
        assert -100 < row["rssi_dbm"] < -20
    table = node("list", team, "--seconds", 14).stdout
    assert "firmware" in table
    assert "power on" in table


def test_monitor_prints_plain_tables_where_there_is_no_terminal(team):
    done = node("monitor", team, "--seconds", 8)
    assert done.exit_code == 0, done.stderr
    assert done.stdout.count("neighbours") == 2  # one while it runs, one at the end
    assert "\x1b" not in done.stdout
    assert re.search(r"5\.0\d V", done.stdout)


def test_monitor_is_a_live_table_on_a_terminal(port):
    screen, terminal = os.openpty()
    try:
        done = subprocess.Popen(
            [*RELPOS, "node", "monitor", port, "--seconds", "3"],
            stdout=terminal,
            stderr=subprocess.PIPE,
            env={**os.environ, "TERM": "xterm", "COLUMNS": "120"},
        )
        os.close(terminal)
        shown = bytearray()
        with suppress(OSError):  # the terminal's end
            while data := os.read(screen, 4096):
                shown += data
        assert done.wait(30) == 0, done.stderr.read()
    finally:
        os.close(screen)
        done.stderr.close()
    text = shown.decode(errors="replace")
    assert text.count("neighbours") > 3  # drawn again and again
    assert "\x1b[" in text
    assert re.search(r"5\.0\d V", text)


def test_settings_are_shown_before_and_after_and_survive_a_restart(team):
    done = node("set", team, "--node", 2, "stature", 1.9, "led", "off", "ranging-period=4")
    assert done.exit_code == 0, done.stderr
    assert re.search(r"led\W+health\W+off", done.stdout)
    assert re.search(r"ranging-period\W+2 s\W+4 s", done.stdout)
    rebooted = node("reboot", team, "--node", 2)
    assert rebooted.exit_code == 0, rebooted.stderr
    assert "has restarted" in rebooted.stdout
    shown = node("set", team, "--node", 2).stdout
    assert re.search(r"leg-length\W+1\.007 m", shown)
    assert re.search(r"led\W+off", shown)
    assert re.search(r"ranging-period\W+4 s", shown)
    assert "stature" not in shown


@pytest.mark.soak
def test_a_number_is_changed_over_the_air_though_the_radio_keeps_its_address():
    with emulated(2, speed=8) as path:
        done = node("set", path, "--node", 2, "id", 7, "led=off")
        assert done.exit_code == 0, done.stderr
        assert re.search(r"id\W+2\W+7", done.stdout)
        assert "relpos node radio --node 7" in done.stdout
        shown = node("set", path, "--node", 7)
        assert shown.exit_code == 0, shown.stderr
        assert re.search(r"led\W+off", shown.stdout)
        taken = node("set", path, "--node", 7, "id", 1)
        assert taken.exit_code == 1
        assert "there is a node 1 already" in taken.stderr


def test_a_first_key_needs_the_cable(team, tmp_path):
    done = node("set", team, "key", "--key-file", tmp_path / "team.key", "--new")
    assert done.exit_code == 1
    assert "by radio everybody could read its first one" in done.stderr.replace("\n", " ")
    assert not (tmp_path / "team.key").exists()


@pytest.mark.soak
def test_a_team_gets_a_new_key_in_one_step_and_is_asked_for_it(tmp_path):
    old, file = tmp_path / "old.key", tmp_path / "team.key"
    write_new_key(old)
    with emulated(2, key=old) as path:
        change = ("set", path, "key", "--key-file", file, "--old-key-file", old)
        done = node(*change, "--new")
        assert done.exit_code == 0, done.stderr
        assert file.stat().st_mode & 0o777 == 0o600
        assert done.stdout.count("answers under it") == 2
        assert "by cable" in done.stderr
        again = node(*change)
        assert again.stdout.count("already") == 2
        stranger = node("set", path, "--node", 1)
        assert stranger.exit_code == 1
        assert "--key-file" in stranger.stderr
        shown = node("set", path, "--node", 2, "--key-file", file)
        assert shown.exit_code == 0, shown.stderr
        assert "leg-length" in shown.stdout
        unheard = node("list", path, "--seconds", 3)
        assert unheard.exit_code == 1
        assert "under another key" in unheard.stderr
        assert file.read_text().strip() not in done.stdout + done.stderr
        listed = node("list", path, "--seconds", 5, "--key-file", file, "--json")
        assert [row["key_set"] for row in json.loads(listed.stdout)["nodes"]] == [True, True]
        overwritten = node(*change, "--new")
        assert overwritten.exit_code == 1
        assert "not overwritten" in overwritten.stderr
        renamed = node("set", path, "--node", 2, "--key-file", file, "id", 7)
        assert renamed.exit_code == 0, renamed.stderr
        assert node("set", path, "--node", 7, "--key-file", file).exit_code == 0


@pytest.mark.soak
def test_defaults_leave_number_and_key():
    with emulated(1) as path:
        assert node("set", path, "step-gain", 2.5, "range-offset=-0.25").exit_code == 0
        done = node("set", path, "defaults")
        assert done.exit_code == 0, done.stderr
        assert re.search(r"step-gain\W+2\.5\W+2\.13", done.stdout)
        assert re.search(r"range-offset\W+-0\.25 m\W+0 m", done.stdout)


@pytest.mark.soak
@pytest.mark.skipif(missing_parts() is not None, reason=str(missing_parts()))
def test_the_uno_keeps_its_settings_over_a_restart():
    with emulated(1, board="uno", speed=2) as path:
        listed = json.loads(node("list", path, "--seconds", 6, "--json").stdout)["nodes"]
        assert [row["node"] for row in listed] == [1]
        assert listed[0]["battery_v"] == pytest.approx(5.0, abs=0.03)
        assert node("set", path, "led", "on", "step-gain", "2.2").exit_code == 0
        rebooted = node("reboot", path)
        assert rebooted.exit_code == 0, rebooted.stderr
        shown = node("set", path).stdout
    assert re.search(r"led\W+on", shown)
    assert re.search(r"step-gain\W+2\.2", shown)


@pytest.mark.parametrize(
    "arguments",
    [
        ("list", "/dev/nowhere"),
        ("monitor", "/dev/nowhere"),
        ("set", "/dev/nowhere", "led", "on"),
        ("reboot", "/dev/nowhere"),
    ],
)
def test_a_port_that_is_none_is_reported_in_one_line(arguments):
    done = node(*arguments)
    assert done.exit_code == 1
    assert "cannot open" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_port_that_another_program_has_is_reported(port):
    first = open_port(port)
    try:
        done = node("list", port)
    finally:
        first.close()
    assert done.exit_code == 1
    assert "another program has it open" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_several_nodes_want_a_choice(team):
    done = node("reboot", team)
    assert done.exit_code == 1
    assert "Heard: 1, 2, 3" in done.stderr


def test_a_value_that_will_not_do_is_wrong_usage(team):
    done = node("set", team, "--node", 2, "led", "blue")
    assert done.exit_code == 2
    assert "off, on, health" in done.stderr


def test_calibrate_shows_its_forms():
    help_text = node("calibrate", "--help").stdout
    for command in ("sensors", "walk", "antenna"):
        assert command in help_text
    assert "--distance" in node("calibrate", "walk", "--help").stdout
    assert "--magnetometer" in node("calibrate", "/dev/x", "--help").stdout
