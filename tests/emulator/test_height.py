"""Height from the tag's pressure: a climb through chips, firmware, radio and link."""

from dataclasses import replace

import numpy as np
import pytest
import scipy

from relpos.emulator import team as emulated
from relpos.emulator.serving import record_team
from relpos.emulator.team import TeamConfig
from relpos.measurements import Height
from relpos.runs import load_run, save_run
from relpos.simulation.world import World
from wearers.activities import Activity
from wearers.solo import make_walker

GROUND_PA = 98_700.0
WALK = (Activity("walk", 8.0), Activity("turn", turn_rad=np.pi))
FLIGHT = (Activity("stairs_up", count=18), Activity("stand", seconds=2.0))


def hydrostatic_pa(height_m):
    """Integrate dp/dh = -g M p / (R T), with T falling by 6.5 K/km from 15 degrees."""

    def slope(h, p):
        return -9.80665 * 0.0289644 * p / (8.314462618 * (288.15 - 0.0065 * h))

    low, high = float(height_m.min()) - 1.0, float(height_m.max()) + 1.0
    up, down = (
        scipy.integrate.solve_ivp(
            slope, (0.0, to), [GROUND_PA], rtol=1e-10, atol=1e-6, dense_output=True
        )
        for to in (high, low)
    )
    return np.where(height_m >= 0.0, up.sol(height_m)[0], down.sol(height_m)[0])


@pytest.fixture(scope="module")
def climb(tmp_path_factory):
    """Two wearers: one climbs three flights, comes down one; the other stays on the floor."""
    scripts = {
        1: (Activity("stand", seconds=10.0), Activity("walk", 6.0), *FLIGHT, *FLIGHT, *FLIGHT,
            Activity("stairs_down", count=18), Activity("stand", seconds=15.0)),
        2: (Activity("stand", seconds=10.0), *WALK, *WALK, *WALK, Activity("stand", seconds=60.0)),
    }  # fmt: skip
    walkers = []
    for node, script in scripts.items():
        truth, _ = make_walker(script, 3 + node, node=node, place="chest")
        walkers.append(replace(truth, pressure_pa=hydrostatic_pa(truth.position_m[:, 2])))
    seconds = min(float(w.time_s[-1]) for w in walkers)
    patch = pytest.MonkeyPatch()
    patch.setattr(emulated, "make_team", lambda *_: (walkers, World()))
    try:
        run = record_team(
            TeamConfig(board="native", nodes=2, seconds=seconds, scenario="stairs", seed=1)
        )
    finally:
        patch.undo()
    folder = tmp_path_factory.mktemp("climb")
    save_run(run, folder)
    return {w.node: w for w in walkers}, run, load_run(folder)


def heights_of(run):
    return [m for m in run.measurements if isinstance(m, Height)]


def of_node(run, node):
    heights = [h for h in heights_of(run) if h.node == node]
    return np.array([h.time_s for h in heights]), np.array([h.height_m for h in heights])


def over_start(walker, time_s):
    start_m = walker.position_m[walker.time_s < 5.0, 2].mean()
    return np.interp(time_s, walker.time_s, walker.position_m[:, 2]) - start_m


def test_a_climb_is_reported_with_every_motion_once_the_start_is_known(climb):
    walkers, run, _ = climb
    time_s, height_m = of_node(run, 1)
    assert len(time_s) >= 0.85 * (walkers[1].time_s[-1] - 10.0)
    true_m = over_start(walkers[1], time_s)
    assert true_m.max() > 7.5, "not much of a climb"
    # 2 Pa a reading: 0.06 m as averaged, and as much for good from the start's. At 0.3 to 0.4 m/s
    # of climbing the average's 0.4 s besides, and what a report is old by when the next comes.
    assert np.abs(height_m - true_m).max() < 0.7
    still = time_s > walkers[1].time_s[-1] - 10.0
    assert np.abs(height_m[still] - true_m[still]).max() < 0.4
    assert abs((height_m[still] - true_m[still]).mean()) < 0.25


def test_a_node_that_stays_on_the_floor_has_no_height(climb):
    _, run, _ = climb
    _, height_m = of_node(run, 2)
    assert np.abs(height_m).max() < 0.4
    assert abs(height_m.mean()) < 0.25


def test_heights_are_kept_in_the_run_directory(climb):
    _, run, loaded = climb
    assert len(heights_of(loaded)) == len(heights_of(run)) > 100
    assert (loaded.directory / "height.csv").is_file()
