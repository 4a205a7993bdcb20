"""The command line within this process."""

from __future__ import annotations

from typer.testing import CliRunner, Result

from relpos.cli.main import app


def relpos(*words: object) -> Result:
    """Run it with these words; what it does not catch is raised."""
    return CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
