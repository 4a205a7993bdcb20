"""Every topic of a recording with its schema: JSON schemas of rows, Foxglove's own of drawings."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any, get_type_hints

from relpos.recording import scene, topics
from relpos.runs.table import plain_type


def _schema_of(kind: type, names: Iterable[str]) -> dict[str, Any]:
    hints = get_type_hints(kind)
    properties: dict[str, Any] = {}
    required: list[str] = []
    for name in names:
        optional, plain = plain_type(hints.get(name, float))
        word = {bool: "boolean", int: "integer", float: "number"}.get(plain, "string")
        properties[name] = {"type": word}
        # A float may be none at all (NaN), and is left out then.
        if not optional and plain is not float:
            required.append(name)
    return {"type": "object", "properties": properties, "required": required}


def _topic(name: str, title: str, schema: Mapping[str, Any]) -> topics.Topic:
    document = json.dumps({"title": title, **schema}).encode()
    return topics.Topic(name, "json", title, "jsonschema", document)


@cache
def all_topics() -> tuple[topics.Topic, ...]:
    """Every topic of a recording, always in the same order."""
    serial = {
        "type": "object",
        "properties": {
            "arrival_s": {"type": "number"},
            "data": {"type": "string", "contentEncoding": "base64"},
        },
        "required": ["arrival_s", "data"],
    }
    rows = [
        _topic(name, f"relpos.{kind.__name__}", _schema_of(kind, topics.names_of(kind)))
        for kind, name in topics.ROWS.items()
    ]
    lists = [
        _topic(
            name,
            f"relpos.{kind.__name__}s",
            {
                "type": "object",
                "properties": {
                    "time_s": {"type": "number"},
                    topics.LIST_NAMES[kind]: {
                        "type": "array",
                        "items": _schema_of(kind, topics.list_names_of(kind)),
                    },
                },
                "required": ["time_s", topics.LIST_NAMES[kind]],
            },
        )
        for kind, name in topics.LISTS.items()
    ]
    drawn = [
        topics.Topic(name, "protobuf", schema.name, schema.encoding, schema.data)
        for name, schema in scene.schemas().items()
    ]
    return (_topic(topics.SERIAL, "relpos.Serial", serial), *rows, *lists, *drawn)
