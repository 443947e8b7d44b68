"""Reads SPZ files, and checks every size in them."""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from clod_adapter.config import FILTERS, SH_COUNTS
from clod_adapter.equation.units import in_world_units
from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import Model
from clod_adapter.io.formats.arrays import gaussians_of, half_turn, logits_of_bytes, read_whole, sha256_of
from clod_adapter.io.formats.checks import NEW_SPZ
from clod_adapter.io.formats.converted import load_converted
from clod_adapter.io.formats.metadata import parse_metadata
from clod_adapter.io.formats.spz import (
    ANTIALIASED,
    AXES,
    COLOR,
    COLUMNS,
    EXTENDED,
    HEADER,
    MAGIC,
    MAGNITUDE,
    MOST,
    RDF,
    RECORD,
)
from clod_adapter.io.ply.columns import GROWTH, SIGMA
from clod_adapter.io.screen_filter import TAG
from clod_adapter.io.settings import DAMAGE, damaged
from clod_adapter.io.sniff import read_start

QUANTISED = "quantised: positions in 24 bits, scales, opacities and harmonics in 8, rotations in 10 or 8"
_BOMB = 64  # times its size that a file may unpack to; Gaussians that differ at all come to 10
_CONVERT = "convert it: splat-transform IN.spz OUT.ply"
_TURNS = {RDF: "", 4: "x", 7: "z"}  # right, up, back; left, up, forward
_UNTURNED = struct.pack("<I", RDF)
_SMALL = 1 << 24  # bytes that any file may


def load_spz(path: Path) -> Model:
    """Reads versions 2 and 3, SH degree 0 to 4; version 4 is converted by splat-transform.

    A quantised value is read as the middle of its interval.

    Raises:
        ClodError: the file cannot be read, is damaged, of another version, or unpacks to far more than it could hold.
    """
    whole = read_whole(path)
    if whole.startswith(NEW_SPZ):
        return load_converted(path, " of version 4")
    data = _unpacked(path, whole)
    magic, version, count, degree, bits, flags, _ = HEADER.unpack_from(data)
    if magic != MAGIC or version not in (2, 3) or degree not in SH_COUNTS or bits > 24 or count > MOST:
        raise ClodError(f"{path}: is no SPZ file of version 2 or 3 (version {version}, {count} Gaussians); {_CONVERT}")
    bands = SH_COUNTS[degree] - 1
    sizes = {"means": 9, "opacities": 1, "colors": 3, "scales": 3, "quats": 4 if version == 3 else 3, "shN": 3 * bands}
    end = HEADER.size + count * sum(sizes.values())
    if not count or end > len(data):
        raise ClodError(f"{path}: has no Gaussians or is truncated; copy or export it again")
    columns, start = {}, HEADER.size
    for name, size in sizes.items():
        columns[name] = np.frombuffer(data, np.uint8, count * size, start).reshape(count, size)
        start += count * size
    records = _records(data[end:]) if flags & EXTENDED else {}
    document, dial = _ours(path, records[RECORD], count) if RECORD in records else (None, {})
    metadata = parse_metadata(path, document, dial=bool(dial))
    arrays = _unquantized(columns, bits, bands)
    arrays = _in_our_axes(path, arrays, records.get(AXES, _UNTURNED)) | dial
    gaussians = in_world_units(gaussians_of(path, arrays, metadata))
    metadata = replace(metadata, attenuation=gaussians.attenuation)
    if flags & ANTIALIASED and not gaussians.screen_filter.compensate:  # by another program, which states no variance
        gaussians = gaussians.replace(screen_filter=FILTERS["on"])
        metadata = replace(metadata, about=(*metadata.about, TAG))
    return Model(gaussians, metadata, sha256_of(whole), (QUANTISED,))


def open_spz(path: Path) -> bool:
    """Whether a file has sigma_d; reads all of it, which is never much. Errors as ``load_spz``."""
    return not read_start(path).startswith(NEW_SPZ) and load_spz(path).gaussians.sigma_d is not None


