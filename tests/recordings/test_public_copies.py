"""What `get` makes of copies of the sources, compared with the recordings of the figures.

RELPOS_SOURCES names a folder with a folder OWNER+NAME for each repository.
"""

import gzip
import os
from pathlib import Path

import pytest

from relpos.recordings import catalog
from relpos.recordings.tables import Archive, digest
from shared_data import DATA

COPIES = Path(os.environ.get("RELPOS_SOURCES", "no-sources"))
LARGEST_DIFFERENCE = {
    "walk_phone_museum": 0.03,
    "walk_mocap_virtual": 0.002,
    "stairs_mocap_virtual": 0.01,
}
"""As docs/walkers.md explains; elsewhere the last digit that is printed."""
DRAWN = {("four_robots_uwb", "motion.csv")}  # truth with noise of another draw


def rows_of(text):
    """Rows of samples or truth by time and node."""
    return {tuple(cells[:2]): cells[2:] for cells in (line.split(",") for line in text.split()[1:])}


def read(path):
    packed = path.with_name(f"{path.name}.gz")
    return gzip.decompress(packed.read_bytes()).decode() if packed.exists() else path.read_text()


@pytest.mark.soak  # it needs copies of the sources, which nobody has by chance
@pytest.mark.parametrize("source", [s for s in catalog.SOURCES if s.sha256], ids=lambda s: s.name)
def test_a_source_gives_the_recordings_of_the_figures(source):
    copy = COPIES / "+".join(source.repository.split("/")[1:])
    if not copy.exists():
        pytest.skip(f"no copy of {source.repository}: RELPOS_SOURCES names the folder of copies")
    runs = list(source.convert(Archive(copy)))
    assert digest(runs) == source.sha256
    if not (DATA / source.name).exists():
        pytest.skip(f"no {source.name} in {DATA}")
    compared = 0
    for run in runs:
        for name, text in run.tables().items():
            if (source.name, name) in DRAWN or name == "events.csv":
                continue
            if not (DATA / source.name / run.name).exists():
                continue
            if name == "errors.csv":
                assert text == read(DATA / source.name / name)
                compared += 1
                continue
            made, published = rows_of(text), rows_of(read(DATA / source.name / run.name / name))
            common = made.keys() & published.keys()
            assert len(common) >= 0.9 * len(published)
            for row in common:
                for mine, theirs in zip(made[row], published[row], strict=True):
                    if mine != theirs:
                        tolerance = LARGEST_DIFFERENCE.get(source.name, 2e-4 * abs(float(theirs)))
                        assert float(mine) == pytest.approx(float(theirs), abs=tolerance)
            compared += 1
    assert compared
