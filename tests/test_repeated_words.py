"""What would be said many times is said once: warnings of a kind, and columns without truth."""

from __future__ import annotations

from typing import Any

from mudg.scene.check import Finding, folded
from mudg.scoring import tables as score_tables


def test_warnings_of_a_kind_are_one_line_with_three_examples() -> None:
    many = [
        Finding("warning", f"track {n} (car)", f"it moves sideways, {80 + n} degrees from its x axis")
        for n in range(67)
    ]
    few = [
        Finding("warning", "ego path", "the vehicle moves at 90 m/s"),
        Finding("warning", "track 3 (bus)", "its box measures 40 m"),
    ]
    lines = folded([*many, *few], "mudg doctor scenes/a")
    assert lines == [
        (
            "67 times: track 0 (car), track 1 (car), track 2 (car) and others: it moves sideways, 80 degrees from its x"
            " axis (all of them: mudg doctor scenes/a)"
        ),
        "ego path: the vehicle moves at 90 m/s",
        "track 3 (bus): its box measures 40 m",
    ]
    assert len(folded(many[:3], "")) == 3


def document(values: dict[str, Any]) -> dict[str, Any]:
    return {
        "scene": {"id": "drive"},
        "rules": [],
        "metrics": [{"name": n, "title": n} for n in ("psnr", "ssim", "lidar_rmse_m")],
        "results": [{"method": m, "trajectory": "shift", "views": 3, "values": values} for m in ("a", "b")],
        "trajectories": [{"name": "shift"}],
    }


def test_metrics_without_truth_are_one_line_and_no_columns() -> None:
    text = score_tables.markdown(document({"psnr": "no truth", "ssim": "no truth", "lidar_rmse_m": 1.5}))
    assert (
        "No truth here for psnr, ssim." in text
        and "| method | views | lidar_rmse_m |" in text
        and "| no truth" not in text
    )
    text = score_tables.markdown(document({"psnr": "no truth", "ssim": "no truth", "lidar_rmse_m": "no truth"}))
    assert "Nothing to score against: there is no truth here." in text and "|" not in text
