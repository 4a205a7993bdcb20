"""Texts of a session that a page says in its reader's language: English, with a key and values."""

from __future__ import annotations

from string import Formatter
from typing import Any


class Said(str):
    """An English text whose ``key`` and ``values`` let a page find it in another catalogue.

    Wherever no page is involved it is an ordinary string. Catalogues name it ``said.KEY``.
    """

    key: str
    values: dict[str, Any]
    template: str

    def __new__(cls, key: str, template: str, **values: Any) -> Said:
        """Return ``template`` filled with ``values``."""
        made = super().__new__(cls, template.format(**values))
        made.key, made.template = key, template
        # A page rounds as the English text does.
        specs = {name: spec for _, name, spec, _ in Formatter().parse(template) if name and spec}
        made.values = {
            name: float(format(value, specs[name])) if name in specs else value
            for name, value in values.items()
        }
        return made

    def filled(self, **values: Any) -> Said:
        """Return the same text with other values."""
        return Said(self.key, self.template, **{**self.values, **values})


def refusal(text: str) -> dict[str, Any]:
    """Return the answer to a request that is refused, for a page to translate."""
    return {"error": str(text), "said": said_of(text)}


def said_of(text: str) -> dict[str, Any] | None:
    """Return the key and the values of a text for a page; None where it has none."""
    return {"key": text.key, "values": text.values} if isinstance(text, Said) else None
