"""`mudg learn` as a worker that is killed or warned during a step: FAULT is kill:STEP:RANK (once) or warn:STEP:RANK."""

import os
import signal
import sys

from toy_clips import before_each_batch

from mudg import app

what, step_of_fault, rank_of_fault = (os.environ.get("FAULT") or "none:-1:-1").split(":")


def fault(step):
    if step == int(step_of_fault) and os.environ["RANK"] == rank_of_fault:
        if what == "warn":
            os.kill(os.getpid(), signal.SIGUSR1)
        elif os.environ["TORCHELASTIC_RESTART_COUNT"] == "0":
            os.kill(os.getpid(), signal.SIGKILL)


with before_each_batch(fault):
    sys.exit(app.main(sys.argv[1:]))
