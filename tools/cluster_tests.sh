#!/usr/bin/env bash
# Tests of mudg batch on clusters of this machine: Slurm of Debian (installed as root where it is missing) and Ray (installed into a folder).
#
#     tools/cluster_tests.sh [FOLDER] [pytest arguments]
#
# PYTHON names the python that mudg and pytest are installed for (default: python3). MUDG_TEST_SCENES: scenes of the largest batch
# (default 100000).
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
folder=${1:-${TMPDIR:-/tmp}/mudg-cluster-tests}
shift || true
python=${PYTHON:-python3}
if ! command -v sbatch >/dev/null || ! PATH=$PATH:/usr/sbin command -v slurmctld >/dev/null; then
    apt-get update -q && apt-get install -q -y --no-install-recommends slurmctld slurmd slurm-client munge
fi
if [ ! -x "$folder/venv/bin/ray" ]; then
    mkdir -p "$folder"
    "$python" -m venv "$folder/venv"
    "$folder/venv/bin/pip" install -q 'ray>=2.40' 'submitit>=1.5'
fi
"$python" -c 'import site; print(*site.getsitepackages(), sep="\n")' >"$(echo "$folder"/venv/lib/python3*/site-packages)/zz_mudg.pth"
cd "$root"
PYTHONPATH=$root/src${PYTHONPATH:+:$PYTHONPATH} exec "$folder/venv/bin/python" -m pytest -m cluster -s --durations=20 \
    tests/test_batch_engines.py "$@"
