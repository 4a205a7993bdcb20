"""What each of the bank's hypotheses models: the data choose by weight among them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from relpos.fusion.bank.settings import BankSettings

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

HEIGHTS_SHARE, STOREY_M2 = 0.5, 9.0
"""Where nobody's height is known, in this share of the hypotheses with biases a pair has instead of
its bias the square of its difference of height: a constant, in which a range's square is linear.
Its prior deviation is that of one storey (``mission-floors-no-heights``, seeds 640 to 642: 0.30 m,
NEES 3.2 without, 0.13 m, 0.9 so; ``paper``, 23010 to 23019: 0.794 +- 0.029 m, 0.798 +- 0.022)."""

RETURN_SHARE = 0.002
"""Of the hypotheses without constants (or range biases), this share gets them back at each
resampling: none may be left when they begin to matter. ``mission-split-hard`` 611: 2.49 m without,
1.63 with; more than that costs where there are none (``paper-h``: 0.83 with it, 0.90 with ten times
as much)."""


@dataclass(slots=True)
class Models:
    """Arrays (K,): 1 where a hypothesis models something, else 0."""

    constants: Floats
    """Step scale and heading drift."""
    bias: Floats
    """Range biases, and what else ranges have in common."""
    heights: Floats
    """That a pair's own entry is the square of its difference of height."""
    low_heading_noise: Floats
    """Headings of wheels or a camera."""

    @staticmethod
    def draw(settings: BankSettings, count: int, rng: np.random.Generator) -> Models:
        """Draw what each of ``count`` hypotheses models."""

        def share_of_all(many: int) -> Floats:
            return (rng.permutation(count) < many).astype(np.float64)

        constants = share_of_all(round(settings.constants * count))
        bias = np.sort(share_of_all(round(settings.biased * count)))
        heights = bias * (rng.random(count) < HEIGHTS_SHARE)
        low_heading_noise = share_of_all(int(settings.steady * count))
        return Models(constants, bias, heights, low_heading_noise)

    def select(self, chosen: Indices) -> Models:
        """Return those of the hypotheses ``chosen`` (M,)."""
        return Models(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def merge(self, weight: Floats, count: int) -> Models:
        """Return what ``count`` hypotheses model that stand for all, whose weights are (K,).

        That is what most of them model. What most do not has no variance left to learn with: it
        has to be given back later.
        """

        def most(model: Floats) -> Floats:
            return np.full(count, float(weight @ model > 0.5))

        # Between the two, where that is open: a nearly linear mixture leaves it so for long.
        low_noise = np.full(count, float(weight @ self.low_heading_noise))
        return Models(most(self.constants), most(self.bias), most(self.heights), low_noise)
