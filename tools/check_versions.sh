#!/bin/sh
# Runs the package's own tests on one Python, with the newest or the oldest libraries it allows.
#   tools/check_versions.sh 3.11 lowest-direct
#   tools/check_versions.sh 3.14 highest
# Needs uv; makes its environment under .build/versions.
set -eu

python=${1:?which Python, such as 3.11}
resolution=${2:?highest or lowest-direct}
cd "$(dirname "$0")/.."
venv=.build/versions/$python-$resolution
uv venv --quiet --clear --python "$python" "$venv"
# The oldest libraries of relpos, with today's tools for tests.
uv pip install --quiet --python "$venv" --resolution "$resolution" --editable '.[all,cluster]'
uv pip install --quiet --python "$venv" pytest pytest-xdist hypothesis httpx digi-xbee
uv pip list --quiet --python "$venv" | grep -iE '^(numpy|numba|scipy|matplotlib|typer|construct|rich) '
export NUMBA_CACHE_DIR="$PWD/$venv/kernels" OPENBLAS_NUM_THREADS=1
"$venv/bin/relpos" --help >/dev/null
"$venv/bin/relpos" simulate --scenario paper-p1 --seed 1 --set seconds=30 --out "$venv/run"
"$venv/bin/relpos" fuse "$venv/run" --out "$venv/fused"
"$venv/bin/relpos" fuse "$venv/run" --estimator particle --no-report --out "$venv/fused"
"$venv/bin/pytest" -q -n auto tests/fusion tests/runs tests/evaluation tests/link tests/cli
