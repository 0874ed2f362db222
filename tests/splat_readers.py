"""Readers of Gaussian files, written for tests from the formats' descriptions: one Gaussian at a time, with struct and
plain numbers.

They share no code with ``mudg.formats.splats``. Each returns a list of ``Splat`` in the axes of the file.
"""

from __future__ import annotations

import io
import json
import math
import re
import struct
import zipfile
import zlib
from dataclasses import dataclass
from typing import Any

from PIL import Image

C0 = 0.28209479177387814


@dataclass
class Splat:
    """One Gaussian: position, rotation (w, x, y, z), sizes in metres, opacity, harmonics [K][3]."""

    place: list[float]
    turn: list[float]
    size: list[float]
    opacity: float
    sh: list[list[float]]


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


def read_ply(content: bytes) -> list[Splat]:
    head, _, body = content.partition(b"end_header\n")
    lines = [line for line in head.decode().splitlines() if not line.startswith("comment ")]
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(lines[2].removeprefix("element vertex "))
    names = [line.removeprefix("property float ") for line in lines[3:]]
    assert len(body) == 4 * count * len(names)
    found = []
    for row in range(count):
        values = struct.unpack_from(f"<{len(names)}f", body, 4 * row * len(names))
        at = dict(zip(names, values, strict=True))
        rest = sum(name.startswith("f_rest_") for name in names) // 3
        sh = [[at[f"f_dc_{c}"] for c in range(3)]] + [
            [at[f"f_rest_{c * rest + k}"] for c in range(3)] for k in range(rest)
        ]
        assert at["nx"] == at["ny"] == at["nz"] == 0
        turn, size = [at[f"rot_{i}"] for i in range(4)], [math.exp(at[f"scale_{i}"]) for i in range(3)]
        found.append(Splat([at["x"], at["y"], at["z"]], turn, size, sigmoid(at["opacity"]), sh))
    return found


def three_and_largest(largest: int, three: list[float]) -> list[float]:
    rest = math.sqrt(max(0.0, 1 - sum(v * v for v in three)))
    return [*three[:largest], rest, *three[largest:]]


