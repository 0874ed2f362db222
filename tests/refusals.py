"""Calls that must end in an error of this program, and pickles that ask for one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from mudg.base.errors import InputError


def refused(words: str, call: Callable[..., object], *args: Any, raises: type = InputError, **options: Any) -> Any:
    """The error that a call ends in; ``words``: a pattern in it."""
    with pytest.raises(raises, match=words) as caught:
        call(*args, **options)
    return caught.value


class Asks:
    """Pickles as a call of ``function``."""

    def __init__(self, function: Callable[..., object], *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call
