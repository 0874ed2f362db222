#!/usr/bin/env bash
# Install what the tests of mudg batch need (Slurm of Debian, Ray) and run them. As root, in an environment that holds mudg and pytest.
#     tools/cluster_tests.sh [further words for pytest]
set -euo pipefail
cd "$(dirname "$0")/.."
if ! command -v sbatch >/dev/null || ! command -v slurmctld >/dev/null; then
  apt-get update -q && apt-get install -q -y --no-install-recommends slurmctld slurmd slurm-client munge
fi
python -c "import ray" 2>/dev/null || python -m pip install -q "ray>=2.40"
exec python -m pytest -m cluster -s tests/test_batch_engines.py "$@"
