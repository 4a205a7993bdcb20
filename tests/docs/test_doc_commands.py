"""Every command of README and the pages works as it stands there."""

import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections import defaultdict
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from doc_commands import (
    OTHERS,
    PAGES,
    PARSED,
    PORTS,
    ROOT,
    SHORTER,
    commands,
    mentions,
    program,
    shortened,
    subcommand,
    unknown_options,
    why_only_parsed,
)

from relpos.emulator.pty import PseudoTerminal
from relpos.simulation.team import make_team
from relpos.simulation.walker import RATE_HZ
from support.command import relpos

PATIENCE_S = 120
STANDS_FOR = (
    (re.compile(r"^(path/to|\.\./shared/data)/(two_robots_vio|four_robots_uwb)/\w+$"), "RUN"),
    (re.compile(r"^path/to/walk$"), "WALK"),
    (re.compile(r"^out/exp1_los$"), "DIR"),
    # The usual port may be another session's.
    (re.compile(r"^(0\.0\.0\.0|127\.0\.0\.1)(:\d+)?$"), r"\1:0"),
)


def with_things(words, port):
    """The command with what the reader has in place of its names for it."""
    given = []
    for word in words:
        if PORTS.match(word):
            word = port
        for pattern, name in STANDS_FOR:
            word = pattern.sub(name, word)
        given.append(word)
    return given


PLACES = defaultdict(list)
for _page in PAGES:
    for _command in commands(_page):
        PLACES[_command.words].append(_command)
SHOWN = [found[0] for found in PLACES.values()]
OURS = [c for c in SHOWN if program(c.words) == "relpos"]
# Once, however the port and the recording are called.
RUN = list(
    {
        tuple(with_things(c.words[1:], "PORT")): c
        for c in reversed(OURS)
        if why_only_parsed(c.words) is None
    }.values()
)[::-1]
THEIRS = [c for c in SHOWN if program(c.words) != "relpos"]
MENTIONED = sorted({c.words: c for page in PAGES for c in mentions(page)}.values(), key=str)


