# %% [markdown]
# # Three estimators on one simulated walk, and the least error there can be
#
# Six people walk round a rectangle of 20 by 10 m; their steps and turns are reported with errors,
# and now and then two of them measure how far apart they are. Dead reckoning, the particle filter
# of the paper and the bank get the same reports. The run is simulated, so two things are known that
# a recording does not hold: the truth, and the Cramer-Rao bound, below which no estimator can stay
# on average.
#
# Run it as a script, or cell by cell in an editor that knows `# %%`:
#
#     python docs/examples/compare_estimators.py [FOLDER]
#
# With a FOLDER the figures are written there.

# %%
import sys
from pathlib import Path

import numpy as np

import relpos

run = relpos.simulate("paper", seed=4, seconds=150)
print(f"{run.name}: {len(run.motions)} motions, {len(run.ranges)} ranges of nodes {run.node_ids}")

# %% [markdown]
# ## The same measurements through each
#
# A result holds everything that an estimator gave. `evaluate` scores it against the truth and says
# which part of a NEES off 1 chance alone explains. The estimators' settings are those of `--set`.

# %%
settings = {"particle": {"particles": 200}, "bank": {"hypotheses": 60}}
results = {
    name: relpos.fuse(run, name, seed=1, settings=settings.get(name))
    for name in ("deadreckoning", "particle", "bank")
}
scores = {name: relpos.evaluate(result, run) for name, result in results.items()}

print(f"{'':14}  distance   aligned      CE95      NEES  (honest)")
for name, score in scores.items():
    figures, chance = score.metrics, score.nees_distance
    # One rigid motion of the plane for the whole run lays the picture on the truth.
    shape = score.iso.frames["per_run"].horizontal
    print(
        f"{name:14}  {figures.relative_distance_rmse_m:6.2f} m  "
        f"{figures.relative_position_rmse_m:6.2f} m  {shape.e95_m:6.2f} m  "
        f"{chance.mean:8.2f}  ({chance.low:.2f} to {chance.high:.2f})"
    )

# %% [markdown]
# ## Against the bound
#
# The bound is a curve over time: right after a range it is small, and it grows until the next. Its
# ratio to an estimator's error says how much there is still to be had.

# %%
bound = relpos.bound(run)
assert bound is not None, "only a simulated run has a bound"
least = bound.totals()
print(f"{'bound':14}  {least.filtering_distance_m:6.2f} m  {least.filtering_position_m:6.2f} m")
for name, score in scores.items():
    ratio = score.metrics.relative_distance_rmse_m / least.filtering_distance_m
    print(f"{name}: {ratio:.2f} times the bound")

# %% [markdown]
# ## When it goes wrong
#
# Tables are arrays, and data frames where pandas is installed: here each estimator's error in four
# parts of the walk.

# %%
for name, score in scores.items():
    parts = np.array_split(score.metrics.distance_rmse_over_time_m, 4)
    rms = [float(np.sqrt(np.nanmean(part**2))) for part in parts]
    print(f"{name:14}", "  ".join(f"{value:5.2f} m" for value in rms))

poses = results["bank"].arrays()
print(f"the bank returned {poses['time_s'].size} poses; the last is of node {poses['node'][-1]}")

# %% [markdown]
# ## Figures
#
# Every figure of the report can be had by its name, and the whole page too.

# %%
if len(sys.argv) > 1:
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    relpos.plot(results["particle"], run, "error").savefig(folder / "particle.svg")
    print("page:", relpos.report(results["bank"], run, folder / "bank.html"))
