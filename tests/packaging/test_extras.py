"""Optional libraries: what is missing, and the line that installs it."""

import json
import os
import shlex
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from relpos import extras
from support.command import relpos

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


WITHOUT = """
import json, os, sys
from typer.testing import CliRunner
sys.modules |= dict.fromkeys(sys.argv[1].split())
from relpos.cli.main import app
for line in sys.argv[2:]:
    done = CliRunner().invoke(app, line.split(), catch_exceptions=False)
    print(json.dumps([done.exit_code, done.stderr, os.listdir()]))
"""


def answers(missing, commands, folder):
    """Status, words and files after each command, of a process that lacks these packages."""
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, missing, *commands], cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT / "host")},
        capture_output=True, text=True, timeout=100, check=True,
    )  # fmt: skip
    return dict(zip(commands, map(json.loads, done.stdout.splitlines()), strict=True))


OF_RECORDINGS = (
    "fuse a.mcap --out o", "replay a.mcap", "replay a.mcap --log l.csv",
    "convert a.mcap --to run --out o", "report a.mcap --out o",
)  # fmt: skip


@pytest.fixture(scope="module")
def without_mcap(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mcap")
    (folder / "a.mcap").write_bytes(b"recorded")
    return answers("foxglove mcap", OF_RECORDINGS, folder)


@pytest.mark.parametrize("command", OF_RECORDINGS)
def test_a_recording_without_the_extra_is_one_clear_line(command, without_mcap):
    status, words, _ = without_mcap[command]
    (line,) = words.splitlines()
    assert status == 1
    assert "(extra 'recording') is not installed" in line


@pytest.mark.parametrize("package", ["pymap3d", "pytak"])
def test_what_a_map_needs_is_asked_for_before_the_session_begins(package, tmp_path, monkeypatch):
    monkeypatch.setattr("relpos.extras._installed", lambda line: not line.startswith(package))
    monkeypatch.setattr("relpos.fusion.warm_up", lambda name: pytest.fail("it prepares first"))
    asked = ("fuse", "loop://", "--cot", "udp://127.0.0.1:6969", "--pin", "52,13,0")
    done = relpos(*asked, "--seconds", 1, "--out", tmp_path / "o")
    (line,) = done.stderr.splitlines()
    assert done.exit_code == 1
    assert package in line
    assert "(extra 'exchange') is not installed" in line
    assert not (tmp_path / "o").exists()


OF_PAGES = ("mission m loop://", "fuse loop:// --view")


@pytest.fixture(scope="module", params=["segno", "starlette"])
def without_page(request, tmp_path_factory):
    return request.param, answers(request.param, OF_PAGES, tmp_path_factory.mktemp("page"))


@pytest.mark.parametrize("command", OF_PAGES)
def test_a_page_without_its_libraries_is_one_clear_line_and_no_folder(command, without_page):
    library, told = without_page
    status, words, files = told[command]
    (line,) = words.splitlines()
    assert status == 1
    assert f"{library} (extra 'view') is not installed" in line
    assert not files
