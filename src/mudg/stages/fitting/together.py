"""The views of one step side by side: each on its own thread, where a single one leaves cores idle.

A step of a fit on a CPU spends a quarter of its time where no loop of the native library runs. Two views at once fill it. Gradients of both
are added to the same parameters; autograd adds whole tensors under a lock, and a + b is b + a, so the result is the same to the bit.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from mudg import native

Result = TypeVar("Result")
Together = Callable[[Sequence[Callable[[], Result]]], list[Result]]


@contextlib.contextmanager
def side_by_side_calls(parallel: bool) -> Iterator[Together[Result]]:
    """A function that makes calls and returns their results in order: two at a time if ``parallel``, else one after the other.

    If calls raise, all end first; then the first one's exception is raised.
    """
    if not parallel:
        yield lambda calls: [call() for call in calls]
        return
    every = native.threads()
    with ThreadPoolExecutor(1, "views") as pool:

        def together(calls: Sequence[Callable[[], Result]]) -> list[Result]:
            if len(calls) < 2:
                return [call() for call in calls]
            native.set_threads(every - 1)  # the second thread is one of them
            try:
                others = [pool.submit(call) for call in calls[1:]]
                try:
                    first = calls[0]()
                finally:
                    for other in others:
                        other.exception()
            finally:
                native.set_threads(every)
            return [first, *(other.result() for other in others)]

        yield together
