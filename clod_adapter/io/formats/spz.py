"""SPZ files (Niantic), version 3, and in a record of our own the dial where there is one.

One gzip stream: a 16-byte header, then one array after another: positions in 24-bit fixed point,
opacities, colours and logarithms of scales in bytes, rotations in four bytes, spherical harmonics
in bytes, as the reference (``load-spz.cc``) reads them. It writes harmonics with 5 bits at degree 1
and 4 above, rounding halves up; 6 bits, rounded to the nearest, take a third more space for 13 dB
(docs/formats.md).

Records of vendors follow, flagged in the header: type, length, bytes; readers skip unknown types.
Two are written:

- Adobe's of the axes: a checkpoint's (x right, y down, z ahead). The format's own are OpenGL's, but
  the reference's ``ply_to_spz``, splat-transform, SuperSplat and gsply all leave those of the PLY:
  turned, it would be upside down;
- ours, ``RECORD``: the length of the JSON document (``settings.document``) as uint32, the document,
  then the dial's columns as float16, to 5e-4: sigma_d, or those that the document names as
  ``"columns": ["sigma_d", "growth_d"]``. Larger values become 65504. Of sigma_d that is no end in
  practice: ``(d s / 65504)^4`` of an opacity is gone.
"""

import json
import math
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from clod_adapter.config import CLASSIC, SH_COUNTS
from clod_adapter.equation.units import (
    estimated_distance,
    in_world_units,
    known_distance,
    with_distance,
)
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io import values
from clod_adapter.io.file_formats import NEW_SPZ
from clod_adapter.io.formats import splat_transform
from clod_adapter.io.settings import MODEL, TAG, Metadata, Source, document, parse_metadata
from clod_adapter.io.values import GROWTH, OPACITY, SIGMA, arrays_of, bytes_of, dial_columns

HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, SH degree, fractional bits, flags, 0
MAGIC = 0x5053474E
VERSION = 3
RECORD = 0x434C0001  # vendor "CL", its first extension
COLUMNS = "columns"  # of the record, in the document
AXES = 0xADBE0003  # SPZ_ADOBE_coordinate_system
RDF = 6  # right, down, forward
ANTIALIASED = 1  # flag of a filter that compensates opacities
EXTENDED = 2  # flag of records after the arrays
MOST_GAUSSIANS = 10_000_000  # Gaussians that the reference reads
COLOR = 0.15  # of the range of bytes to one of sh0
MAGNITUDE = 511 * math.sqrt(2)  # of the three components of a rotation that are not the largest
# by the largest component of a rotation, the three others, and at which bits these begin
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
_SHIFTS = [20, 10, 0]
_STEP = 4  # of the bytes of harmonics, of which 6 bits are used
_MOST = float(np.finfo(np.float16).max)  # 65504, of the columns of the dial
# Reference distance, world units, above which sigma_d is stored in units of it: in world units some
# that still fade at high dial values would exceed _MOST.
_FAR = 25.0
QUANTISED = (
    "quantised: positions in 24 bits, scales, opacities and harmonics in 8, rotations in 10 or 8"
)
_BOMB = 64  # times its size that a file may unpack to; Gaussians that differ at all come to 10
_SMALL = 1 << 24  # bytes that any file may unpack to


def write(path: Path, gaussians: Gaussians, metadata: Metadata) -> tuple[str, ...]:
    """Writes with the format's quantisation, about 8 bits.

    Positions have as many of their 24 bits for the fraction as they leave, 20 at most. A few
    Gaussians at an enormous distance, as many checkpoints have them, would leave the rest too few:
    see ``_nearer``.
    """
    config = gaussians.attenuation
    # in world units float16 would cut a large sigma_d off
    if config is not None and config.form == "ours":
        distance = known_distance(config) or estimated_distance(gaussians.means)
        gaussians = with_distance(gaussians, distance) if distance > _FAR else gaussians
    arrays, bits, moved = _nearer(arrays_of(path, gaussians))
    if len(gaussians) > MOST_GAUSSIANS or bits < 1:
        actual = f"these are {len(gaussians):,} within {float(gaussians.means.abs().max()):.4g}"
        raise ClodError(
            f"{path}: has room for {MOST_GAUSSIANS:,} Gaussians within 4,000,000 of 0, {actual};"
            " write a .ply"
        )
    degree = gaussians.sh_degree
    flags = EXTENDED | (ANTIALIASED if gaussians.screen_filter.compensate else 0)
    header = HEADER.pack(MAGIC, VERSION, len(gaussians), degree, bits, flags, 0)
    sections = [header, *_packed(arrays, bits), struct.pack("<III", AXES, 4, RDF)]
    metadata = replace(metadata, attenuation=gaussians.attenuation)
    if metadata != Metadata(screen_filter=CLASSIC):
        columns = list(dial_columns(arrays))
        column_names = {COLUMNS: columns} if len(columns) > 1 else {}  # sigma_d alone needs no name
        text = document(MODEL, metadata, **column_names).encode()
        halves = b""
        for name in columns:
            halves += np.clip(arrays[name], -_MOST, _MOST).astype("<f2").tobytes()
        size = 4 + len(text) + len(halves)
        sections += [struct.pack("<III", RECORD, size, len(text)), text, halves]
    gzip = zlib.compressobj(wbits=31)
    path.write_bytes(gzip.compress(b"".join(sections)) + gzip.flush())
    return (*moved, *_losses(arrays, bits))


