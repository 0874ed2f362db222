"""One of two processes that train together: started by test_learn_parallel with (rank, store file, folder of clips,
out)."""

import json
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ["GLOO_SOCKET_IFNAME"] = "lo"

import torch.distributed as dist
from toy_clips import before_each_batch, tiny

from mudg.base.errors import NumericsError, UsageError
from mudg.base.processes import Interruption
from mudg.steps.synthesize import Learn

rank, store, clips, out = int(sys.argv[1]), sys.argv[2], sys.argv[3], Path(sys.argv[4])
dist.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=2)
said = {}


def stop_in_step_5(drawn_step):
    """One of the two processes alone is asked to stop."""
    if rank == 1 and drawn_step == 4:
        Interruption.requested = property(lambda self: True)


common = {"batch_frames": 8, "log_every": 1, "checkpoint_every": 100, "steps": 6}
asked = Interruption.requested
try:
    with before_each_batch(stop_in_step_5):
        Learn(out=out / "parts", settings=tiny(clips, **common, recompute=True)).run()
except KeyboardInterrupt:
    said["stopped"] = True
Interruption.requested = asked
try:
    Learn(out=out / "numerics", settings=tiny(clips, batch_frames=8, lr=1e30, steps=20)).run()
except NumericsError as error:
    said["numerics"] = str(error)
try:
    Learn(out=out / "uneven", settings=tiny(clips, batch_frames=4)).run()
except UsageError as error:
    said["uneven"] = str(error)
(out / f"said_{rank}.json").write_text(json.dumps(said))
dist.destroy_process_group()
