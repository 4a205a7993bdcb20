"""The default estimator, which fails once where the file that RELPOS_FAILS names lies."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from relpos import Estimate, Measurement, Prior, fusion
from relpos.fusion.estimator import Estimator


class Failing:
    """Fails at the next measurement, and takes the file away."""

    def __init__(self, bank: Estimator, fails: Path) -> None:
        self.bank = bank
        self.fails = fails

    def process(self, measurement: Measurement) -> Sequence[Estimate]:
        if self.fails.exists():
            self.fails.unlink()
            raise ZeroDivisionError("as a fault of the estimator would")
        return self.bank.process(measurement)

    def finish(self) -> Sequence[Estimate]:
        return self.bank.finish()

    def counters(self) -> Mapping[str, int]:
        return self.bank.counters()


def make(priors: Sequence[Prior] = (), seed: int = 0) -> Failing:
    return Failing(fusion.make("bank", priors, {}, seed), Path(os.environ["RELPOS_FAILS"]))
