"""``run.toml``: the description of a recording, every key optional."""

from __future__ import annotations

import json
import math
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from relpos.errors import DataError
from relpos.files import write_whole
from relpos.measurements import Prior
from relpos.runs.table import read_text, within_bounds


class InitialPose(StrEnum):
    """Start of the nodes, as the run states it; the values of ``initial_pose``."""

    UNKNOWN = "unknown"
    COMMON = "common"
    FROM_TRUTH = "from truth"


@dataclass(frozen=True)
class NodeInfo:
    """Wearer and mounting of one node; None for an unknown value."""

    name: str | None = None
    stature_m: float | None = None
    leg_length_m: float | None = None
    height_m: float | None = None
    antenna_offset_m: tuple[float, float] | None = None
    """The antenna's place (forward, left) of the point whose motion is reported."""
    post: bool = False
    """Nobody wears it: it lies still at the command post."""


@dataclass(frozen=True)
class Simulated:
    """Scenario, seed and settings of a simulated run. For evaluation alone."""

    scenario: str
    seed: int
    settings: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Description:
    """The content of ``run.toml``; ``priors`` are its ``[initial.NODE]`` tables."""

    name: str | None = None
    source: str | None = None
    initial_pose: InitialPose = InitialPose.UNKNOWN
    heading_known: bool = False
    priors: tuple[Prior, ...] = ()
    nodes: Mapping[int, NodeInfo] = field(default_factory=dict)
    stature_m: float | None = None
    leg_length_m: float | None = None
    sensor_height_m: float | None = None
    mount: str | None = None
    true_distance_m: float | None = None
    true_turn_deg: float | None = None
    simulated: Simulated | None = None
    """The ``[simulated]`` table: the bound of such a run can be computed."""
    floors_m: tuple[float, ...] = ()
    """Heights of the floors over the start's, from the lowest on. For evaluation alone."""
    unread: tuple[str, ...] = field(default=(), compare=False)
    """Keys of the file that have no meaning: another program's, or misspelt."""

    @property
    def names(self) -> dict[int, str]:
        """The wearers' names, where there are any."""
        return {node: info.name for node, info in self.nodes.items() if info.name}

    def with_names(self, names: Mapping[int, str]) -> Description:
        """Return a description with new names of these nodes' wearers."""
        known = {node: self.nodes.get(node, NodeInfo()) for node in names}
        named = {node: replace(info, name=names[node]) for node, info in known.items()}
        return replace(self, nodes={**self.nodes, **named})

    def with_post(self, node: int | None) -> Description:
        """Return a description in which a node lies at the command post."""
        if node is None:
            return self
        info = replace(self.nodes.get(node, NodeInfo()), post=True)
        return replace(self, nodes={**self.nodes, node: info})


MOST_BYTES = 1 << 20
"""Of a ``run.toml``; names of a thousand nodes are a tenth of it."""
MOST_DOTS = 200
_PLAIN_NUMBERS = (
    "stature_m", "leg_length_m", "sensor_height_m", "true_distance_m", "true_turn_deg"
)  # fmt: skip


def read_description(path: Path) -> Description:
    """Read ``run.toml``; a missing file says nothing. DataError names file and key or line."""
    if not os.path.lexists(path):
        return Description()
    return parse_description(path, read_text(path, MOST_BYTES))


