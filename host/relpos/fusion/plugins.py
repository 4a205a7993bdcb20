"""Plugins: estimators that other packages or files define, behind the same interface as ours.

A class, or a function that makes an object, is found in three ways:

* ``module:Class`` or ``path/to/file.py:Class``, as the command line takes it;
* under a name, where an installed package registers one in the entry point group
  ``relpos.estimators``;
* as the class itself, in Python.

What it is made with goes by the names of its parameters, each of which it may leave out:
``priors`` (a sequence of :class:`relpos.measurements.Prior`, empty where every start is unknown),
``seed``, ``nodes`` (node -> how it is worn) and ``settings`` (key -> value as given). One without
``settings`` has its settings as parameters: ``def __init__(self, priors=(), *, range_m=0.5)``
takes ``--set range_m=0.3``, a number because the default is one.

Its errors are reported in one line, as a fault of that estimator and not of the data.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import math
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from relpos.errors import RelposError
from relpos.fusion.estimator import Estimate, Estimator
from relpos.fusion.models.ranging import Mounting
from relpos.measurements import Measurement, Prior

GROUP = "relpos.estimators"
"""Entry point group: ``[project.entry-points."relpos.estimators"]`` of a package's pyproject."""

Factory = Callable[..., Estimator]

_GIVEN = ("priors", "seed", "nodes", "settings")


class EstimatorError(RelposError):
    """A plugin failed; its own error is the cause."""


@cache
def registered() -> Mapping[str, EntryPoint]:
    """Return what installed packages register, by name."""
    return {point.name: point for point in entry_points(group=GROUP)}


def is_plugin(name: str) -> bool:
    """Whether a name can be a plugin's."""
    return ":" in name or name in registered()


def factory(name: str) -> Factory:
    """Find what makes an estimator; EstimatorError says what is not there, in one line."""
    point = registered().get(name)
    target = point.value if point is not None else name
    where, _, attribute = target.rpartition(":")
    if not where or not attribute:
        raise EstimatorError(f"estimator '{name}': not MODULE:CLASS or FILE.py:CLASS")
    try:
        found: Any = _module(where)
        for part in attribute.split("."):
            found = getattr(found, part)
    except RelposError:
        raise
    except AttributeError:
        raise EstimatorError(f"estimator '{name}': no '{attribute}' in {where}") from None
    except ModuleNotFoundError as error:
        raise EstimatorError(f"estimator '{name}': {error}") from error
    except (Exception, SystemExit) as error:
        raise EstimatorError(f"estimator '{name}': {_describe(error, None)}") from error
    if not callable(found):
        raise EstimatorError(f"estimator '{name}': '{attribute}' is no class or function")
    maker: Factory = found
    return maker


def make(
    name: str,
    maker: Factory,
    priors: Sequence[Prior] = (),
    settings: Mapping[str, object] | None = None,
    seed: int = 0,
    nodes: Mapping[int, Mounting] | None = None,
) -> Estimator:
    """Make a plugin's estimator; its errors become EstimatorError."""
    given = {"priors": tuple(priors), "seed": seed, "nodes": nodes or {}}
    arguments = _arguments(name, maker, {**given, "settings": settings or {}})
    try:
        made: Any = maker(**arguments)
    except RelposError:
        raise
    except (Exception, SystemExit) as error:
        raise EstimatorError(f"estimator {name}: {_describe(error, maker)}") from error
    return guard(name, made)


def guard(name: str, estimator: Any) -> Estimator:
    """Wrap an object so that its errors become EstimatorError, in one line."""
    if isinstance(estimator, type) or not isinstance(estimator, Estimator):
        missing = [
            part for part in ("process", "finish", "counters") if not hasattr(estimator, part)
        ]
        raise EstimatorError(
            f"estimator {name}: not an estimator: it has no {', '.join(missing) or 'instance'}"
        )
    return _Guarded(name, estimator)


