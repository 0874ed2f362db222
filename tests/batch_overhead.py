"""What the batch layer itself takes: many scenes whose step only writes one small file.

    python tests/batch_overhead.py FOLDER [COUNT]

Prints seconds and bytes per scene, seconds of a second run that does nothing, and time and memory of ``mudg batch status``.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from pathlib import Path

from mudg.base import log
from mudg.base.location import Location
from mudg.stages.batches.children import Ending
from mudg.stages.batches.folders import BatchFolder
from mudg.stages.batches.lists import Entry
from mudg.stages.batches.plan import plan_of
from mudg.stages.batches.work import Worker, WorkRequest, WorkRules


def writes(unit, folder):
    folder.result.mkdir(parents=True)
    (folder.result / "x.txt").write_text(unit.entry.name)
    return Ending(3, "it is cut off") if unit.entry.name.endswith("77") else Ending(0, seconds=0.005)


def measured(out: Path, count: int) -> dict[str, float]:
    log.set_quiet(True)
    entries = [Entry(f"scene{number:06d}", f"/logs/{number}") for number in range(count)]
    folder, plan = BatchFolder(Location.of(out)), plan_of((), {}, ("program", "{out}"))
    folder.begin(plan, entries)
    request = WorkRequest(folder, plan, entries, WorkRules(patience_s=0.0))
    sys.stderr = open(os.devnull, "w")
    began = time.monotonic()
    Worker(request, perform=writes).run()
    ran = time.monotonic()
    Worker(request, perform=writes).run()
    again = time.monotonic()
    code = "import sys,resource,time; b=time.monotonic(); from mudg import app; "
    code += "app.main(['batch','status',sys.argv[1],'--html','--quiet']); "
    code += "print(time.monotonic()-b, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss/1024)"
    done = subprocess.run([sys.executable, "-c", code, str(out)], capture_output=True, text=True, check=True)
    seconds, mebibytes = map(float, done.stdout.splitlines()[-1].split())
    size = sum(os.lstat(os.path.join(top, name)).st_blocks * 512 for top, _, names in os.walk(out / "_batch") for name in names)
    return {
        "ms_per_scene": 1000 * (ran - began) / count, "second_run_s": again - ran, "status_s": seconds, "status_mib": mebibytes,
        "disk_kb_per_scene": size / count / 1000, "worker_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }  # fmt: skip


if __name__ == "__main__":
    for name, value in measured(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 100_000).items():
        print(f"{name:20} {value:.3f}")
