"""What becomes of a failure: by exit code, how often a step is tried again, when, and from where."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from mudg.base.errors import UsageError


@dataclass(frozen=True)
class RetryRule:
    """What is done about one kind of failure.

    Args:
        reason: its name. tries: how often it may happen to a step before the step has failed. backoff_s: seconds until the second
            try, doubled for each further one. fresh: what was made is thrown away first. elsewhere: the machine where it
            happened waits three times as long as others.
    """

    reason: str
    tries: int = 1
    backoff_s: float = 0.0
    fresh: bool = False
    elsewhere: bool = False


KILLED: Final = 137
"""Code of a step that was killed, as the system does where memory runs out."""
RULES: Final[Mapping[int, RetryRule]] = {
    1: RetryRule("a mistake in the program"),
    2: RetryRule("usage"),
    3: RetryRule("bad input"),
    4: RetryRule("damaged result", tries=2, fresh=True),
    5: RetryRule("memory or disk", tries=4, backoff_s=60, elsewhere=True),
    6: RetryRule("numbers"),  # the same settings give the same numbers
    130: RetryRule("interrupted", tries=20),
    KILLED: RetryRule("killed, most likely for want of memory", tries=2, backoff_s=5),  # the second time with less
    143: RetryRule("asked to stop", tries=20),
}
LOST: Final = -1
"""Code of an attempt whose worker vanished: a machine that went down, a killed worker, a lease that ran out."""
REJECTED: Final = -2
"""Code of a result that fails a bound on its quality."""
DIFFERENT: Final = -3
"""Code of a result whose second run gave other bytes."""
_OTHERS: Final[Mapping[int, RetryRule]] = {
    LOST: RetryRule("its worker vanished", tries=20), REJECTED: RetryRule("quality"), DIFFERENT: RetryRule("second run differs"),
}  # fmt: skip
REASONS: Final = {"lost": LOST, "quality": REJECTED, "differs": DIFFERENT}
"""Names of the reasons that are no exit codes."""


def rule_of(code: int) -> RetryRule:
    """The rule for an exit code; a signal s, which ends a process with -s or 128 + s, counts as 128 + s."""
    if code in _OTHERS:
        return _OTHERS[code]
    if code not in RULES and code > 128:
        return RetryRule(f"ended by signal {code - 128}", tries=3, backoff_s=5)
    return RULES.get(code, RetryRule(f"exit code {code}"))


def code_of(returned: int) -> int:
    """What ``subprocess`` returns, as an exit code of a shell: signal s is 128 + s."""
    return 128 - returned if returned < 0 else returned


def backoff(code: int, times: int, same_host: bool) -> float:
    """Seconds to wait after the failure with this code has happened ``times`` times."""
    rule = rule_of(code)
    return rule.backoff_s * 2 ** (times - 1) * (3.0 if rule.elsewhere and same_host else 1.0)


def parse_reasons(text: str) -> set[int]:
    """Codes of ``"5,6"`` or ``"quality,137"``; empty for an empty text.

    Raises:
        UsageError: something else.
    """
    found: set[int] = set()
    for word in filter(None, re.split(r"[,\s]+", text)):
        if not word.isdecimal() and word not in REASONS:
            raise UsageError("unknown reason", where="--reason", got=word, expected=f"exit codes, or {', '.join(REASONS)}")
        found.add(int(word) if word.isdecimal() else REASONS[word])
    return found
