"""Takes up a training state, or trains one for three steps, saves it anew and prints the hash of all of it: LAYOUT FROM
INTO."""

import hashlib
import os
import sys
from pathlib import Path

import torch
from torch import nn

from mudg.diffusion.parallel import Ranks, Spread, TrainingState, gathered, join_processes


class ToyBlocks(nn.Module):
    """Two blocks with rows that 2 and 4 processes do not divide."""

    def __init__(self) -> None:
        super().__init__()
        self.blocks = nn.ModuleList([nn.Sequential(nn.Linear(7, 13), nn.GELU(), nn.Linear(13, 7)) for _ in range(2)])
        self.norm = nn.LayerNorm(7)


def state_of(ranks: Ranks, layout: str) -> tuple[TrainingState, nn.Module]:
    torch.manual_seed(0)
    trained = nn.ModuleDict({"net": ToyBlocks()})
    Spread(trained, trained, ranks, layout)
    optimizer = torch.optim.AdamW(trained.parameters(), lr=1e-2, fused=True)
    return TrainingState(trained, optimizer, {k: v.detach().clone() for k, v in trained.state_dict().items()}), trained


def main(layout: str, before: str, into: str) -> None:
    with join_processes("cpu") as ranks:
        state, trained = state_of(ranks, layout)
        if before:
            if not state.resume(Path(before), ranks):
                raise SystemExit("nothing to resume")
        else:
            for _ in range(3):
                for number, value in enumerate(trained.parameters()):
                    value.grad = torch.full_like(value, 0.1 + number)
                state.optimizer.step()
                state.step += 1
                state.blend(0.9)
        digest = hashlib.sha256(str(state.step).encode())
        held = [*state.trained.state_dict().items(), *(state.average or {}).items()]
        held += [pair for kind in state._moments().values() for pair in kind.items()]
        for name, value in held:
            digest.update(name.encode() + gathered(value).contiguous().numpy().tobytes())
        state.save(Path(into), ranks, {})
        if ranks.leads:
            print(digest.hexdigest(), flush=True)


os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
main(*sys.argv[1:])