def parse_description(path: Path | str, text: str) -> Description:
    """Read the text of a ``run.toml`` that is found at ``path``. DataError names key or line."""
    try:
        # The time that a key takes grows with the square of its parts.
        if any(line.count(".") > MOST_DOTS for line in text.splitlines()):
            raise RecursionError
        document = tomllib.loads(text)
    except ValueError as error:  # tomllib's own, and Python's of a number of thousands of digits.
        raise DataError(f"{path}: not TOML: {error}") from None
    except RecursionError:
        raise DataError(f"{path}: not TOML of a run: nested too deeply") from None
    reader = _Reader(path)

    pose = reader.text(document, "initial_pose")
    if pose is not None and pose not in list(InitialPose):
        known = ", ".join(f'"{p}"' for p in InitialPose)
        raise DataError(f'{path}: key initial_pose: "{pose}" is none of {known}')
    priors = [
        Prior(
            node=node,
            x_m=reader.needed_number(table, "x_m", where),
            y_m=reader.needed_number(table, "y_m", where),
            heading_rad=reader.needed_number(table, "heading_rad", where),
            sigma_m=reader.sigma(table, "sigma_m", where),
            sigma_rad=reader.sigma(table, "sigma_rad", where),
        )
        for node, table, where in reader.tables(document, "initial")
    ]
    nodes = {
        node: NodeInfo(
            name=reader.text(table, "name", where),
            stature_m=reader.number(table, "stature_m", where),
            leg_length_m=reader.number(table, "leg_length_m", where),
            height_m=reader.number(table, "height_m", where),
            antenna_offset_m=reader.offset(table, "antenna_offset_m", where),
            post=reader.flag(table, "post", where),
        )
        for node, table, where in reader.tables(document, "nodes")
    }
    return Description(
        name=reader.text(document, "name"),
        source=reader.text(document, "source"),
        initial_pose=InitialPose(pose) if pose is not None else InitialPose.UNKNOWN,
        heading_known=reader.flag(document, "heading_known"),
        priors=tuple(sorted(priors, key=lambda prior: prior.node)),
        nodes=nodes,
        mount=reader.text(document, "mount"),
        simulated=reader.simulated(document),
        floors_m=reader.floors(document),
        unread=reader.unread(document),
        **{key: reader.number(document, key) for key in _PLAIN_NUMBERS},
    )


def write_description(path: Path, description: Description) -> None:
    """Write ``run.toml`` so that reading it gives the same description.

    A failure (a full disk, text that cannot be encoded) leaves the file that was there.
    """
    write_whole(path, description_text(description).encode())


def description_text(description: Description) -> str:
    """The text of the ``run.toml`` that says the same."""
    lines: list[str] = []
    for key in ("name", "source", "initial_pose", "heading_known", "mount", *_PLAIN_NUMBERS):
        value = getattr(description, key)
        if key == "initial_pose" and value is InitialPose.UNKNOWN and description.priors:
            continue  # the tables say it
        if value is not None:
            lines.append(f"{key} = {_toml(value)}")
    for prior in description.priors:
        lines += ["", f"[initial.{prior.node}]"]
        for key in ("x_m", "y_m", "heading_rad", "sigma_m", "sigma_rad"):
            lines.append(f"{key} = {_toml(getattr(prior, key))}")
    for node, info in sorted(description.nodes.items()):
        lines += ["", f"[nodes.{node}]"]
        for key in ("name", "stature_m", "leg_length_m", "height_m", "antenna_offset_m"):
            value = getattr(info, key)
            if value is not None:
                lines.append(f"{key} = {_toml(value)}")
        lines += ["post = true"] * info.post
    if description.floors_m:
        lines += ["", "[building]", f"floors_m = {_toml(description.floors_m)}"]
    if description.simulated is not None:
        made = description.simulated
        lines += ["", "[simulated]", f"scenario = {_toml(made.scenario)}", f"seed = {made.seed}"]
        lines += ["", "[simulated.settings]"] * bool(made.settings)
        lines += [f"{key} = {_toml(value)}" for key, value in made.settings.items()]
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # A JSON string is a TOML basic string, but for the one control character JSON lets pass.
        return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return repr(float(str(value)))