def _nearer(arrays: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], int, tuple[str, ...]]:
    """The arrays, the bits of the fraction that they leave, and a line if the farthest were moved
    for it.

    What is beyond 8 times the distance that 99 % keep to (rounded up to a power of two) is moved
    towards 0 and made smaller by the same factor, and its sigma_d with it: from 0 it looks as
    before, from nearby very nearly. Its growth ``(d s / r)^h`` is less at the smaller distance, by
    ``factor^h``; its scales are divided by that.
    """
    reach = np.abs(arrays["means"]).max(1).astype(np.float64)
    most = min(float(reach.max()), 8 * float(np.quantile(reach, 0.99)))
    bits = min(20, 23 - math.frexp(most)[1])
    end = 2.0 ** (23 - bits)
    factor = np.minimum(1, end / np.maximum(reach, 1e-300))[:, None]
    moved = int((factor < 1).sum())
    if not moved:
        return arrays, bits, ()
    nearer = {
        **arrays,
        "means": arrays["means"] * factor,
        "log_scales": arrays["log_scales"] + np.log(factor),
    }
    if SIGMA in arrays:
        nearer[SIGMA] = arrays[SIGMA] * factor[:, 0]
    if GROWTH in arrays:
        nearer["log_scales"] -= arrays[GROWTH][:, None] * np.log(factor)
    note = f"the {moved} farthest are moved to {end:g} from 0, and made as much smaller"
    return nearer, bits, (note,)


def _packed(arrays: dict[str, np.ndarray], bits: int) -> list[bytes]:
    """The arrays in the order of the file; positions have ``bits`` for the fraction."""
    # Far beyond what a byte has room for, but not so far that it overflows.
    sh0 = np.clip(arrays["sh0"], -9, 9)
    harmonics = np.clip(arrays["shN"], -9, 9)
    steps = np.round(arrays["means"].astype(np.float64) * 2.0**bits)
    fixed = steps.clip(-(2**23), 2**23 - 1).astype("<i4")
    columns = [
        np.ascontiguousarray(fixed[..., None].view(np.uint8)[..., :3]),
        bytes_of(255 * values.sigmoid(arrays["opacity_logits"])),
        bytes_of(255 * (COLOR * sh0 + 0.5)),
        bytes_of(16 * (arrays["log_scales"] + 10)),
        _packed_quats(arrays["quats"]),
        bytes_of(128 + _STEP * np.round(128 / _STEP * harmonics)),
    ]
    return [column.tobytes() for column in columns]


def _packed_quats(quats: np.ndarray) -> np.ndarray:
    """``[N, 1]`` uint32: the index of the largest component in xyzw, then of each other a sign and
    9 bits, over sqrt(1/2).
    """
    xyzw = np.roll(values.normalized(quats), -1, axis=1).astype(np.float64)
    largest = np.abs(xyzw).argmax(1)[:, None]
    signs = np.sign(np.take_along_axis(xyzw, largest, 1))
    others = signs * np.take_along_axis(xyzw, _OTHERS[largest[:, 0]], 1)
    levels = np.floor(MAGNITUDE * np.abs(others) + 0.5).clip(max=511).astype(np.int64)
    fields = levels + 512 * (others < 0)
    return ((largest << 30) + (fields << _SHIFTS).sum(1, keepdims=True)).astype("<u4")


def _losses(arrays: dict[str, np.ndarray], bits: int) -> list[str]:
    """A line for each loss. The limits are the ranges of the bytes and a little more: -2.03125 is
    the middle of the logarithms of scales, -10 to 5.9375.
    """
    notes = [
        f"positions are rounded to {2.0**-bits:.1g}, colours, opacities, scales and rotations to"
        " about 8 bits",
    ]
    if np.abs(arrays["shN"]).max(initial=0) > 1.01:
        notes.append("harmonics beyond 1 are cut to it")
    if np.abs(arrays["sh0"]).max() > 0.51 / COLOR:
        notes.append("colours beyond the range are cut to it")
    if (np.abs(arrays["log_scales"] + 2.03125) > 8).any():
        notes.append("scales beyond e^-10 to e^5.9 are cut to it")
    return notes


