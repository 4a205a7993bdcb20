"""pip, pipx and uv install from a clean clone, with everything that comes from the net."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from wheel_install import PATIENCE_S, ROOT, environment_of, run

pytestmark = pytest.mark.soak


@pytest.fixture(scope="module")
def clone(tmp_path_factory):
    """The committed state, as somebody else gets it."""
    folder = tmp_path_factory.mktemp("clone") / "relpos"
    run("git", "clone", "--quiet", ROOT, folder)
    return folder


def new_venv(folder):
    run(sys.executable, "-m", "venv", folder)
    return folder / "bin"


def works(command, folder, environment):
    """Fuse an emulated team, compiling everything anew, away from any repository."""
    out = folder / "out"
    done = run(
        command, "demo", "--nodes", 3, "--seconds", 20, "--out", out, cwd=folder, env=environment
    )
    assert "relative distance RMSE" in done.stdout
    assert (out / "index.html").is_file()
    doctor = subprocess.run(
        [command, "doctor", "--json"], cwd=folder, env=environment,
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert doctor.returncode == 0, doctor.stdout


def with_registry(environment):
    """The user's own pip settings hold for a home that is empty, too."""
    config = Path.home() / ".config" / "pip" / "pip.conf"
    return environment | ({"PIP_CONFIG_FILE": str(config)} if config.is_file() else {})


def test_pip_installs_with_every_extra(clone, tmp_path):
    environment = with_registry(environment_of(tmp_path))
    tools = new_venv(tmp_path / "venv")
    run(tools / "pip", "install", "--quiet", f"{clone}[all]", env=environment)
    works(tools / "relpos", tmp_path, environment)
    run(tools / "python", "-c", "import starlette, uvicorn, mcap, foxglove, pytak, gpxpy, segno")


def test_pipx_installs(clone, tmp_path):
    tools = new_venv(tmp_path / "venv")
    run(tools / "pip", "install", "--quiet", "pipx")
    environment = with_registry(environment_of(tmp_path)) | {
        "PIPX_HOME": str(tmp_path / "pipx"), "PIPX_BIN_DIR": str(tmp_path / "bin"),
    }  # fmt: skip
    run(tools / "pipx", "install", clone, env=environment)
    works(tmp_path / "bin" / "relpos", tmp_path, environment)


def test_uv_installs(clone, tmp_path):
    tools = new_venv(tmp_path / "venv")
    run(tools / "pip", "install", "--quiet", "uv")
    environment = environment_of(tmp_path) | {
        "UV_TOOL_DIR": str(tmp_path / "tools"), "UV_TOOL_BIN_DIR": str(tmp_path / "bin"),
        "UV_CACHE_DIR": os.environ.get("UV_CACHE_DIR", str(tmp_path / "uv")),
    }  # fmt: skip
    run(tools / "uv", "tool", "install", "--python", sys.executable, clone, env=environment)
    works(tmp_path / "bin" / "relpos", tmp_path, environment)
