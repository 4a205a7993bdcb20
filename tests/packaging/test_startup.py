"""How light the command is at its start, and that a shell completes it."""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("numba", "numpy", "scipy", "matplotlib", "starlette", "uvicorn", "mcap", "foxglove",
         "pandas", "serial", "construct")  # fmt: skip
PATIENCE_S = 60


@pytest.fixture
def shell_environment(tmp_path):
    """A new user's: an empty home, the command on the path."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return os.environ | {
        "HOME": str(tmp_path), "PATH": path, "PYTHONPATH": str(ROOT / "host"), "SHELL": "/bin/bash",
    }  # fmt: skip


def bash(script: str, environment: dict[str, str]) -> str:
    done = subprocess.run(
        ["bash", "--norc", "-c", script],
        env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("arguments", ["--help", "--version", "node --help"])
def test_help_imports_nothing_heavy(arguments):
    program = (
        "import sys\nfrom relpos.cli.main import app\n"
        "try:\n    app(sys.argv[1:])\nfinally:\n"
        f"    print('HEAVY', sorted(set({HEAVY!r}) & set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments.split()],
        env=os.environ | {"PYTHONPATH": str(ROOT / "host")},
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "HEAVY []"


def test_the_page_s_serving_process_imports_no_estimator():
    # Beside a session of twenty nodes it would be another 35 MB, and restart later.
    program = (
        "import sys\nimport relpos.cli.main, relpos.view.process, relpos.view.server\n"
        "print(sorted({'numba', 'numpy', 'scipy'} & set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"PYTHONPATH": str(ROOT / "host")},
        capture_output=True, text=True, timeout=PATIENCE_S, check=True,
    )  # fmt: skip
    assert done.stdout == "[]\n"


INTERRUPTED = """
import importlib, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
class CtrlC:
    def find_spec(self, name, path=None, target=None):
        if name == "relpos.cli.emulate":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, CtrlC())
module, _, name = sys.argv.pop(1).partition(":")
getattr(importlib.import_module(module), name)()
"""


def test_an_interrupt_while_the_commands_are_imported_is_one_clear_line():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, project["scripts"]["relpos"], "fuse", "/dev/ttyNOPE7"],
        env=os.environ | {"PYTHONPATH": str(ROOT / "host")},
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (1, "relpos: interrupted\n")


def test_the_package_itself_is_the_command():
    done = subprocess.run(
        [sys.executable, "-m", "relpos", "--version"],
        env=os.environ | {"PYTHONPATH": str(ROOT / "host")},
        capture_output=True, text=True, timeout=PATIENCE_S, check=True,
    )  # fmt: skip
    assert done.stdout.startswith("relpos ")


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_bash_completes_commands_and_values(shell_environment):
    completed = {
        "relpos dead": "deadreckon",
        "relpos node fla": "flash",
        "relpos node calibrate ant": "antenna",
        "relpos fuse --estimator ba": "bank",
    }
    script = 'eval "$(relpos --show-completion)"\n'
    for words in completed:
        script += (
            f"COMP_WORDS=({words})\nCOMP_CWORD={len(words.split()) - 1}\n"
            "_relpos_completion relpos\nprintf '%s\\n' \"${COMPREPLY[@]}\"\n"
        )
    assert bash(script, shell_environment).split() == list(completed.values())


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_installed_completion_is_there_in_the_next_bash(shell_environment):
    bash("relpos --install-completion; true", shell_environment)
    script = '. "$HOME/.bashrc"\ncomplete -p relpos\n'
    assert "_relpos_completion" in bash(script, shell_environment)