def read(path: Path, data: bytes) -> Source:
    """Reads version 3, SH degree 0 to 3; versions 2 and 4 are converted by splat-transform."""
    if data.startswith(NEW_SPZ):
        return splat_transform.read(path, data)
    packed = data
    limit = max(_SMALL, _BOMB * len(packed))
    gzip = zlib.decompressobj(wbits=31)
    data = gzip.decompress(packed, limit)
    if not gzip.eof:
        raise ValueError(f"it is truncated, or unpacks to more than {limit:,} bytes, as no splat")
    magic, version, count = struct.unpack_from("<III", data)
    degree, bits, flags = data[12:15]
    if magic == MAGIC and version == 2:
        return splat_transform.read(path, packed)
    readable = magic == MAGIC and version == VERSION
    if not readable or degree not in SH_COUNTS or bits > 24 or count > MOST_GAUSSIANS:
        raise ValueError(f"no SPZ file of version 3: version {version}, {count} Gaussians")
    bands = SH_COUNTS[degree] - 1
    sizes = 9, 1, 3, 3, 4, 3 * bands
    end = HEADER.size + count * sum(sizes)
    if not count or end > len(data):
        raise ValueError("it has no Gaussians or is truncated")
    table = np.frombuffer(data[HEADER.size : end], np.uint8)
    ends = count * np.cumsum(sizes)[:-1]
    columns = [column.reshape(count, -1) for column in np.split(table, ends)]
    records = _records(data[end:]) if flags & EXTENDED else {}
    stored, dial = _ours(records[RECORD], count) if RECORD in records else (None, {})
    metadata = parse_metadata(path, stored, dial=bool(dial))
    # the axes; a file without a record has those that converters write
    axes = int.from_bytes(records.get(AXES, bytes([RDF])), "little")
    if axes != RDF:
        raise ClodError(
            f"{path}: its axes are of kind {axes}, which this reader does not know; convert it:"
            " splat-transform IN.spz OUT.ply"
        )
    arrays = _unquantized(columns, bits) | dial
    if dial:  # whose sigma_d is in units of the reference distance where that is large
        tensors: dict[str, Any] = {
            name: torch.from_numpy(array).float()
            for name, array in arrays.items()
            if name != OPACITY
        }
        gaussians = in_world_units(Gaussians(**tensors, attenuation=metadata.attenuation))
        arrays[SIGMA] = gaussians.tensors()[SIGMA].numpy()
        metadata = replace(metadata, attenuation=gaussians.attenuation)
    antialiased = flags & ANTIALIASED and not (metadata.screen_filter or CLASSIC).compensate
    # the file is then another program's, which states no variance
    comments = (*metadata.about, TAG) if antialiased else metadata.about
    return Source(arrays, metadata, (QUANTISED,), comments)


def _records(data: bytes) -> dict[int, bytes]:
    """The records after the arrays by their types, as far as they are whole."""
    records = {}
    start = 0
    while start + 8 <= len(data):
        kind, size = struct.unpack_from("<II", data, start)
        start += 8 + size
        if start <= len(data):
            records[kind] = data[start - size : start]
    return records


def _ours(body: bytes, count: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The JSON document of our record, and the columns of the dial if they are there."""
    (length,) = struct.unpack_from("<I", body)
    stored = json.loads(body[4 : 4 + length])
    names = stored.get(COLUMNS, [SIGMA])
    table = np.frombuffer(body[4 + length :], "<f2").astype(np.float32).reshape(-1, count)
    known = isinstance(names, list) and names == list(dial_columns(names))
    if not known or len(table) not in (0, len(names)):
        raise ValueError(f"its record of sigma_d is damaged: {len(table)} of {names!r:.40}")
    return stored, dict(zip(names, table, strict=False))  # no rows without a dial


def _unquantized(columns: list[np.ndarray], bits: int) -> dict[str, np.ndarray]:
    """The inverse of ``_packed``, of ``[N, bytes]`` columns."""
    means, opacities, colors = columns[:3]
    scales, quats, harmonics = columns[3:]
    wide = np.zeros((len(means), 3, 4), np.uint8)
    wide[..., 1:] = means.reshape(-1, 3, 3)
    fixed = wide.view("<i4")[..., 0] >> 8  # with the sign
    levels = harmonics.reshape(len(means), -1, 3).astype(np.float32)
    # so that logits are finite: the first and last level are a quarter of a level from 0 and 1
    shares = opacities[:, 0].astype(np.float64).clip(0.25, 254.75) / 255
    return {
        "means": (fixed / 2.0**bits).astype(np.float32),
        "quats": _rotations(quats),
        "log_scales": scales.astype(np.float32) / 16 - 10,
        "opacity_logits": values.logit(shares),
        "sh0": ((colors.astype(np.float32) / 255 - 0.5) / COLOR)[:, None],
        "shN": (levels - 128) / 128,
    }


def _rotations(quats: np.ndarray) -> np.ndarray:
    """``[N, 4]`` wxyz; the inverse of ``_packed_quats``."""
    packed = np.ascontiguousarray(quats).view("<u4")
    largest = packed >> 30
    fields = packed >> _SHIFTS
    others = (fields & 511) / MAGNITUDE * np.where(fields & 512, -1.0, 1.0)
    xyzw = np.empty((len(packed), 4))
    np.put_along_axis(xyzw, _OTHERS[largest[:, 0]], others, 1)
    longest = np.sqrt(np.maximum(0, 1 - (others**2).sum(1, keepdims=True)))
    np.put_along_axis(xyzw, largest, longest, 1)
    return np.roll(xyzw, 1, axis=1).astype(np.float32)
