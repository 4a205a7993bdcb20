"""What make does with a .venv that leads nowhere; what pip installs is left out."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
WITHOUT_PIP = f"""#!/bin/sh
[ "$1" != -m ] || set -- "$@" --without-pip
exec {sys.executable} "$@"
"""
"""A Python whose environments are made in a tenth of the time."""


def setup(checkout, *, with_pip=False):
    """Return what `make setup` prints."""
    quick = {} if with_pip else {"RELPOS_PYTHON": str(checkout.parent / "python-without-pip")}
    done = subprocess.run(
        ["make", "setup", "PIP=@echo installs", "compile-kernels=@:"],
        cwd=checkout, env=os.environ | quick, capture_output=True, text=True, timeout=300,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def prefix(checkout):
    """Return the environment that .venv's Python is of."""
    python = checkout / ".venv" / "bin" / "python"
    asked = [python, "-c", "import sys; print(sys.prefix)"]
    return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()


@pytest.fixture
def checkout(tmp_path):
    python = tmp_path / "python-without-pip"
    python.write_text(WITHOUT_PIP)
    python.chmod(0o755)
    folder = tmp_path / "a place for relpos"
    (folder / "firmware").mkdir(parents=True)
    for name in ("Makefile", "pyproject.toml", "platformio.ini"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(ROOT / "tools", folder / "tools")
    assert "installs" in setup(folder)
    return folder


def test_a_checkout_that_is_set_up_is_left_alone(checkout):
    assert "installs" not in setup(checkout)


def test_a_checkout_that_was_moved_is_set_up_anew(checkout):
    moved = checkout.rename(checkout.with_name("elsewhere"))
    assert "installs" in setup(moved)
    script = (moved / ".venv" / "bin" / "activate").read_text()
    assert str(moved) in script
    assert str(checkout) not in script
    assert "installs" not in setup(moved)


def test_a_python_that_is_gone_is_replaced(checkout):
    for python in (checkout / ".venv" / "bin").glob("python*"):
        python.unlink()
        python.symlink_to("/nowhere/python")
    assert "installs" in setup(checkout)
    assert prefix(checkout) == str(checkout / ".venv")


def test_a_setup_that_was_killed_before_pip_was_there_is_begun_again(checkout):
    for made in (checkout / ".venv").glob(".relpos-*"):
        made.unlink()
    assert "installs" in setup(checkout, with_pip=True)
    pip = [checkout / ".venv" / "bin" / "pip", "--version"]
    done = subprocess.run(pip, capture_output=True, text=True, check=True)
    assert f" {checkout}/.venv/lib/" in done.stdout


def test_a_python_whose_path_has_spaces_is_found(tmp_path):
    python = tmp_path / "a python of mine"
    python.symlink_to(sys.executable)
    command = [ROOT / "tools" / "find_python.sh"]
    chosen = os.environ | {"RELPOS_PYTHON": str(python)}
    found = subprocess.run(command, env=chosen, capture_output=True, text=True, check=False)
    assert (found.stdout, found.stderr) == (f"{python}\n", "")
