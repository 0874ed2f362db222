"""The command line: precedence, suggestions, exit codes, quiet errors."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import Any

import pytest

from mudg import app
from mudg.base import config as configuration
from mudg.base.errors import InputError, IntegrityError, MudgError, NumericsError, ResourceError, UsageError
from mudg.steps.doctor import Doctor
from mudg.steps.settings import run_preset, with_seed


def parse(*words: str) -> Any:
    return app.parse(words)[0]


def call(monkeypatch: pytest.MonkeyPatch, outcome: object, *words: str) -> int:
    """Run ``mudg doctor`` with its function replaced."""

    def act(_args: object) -> dict[str, Any]:
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    monkeypatch.setattr(Doctor, "run", act)
    return app.main(["doctor", *words])


# ---- settings ----


def test_the_seed_goes_to_every_verb_that_draws_and_beats_the_file(tmp_path: Path) -> None:
    args = parse("demo", "--seed", "7")
    parts = [part for part in configuration.to_dict(args.settings).values() if isinstance(part, dict)]
    seeds = [part["seed"] for part in parts if "seed" in part]
    assert len(seeds) >= 2 and {*seeds, args.settings.ingest.city.seed} == {7}
    assert parse("demo", "--seed", "7", "--fit.seed", "3").settings.fit.seed == 3
    file = tmp_path / "run.yaml"
    file.write_text(configuration.dump_yaml(with_seed(run_preset(), 3)))
    assert parse("demo", "--config", str(file)).settings.fit.seed == 3
    assert parse("demo", "--config", str(file), "--seed", "4").settings.fit.seed == 4


def test_shifts_go_to_synthesize_and_render_together() -> None:
    settings = parse("demo", "--shifts-m", "1.5", "-2", "0").settings
    assert settings.synthesize.shifts_m == (1.5, -2.0)
    assert settings.render.shifts_m == (0.0, 1.5, -2.0)
    default = parse("run", "log", "--out", "o").settings
    assert default.synthesize.cameras == default.render.cameras == ()
    assert set(default.render.shifts_m) == {0.0, *default.synthesize.shifts_m}
    side = parse("run", "log", "--out", "o", "--cameras", "front_left").settings
    assert side.synthesize.cameras == side.render.cameras == ("front_left",)


@pytest.mark.parametrize(
    ("line", "text", "code", "words"),
    [
        ("fit scene --fused f --out o", "iteratons: 3\n", 2, ("iteratons", "did you mean iterations")),
        ("demo", "fit:\n  iterations: -4\n", 2, ("fit.iterations", "FILE")),
        ("demo", "fit: {iteratons: 3}\n", 2, ("fit.iteratons", "did you mean fit.iterations")),
        ("demo", "guided_share: [1]\n", 2, ("guided_share", "FILE")),
        ("demo", "fit: [1, 2\n", 3, ("not valid YAML",)),
        ("demo", None, 3, ()),
    ],
)
def test_what_is_wrong_in_a_file_of_settings_is_said(
    line: str, text: str | None, code: int, words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "settings.yaml"
    if text is not None:
        file.write_text(text)
    assert app.main([*line.split(), "--config", str(file)]) == code
    said = capsys.readouterr().err
    assert "Traceback" not in said and all(word.replace("FILE", "settings.yaml") in said for word in words)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("fti --help", "did you mean `mudg fit`?"),
        ("synthesise", "did you mean `mudg synthesize`?"),
        ("zzzz", "see mudg --help"),
        ("fit scene --fused f --out o --iteratons 3", "did you mean --iterations?"),
        ("fit scene --out x --no-such-flag 3", "--no-such-flag"),
        ("fit scene clouds --out x", "too many words"),
        ("fit scene --fused f --out o --method nerf", ""),
        ("score scene --out o --views no-equals-sign", ""),
        ("demo --seed x", ""),
        ("render scene", ""),
    ],
)
def test_wrong_words_end_with_code_2_and_no_traceback(
    line: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert app.main(line.split()) == 2
    said = capsys.readouterr().err
    assert words in said and "Traceback" not in said


# ---- exit codes and output ----


@pytest.mark.parametrize(
    ("error", "code"),
    [
        *((UsageError, 2), (InputError, 3), (IntegrityError, 4)),
        *((ResourceError, 5), (NumericsError, 6), (KeyboardInterrupt, 130)),
    ],
)
def test_exit_codes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: type[BaseException], code: int
) -> None:
    raised = error("it broke", where="here", remedy="mend it") if issubclass(error, MudgError) else error()
    assert call(monkeypatch, raised) == code
    message = capsys.readouterr().err
    assert "Traceback" not in message and ("mend it" if issubclass(error, MudgError) else "mudg doctor") in message
    with pytest.raises(error if issubclass(error, MudgError) else ZeroDivisionError):  # a mistake is not disguised
        call(monkeypatch, raised if issubclass(error, MudgError) else ZeroDivisionError(), "--debug")


def test_results_go_to_stdout_as_text_or_json(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(monkeypatch, {"report": Path("a") / "b", "text": "words"}) == 0
    assert capsys.readouterr().out == "words\n"
    assert call(monkeypatch, {"report": Path("a") / "b", "text": "words"}, "--json") == 0
    assert json.loads(capsys.readouterr().out) == {"report": str(Path("a") / "b")}
    assert call(monkeypatch, {"model": Path("m")}) == 0
    assert capsys.readouterr().out == "model: m\n"
    assert call(monkeypatch, {"text": "bad", "exit_code": 3}) == 3


def test_version_and_overview(capsys: pytest.CaptureFixture[str]) -> None:
    assert app.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("mudg ")
    assert app.main(["--help"]) == 0
    assert "mudg VERB --help" in capsys.readouterr().out
    assert app.main([]) == 2


def test_sigterm_stops_like_ctrl_c_with_its_own_code(monkeypatch: pytest.MonkeyPatch) -> None:
    def act(_args: object) -> dict[str, Any]:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5)
        return {}

    monkeypatch.setattr(Doctor, "run", act)
    before = signal.getsignal(signal.SIGTERM)
    assert app.main(["doctor"]) == 143
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize(
    "line, flag, got",
    [
        ("fit scene --out x --loss.ssim-weight=-1", "--loss.ssim-weight", "-1"),
        ("learn --out x --data.width=-3", "--data.width", "-3"),
        ("render scene --model fit --out x --width-px=-1", "--width-px", "-1"),
        ("ingest city x --city.n-frames=-2", "--city.n-frames", "-2"),
        ("run city --out x --fit.loss.ssim-weight nan", "--fit.loss.ssim-weight", "nan"),
        ("demo --out x --fit.densify.max-gaussians 3", "--fit.densify.max-gaussians", "3"),
        ("fit scene --out x --iterations=-1", "--iterations", "-1"),
    ],
)
def test_a_value_of_a_nested_setting_is_refused_in_our_words(
    line: str, flag: str, got: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert app.main(line.split()) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and f"where: {flag}\n" in said and "expected: " in said
    assert f"got: {got!r}" in said or f"got: {got}" in said
