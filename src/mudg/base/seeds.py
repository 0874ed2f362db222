"""Random numbers without random state: every draw in the package comes from a seed computed from (run seed, step,
purpose). There is no generator to save: resuming at step 1000 draws what the uninterrupted run would have drawn."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch


def key(run_seed: int, step: int, purpose: str) -> int:
    """Return a 63-bit seed that depends on all three arguments and on nothing else."""
    text = f"{int(run_seed)}\x1f{int(step)}\x1f{purpose}".encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "little") >> 1


def numpy_rng(run_seed: int, step: int, purpose: str) -> np.random.Generator:
    """Return a fresh numpy generator for this (run seed, step, purpose)."""
    return np.random.Generator(np.random.PCG64(key(run_seed, step, purpose)))


def torch_generator(run_seed: int, step: int, purpose: str) -> torch.Generator:
    """Return a fresh torch generator (on the CPU) for this (run seed, step, purpose)."""
    import torch

    return torch.Generator().manual_seed(key(run_seed, step, purpose))