def _unpacked(path: Path, data: bytes) -> bytes:
    if data[:2] != b"\x1f\x8b":
        raise ClodError(f"{path}: is no SPZ file; copy or export it again")
    limit = max(_SMALL, _BOMB * len(data))
    gzip = zlib.decompressobj(wbits=31)
    try:
        unpacked = gzip.decompress(data, limit)
    except zlib.error as error:
        raise ClodError(f"{path}: is damaged ({error}); copy or export it again") from error
    if not gzip.eof or len(unpacked) < HEADER.size:
        raise ClodError(
            f"{path}: is truncated, or unpacks to more than {limit:,} bytes, which no Gaussians do; export it again"
        )
    return unpacked


def _records(data: bytes) -> dict[int, bytes]:
    """The records after the arrays by their types, as far as they are whole."""
    found, start = {}, 0
    while start + 8 <= len(data):
        kind, size = struct.unpack_from("<II", data, start)
        start += 8 + size
        if start <= len(data):
            found[kind] = data[start - size : start]
    return found


def _ours(path: Path, body: bytes, count: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The JSON document of our record, and the columns of the dial if they are there."""
    length = struct.unpack_from("<I", body)[0] if len(body) >= 4 else 0
    text, values = body[4 : 4 + length], body[4 + length :]
    try:
        document = json.loads(text)
        names = document.get(COLUMNS, [SIGMA])
    except DAMAGE as error:
        raise damaged(path, error) from error
    if names not in ([SIGMA], [SIGMA, GROWTH]) or len(values) not in (0, 2 * count * len(names)):
        raise ClodError(f"{path}: its record of sigma_d is damaged; copy or export it again")
    table = np.frombuffer(values, "<f2").astype(np.float32).reshape(-1, count)
    return document, dict(zip(names, table, strict=False))  # no rows without a dial


def _in_our_axes(path: Path, arrays: dict[str, np.ndarray], record: bytes) -> dict[str, np.ndarray]:
    """Turned as Adobe's record states; without a record unchanged, as converters write them."""
    (axes,) = struct.unpack("<I", record) if len(record) == 4 else (0,)
    if axes not in _TURNS:
        raise ClodError(f"{path}: its axes are of kind {axes}, which this reader does not know; {_CONVERT}")
    return half_turn(arrays, _TURNS[axes]) if _TURNS[axes] else arrays


def _unquantized(columns: dict[str, np.ndarray], bits: int, bands: int) -> dict[str, np.ndarray]:
    count = len(columns["means"])
    wide = np.zeros((count, 3, 4), np.uint8)
    wide[..., 1:] = columns["means"].reshape(count, 3, 3)
    fixed = wide.view("<i4")[..., 0] >> 8  # with the sign
    quats = columns["quats"]
    return {
        "means": (fixed / 2.0**bits).astype(np.float32),
        "quats": _smallest_three(quats) if quats.shape[1] == 4 else _first_three(quats),
        "log_scales": columns["scales"].astype(np.float32) / 16 - 10,
        "opacity_logits": logits_of_bytes(columns["opacities"][:, 0]),
        "sh0": ((columns["colors"].astype(np.float32) / 255 - 0.5) / COLOR)[:, None],
        "shN": (columns["shN"].reshape(count, bands, 3).astype(np.float32) - 128) / 128,
    }


def _smallest_three(quats: np.ndarray) -> np.ndarray:
    """``[N, 4]`` wxyz; the inverse of ``spz._packed_quats``."""
    packed = np.ascontiguousarray(quats).view("<u4")[:, 0]
    largest, xyzw = packed >> 30, np.zeros((len(packed), 4), np.float64)
    for axis in (3, 2, 1, 0):
        there = largest != axis
        value = (packed & 511) / MAGNITUDE
        xyzw[:, axis] = np.where(there, np.where(packed & 512, -value, value), 0)
        packed = np.where(there, packed >> 10, packed)
    xyzw[np.arange(len(xyzw)), largest] = np.sqrt(np.maximum(0, 1 - (xyzw**2).sum(1)))
    return np.roll(xyzw, 1, axis=1).astype(np.float32)


def _first_three(quats: np.ndarray) -> np.ndarray:
    """``[N, 4]`` wxyz of version 2: x, y and z in bytes, w >= 0."""
    xyz = quats.astype(np.float32) / 127.5 - 1
    return np.concatenate([np.sqrt(np.maximum(0, 1 - (xyz**2).sum(1, keepdims=True))), xyz], 1)
