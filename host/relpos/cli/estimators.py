"""``--estimator``: those of relpos by name, others by ``MODULE:CLASS``."""

from __future__ import annotations

from typing import Annotated

import typer

from relpos.errors import RelposError

BANK, DEADRECKONING = "bank", "deadreckoning"
"""The default, and the one that needs no ranges."""

HELP = (
    "bank, particle, deadreckoning, a name that a package registers, or MODULE:CLASS "
    "(also FILE.py:CLASS) of your own."
)


def check(name: str | None) -> str | None:
    """Pass a name on that may be an estimator's; wrong usage otherwise."""
    from relpos import fusion

    if name is not None:
        try:
            fusion.check(name)
        except RelposError as error:
            raise typer.BadParameter(str(error)) from None
    return name


def _begun(incomplete: str) -> list[str]:
    """Names that the shell may complete."""
    from relpos import fusion

    return [name for name in fusion.names() if name.startswith(incomplete)]


EstimatorName = Annotated[
    str, typer.Option(metavar="NAME", help=HELP, callback=check, autocompletion=_begun)
]
"""The ``--estimator`` option of every command that takes one."""
