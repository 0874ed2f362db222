"""Edit scripts: what they say, and how what is wrong with one is told."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from refusals import refused

from mudg.base import store
from mudg.base.weather_settings import Conditions, FogSettings, RainSettings, SnowSettings, WeatherSettings
from mudg.editing.script import conditions_of, parse_edits

EVERY_VERB = """
- remove: {ids: [car-017]}
- remove: {class: car, moving: true, within_m: 30}
- move: {id: car-003, along_m: 3, yaw_deg: 5, from_s: 0.5, ramp_s: 1}
- stop: {id: car-003, at_s: 1.2, brake_m_s2: 4}
- speed: {id: car-003, factor: 0.7}
- lane_change: {id: ego, left_m: 3.5, start_s: 1, duration_s: 3}
- path: {id: car-003, points: [[0, 1, 2, 90], [1, 2, 2, 90]]}
- replace: {id: car-003, by: {run: other, id: truck-002}}
- insert: {asset: {file: van.safetensors}, class: car, near: {ahead_m: 12}}
- sky: {image: sky.png, yaw_deg: 20}
- weather: {fog: {visibility_m: 150}, rain: {mm_h: 10}, wet: 0.8, puddles: 0.3, snow: {cover: 0.6, mm_h: 2}}
- light: {time: dusk, exposure_ev: -1.5}
"""


def test_every_verb_is_understood_and_says_its_defaults() -> None:
    script = parse_edits(EVERY_VERB, "edits.yaml")
    assert [edit.verb for edit in script.edits][:3] == ["remove", "remove", "move"]
    assert script.canonical()[2]["move"]["left_m"] == 0.0
    asked = conditions_of(script.canonical())
    assert asked.weather.rain.mm_h == 10 and asked.weather.snow.wind_m_s == (0.5, 0.0)
    assert parse_edits(script.text(), "again").canonical()[0] == script.canonical()[0]


@pytest.mark.parametrize(
    ("text", "where", "said"),
    [
        ("- move: {id: a}\n- mve: {id: a}", "line 2", "did you mean 'move'"),
        ("- move:\n    id: a\n    alng_m: 3", "line 3: move", "along_m"),
        ("- move:\n    id: a\n    along_m: far", "line 3: move.along_m", "a number"),
        ("- move: {id: a, along_m: .nan}", "move.along_m", "finite"),
        ("- stop: {id: a}", "line 1: stop", "'at_s' is missing"),
        ("- stop: {id: a, at_s: 1, brake_m_s2: -1}", "stop.brake_m_s2", "greater than 0"),
        ("- move: {id: a, id: b}", "line 1", "given twice"),
        ("- path: {id: a, points: [[0, 1, 2],\n   [0, 1, 2]]}", "line 2: path.points[1]", "do not increase"),
        ("- remove: {}", "remove", "ids, or any of class"),
        ("- remove: {ids: [ego]}", "remove.ids[0]", "ego takes"),
        ("- insert: {asset: {run: a}, near: {}}", "insert.asset", "run and id, or file alone"),
        ("- insert: {asset: {file: a}}", "insert", "path or near"),
        ("- weather: {rain: {mm_h: 1000}}", "weather.rain.mm_h", "150"),
        ("- weather: {snow: {wind_m_s: [1, 2, 3]}}", "weather.snow.wind_m_s", "wind_m_s"),
        ("- light: {headlights: 1}", "light.headlights", "headlights"),
        ("- move: 3", "line 1: move", "{...}"),
        ("- move: {id: a}\n  stop: {id: a}", "line 1", "one verb"),
        ("", "edits.yaml", "list of edits"),
        ("- move: [1", "line 1", "not valid YAML"),
        ("- !!python/object/apply:os.system ['ls']", "line 1", "of which type it is"),
    ],
)
def test_what_is_wrong_is_told_with_its_place(text: str, where: str, said: str) -> None:
    problem = refused(re.escape(said), parse_edits, text, "edits.yaml")
    assert where in problem.where, problem


def test_the_digest_is_that_of_what_is_said_and_read(tmp_path: Path) -> None:
    said = lambda text: parse_edits(text, "e", tmp_path).digest()
    same = "# the same\n- move:\n    along_m: 3.0\n    id: a\n"
    assert said("- move: {id: a, along_m: 3}") == said(same) != said("- move: {id: a, along_m: 4}")
    van = "- insert: {asset: {file: van.safetensors}, near: {}}"
    refused("not there", said, van)
    found = []
    for content in ("one", "two"):
        store.write_text(tmp_path / "van.safetensors", content)
        found.append(said(van))
    assert found[0] != found[1]


def test_a_script_without_settings_asks_for_the_settings_of_weather_and_light() -> None:
    assert conditions_of(parse_edits("- move: {id: a, left_m: 1}", "e").canonical()) is None
    assert conditions_of(parse_edits("- weather: {}\n- light: {}", "e").canonical()) == Conditions()
    whole = conditions_of(parse_edits("- weather: {fog: {}, rain: {}, snow: {}}", "e").canonical())
    assert whole.weather == WeatherSettings(fog=FogSettings(), rain=RainSettings(), snow=SnowSettings())
    last = conditions_of(parse_edits("- light: {time: dusk}\n- light: {time: night}", "e").canonical())
    assert last.light.time == "night"