def read_compressed(content: bytes) -> list[Splat]:
    head, _, body = content.partition(b"end_header\n")
    counts = {m[1]: int(m[2]) for m in re.finditer(r"element (\w+) (\d+)", head.decode())}
    rest = len(re.findall(r"property uchar f_rest_", head.decode()))
    chunks = [struct.unpack_from("<18f", body, 72 * i) for i in range(counts["chunk"])]
    start = 72 * counts["chunk"]
    found = []
    for row in range(counts["vertex"]):
        position, rotation, scale, color = struct.unpack_from("<4I", body, start + 16 * row)
        c = chunks[row // 256]

        def between(word: int, low: tuple[float, ...], high: tuple[float, ...]) -> list[float]:
            shares = ((word >> 21 & 2047) / 2047, (word >> 11 & 1023) / 1023, (word & 2047) / 2047)
            return [a + s * (b - a) for s, a, b in zip(shares, low, high, strict=True)]

        three = [((rotation >> shift & 1023) / 1023 - 0.5) * math.sqrt(2) for shift in (20, 10, 0)]
        rgb = [
            a + (color >> shift & 255) / 255 * (b - a)
            for shift, a, b in zip((24, 16, 8), c[12:15], c[15:18], strict=True)
        ]
        sh = [[(v - 0.5) / C0 for v in rgb]]
        if rest:
            raw = body[start + 16 * counts["vertex"] + rest * row :][:rest]
            values = [-4.0 if u == 0 else 4.0 if u == 255 else ((u + 0.5) / 256 - 0.5) * 8 for u in raw]
            sh += [[values[channel * (rest // 3) + k] for channel in range(3)] for k in range(rest // 3)]
        turn, size = three_and_largest(rotation >> 30, three), map(math.exp, between(scale, c[6:9], c[9:12]))
        found.append(Splat(between(position, c[:3], c[3:6]), turn, list(size), (color & 255) / 255, sh))
    return found


def read_splat(content: bytes) -> list[Splat]:
    found = []
    for row in struct.iter_unpack("<6f8B", content):
        turn, sh = [u / 255 * 2 - 1 for u in row[10:14]], [[(u / 255 - 0.5) / C0 for u in row[6:9]]]
        found.append(Splat(list(row[:3]), turn, list(row[3:6]), row[9] / 255, sh))
    return found


def read_spz(content: bytes) -> list[Splat]:
    raw = zlib.decompress(content, 31)
    magic, version, count, degree, bits, flags, zero = struct.unpack_from("<4sIIBBBB", raw)
    assert (magic, version, flags, zero) == (b"NGSP", 3, 0, 0)
    places, opacities, colors = 16, 16 + 9 * count, 16 + 10 * count
    scales, turns, rest = 16 + 13 * count, 16 + 16 * count, 16 + 20 * count
    coefficients = (degree + 1) ** 2 - 1
    assert len(raw) == rest + 3 * coefficients * count
    found = []
    for n in range(count):
        place = [int.from_bytes(raw[places + 9 * n + 3 * i :][:3], "little", signed=True) / 2**bits for i in range(3)]
        word = int.from_bytes(raw[turns + 4 * n :][:4], "little")
        three = []
        for shift in (20, 10, 0):
            part = word >> shift & 1023
            three.append((-1 if part & 512 else 1) * (part & 511) / 511 / math.sqrt(2))
        x, y, z, w = three_and_largest(word >> 30, three)
        sh = [[(raw[colors + 3 * n + i] / 255 - 0.5) / 0.15 for i in range(3)]]
        at = rest + 3 * coefficients * n
        sh += [[(raw[at + 3 * k + i] - 128) / 128 for i in range(3)] for k in range(coefficients)]
        size = [math.exp(raw[scales + 3 * n + i] / 16 - 10) for i in range(3)]
        found.append(Splat(place, [w, x, y, z], size, raw[opacities + n] / 255, sh))
    return found


def read_sog(content: bytes) -> list[Splat]:
    archive = zipfile.ZipFile(io.BytesIO(content))
    meta = json.loads(archive.read("meta.json"))

    def pixels(name: str) -> Any:
        image = Image.open(io.BytesIO(archive.read(name)))
        assert image.format == "WEBP"
        image = image.convert("RGBA")  # the format drops an alpha of 255 everywhere
        return image, image.load()

    def pixel(name: str, n: int) -> tuple[int, ...]:
        image, loaded = pixels(name)
        return loaded[n % image.width, n // image.width]

    found = []
    for n in range(meta["count"]):
        low, high = (pixel(name, n) for name in meta["means"]["files"])
        place = []
        for i in range(3):
            t = meta["means"]["mins"][i] + (low[i] + 256 * high[i]) / 65535 * (
                meta["means"]["maxs"][i] - meta["means"]["mins"][i]
            )
            place.append(math.copysign(math.exp(abs(t)) - 1, t))
        turn, size, color = (pixel(meta[name]["files"][0], n) for name in ("quats", "scales", "sh0"))
        three = [(v / 255 * 2 - 1) / math.sqrt(2) for v in turn[:3]]
        sh = [[meta["sh0"]["codebook"][v] for v in color[:3]]]
        if "shN" in meta:
            coefficients = (meta["shN"]["bands"] + 1) ** 2 - 1
            label = pixel(meta["shN"]["files"][1], n)
            index = label[0] + 256 * label[1]
            _, loaded = pixels(meta["shN"]["files"][0])
            for k in range(coefficients):
                rgb = loaded[index % 64 * coefficients + k, index // 64]
                sh.append([meta["shN"]["codebook"][v] for v in rgb[:3]])
        sizes = [math.exp(meta["scales"]["codebook"][v]) for v in size[:3]]
        found.append(Splat(place, three_and_largest(turn[3] - 252, three), sizes, color[3] / 255, sh))
    return found


# -- glTF ------------------------------------------------------------------------------------------


def open_glb(content: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, size, json_size, json_kind = struct.unpack_from("<4sIII4s", content)
    assert (magic, version, size, json_kind) == (b"glTF", 2, len(content), b"JSON") and json_size % 4 == 0
    bin_size, bin_kind = struct.unpack_from("<I4s", content, 20 + json_size)
    assert bin_kind == b"BIN\0" and bin_size % 4 == 0 and 28 + json_size + bin_size == size
    return json.loads(content[20 : 20 + json_size]), content[28 + json_size :]


def accessor(document: dict[str, Any], content: bytes, index: int) -> list[list[float]]:
    one = document["accessors"][index]
    view = document["bufferViews"][one["bufferView"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[one["type"]]
    assert (
        one["componentType"] == 5126 and view["byteLength"] == 4 * width * one["count"] and view["byteOffset"] % 4 == 0
    )
    flat = struct.unpack_from(f"<{width * one['count']}f", content, view["byteOffset"])
    return [list(flat[i : i + width]) for i in range(0, len(flat), width)]


def read_glb_mesh(document: dict[str, Any], content: bytes, mesh: int) -> list[Splat]:
    (primitive,) = document["meshes"][mesh]["primitives"]
    given = {name: accessor(document, content, index) for name, index in primitive["attributes"].items()}
    prefix = "KHR_gaussian_splatting:"
    bands = [name for name in given if name.startswith(prefix + "SH_DEGREE_")]
    bands.sort(key=lambda name: [int(word) for word in re.findall(r"\d+", name)])
    columns = [given["POSITION"], *(given[prefix + name] for name in ("ROTATION", "SCALE", "OPACITY"))]
    harmonics = zip(*(given[name] for name in bands), strict=True)
    return [
        Splat(place, [turn[3], *turn[:3]], size, opacity[0], list(sh))
        for place, turn, size, opacity, sh in zip(*columns, harmonics, strict=True)
    ]


# -- USD -------------------------------------------------------------------------------------------


def parse_usda(text: str) -> dict[str, Any]:
    """Prims as nested dictionaries: attribute -> value (``{time: value}`` for samples), prim -> dictionary."""
    lines = iter(text.splitlines())
    assert next(lines) == "#usda 1.0"
    root: dict[str, Any] = {"metadata": {}}
    stack: list[dict[str, Any]] = [root]
    pending: dict[str, Any] | None = None
    in_metadata, samples = False, None
    for line in lines:
        word = line.strip()
        if not word:
            continue
        if samples is not None:
            if word == "}":
                samples = None
            else:
                time, _, value = word.removesuffix(",").partition(": ")
                samples[float(time)] = usd_value(value)
        elif word == "(" or word.endswith(" ("):
            in_metadata = True
            if word != "(":
                name, _, value = word.removesuffix(" (").partition(" = ")
                stack[-1][name.split()[-1]] = usd_value(value)
        elif word == ")":
            in_metadata = False
        elif in_metadata:
            name, _, value = word.partition(" = ")
            if len(stack) == 1:
                root["metadata"][name] = value
            else:
                stack[-1].setdefault("_metadata", {})[name] = value
        elif match := re.fullmatch(r'def (\w+) "(\w+)"', word):
            pending = {"type": match[1]}
            assert match[2] not in stack[-1]
            stack[-1][match[2]] = pending
        elif word == "{":
            assert pending is not None
            stack.append(pending)
        elif word == "}":
            stack.pop()
        else:
            name, _, value = word.partition(" = ")
            name = name.split()[-1]
            if name.endswith(".timeSamples"):
                assert value == "{"
                samples = {}
                stack[-1][name.removesuffix(".timeSamples")] = samples
            else:
                stack[-1][name] = usd_value(value)
    assert len(stack) == 1
    return root


def usd_value(text: str) -> Any:
    if text.startswith("@"):
        return text
    return json.loads(text.replace("(", "[").replace(")", "]"))


def read_usd_splats(prim: dict[str, Any], places: list[list[float]] | None = None) -> list[Splat]:
    count = len(prim["orientations"])
    harmonics = prim["radiance:sphericalHarmonicsCoefficients"]
    each = len(harmonics) // count
    sh = [harmonics[n * each : (n + 1) * each] for n in range(count)]
    columns = (prim["orientations"], prim["scales"], prim["opacities"], sh)
    return [Splat(*one) for one in zip(prim["positions"] if places is None else places, *columns, strict=True)]
