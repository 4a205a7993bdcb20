"""The wheel: what is in it, and that its commands work where there is no repository."""

import json
import os
import re
import signal
import subprocess
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest
from wheel_install import (
    PATIENCE_S,
    ROOT,
    build_wheel,
    environment_of,
    install_beside_our_libraries,
    run,
    share_compiled_firmware,
)

from relpos import __version__


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def names(wheel):
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


@pytest.fixture(scope="module")
def elsewhere(wheel, tmp_path_factory):
    """(relpos, folder, environment) of an installation that knows no repository."""
    folder = tmp_path_factory.mktemp("elsewhere")
    command = install_beside_our_libraries(wheel, folder / "venv")
    environment = environment_of(folder)
    share_compiled_firmware(environment)

    def relpos(*arguments):
        return run(command, *arguments, cwd=folder, env=environment)

    return relpos, folder, environment


def test_everything_of_the_package_is_in_the_wheel_and_nothing_else(names):
    package = ROOT / "host" / "relpos"
    left_out = ("emulator/avr/simavr_shim/", "emulator/avr/README.md")
    wanted = set()
    for folder, _, files in os.walk(package, followlinks=True):
        for file in files:
            path = (Path(folder) / file).relative_to(package).as_posix()
            if "__pycache__" not in path and not path.startswith(left_out):
                wanted.add(f"relpos/{path}")
    shipped = {n for n in names if ".dist-info/" not in n and "/firmware_project/" not in n}
    assert shipped == wanted
    assert "relpos/protocol/messages.py" in shipped


def test_the_firmware_is_in_the_wheel_as_a_platformio_project(names):
    project = "relpos/firmware_project/"
    sources = {
        p.relative_to(ROOT).as_posix()
        for p in (ROOT / "firmware").rglob("*")
        if p.is_file() and "__pycache__" not in p.parts
    }
    assert {n.removeprefix(project) for n in names if n.startswith(project)} == sources | {
        "platformio.ini"
    }


def test_no_file_under_the_gpl_is_in_the_wheel(wheel):
    with zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            if not name.endswith(("METADATA", "RECORD")):
                assert not re.search(rb"SPDX-License-Identifier: .*GPL", archive.read(name)), name


def test_the_wheel_names_version_licence_python_and_extras(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith("METADATA"))
        metadata = Parser().parsestr(archive.read(name).decode())
    assert metadata["Version"] == __version__
    assert metadata["License-Expression"] == "MIT"
    assert metadata["Requires-Python"] == ">=3.11"
    extras = set(metadata.get_all("Provides-Extra"))
    assert {"view", "recording", "exchange", "bench", "docs", "test", "all"} <= extras


def test_the_commands_work_away_from_the_repository(elsewhere):
    relpos, folder, _ = elsewhere
    assert relpos("--version").stdout.strip() == f"relpos {__version__}"
    relpos("simulate", "--scenario", "paper", "--seed", 1, "--set", "seconds=20", "--out", "walk")
    done = relpos(
        "fuse", "walk", "--estimator", "deadreckoning", "--no-report", "--json", "--out", "fused"
    )
    assert json.loads(done.stdout)["relative_distance_rmse_m"] > 0.0
    assert (folder / "fused" / "estimate.csv").is_file()


def test_emulated_nodes_run_away_from_the_repository(elsewhere):
    relpos, folder, environment = elsewhere
    emulated = subprocess.Popen(
        [
            folder / "venv" / "bin" / "relpos",
            *("emulate", "--nodes", "2", "--speed", "2", "--seconds", "60"),
        ],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        assert emulated.stdout is not None
        port = emulated.stdout.readline().split()[-1]
        listing = json.loads(relpos("node", "list", port, "--seconds", 3, "--json").stdout)
    finally:
        emulated.terminate()
        emulated.wait(PATIENCE_S)
    assert [node["node"] for node in listing["nodes"]] == [1, 2]
    assert (folder / "cache" / "relpos" / "native").is_dir()
    built = list((folder / "venv").rglob("relpos-node-*.so"))
    assert not built, "an installed package's folder may be read-only"


def test_simulated_boards_are_refused_in_one_line_where_their_shim_is_not(elsewhere):
    _, folder, environment = elsewhere
    done = subprocess.run(
        [folder / "venv" / "bin" / "relpos", "demo", "--board", "uno", "--seconds", "10"],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 1
    assert done.stdout == ""
    # Where it takes longer, it says before that it works.
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("relpos: ")]
    assert "Traceback" not in done.stderr
    assert "repository" in line
    assert "--board native" in line