class _Guarded:
    """A plugin's estimator; each of its errors becomes an EstimatorError."""

    def __init__(self, name: str, estimator: Estimator) -> None:
        self._name = name
        self._estimator = estimator

    def process(self, measurement: Measurement) -> list[Estimate]:
        """Pass one measurement on."""
        kind = type(measurement).__name__
        where = f"process({kind} of node {measurement.node} at {measurement.time_s:g} s)"
        return self._listed(where, self._call(where, self._estimator.process, measurement))

    def finish(self) -> list[Estimate]:
        """Let it finish."""
        return self._listed("finish()", self._call("finish()", self._estimator.finish))

    def counters(self) -> Mapping[str, int]:
        """Give its counters."""
        return dict(self._call("counters()", self._estimator.counters))

    def _call(self, where: str, method: Callable[..., Any], *arguments: object) -> Any:
        try:
            return method(*arguments)
        except RelposError:
            raise
        except (Exception, SystemExit) as error:
            words = _describe(error, type(self._estimator))
            raise EstimatorError(f"estimator {self._name}: {where} failed: {words}") from error

    def _listed(self, where: str, given: Any) -> list[Estimate]:
        if isinstance(given, list | tuple) and all(isinstance(one, Estimate) for one in given):
            for node in (node for one in given for node in one.nodes):
                if not all(map(math.isfinite, (node.x_m, node.y_m, node.heading_rad))):
                    raise EstimatorError(
                        f"estimator {self._name}: {where} returned a pose of node {node.node} "
                        "that is not finite"
                    )
            return list(given)
        raise EstimatorError(
            f"estimator {self._name}: {where} returned {type(given).__name__}, not a list of "
            "relpos.Estimate"
        )


def _module(where: str) -> ModuleType:
    if not where.endswith(".py"):
        # As `python -m` does it: what lies in the working directory is found first.
        here = str(Path.cwd())
        if here not in sys.path:
            sys.path.insert(0, here)
        return importlib.import_module(where)
    path = Path(where).resolve()
    if not path.is_file():
        raise EstimatorError(f"{where}: no such file")
    name = f"relpos_plugin_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _arguments(name: str, maker: Factory, given: Mapping[str, Any]) -> dict[str, Any]:
    try:
        parameters = inspect.signature(maker).parameters
    except (TypeError, ValueError):
        return {}
    arguments = {key: given[key] for key in _GIVEN if key in parameters}
    if "settings" in parameters:
        return arguments
    takes_all = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    known = [
        key
        for key, p in parameters.items()
        if key not in _GIVEN and p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)
    ]
    for key, value in given["settings"].items():
        if key in known:
            arguments[key] = _converted(name, key, value, parameters[key].default)
        elif takes_all and key not in _GIVEN:
            arguments[key] = value
        else:
            has = f"one of {', '.join(known)}" if known else "it has none"
            raise EstimatorError(f"estimator {name} has no setting '{key}': {has}")
    return arguments


def _converted(name: str, key: str, value: object, default: object) -> object:
    if not isinstance(value, str) or isinstance(default, str):
        return value
    try:
        if isinstance(default, bool):
            return {"true": True, "1": True, "false": False, "0": False}[value.lower()]
        if isinstance(default, int):
            return int(value)
        if isinstance(default, float):
            return float(value)
    except (ValueError, KeyError):
        kind = type(default).__name__
        raise EstimatorError(f"estimator {name}: setting {key}: '{value}' is no {kind}") from None
    try:
        return float(value)
    except ValueError:
        return value


def _describe(error: BaseException, of: Any) -> str:
    """Describe an error in one line, with the innermost place in the estimator's file."""
    frames = traceback.extract_tb(error.__traceback__)
    try:
        own = inspect.getsourcefile(of) if of is not None else None
    except TypeError:
        own = None
    inside = [frame for frame in frames if frame.filename == own]
    if not inside:
        inside = [frame for frame in frames if not frame.filename.startswith("<frozen")]
    words = " ".join(str(error).split())
    what = f"{type(error).__name__}: {words}" if words else type(error).__name__
    where = f" ({Path(inside[-1].filename).name}, line {inside[-1].lineno})" if inside else ""
    return what + where
