"""The ``mudg`` command: words to a `Step`, errors to exit codes. No logic of its own, and no torch.

Results go to stdout, progress and messages to stderr.
"""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import signal
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from mudg.base import failures, log, memory
from mudg.base.errors import ResourceError, UsageError, nearest, plain, plain_lines
from mudg.base.versions import version

if TYPE_CHECKING:
    from mudg.steps.command import Common
    from mudg.steps.step import Step

INTERRUPTED = 130
TERMINATED = 143
HELP = ("-h", "--help", "--help-all")


# the command line ---------------------------------------------------------------------------------


def overview() -> str:
    """The text of ``mudg --help``."""
    from mudg import steps

    lines = [
        f"mudg {version()}: turns a driving log into laterally shifted RGB, depth and semantic video",
        "and a dynamic 3D Gaussian scene that also renders well beside the recorded path.",
        "",
        "usage: mudg VERB [arguments]",
        "       mudg VERB --help     what it takes; mudg VERB --help-all: every setting",
        "       mudg --version",
    ]
    for title, names in steps.sections():
        lines += ["", f"{title}:", *_listed(names)]
    lines += [
        "",
        "Settings: flags override --config FILE.yaml, which overrides the defaults. Every result holds its settings in"
        " run.yaml.",
        "Repeat a command to resume it: finished results are verified and reused, interrupted ones are continued.",
        "Exit codes: 0 ok, 2 usage, 3 bad input, 4 damaged result, 5 missing resource, 6 numerical error, 130"
        " interrupted;",
        "of batch: 10 + number of failed scenes (99: 89 or more); 143 stopped by SIGTERM.",
    ]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line; return its exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words
    try:
        if not words or words[0] in ("-h", "--help", "help"):
            _say(overview())
            return 0 if words else UsageError.exit_code
        if words[0] in ("-V", "--version"):
            _say(f"mudg {version()}")
            return 0
        try:  # relative paths count from it, and libraries end the process without it
            os.getcwd()
        except OSError as error:
            what, remedy = "the current folder is gone, or cannot be entered", "change to a folder that exists"
            raise ResourceError(what, got=str(error), remedy=remedy) from error
        # Idle threads of OpenMP and of numpy's BLAS that spin would take the cores from others; must precede torch and
        # numpy.
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        os.environ.setdefault("PYDANTIC_ERRORS_INCLUDE_URL", "0")  # a wrong flag is told in our words
        if any("://" in word for word in words):
            from mudg.base import staging

            staging.refuse_secrets(words)
        verb, rest = find_verb(words)
        page = _help(verb, rest)
        if page is not None:
            _say(page)
            return 0
        result, as_json = _run_verb(verb, words)
        code = int(result.pop("exit_code", 0))
        _show(result, as_json=as_json)
        return code
    except KeyboardInterrupt as interrupt:
        _complain(plain(f"stopped. Repeat the same command to resume: mudg {shlex.join(words)}"))
        return TERMINATED if isinstance(interrupt, Terminated) else INTERRUPTED
    except BrokenPipeError:
        failures.silence(1)
        return 0
    except Exception as error:
        told = failures.in_words(error, _smaller(words))
        if told is None or debug:
            raise
        _complain(f"error: {told}")
        return told.exit_code


def _smaller(words: Sequence[str]) -> str:
    """The settings that make a command need less memory."""
    from mudg import steps

    with contextlib.suppress(UsageError, KeyError):
        return steps.step_class(find_verb(words)[0]).smaller
    return ""


def find_verb(words: Sequence[str]) -> tuple[str, list[str]]:
    """The verb of a command line, of one word or two, and the words behind it. UsageError: there is no such verb; the
    nearest is named."""
    from mudg import steps

    name, rest = words[0], list(words[1:])
    if name in steps.VERBS:
        return name, rest
    inside = steps.groups().get(name, [])
    if inside and rest and f"{name} {rest[0]}" in inside:
        return f"{name} {rest[0]}", rest[1:]
    if inside and (not rest or rest[0] in HELP):
        return name, rest
    what, head, wrong = f"there is no verb {name!r}", "mudg", name
    if inside:
        what, head, wrong = f"mudg {name} has no {rest[0]!r}", f"mudg {name}", rest[0]
    known = list(dict.fromkeys(verb.split(" ")[bool(inside)] for verb in inside or steps.VERBS))
    near = nearest(wrong, known, 0.5)
    remedy = f"did you mean `{head} {near}`?" if near else f"see {head} --help"
    raise UsageError(what, expected=f"one of {', '.join(known)}", remedy=remedy)


