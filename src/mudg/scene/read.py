"""Reading scenes: the index at once, images and points when they are needed (labels: ``labels.py``)."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from mudg.base import palette, store
from mudg.base.errors import InputError, IntegrityError
from mudg.base.types import Camera, Frame, Ref, Scene, Sweep, SweepPoints
from mudg.scene import schema
from mudg.scene.schema import parse_object, ref_problem

# files --------------------------------------------------------------------------------------------
# Nothing outside the scene can be reached: references are checked as text, and on disk as real paths. What this package
# wrote carries a manifest of sha256 sums, and every file read is compared with it.

Record = TypeVar("Record")
MAX_FILE_BYTES: Final = 4 * 1024**3
READABLE: Final = "a readable file inside the scene"


def open_files(path: Path | str) -> SceneFiles:
    """Open a scene directory; its manifest is kept until the index changes. InputError: no such path, or no scene."""
    path = Path(path)
    index, manifest = path / "scene.json", path / store.MANIFEST
    try:
        state = index.stat()
    except (FileNotFoundError, NotADirectoryError) as error:
        if path.is_dir():
            remedy = "make one with `mudg ingest`; an interrupted ingest leaves no scene.json"
            what = "folder is not a scene: it has no scene.json"
            raise InputError(what, where=str(path), expected="a scene directory", remedy=remedy) from error
        raise InputError("scene does not exist", where=str(path), expected="a scene directory") from error
    except OSError as error:
        raise InputError("scene cannot be read", where=str(path), got=str(error)) from error
    written_ns = manifest.stat().st_mtime_ns if manifest.is_file() else 0
    return _open_cached(str(path.absolute()), state.st_mtime_ns, state.st_size, written_ns)


class SceneFiles:
    """Read access to the files of one scene, which are compared with the sha256 sums that were written with it."""

    def __init__(self, root: str) -> None:
        self.root, self._real_root = root, os.path.realpath(root)
        self._hashes: dict[str, str] = {}
        where, manifest = f"{root}: {store.MANIFEST}", Path(root) / store.MANIFEST
        try:
            if manifest.is_file():
                files = parse_object(store.read_bytes(manifest), where)["files"]
                self._hashes = {str(name): str(entry["sha256"]) for name, entry in files.items()}
        except (InputError, KeyError, TypeError, AttributeError) as error:
            remedy = "ingest again, or delete the manifest if you edited the scene on purpose"
            raise IntegrityError("the manifest is damaged", where=where, got=str(error), remedy=remedy) from error

    def read(self, ref: str) -> bytes:
        """All bytes of the file ``ref``, checked against the manifest where there is one."""
        problem, where = self.problem(ref), f"{self.root}: {ref}"
        if problem is not None:
            remedy = "restore the file or ingest the log again"
            raise InputError(problem, where=where, expected=READABLE, remedy=remedy)
        content, expected = store.read_bytes(Path(self.root) / ref), self._hashes.get(ref)
        if expected is not None and hashlib.sha256(content).hexdigest() != expected:
            what, expected = "a file differs from what was written", f"sha256 {expected[:16]}..."
            remedy = "restore the file or ingest again; delete manifest.json if you edited the scene on purpose"
            raise IntegrityError(what, where=where, expected=expected, remedy=remedy)
        return content

    def is_hashed(self, ref: str) -> bool:
        """Whether the manifest holds a hash of ``ref``, so that what ``read`` returns is known to be as written."""
        return ref in self._hashes

    def problem(self, ref: str) -> str | None:
        """Say why ``ref`` cannot be read (missing, outside the scene), or None. Cheap: nothing is opened."""
        text_problem = ref_problem(ref)
        if text_problem is not None:
            return f"file reference {text_problem}"
        real = os.path.realpath(os.path.join(self._real_root, *ref.split("/")))
        if os.path.commonpath([real, self._real_root]) != self._real_root:
            return "a link leads out of the scene"
        try:
            state = os.stat(real)
        except OSError:
            return "a file is missing"
        if not stat.S_ISREG(state.st_mode):
            return "a reference names something that is not a plain file"
        if state.st_size > MAX_FILE_BYTES:
            return f"a file is larger than {MAX_FILE_BYTES} bytes"
        return None


_open_cached = functools.lru_cache(maxsize=16)(lambda path, *_state: SceneFiles(path))


# read ---------------------------------------------------------------------------------------------

_EXIF_ORIENTATION: Final = 0x0112
_PNG: Final = b"\x89PNG"


def read_scene(path: Path | str) -> Scene:
    """Read and check a scene directory; images, points and labels stay on disk until asked for. InputError: a record,
    reference or relation is wrong, or a referenced file is missing. IntegrityError: a file differs from the scene's
    manifest."""
    return load_scene(path, schema.raise_first)


def load_scene(path: Path | str, complain: schema.Complain) -> Scene:
    """``read_scene`` with a choice of what happens to a problem (see ``schema.py``)."""
    files = open_files(path)
    where = str(Path(path) / "scene.json")
    scene_json = schema.parse_object(files.read("scene.json"), where)
    tracks_json = None
    if files.problem("tracks.json") is None:
        tracks_json = schema.parse_object(files.read("tracks.json"), where.replace("scene.json", "tracks.json"))
    scene = schema.parse_scene(scene_json, tracks_json, files.root, where, complain)
    named: dict[str, str] = {}
    for owner, ref in all_refs(scene):
        problem = files.problem(ref.path)
        if problem is not None:
            remedy = "restore the file, remove the record, or ingest the log again"
            complain(InputError(problem, where=f"{where}: {owner}", expected=READABLE, got=ref.path, remedy=remedy))
        if named.setdefault(ref.path, owner) != owner:
            got = f"{ref.path}, also in {named[ref.path]}"
            complain(InputError("two records name the same file", where=f"{where}: {owner}", got=got))
    return scene


def all_refs(scene: Scene) -> list[tuple[str, Ref]]:
    """Every file reference of a scene, each with the name of its owner."""
    refs = [(f"frame {frame.id} image", frame.image) for frame in scene.frames]
    refs += [(f"frame {frame.id} label {name}", ref) for frame in scene.frames for name, ref in frame.labels.items()]
    return refs + [(f"sweep {sweep.id}", sweep.points) for sweep in scene.sweeps]


def read_image(scene: Scene, frame: Frame) -> NDArray[np.uint8]:
    """The recorded image, u8[H, W, 3] RGB. Grey images are repeated on three channels. InputError: missing, truncated,
    not 8-bit, or not of the camera's size."""
    content = open_files(scene.root).read(frame.image.path)
    return decode_image(content, f"{scene.root}: {frame.image.path}", frame.view.camera)


