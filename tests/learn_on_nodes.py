"""`mudg learn` as a worker that is killed or warned during a step: FAULT is kill:STEP:RANK (once) or warn:STEP:RANK."""

import os
import signal
import sys

from mudg import app
from mudg.diffusion import learn

what, step_of_fault, rank_of_fault = (os.environ.get("FAULT") or "none:-1:-1").split(":")
draw = learn.draw_clips


def draw_with_fault(config, folder, step, *rest):
    if step == int(step_of_fault) and os.environ["RANK"] == rank_of_fault:
        if what == "warn":
            os.kill(os.getpid(), signal.SIGUSR1)
        elif os.environ["TORCHELASTIC_RESTART_COUNT"] == "0":
            os.kill(os.getpid(), signal.SIGKILL)
    return draw(config, folder, step, *rest)


learn.draw_clips = draw_with_fault
sys.exit(app.main(sys.argv[1:]))
