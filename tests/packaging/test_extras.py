"""Optional libraries: what is missing, and the line that installs it."""

import os
import shlex
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from typer.testing import CliRunner

from relpos import extras
from relpos.cli.main import app

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
OPTIONAL = PROJECT["project"]["optional-dependencies"]


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    """Not in a repository, which knows its extras from the project's file."""
    monkeypatch.setattr("relpos.paths.repository", lambda: None)
    extras.requirements.cache_clear()
    yield
    extras.requirements.cache_clear()


def test_a_repository_knows_its_extras_itself(monkeypatch):
    monkeypatch.setattr("relpos.paths.repository", lambda: ROOT)
    assert extras.requirements("view") == tuple(OPTIONAL["view"])


@pytest.fixture
def metadata_of_the_project(monkeypatch):
    """As an installation from this tree would have it."""
    lines = [f'{r} ; extra == "{e}"' for e, named in OPTIONAL.items() for r in named]
    monkeypatch.setattr(
        metadata, "requires", lambda _: [*PROJECT["project"]["dependencies"], *lines]
    )


@pytest.mark.usefixtures("metadata_of_the_project")
@pytest.mark.parametrize("extra", list(extras.PURPOSES))
def test_an_extra_has_what_the_project_names(extra):
    assert sorted(extras.requirements(extra)) == sorted(OPTIONAL[extra])


def test_all_is_every_extra_that_has_a_purpose():
    assert OPTIONAL["all"] == [f"relpos[{','.join(extras.PURPOSES)}]"]


def test_a_package_that_is_not_installed_is_missing(monkeypatch):
    lines = ['not-there-a>=2; extra == "view"', "pytest ; extra == 'view'", "not-there-b>=1"]
    monkeypatch.setattr(metadata, "requires", lambda _: lines)
    assert extras.missing("view") == ["not-there-a>=2"]
    message = str(extras.missing_extra("the page", "view"))
    assert "\n" not in message
    assert "'not-there-a>=2'" in message
    assert "not-there-b" not in message


@pytest.mark.parametrize(
    ("prefix", "line"),
    [
        ("/home/a/.local/share/pipx/venvs/relpos", "pipx inject relpos 'mcap>=1'"),
        ("/home/a/.local/share/uv/tools/relpos",
         "uv pip install --python /home/a/.local/share/uv/tools/relpos 'mcap>=1'"),
    ],
)  # fmt: skip
def test_the_line_installs_beside_this_very_relpos(prefix, line, monkeypatch):
    monkeypatch.setattr(sys, "prefix", prefix)
    assert extras.install_line(["mcap>=1"]) == line


def test_elsewhere_the_line_names_the_python_that_runs():
    words = shlex.split(extras.install_line(["mcap>=1"]))
    assert words == [sys.executable, "-m", "pip", "install", "mcap>=1"]


WITHOUT_MCAP = """
import sys
class NotInstalled:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("foxglove", "mcap"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, NotInstalled())
from relpos.cli.main import app
app(sys.argv[1:])
"""


@pytest.mark.parametrize(
    "arguments",
    ["fuse a.mcap --out o", "replay a.mcap", "replay a.mcap --log l.csv",
     "convert a.mcap --to run --out o", "report a.mcap --out o"],
)  # fmt: skip
def test_a_recording_without_the_extra_is_one_clear_line(arguments, tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"recorded")
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_MCAP, *arguments.split()], cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT / "host")},
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    (line,) = done.stderr.splitlines()
    assert done.returncode == 1
    assert "(extra 'recording') is not installed" in line


@pytest.mark.parametrize("package", ["pymap3d", "pytak"])
def test_what_a_map_needs_is_asked_for_before_the_session_begins(package, tmp_path, monkeypatch):
    monkeypatch.setattr("relpos.extras._installed", lambda line: not line.startswith(package))
    monkeypatch.setattr("relpos.fusion.warm_up", lambda name: pytest.fail("it prepares first"))
    asked = ["fuse", "loop://", "--cot", "udp://127.0.0.1:6969", "--pin", "52,13,0"]
    done = CliRunner().invoke(app, [*asked, "--seconds", "1", "--out", str(tmp_path / "o")])
    (line,) = done.stderr.splitlines()
    assert done.exit_code == 1
    assert package in line
    assert "(extra 'exchange') is not installed" in line
    assert not (tmp_path / "o").exists()


WITHOUT = """
import sys
sys.modules[sys.argv.pop(1)] = None
from relpos.cli.main import app
app(sys.argv[1:])
"""


@pytest.mark.parametrize("library", ["segno", "starlette"])
@pytest.mark.parametrize("arguments", ["mission m loop://", "fuse loop:// --view"])
def test_a_page_without_its_libraries_is_one_clear_line_and_no_folder(library, arguments, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, library, *arguments.split()], cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT / "host")},
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    (line,) = done.stderr.splitlines()
    assert done.returncode == 1
    assert f"{library} (extra 'view') is not installed" in line
    assert not list(tmp_path.iterdir())