def decode_image(content: bytes, where: str, camera: Camera | None = None) -> NDArray[np.uint8]:
    """Decode PNG or JPEG bytes to u8[H, W, 3]; the size is compared with ``camera`` before anything is unpacked."""
    with _opened(content, where, camera) as image:
        return np.array(image.convert("RGB"))


def check_image(content: bytes, where: str, camera: Camera | None = None) -> bool:
    """Refuse PNG or JPEG bytes that ``decode_image`` would refuse, at less cost; returns whether the image is grey. All
    data are read. Of a JPEG they are turned into a picture of an eighth of the size, a tenth of the work; a PNG's
    checksums are compared, too, which decoding leaves out."""
    if content[:4] == _PNG:
        with _explained(content, where), Image.open(io.BytesIO(content), formats=("PNG",)) as image:
            image.verify()
    with _opened(content, where, camera) as image:
        grey = image.mode == "L"
        if image.format == "JPEG":
            image.draft("L", (max(1, image.width // 8), max(1, image.height // 8)))
        image.load()
        return grey


def is_grey(content: bytes, where: str, camera: Camera) -> bool:
    """``check_image`` of the header alone, for bytes that are known to be as they were written."""
    with _opened(content, where, camera) as image:
        return image.mode == "L"


@contextlib.contextmanager
def _opened(content: bytes, where: str, camera: Camera | None) -> Iterator[Image.Image]:
    """An opened image of a kind that scenes hold; what goes wrong with it in the block becomes an InputError."""
    with _explained(content, where), Image.open(io.BytesIO(content), formats=("PNG", "JPEG")) as image:
        size = f"{image.width}x{image.height}"
        if camera is not None and image.size != (camera.width, camera.height):
            what, remedy = "image does not have its camera's size", "correct camera and intrinsics, or the image"
            raise InputError(what, where=where, got=size, expected=f"{camera.width}x{camera.height}", remedy=remedy)
        if max(image.size) > schema.MAX_IMAGE_SIDE_PX:
            raise InputError("image is too large", where=where, got=size)
        if image.getexif().get(_EXIF_ORIENTATION, 1) != 1:
            what, remedy = "image is stored rotated (EXIF orientation)", "apply the rotation and write the image again"
            raise InputError(what, where=where, expected="upright pixels", remedy=remedy)
        sixteen_bits = content[:4] == _PNG and content[24:25] == b"\x10"  # Pillow would drop the lower half
        if image.mode not in ("RGB", "L", "P", "RGBA") or sixteen_bits:
            got = "16 bits a channel" if sixteen_bits else f"mode {image.mode}"
            what = "image is not 8-bit RGB or grey"
            raise InputError(what, where=where, expected="8 bits a channel", got=got, remedy="convert it to 8-bit RGB")
        if image.mode == "RGBA" and image.getchannel("A").getextrema() != (255, 255):
            raise InputError("image has transparent pixels", where=where, expected="an opaque image")
        yield image


@contextlib.contextmanager
def _explained(content: bytes, where: str) -> Iterator[None]:
    """Make what Pillow raises an InputError."""
    try:
        yield
    except UnidentifiedImageError as error:
        got = f"{len(content)} bytes starting {content[:12]!r}" if content else "an empty file"
        remedy = "is it an empty or placeholder file? copy it again"
        raise InputError("file is not a PNG or JPEG image", where=where, got=got, remedy=remedy) from error
    except Image.DecompressionBombError as error:
        remedy = "is its header damaged? copy the file again"
        raise InputError("image is too large", where=where, got=str(error)[:120], remedy=remedy) from error
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        what, got = "image cannot be decoded (is it cut off?)", f"{error} after {len(content)} bytes"
        raise InputError(what, where=where, got=got, remedy="copy the file again") from error


def read_points(scene: Scene, sweep: Sweep) -> SweepPoints:
    """The points of a sweep in the LiDAR frame. A sweep with zero points is a sweep with zero points, not an error.
    InputError: missing, truncated, wrong tensors, or NaN coordinates."""
    where = f"{scene.root}: {sweep.points.path}"
    arrays = store.parse_safetensors(open_files(scene.root).read(sweep.points.path), where)
    for name in ("xyz", "intensity", "dt_s"):
        if name not in arrays:
            expected, got = "xyz, intensity, dt_s", ", ".join(arrays) or "nothing"
            raise InputError(f"sweep has no tensor {name!r}", where=where, expected=expected, got=got)
    return checked_points(arrays, where)


def sweeps_beside(scene: Scene, frame: Frame, max_gap_s: float) -> list[Sweep]:
    """The nearest sweep of each LiDAR within ``max_gap_s`` seconds of the image, in the order of their distance in
    time."""
    gap_s = lambda sweep: abs(sweep.time_s - frame.view.time_s)
    nearest: dict[str, Sweep] = {}
    for sweep in scene.sweeps:
        if gap_s(sweep) <= max_gap_s and (sweep.sensor not in nearest or gap_s(sweep) < gap_s(nearest[sweep.sensor])):
            nearest[sweep.sensor] = sweep
    return sorted(nearest.values(), key=gap_s)


def spread(records: Sequence[Record], count: int) -> list[Record]:
    """At most ``count`` of the records, evenly spread, first and last among them."""
    places = np.unique(np.linspace(0, len(records) - 1, count).astype(int)) if records else ()
    return [records[place] for place in places]


def checked_points(arrays: Mapping[str, NDArray[Any]], where: str) -> SweepPoints:
    """Points from the arrays ``xyz``, ``intensity``, ``dt_s`` and, if there, ``classes``. InputError: wrong shape or
    type, values that are not finite, or classes that are no train ids."""
    count, classes = len(arrays["xyz"]), arrays.get("classes")
    wanted = {"xyz": ((count, 3), "float32"), **dict.fromkeys(("intensity", "dt_s"), ((count,), "float32"))}
    wanted |= {} if classes is None else {"classes": ((count,), "uint8")}
    for name, (shape, dtype) in wanted.items():
        array = arrays[name]
        if array.shape != shape or array.dtype != dtype:
            expected, got = f"{dtype} {shape}", f"{array.dtype} {array.shape}"
            raise InputError(f"sweep tensor {name!r} has the wrong form", where=where, expected=expected, got=got)
        if not np.isfinite(array).all():
            bad = int((~np.isfinite(array.reshape(count, -1)).all(1)).sum())
            what, where = "sweep holds values that are not finite", f"{where}: {name}"
            remedy = "drop missing returns when importing"
            raise InputError(what, where=where, got=f"{bad} of {count} points", expected="finite metres", remedy=remedy)
    if classes is not None and (wrong := palette.other_ids(classes)):
        what, expected = "classes of points hold values that are no train id", "0..18 or 255 (unlabelled)"
        raise InputError(what, where=f"{where}: classes", expected=expected, got=str(wrong))
    return SweepPoints(arrays["xyz"], arrays["intensity"], arrays["dt_s"], classes)
