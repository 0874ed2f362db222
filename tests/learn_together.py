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


def run_until(step, config, folder, stopper):
    """Run on; process `stopper` alone is asked to stop during step number `step`."""

    def stop_then(drawn_step):
        if rank == stopper and drawn_step == step - 1:
            Interruption.requested = property(lambda self: True)

    asked = Interruption.requested
    try:
        with before_each_batch(stop_then):
            Learn(out=folder, settings=config).run()
    except KeyboardInterrupt:
        return True
    finally:
        Interruption.requested = asked
    return False


common = {"batch_frames": 8, "log_every": 1, "checkpoint_every": 100, "steps": 6}
config = tiny(clips, **common)
said["stopped under ddp"] = run_until(3, config, out / "parts", stopper=1)
sharded = tiny(clips, **common, parallel="fsdp", recompute=True)
said["stopped under fsdp"] = run_until(5, sharded, out / "parts", stopper=0)
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
