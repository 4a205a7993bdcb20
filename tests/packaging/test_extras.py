"""Optional libraries: what is missing, and the line that installs it."""

import shlex
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from relpos import extras

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
