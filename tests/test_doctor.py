"""What doctor says about the machine and about scenes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import toy_views

from mudg import app, native
from mudg.formats.exporters import video
from mudg.steps import doctor as diagnosis


def test_machine_report_names_what_matters() -> None:
    report = diagnosis.report_machine()
    text = report["text"]
    for word in ("processors", "torch", "native library", "encoders", "weights"):
        assert word in text
    rows = report["torch"]
    assert rows["--device auto"] in ("cpu", "cuda") and rows["--device cpu"] == "on the CPU"
    assert any(name.startswith("--device cuda") for name in rows) and "--device mps" in rows
    assert report["ready"] == (not report["problems"])
    json.dumps(report, default=str, allow_nan=False)


def test_a_missing_native_library_and_encoder_are_problems_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "library", lambda: None)
    monkeypatch.setattr(native, "status", lambda: "native library: not in use (for the test)")
    monkeypatch.setattr(video, "_H264_ENCODERS", ("no-such-encoder",))
    assert video.video_encoders() == []
    report = diagnosis.report_machine()
    for words in ("C++17 compiler", "H.264"):
        assert any(words in problem for problem in report["problems"])
    assert not report["ready"]


def test_a_good_scene_is_usable_and_damaged_images_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = toy_views.write_scene(tmp_path / "scene")
    assert app.main(["doctor", str(scene)]) == 0
    assert "can be used" in capsys.readouterr().out
    image = scene / "images" / "front" / "000002.png"
    image.write_bytes(image.read_bytes()[:100])
    assert app.main(["doctor", str(scene)]) == 3
    out = capsys.readouterr().out
    assert "000002" in out
    assert "cannot be used" in out
    (scene / "images" / "front" / "000001.png").unlink()
    assert app.main(["doctor", str(scene), "--json"]) == 3
    result = json.loads(capsys.readouterr().out)
    assert result["usable"] is False
    assert any(f["level"] == "error" and "000001" in f["where"] + f["words"] for f in result["findings"])
    assert app.main(["doctor", str(tmp_path / "nothing")]) == 3
    assert "does not exist" in capsys.readouterr().out


def test_a_log_in_the_neutral_layout_is_checked_and_other_logs_are_told_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log"
    log.mkdir()
    (log / "log.json").write_text('{"format": "mudg-log", "version": 1, "name": "x"}')
    assert app.main(["doctor", str(log)]) == 3
    assert "the field 'licence' is missing" in capsys.readouterr().out
    (tmp_path / "drive" / "image_02").mkdir(parents=True)
    assert app.main(["doctor", str(tmp_path / "drive")]) == 3
    assert "this is a log (kitti), not a scene" in capsys.readouterr().out
