"""The viewer page as files: one HTML file that works without a network, or the page and its data in a folder for a web server."""

from __future__ import annotations

import base64
import bisect
import gzip
import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Final

from markupsafe import Markup

from mudg.base import store
from mudg.pages import html
from mudg.pages.viewer.chunks import chunk_rows
from mudg.pages.viewer.facts import PageFacts
from mudg.pages.viewer.packed import Packed, Sections, blob_of

ONE_FILE_BYTES: Final = 32 * 2**20
"""A page larger than this becomes a folder: not every browser opens larger ones."""
TEXELS: Final = (2, 3, 4, 5)
"""Texels per Gaussian by degree of the harmonics; as `assets/viewer/data.js` lays them out."""
SORT_BYTES: Final = 38
"""Per Gaussian in the sorter of a page (`assets/viewer/sorter.js`)."""
MODULES: Final = (
    "math", "data", "sorter", "shaders", "edits", "particles", "weather", "renderer", "cameras", "state", "overlay", "arrival", "app",
    "zip", "share", "gizmo", "editor", "ui", "input", "exact", "main",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class PageFile:
    """One data file of a page, gzipped where that helps.

    Args:
        name: of the element that holds it in a page of one file. content: bytes.
    """

    name: str
    content: bytes

    @property
    def url(self) -> str:
        """Name of the file beside the page. It changes with the content: no store of old answers can mix two pages."""
        return f"{self.name}-{hashlib.sha256(self.content).hexdigest()[:8]}.bin"

    def record(self) -> dict[str, Any]:
        """How the page finds and checks the file."""
        digest = base64.b64encode(hashlib.sha256(self.content).digest()).decode()
        return {"name": self.name, "url": self.url, "bytes": len(self.content), "sha256": digest}


@dataclass(frozen=True, slots=True)
class ViewerPage:
    """What is to be written.

    Args:
        title, subtitle, about: texts. report: relative address of the report, or empty.
        scenes: (name, scene), the one that is shown first; at most two.
        log: everything else. live: settings of a server behind the page, or None.
        effort: of gzip, 1 to 9.
    """

    title: str
    subtitle: str
    about: str
    report: str
    scenes: Sequence[tuple[str, Packed]]
    log: PageFacts
    live: Mapping[str, Any] | None = None
    effort: int = 9

    def files(self, facts: dict[str, Any]) -> Iterator[PageFile]:
        """The data files, made one at a time; `facts` becomes what the page says about them and is complete after the last one."""
        facts |= self.log.facts | {"live": None if self.live is None else dict(self.live), "scenes": []}
        made = PageFile("images", self.log.images)
        facts["images"] = facts["images"] | {"file": made.record()}
        yield made
        made, facts["log"] = self._file("log", self.log.sections)
        yield made
        for index, (name, packed) in enumerate(self.scenes):
            made, record = self._file(f"scene-{index}", packed.sections)
            scene = {"name": name, **packed.facts, **record, "chunks": []}
            facts["scenes"].append(scene)
            yield made
            for number in range(len(packed.layout)):
                sections, about = packed.chunk(number)
                made, record = self._file(f"scene-{index}-{number:03d}", sections)
                scene["chunks"].append(record | about)
                yield made

    def _file(self, name: str, sections: Sections) -> tuple[PageFile, dict[str, Any]]:
        blob, directory = blob_of(sections)
        made = PageFile(name, gzip.compress(blob, self.effort, mtime=0))
        return made, {"file": made.record(), "directory": directory}

    def chunks(self) -> int:
        """Chunks of all scenes."""
        return sum(len(packed.layout) for _, packed in self.scenes)

    def graphics_bytes(self) -> int:
        """What the scenes take on the graphics card: texels of 16 bytes, and the order, 4 bytes per Gaussian."""
        return sum(scene_bytes(p.kept, p.layout.size, p.facts["degree"])[0] for _, p in self.scenes)

    def heap_bytes(self) -> int:
        """What a browser keeps of the scenes to sort them: places, nodes, keys and rows twice, two orders."""
        return sum(scene_bytes(p.kept, p.layout.size, p.facts["degree"])[1] for _, p in self.scenes)

    def one_file(self, files: Iterable[PageFile], facts: Mapping[str, Any]) -> bytes:
        """The page with all data in it."""
        inside = [(file.name, base64.b64encode(file.content).decode()) for file in files]
        return self.html(facts, sum(3 * len(text) // 4 for _, text in inside), inside)

    def html(self, facts: Mapping[str, Any], size: int, inside: Sequence[tuple[str, str]] = ()) -> bytes:
        """The page. size: bytes of all data. inside: (name, base64) of the data that stand in it."""
        near, far = facts["depth_range_m"]
        imports, entry = import_map(), 'import "mudg/main";'
        text = html.render(
            "viewer.html.j2", title=self.title, subtitle=self.subtitle, about=self.about, report=self.report,
            css=Markup(asset("viewer.css")), import_map=Markup(imports), policy=policy(imports, entry),  # noqa: S704
            size=f"{size / 1e6:.1f} MB", near=f"{near:g}", far=f"{far:g}", class_legend=html.class_legend(),
            notes=[note for _, packed in self.scenes for note in packed.notes],
            payloads=inside, live=self.live is not None, facts=Markup(script_json(facts)), entry=Markup(entry),  # noqa: S704
        )  # fmt: skip
        return text.encode()


def scene_bytes(rows: int, size: int, degree: int) -> tuple[int, int]:
    """What a scene of so many rows takes on the graphics card, and to be sorted; ``size``: rows per chunk."""
    layers = -(-rows // size)
    return 16 * TEXELS[degree] * layers * min(size, rows) + 4 * rows, SORT_BYTES * rows


def most_within(limit_bytes: float, degree: int, size: int) -> int:
    """The most rows whose graphics memory and memory for sorting are together within a limit."""
    most = int(limit_bytes // (16 * TEXELS[degree] + 4 + SORT_BYTES))
    return bisect.bisect_right(range(most + 1), limit_bytes, key=lambda n: sum(scene_bytes(n, chunk_rows(n, size), degree))) - 1


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
