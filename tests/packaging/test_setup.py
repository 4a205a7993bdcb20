"""What make does with a .venv that leads nowhere; pip itself is left out."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def setup(checkout):
    """Return what `make setup` prints; what pip would have installed is not there."""
    done = subprocess.run(
        ["make", "setup", "PIP=@echo installs", "compile-kernels=@:"],
        cwd=checkout, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def works(checkout):
    """Whether pip, which is a script of .venv, is that of this very .venv."""
    pip = checkout / ".venv" / "bin" / "pip"
    done = subprocess.run([pip, "--version"], capture_output=True, text=True, check=False)
    return f" {checkout}/.venv/lib/" in done.stdout


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """Made once, which takes seconds; each test leaves one that works."""
    folder = tmp_path_factory.mktemp("setup") / "a place for relpos"
    (folder / "firmware").mkdir(parents=True)
    for name in ("Makefile", "pyproject.toml", "platformio.ini"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(ROOT / "tools", folder / "tools")
    assert "installs" in setup(folder)
    assert works(folder)
    return folder


def test_a_checkout_that_is_set_up_is_left_alone(checkout):
    assert "installs" not in setup(checkout)


def test_a_checkout_that_was_moved_is_set_up_anew(checkout, tmp_path):
    moved = shutil.copytree(checkout, tmp_path / "elsewhere", symlinks=True)
    assert "installs" in setup(moved)
    assert works(moved)
    assert "installs" not in setup(moved)


def test_a_python_that_is_gone_is_replaced(checkout):
    for python in (checkout / ".venv" / "bin").glob("python*"):
        python.unlink()
        python.symlink_to("/nowhere/python")
    assert "installs" in setup(checkout)
    assert works(checkout)


def test_a_setup_that_was_killed_amid_is_begun_again(checkout):
    for made in (checkout / ".venv").glob(".relpos-*"):
        made.unlink()
    (packages,) = (checkout / ".venv" / "lib").glob("python*/site-packages")
    shutil.rmtree(packages)
    packages.mkdir()
    assert "installs" in setup(checkout)
    assert works(checkout)
