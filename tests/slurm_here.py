"""A Slurm of one node in a scratch folder: munge, controller and node daemon as processes of this test, on ports of
their own.

    with slurm_here(folder) as environment: ...          None with a reason where it cannot be started
"""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

CONF = """ClusterName=test
SlurmctldHost={host}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CryptoType=crypto/munge
SlurmUser={user}
SlurmdUser={user}
SlurmctldPort={port}
SlurmdPort={node_port}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SchedulerType=sched/backfill
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
ReturnToService=2
MpiDefault=none
SwitchType=switch/none
KillWait=20
NodeName={host} CPUs={cores} State=UNKNOWN
PartitionName=main Nodes={host} Default=YES MaxTime=INFINITE State=UP OverSubscribe=NO
"""
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scontrol")


def missing() -> str:
    """Why no Slurm can be started here; empty if it can."""
    lacking = [name for name in PROGRAMS if _program(name) is None]
    if lacking:
        return f"not installed: {', '.join(lacking)} (apt-get install slurmctld slurmd slurm-client munge)"
    return "" if os.geteuid() == 0 else "slurmd needs root"


def _program(name: str) -> str | None:
    return shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin:/usr/local/sbin")


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@contextlib.contextmanager
def slurm_here(folder: Path) -> Iterator[dict[str, str]]:
    """Environment in which sbatch and the others reach the cluster. RuntimeError if it does not come up."""
    folder.mkdir(parents=True)
    folder.chmod(0o755)
    for name in ("state", "spool"):
        (folder / name).mkdir()
    (folder / "munge.key").write_bytes(os.urandom(128))
    (folder / "munge.key").chmod(0o600)
    host = socket.gethostname().split(".")[0]
    ports = {"port": _free_port(), "node_port": _free_port()}
    text = CONF.format(host=host, folder=folder, user="root", cores=os.cpu_count(), **ports)
    (folder / "slurm.conf").write_text(text)
    environment = {**os.environ, "SLURM_CONF": str(folder / "slurm.conf")}
    commands = (
        [
            *("munged", "--foreground", "--force", f"--key-file={folder}/munge.key"),
            *(f"--{kind}-file={folder}/munge.{kind}" for kind in ("pid", "seed", "log")),
            f"--socket={folder}/munge.socket",
        ],
        ["slurmctld", "-D", "-f", str(folder / "slurm.conf")],
        ["slurmd", "-D", "-f", str(folder / "slurm.conf"), "-N", host],
    )
    running: list[subprocess.Popen[bytes]] = []
    try:
        for words in commands:
            with (folder / f"{words[0]}.out").open("wb") as log:
                program = [_program(words[0]) or words[0], *words[1:]]
                running.append(subprocess.Popen(program, env=environment, stdout=log, stderr=log))
            time.sleep(1.0)
        end = time.monotonic() + 60
        while (
            "idle"
            not in subprocess.run(["sinfo", "-h", "-o", "%t"], env=environment, capture_output=True, text=True).stdout
        ):
            if time.monotonic() > end or any(one.poll() is not None for one in running):
                logs = " ".join(path.read_text(errors="replace")[-300:] for path in sorted(folder.glob("*.out")))
                raise RuntimeError(f"Slurm did not come up: {logs}")
            time.sleep(0.5)
        yield environment
    finally:
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):  # no job may outlive its daemons
            words = ["scancel", "--full", "--signal=KILL", "--user", "root"]
            subprocess.run(words, env=environment, capture_output=True, timeout=10)
            time.sleep(2.0)
        for one in reversed(running):
            one.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                one.wait(10)
            if one.poll() is None:
                one.kill()
                one.wait()
