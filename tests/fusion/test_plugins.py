"""Plugin estimators are found, used everywhere, and their faults reported in one line."""

from __future__ import annotations

import json
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from click.testing import Result

import relpos
from relpos.fusion import plugins
from support.command import relpos as command

OWN = Path(__file__).with_name("own_estimators.py")


@pytest.fixture(scope="module")
def run() -> relpos.Run:
    return relpos.simulate("paper", 3, seconds=40)


@pytest.fixture(scope="module")
def directory(run: relpos.Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "walk"
    relpos.save(run, path)
    return path


def one_clear_line(result: Result) -> str:
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    return result.stderr


def test_a_file_on_the_command_line_gives_what_the_object_gives(
    run: relpos.Run, directory: Path, tmp_path: Path
) -> None:
    made = command(
        "fuse", directory, "--estimator", f"{OWN}:Adder", "--set", "stretch=0.5", "--out", tmp_path,
        "--json",
    )  # fmt: skip
    assert made.exit_code == 0, made.stderr
    report = json.loads(made.stdout)
    assert report["counters"]["motions"] == len(run.motions)
    adder = plugins.factory(f"{OWN}:Adder")
    result = relpos.fuse(run, adder, settings={"stretch": 0.5})
    score = relpos.evaluate(result, run)
    assert report["relative_distance_rmse_m"] == pytest.approx(
        score.metrics.relative_distance_rmse_m, abs=1e-6
    )
    evaluated = command("evaluate", directory, "--estimate", tmp_path, "--json")
    assert json.loads(evaluated.stdout)["iso_18305"]["headline"] == "as_given"


def test_a_module_in_the_working_directory_is_found(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_estimators.py").write_text(OWN.read_text())
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", list(__import__("sys").path))
    made = command("fuse", directory, "--estimator", "my_estimators:Adder", "--out", "o", "--json")
    assert made.exit_code == 0, made.stderr
    assert json.loads(made.stdout)["estimator"] == "my_estimators:Adder"


def test_a_package_registers_its_estimator_by_name(
    run: relpos.Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    point = EntryPoint("adder", f"{OWN}:Adder", plugins.GROUP)
    monkeypatch.setattr(plugins, "registered", lambda: {"adder": point})
    assert "adder" in relpos.fusion.names()  # type: ignore[attr-defined]
    result = relpos.fuse(run, "adder")
    assert result.estimator == "adder"
    assert result.counters["motions"] == len(run.motions)


def test_an_object_is_used_as_it_is(run: relpos.Run) -> None:
    adder = plugins.factory(f"{OWN}:Adder")(run.priors, stretch=2.0)
    result = relpos.fuse(run, adder)
    assert result.estimator == "Adder"
    assert relpos.evaluate(result, run).metrics.epochs > 30


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (f"{OWN}:Crashing", ["process(Motion of node 1 at 6 s)", "KeyError", "own_estimators.py"]),
        (f"{OWN}:Talkative", ["process(Motion of node 1", "returned str"]),
        (f"{OWN}:Nowhere", ["process(Motion of node 1", "pose of node 1 that is not finite"]),
        (f"{OWN}:Leaving", ["process(Motion of node 1", "SystemExit"]),
        (f"{OWN}:Unfinished", ["it has no finish, counters"]),
        (f"{OWN}:Stillborn", ["ValueError: two lines"]),
        (f"{OWN}:Missing", ["no 'Missing'"]),
        (f"{OWN}:math", ["is no class or function"]),
        ("no_such_module_at_all:Class", ["No module named 'no_such_module_at_all'"]),
        ("nowhere/file.py:Class", ["nowhere/file.py: no such file"]),
    ],
)
def test_a_faulty_estimator_is_reported_in_one_line(
    name: str, words: list[str], directory: Path, tmp_path: Path
) -> None:
    message = one_clear_line(command("fuse", directory, "--estimator", name, "--out", tmp_path))
    for word in words:
        assert word in message


def test_the_estimators_own_error_is_the_cause_in_python(run: relpos.Run) -> None:
    with pytest.raises(relpos.RelposError) as caught:
        relpos.fuse(run, f"{OWN}:Crashing")
    assert isinstance(caught.value.__cause__, KeyError)


@pytest.mark.parametrize(
    ("setting", "words"), [("strech=1", "one of stretch"), ("stretch=wide", "is no float")]
)
def test_a_wrong_setting_is_reported(
    setting: str, words: str, directory: Path, tmp_path: Path
) -> None:
    name = f"{OWN}:Adder"
    made = command("fuse", directory, "--estimator", name, "--set", setting, "--out", tmp_path)
    assert words in one_clear_line(made)


def test_an_unknown_name_is_wrong_usage_that_names_the_known_ones(directory: Path) -> None:
    made = command("fuse", directory, "--estimator", "bnk")
    assert made.exit_code == 2
    assert "particle" in made.stderr


def test_figures_report_a_plugin_that_cannot_be_loaded_before_anything_is_drawn(
    tmp_path: Path,
) -> None:
    name = "no_such_module_at_all:Class"
    assert "No module" in one_clear_line(command("figures", "--estimator", name, "--out", tmp_path))
    assert command("figures", "--estimator", "bank", "--out", tmp_path).exit_code == 2
