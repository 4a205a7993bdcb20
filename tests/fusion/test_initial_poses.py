"""What is given of where nodes start."""

from __future__ import annotations

import math

import pytest

from relpos import fusion
from relpos.errors import RelposError
from relpos.measurements import Prior

FEW, MANY = range(1, 4), range(1, 31)


@pytest.mark.parametrize("name", ["bank", "particle", "deadreckoning"])
@pytest.mark.parametrize("nodes", [FEW, MANY], ids=["few", "many"])
@pytest.mark.parametrize("sigma_m", [0.1, math.inf], ids=["known", "unknown"])
def test_a_node_with_two_initial_poses_is_refused(name: str, nodes: range, sigma_m: float) -> None:
    priors = [Prior(node, float(node), 0.0, 0.0, sigma_m) for node in [*nodes, 2]]
    with pytest.raises(RelposError, match="node 2 has two initial poses"):
        fusion.make(name, priors)