def _help(verb: str, words: Sequence[str]) -> str | None:
    """The page of help that a command line asks for; None if it asks for none."""
    from mudg import steps
    from mudg.steps import command

    if not {*HELP} & {*words}:
        return None
    if verb in steps.groups():
        lines = [f"usage: mudg {verb} WORD [flags]", "", *_listed(steps.groups()[verb])]
        return "\n".join([*lines, "", f"mudg {verb} WORD --help lists its flags."])
    cls, part = steps.step_class(verb), next((word for word in words if not word.startswith("-")), "")
    part, choice = part if part in cls.parts else "", command.chosen(cls, words)
    return command.help_page(cls, everything="--help-all" in words, part=part, choice=choice)


def _listed(names: Sequence[str]) -> list[str]:
    from mudg import steps

    return [f"  {name:<14}{steps.step_class(name).summary()}" for name in names]


def parse(words: Sequence[str]) -> tuple[Step, Common]:
    """A command line as its step, and the flags that every command has. UsageError: an unknown verb or flag, a missing
    or wrong value. InputError: --config cannot be read."""
    from mudg import steps
    from mudg.steps import command

    verb, rest = find_verb(words)
    if verb in steps.groups():
        expected = ", ".join(f"mudg {one}" for one in steps.groups()[verb])
        raise UsageError(f"mudg {verb} needs one more word", expected=expected)
    return command.parse(steps.step_class(verb), rest)


def _run_verb(verb: str, words: Sequence[str]) -> tuple[dict[str, Any], bool]:
    """Run a verb; returns what it shows, and whether as JSON."""
    step, common = parse(words)
    log.set_quiet(common.quiet)
    if verb not in ("doctor", "fuse"):  # they do without torch
        memory.require_address_space(f"mudg {verb}")
    if os.environ.get("MUDG_LIFE_LINE"):
        from mudg.base import processes

        processes.hold_life_line()

    call = lambda placed: placed.answer(placed.run())
    with _sigterm_interrupts():
        # whose workers stage in and out for every step
        if any("://" in word for word in words) and not verb.startswith("batch"):
            from mudg.base import staging

            return staging.run_staged(verb, step, call, common.scratch), common.json
        return call(step), common.json


def _say(text: str) -> None:
    try:
        sys.stdout.write(plain_lines(text.split("\n")) + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except (OSError, ValueError, AttributeError) as error:
        failures.silence(1)
        what, remedy = "the answer cannot be written to standard output", "repeat the command to see the answer"
        raise ResourceError(what, got=str(error), remedy=f"what was made is complete; {remedy}") from error


def _complain(text: str) -> None:
    """A message that cannot be written changes no exit code."""
    try:
        sys.stderr.write(text + "\n")
        sys.stderr.flush()
    except (OSError, ValueError, AttributeError):  # on a full disk; closed; never opened
        failures.silence(2)


def _show(result: dict[str, Any], *, as_json: bool) -> None:
    """Print a verb's result: its text, else one ``name: path`` a line; or all but the text as JSON."""
    text = result.pop("text", None)
    if as_json:
        text = json.dumps(result, indent=1, default=str, allow_nan=False)
    _say(text if text is not None else plain_lines(f"{name}: {value}" for name, value in result.items()))


class Terminated(KeyboardInterrupt):
    """SIGTERM: stops as Ctrl-C does, with its own exit code."""


@contextlib.contextmanager
def _sigterm_interrupts() -> Iterator[None]:
    def stop(_number: int, _frame: object) -> None:
        raise Terminated

    before = signal.getsignal(signal.SIGTERM)
    try:
        with contextlib.suppress(ValueError):  # not the main thread
            signal.signal(signal.SIGTERM, stop)
        yield
    finally:
        with contextlib.suppress(ValueError):
            signal.signal(signal.SIGTERM, before)