class _Reader:
    """Typed access to a TOML document; every complaint names the file and the key."""

    def __init__(self, path: Path | str) -> None:
        self._path = path

    def _fail(self, where: str, key: str, value: object, words: str) -> DataError:
        try:
            shown = repr(value)
        except (RecursionError, ValueError):  # Lists within lists; a number of thousands of digits.
            shown = type(value).__name__
        shown = shown if len(shown) <= 40 else shown[:40] + "..."
        return DataError(f"{self._path}: key {where}{key}: {shown} {words}")

    def text(self, table: Mapping[str, Any], key: str, where: str = "") -> str | None:
        value = table.get(key)
        if value is not None and not isinstance(value, str):
            raise self._fail(where, key, value, "is not text")
        return value

    def flag(self, table: Mapping[str, Any], key: str, where: str = "") -> bool:
        value = table.get(key, False)
        if not isinstance(value, bool):
            raise self._fail(where, key, value, "is neither true nor false")
        return value

    def number(self, table: Mapping[str, Any], key: str, where: str = "") -> float | None:
        value = table.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self._fail(where, key, value, "is not a number")
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise self._fail(where, key, value, "is not a finite number")
        try:
            return within_bounds(key, number)
        except ValueError as error:
            raise self._fail(where, key, value, str(error)) from None

    def needed_number(self, table: Mapping[str, Any], key: str, where: str) -> float:
        value = self.number(table, key, where)
        if value is None:
            raise DataError(f"{self._path}: key {where}{key} is missing")
        return value

    def sigma(self, table: Mapping[str, Any], key: str, where: str) -> float:
        if table.get(key) == math.inf:  # unknown
            return math.inf
        return self.number(table, key, where) or 0.0

    def offset(self, table: Mapping[str, Any], key: str, where: str) -> tuple[float, float] | None:
        value = table.get(key)
        if value is None:
            return None
        if not isinstance(value, list) or len(value) != 2:
            raise self._fail(where, key, value, "is not [forward, left]")
        forward, left = (self.needed_number({key: part}, key, where) for part in value)
        return forward, left

    def simulated(self, document: Mapping[str, Any]) -> Simulated | None:
        table = document.get("simulated")
        if table is None:
            return None
        if not isinstance(table, dict):
            raise self._fail("", "simulated", table, "is not a table")
        scenario, seed = self.text(table, "scenario", "simulated."), table.get("seed")
        if scenario is None:
            raise DataError(f"{self._path}: key simulated.scenario is missing")
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            raise self._fail("simulated.", "seed", seed, "is not a seed")
        settings = table.get("settings", {})
        if not isinstance(settings, dict):
            raise self._fail("simulated.", "settings", settings, "is not a table")
        return Simulated(scenario, seed, {key: str(value) for key, value in settings.items()})

    def floors(self, document: Mapping[str, Any]) -> tuple[float, ...]:
        table = document.get("building", {})
        if not isinstance(table, dict):
            raise self._fail("", "building", table, "is not a table")
        value = table.get("floors_m", [])
        if not isinstance(value, list):
            raise self._fail("building.", "floors_m", value, "is not a list of heights")
        floors_m = tuple(self.needed_number({"z_m": z}, "z_m", "building.") for z in value)
        if floors_m and (0.0 not in floors_m or sorted(set(floors_m)) != list(floors_m)):
            words = "does not go from the lowest floor over the start's, 0.0, to the highest"
            raise self._fail("building.", "floors_m", value, words)
        return floors_m

    def unread(self, document: Mapping[str, Any]) -> tuple[str, ...]:
        """Return the keys that nothing is read from."""
        known = {"initial", "building", *(one.name for one in fields(Description))}
        found = [key for key in document if key not in known - {"priors", "floors_m", "unread"}]
        for group, kind in (("nodes", NodeInfo), ("initial", Prior)):
            known = {one.name for one in fields(kind)} - {"node"}
            for _, table, where in self.tables(document, group):
                found += [where + key for key in table if key not in known]
        return tuple(key if key.isprintable() else repr(key) for key in found)

    def tables(
        self, document: Mapping[str, Any], key: str
    ) -> list[tuple[int, Mapping[str, Any], str]]:
        group = document.get(key, {})
        if not isinstance(group, dict):
            raise self._fail("", key, group, "is not a group of tables")
        result: list[tuple[int, Mapping[str, Any], str]] = []
        for name, table in group.items():
            if not (name.isascii() and name.isdigit()):
                raise DataError(f"{self._path}: table {key}.{name}: {name!r} is no node id")
            if not isinstance(table, dict):
                raise self._fail(f"{key}.", name, table, "is not a table")
            result.append((int(name), table, f"{key}.{name}."))
        return result
