"""One of two processes that train a published-type model together: started by test_learn_published with (rank, store
file, folder of the model, folder of clips, out)."""

import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ["GLOO_SOCKET_IFNAME"] = "lo"

import torch.distributed as dist
from toy_published import published_settings

from mudg.steps.synthesize import Learn

rank, store, start, clips, out = int(sys.argv[1]), *sys.argv[2:5], Path(sys.argv[5])
dist.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=2)
settings = published_settings(start, clips, frozen="temporal_transformers", steps=3, recompute=True)
Learn(out=out, settings=settings).run()
dist.destroy_process_group()
