"""The viewer page as files: one HTML file that works without a network, or the page and its data in a folder for a web server."""

from __future__ import annotations

import base64
import gzip
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Final

from markupsafe import Markup

from mudg.base import store
from mudg.report import html
from mudg.report.viewer.facts import PageFacts
from mudg.report.viewer.packed import Packed, blob_of

ONE_FILE_BYTES: Final = 32 * 2**20
"""A page larger than this becomes a folder: not every browser opens larger ones."""
MODULES: Final = (
    "math", "data", "sorter", "shaders", "renderer", "cameras", "state", "overlay", "edits", "app", "share", "gizmo", "editor",
    "ui", "input", "exact", "main",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ViewerPage:
    """What is to be written.

    Args:
        title, subtitle, about: texts. report: relative address of the report, or empty.
        scenes: (name, scene), the one that is shown first; at most two.
        log: everything else. live: settings of a server behind the page, or None.
    """

    title: str
    subtitle: str
    about: str
    report: str
    scenes: Sequence[tuple[str, Packed]]
    log: PageFacts
    live: Mapping[str, Any] | None = None

    def build(self) -> tuple[dict[str, bytes], dict[str, Any]]:
        """The data files by name, gzipped where that helps, and the facts that name them."""
        data, facts = {}, dict(self.log.facts)
        blob, directory = blob_of(self.log.sections)
        data["log"] = _gzipped(blob)
        facts |= {
            "log": {"directory": directory, "url": "log.bin"},
            "images": facts["images"] | {"url": "images.bin"},
            "scenes": [],
        }
        facts["live"] = None if self.live is None else dict(self.live)
        for index, (name, packed) in enumerate(self.scenes):
            blob, directory = blob_of(packed.sections)
            data[f"scene-{index}"] = _gzipped(blob)
            facts["scenes"].append({"name": name, "directory": directory, "url": f"scene-{index}.bin", **packed.facts})
        data["images"] = self.log.images
        return data, facts

    def one_file(self, data: Mapping[str, bytes], facts: Mapping[str, Any]) -> bytes:
        """The page with all data in it."""
        inside = [(name, base64.b64encode(content).decode()) for name, content in data.items()]
        return self._html(inside, facts, sum(map(len, data.values())))

    def folder(self, data: Mapping[str, bytes], facts: Mapping[str, Any]) -> dict[str, bytes]:
        """The page and its data as files."""
        pages = {"index.html": self._html([], facts, sum(map(len, data.values())))}
        return pages | {f"{name}.bin": content for name, content in data.items()}

    def _html(self, inside: Sequence[tuple[str, str]], facts: Mapping[str, Any], size: int) -> bytes:
        near, far = facts["depth_range_m"]
        imports, entry = import_map(), 'import "mudg/main";'
        text = html.render(
            "viewer.html.j2", title=self.title, subtitle=self.subtitle, about=self.about, report=self.report,
            css=Markup(asset("viewer.css")), import_map=Markup(imports), policy=policy(imports, entry),  # noqa: S704
            size=f"{size / 1e6:.1f} MB", near=f"{near:g}", far=f"{far:g}", class_legend=html.class_legend(),
            notes=[note for _, packed in self.scenes for note in packed.notes],
            payloads=inside, facts=Markup(script_json(facts)), entry=Markup(entry),  # noqa: S704
        )  # fmt: skip
        return text.encode()


def _gzipped(blob: bytes) -> bytes:
    return gzip.compress(blob, 9, mtime=0)


def asset(name: str) -> str:
    """A file of ``assets/viewer``."""
    return (files("mudg") / "assets" / "viewer" / name).read_text(encoding="utf-8")


def import_map() -> str:
    """The viewer's modules as an import map of data addresses: a page opened by double click may not load files beside it."""
    sources = {f"mudg/{name}": asset(f"{name}.js") for name in MODULES}
    coded = {
        name: "data:text/javascript;base64," + base64.b64encode(text.encode()).decode()
        for name, text in sources.items()
    }
    return script_json({"imports": coded})


def policy(*scripts: str) -> str:
    """A content security policy under which only these inline scripts run, and nothing is loaded from elsewhere."""
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in scripts
    )
    return (
        f"default-src 'none'; script-src {hashes} data: blob:; worker-src blob:; style-src 'unsafe-inline'; "
        "img-src 'self' data: blob:; media-src blob:; connect-src 'self' data: blob:; base-uri 'none'; form-action 'none'"
    )


def script_json(value: Any) -> str:
    """JSON that may stand in a script element: nothing in it ends the element or begins a comment."""
    text = store.json_text(value, indent=None)
    for letter in "&<>\u2028\u2029":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text