@contextmanager
def emulated(*arguments):
    """The port that `relpos emulate` prints."""
    process = subprocess.Popen(
        [sys.executable, "-m", "relpos.cli.main", "emulate", *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    try:
        port = re.search(r"/dev/\S+", process.stdout.readline())
        assert port, process.stderr.read()
        yield port[0]
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE_S)
    finally:
        process.kill()


@pytest.fixture(scope="module")
def port():
    """An emulated team behind it, at several times real time."""
    with emulated("--nodes", "3", "--speed", "3", "--seconds", "600") as path:
        yield path


@pytest.fixture(scope="module")
def radio():
    """A coordinator's module that may be set up anew."""
    with emulated("--nodes", "1", "--seconds", "600") as path:
        yield path


@pytest.fixture(scope="module")
def belongings(tmp_path_factory):
    """What a reader has: a run with truth, an estimate of it, a recorded walk, a key."""
    folder = tmp_path_factory.mktemp("belongings")
    made = relpos("simulate", "--scenario", "paper", "--seed", 1, "--out", folder / "RUN",
                  "--set", "seconds=20", "--set", "nodes=3")  # fmt: skip
    assert made.exit_code == 0, made.output
    fused = relpos("fuse", folder / "RUN", "--out", folder / "DIR", "--no-report")
    assert fused.exit_code == 0, fused.output
    walker = make_team("paper", 1, 20.0, 1)[0][0]
    times_s = np.arange(20 * RATE_HZ) / RATE_HZ
    columns = (walker.specific_force_m_s2, walker.angular_rate_rad_s, walker.magnetic_field_ut)
    (folder / "WALK").mkdir()
    write_imu(folder / "WALK", times_s, [c[: len(times_s)] for c in columns])
    shutil.copytree(folder / "RUN", folder / "walk")
    write_others_files(folder)
    shutil.copytree(ROOT / "docs" / "examples", folder / "docs" / "examples")
    key = folder / "team.key"
    key.write_text("00" * 16 + "\n")
    key.chmod(0o600)
    return folder


def write_others_files(folder):
    """Another tool's trajectories, a recording, a watch's track, presses, surveyed landmarks."""
    pin = ("--pin", "48.13713,11.57538,90", "--start", "2026-05-04T09:30:00Z")
    for words in (
        ("DIR", "--to", "tum", "--out", "slam"),
        ("RUN", "--to", "mcap", "--out", "FILE.mcap"),
        ("RUN", "--to", "gpx", *pin, "--out", "watch.gpx"),
    ):
        source, *options, out = words
        made = relpos("convert", folder / source, *options, folder / out)
        assert made.exit_code == 0, made.output
    watch = (folder / "watch.gpx").read_text()
    first, *_, last = watch.split("<trk>")
    (folder / "watch.gpx").write_text(f"{first}<trk>{last}")
    shutil.copy(folder / "slam" / "estimate_2.tum", folder / "mocap.tum")
    shutil.copytree(folder / "RUN", folder / "PRESSED")
    (folder / "PRESSED" / "truth.csv").unlink()
    (folder / "PRESSED" / "events.csv").write_text("time_s,node,event,value\n5,1,landmark,17\n")
    (folder / "landmarks.csv").write_text("id,x_m,y_m\n17,3.5,0\n")


def write_imu(folder, times_s, columns):
    header = "time_s,node,ax_m_s2,ay_m_s2,az_m_s2,gx_rad_s,gy_rad_s,gz_rad_s,mx_ut,my_ut,mz_ut"
    rows = np.column_stack([times_s, np.ones_like(times_s), *columns])
    np.savetxt(folder / "imu.csv", rows, delimiter=",", header=header, comments="", fmt="%.9g")


@pytest.fixture
def scratch(belongings, tmp_path, monkeypatch):
    """A directory of its own to run a command in, with everything that commands name."""
    for thing in belongings.iterdir():
        copy = shutil.copytree if thing.is_dir() else shutil.copy2
        copy(thing, tmp_path / thing.name)
    monkeypatch.chdir(tmp_path)
    for name in ("NO_COLOR", "RELPOS_KEY_FILE"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


def test_there_are_commands_to_check():
    assert len(OURS) > 30
    assert len(RUN) > 15
    assert len(THEIRS) > 5


@pytest.mark.parametrize("command", SHOWN, ids=str)
def test_a_shown_command_is_in_a_class(command):
    name = program(command.words)
    assert name == "relpos" or name in OTHERS, (
        f"{command}: say in tests/docs/doc_commands.py what is done with `{name}`"
    )


@pytest.mark.parametrize("command", OURS, ids=str)
def test_a_shown_command_is_understood_by_the_command_line(command):
    name, parsed, rest = subcommand(with_things(command.words, "/dev/ttyUSB0"))
    assert name or rest, command
    if not name or "--help" in rest:
        return
    with parsed.make_context(f"relpos {name}", rest, resilient_parsing=False) as context:
        assert context.params


@pytest.mark.parametrize("command", [*SHOWN, *MENTIONED], ids=str)
def test_every_option_exists(command):
    if program(command.words) == "relpos":
        assert not unknown_options(command.words), command


@pytest.mark.parametrize("command", THEIRS, ids=str)
def test_commands_of_other_programs_name_what_is_there(command):
    _, check = OTHERS[program(command.words)]
    assert check(command.words), command


def options_of(command):
    """What a command exercises: name, kind of its source, options, and values that matter."""
    words = with_things(command.words, "PORT")
    name, _, rest = subcommand(words)
    options = {word for word in rest if word.startswith("--")}
    kinds = {rest[k + 1] for k, word in enumerate(rest) if word in DECISIVE}
    source = next((word for word in rest if word in SOURCES), "")
    return name, source, options - COSTLESS, kinds


DECISIVE = {"--to", "--as", "--estimator"}
"""Options whose values decide what is done."""
SOURCES = {"PORT", "FILE.mcap", "mocap.tum", "watch.gpx", "PRESSED"}
"""Kinds of arguments that are read in different ways."""
COSTLESS = {"--out", "--seed"}
"""Options that nearly every command has."""


def runs_in_soak(command):
    """Whether another shown command does all that this one does."""
    name, source, options, kinds = options_of(command)
    for other in RUN:
        beside = options_of(other)
        if beside[:2] != (name, source) or other is command:
            continue
        more = options < beside[2] and kinds <= beside[3]
        alike = (options, kinds) == beside[2:] and RUN.index(other) < RUN.index(command)
        if more or alike:
            return True
    return False


@pytest.mark.parametrize(
    "command",
    [pytest.param(c, marks=[pytest.mark.soak] if runs_in_soak(c) else []) for c in RUN],
    ids=str,
)
@pytest.mark.usefixtures("scratch")
def test_a_shown_command_runs(command, port, radio, monkeypatch):
    name, _, _ = subcommand(command.words)
    if name == "emulate":  # serves until Ctrl-C, as the one behind `port` does
        monkeypatch.setattr(PseudoTerminal, "serve", lambda _: None)
    if "--install-completion" in command.words:  # into the start-up file of whatever shell
        monkeypatch.setenv("HOME", str(Path.cwd()))
        monkeypatch.setattr("shellingham.detect_shell", lambda: ("bash", "/bin/bash"))
    words = with_things(shortened(command.words), radio if name == "node radio" else port)
    done = relpos(*words[1:])
    assert done.exit_code == 0, f"{shlex.join(words)}\n{done.output}"


def test_every_exception_is_still_needed():
    names = [subcommand(c.words)[0] for c in OURS]
    assert not [known for known in PARSED if not any(n.startswith(known) for n in names)]
    assert not [known for known in SHORTER if known.split(" PORT")[0] not in names]
