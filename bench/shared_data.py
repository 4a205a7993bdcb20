"""Where the recordings are: in ``RELPOS_DATA``, else in ``../shared/data`` beside the project."""

import os
from pathlib import Path

DATA = Path(os.environ.get("RELPOS_DATA") or Path(__file__).resolve().parents[2] / "shared/data")
