"""Damage for fuzz.py: random changes to bytes, lines, numbers and the documents inside files."""

from __future__ import annotations

import gzip
import io
import json
import random
import zipfile
from copy import deepcopy
from pathlib import Path
from typing import Any

from mutants import Input

VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1 << 31, 1 << 63, 1 << 200, 1e308, float("nan"), float("inf"), "", "x", "nan", "a\nb", "\x1b",
    [], {}, [1], {"a": 1}, [None, None], "[" * 100000, 0.5, "F64", [2**62, 2**62], [0, 2**63], 1e-300, 1e9, -0.5,
    "../a.png", "/etc/passwd", "images/a", "OPENCV_FISHEYE", "x" * 300,
)  # fmt: skip
NUMBERS = (0, 1, 2, 255, 1 << 15, 1 << 16, 1 << 24, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 40, 1 << 62)
NUMBERS += ((1 << 63) - 1, 1 << 63, (1 << 64) - 1)
WORDS = (
    b"nan", b"inf", b"-inf", b"-1", b"1e999", b"-0", b"0x10", b"1_0", b"", b" ", b"\n", b"\r", b"\r\n", b"\0", b"\xff",
    b"../", b"../../etc/passwd", b"/etc/passwd\0", b"C:\\", b"..\\..\\", b"\\\\host\\x", b"~/", b"a" * 5000, b"\x1b[2J",
    b"b" * 300,
    b"element vertex", b"property float x", b"property list uchar int x", b"end_header",
    b"comment clod_adapter tau nan",
    b"ascii", b"binary_big_endian", b"double", b"uchar", b"PINHOLE", b"OPENCV", b"#", b"{", b"}", b"[" * 2000, b"null",
    b"99999999999999999999", *(str(number).encode() for number in NUMBERS),
)  # fmt: skip


def mutate(case: Input, others: list[Input], chance: random.Random) -> Input:
    """Damages one of the files, or two, in one to four ways."""
    whole, case = case, dict(case)
    for _ in range(chance.choice((1, 1, 1, 2))):
        name = chance.choice(sorted(case))
        data = bytearray(case[name])
        inside = INSIDE.get(Path(name).suffix)
        if inside and case[name] is whole[name] and chance.random() < 0.5:
            data = inside(bytes(data), chance)
        else:
            damage(data, chance)
        case[name] = bytes(data)
    if chance.random() < 0.02 and len(case) > 1:  # files missing, or of another model
        del case[chance.choice(sorted(case))]
    if chance.random() < 0.02 and len(case) > 1:
        other = chance.choice(others)
        case |= {name: other[name] for name in chance.sample(sorted(other), 1)}
    return case


def damage(data: bytearray, chance: random.Random) -> None:
    for _ in range(chance.choice((1, 1, 2, 4))):
        chance.choice(WAYS)(data, chance)


def _describe(data: bytes, chance: random.Random) -> bytearray:
    """A safetensors file whose description is damaged: as text, or a value in it, the lengths right again."""
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    (key,) = header["__metadata__"]
    about = json.loads(header["__metadata__"][key])
    if chance.random() < 0.3:
        text = bytearray(json.dumps(about).encode())
        damage(text, chance)
        header["__metadata__"][key] = text.decode("latin1")
    else:
        _replace(header if chance.random() < 0.2 else about, chance)
        if isinstance(header.get("__metadata__"), dict):
            header["__metadata__"][key] = json.dumps(about)
    changed = json.dumps(header).encode()
    return bytearray(len(changed).to_bytes(8, "little") + changed + data[8 + size :])


def _document(data: bytes, chance: random.Random, as_text: float = 0.0) -> bytearray:
    """JSON with some of its values replaced, or, with probability ``as_text``, damaged as text."""
    if as_text and chance.random() < as_text:
        text = bytearray(data)
        damage(text, chance)
        return text
    document = json.loads(data)
    for _ in range(1 if as_text else chance.choice((1, 1, 2, 4))):
        _replace(document, chance)
    return bytearray(json.dumps(document).encode())


def _replace(where: Any, chance: random.Random) -> None:
    """Puts another value somewhere into a JSON document."""
    while True:
        key = chance.choice(sorted(where) if isinstance(where, dict) else range(len(where)))
        if not isinstance(where[key], dict | list) or not where[key] or chance.random() < 0.3:
            break
        where = where[key]
    where[key] = deepcopy(chance.choice(VALUES))


def _repack(data: bytes, chance: random.Random) -> bytearray:
    """A zip archive one of whose entries is damaged, its checksum right again."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
        names = old.namelist()
        chosen = chance.choice([name for name in names if name.endswith("data.pkl")] * 3 + names)
        for name in names:
            entry = bytearray(old.read(name))
            if name == chosen:
                damage(entry, chance)
            new.writestr(name, bytes(entry))
    return bytearray(out.getvalue())


def _packed(data: bytes, chance: random.Random) -> bytearray:
    """An SPZ file damaged within what its gzip holds."""
    inner = bytearray(gzip.decompress(data))
    damage(inner, chance)
    return bytearray(gzip.compress(bytes(inner)))


def _glb(data: bytes, chance: random.Random) -> bytearray:
    """A glb whose JSON is damaged, as text or in a value, its lengths right again."""
    size = int.from_bytes(data[12:16], "little")
    text = _document(data[20 : 20 + size], chance, as_text=0.3)
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = data[:8] + (20 + len(text) + len(rest)).to_bytes(4, "little")
    return bytearray(head + len(text).to_bytes(4, "little") + b"JSON" + bytes(text) + rest)


def _flip(data: bytearray, chance: random.Random) -> None:
    for _ in range(chance.choice((1, 1, 3, 8))):
        if data:
            data[_place(data, chance)] ^= 1 << chance.randrange(8)


def _cut(data: bytearray, chance: random.Random) -> None:
    """The rest of the file, or some bytes."""
    start = _place(data, chance)
    del data[start : start + chance.choice((1, 2, 4, 8, 64, len(data), len(data), len(data)))]


def _put(data: bytearray, chance: random.Random) -> None:
    """Random bytes, a word with a meaning, or a copy of another part: in place of what is there, or between."""
    start, size = _place(data, chance), chance.choice((4, 16, 64, 256))
    new = chance.choice((chance.randbytes(min(size, 100)), chance.choice(WORDS), bytes(data[start : start + size])))
    place = _place(data, chance)
    data[place : place + (len(new) if chance.random() < 0.5 else 0)] = new


def _number(data: bytearray, chance: random.Random) -> None:
    """An extreme integer, as 1, 2, 4 or 8 bytes of either order."""
    size, place = chance.choice((1, 2, 4, 8)), _place(data, chance)
    number = chance.choice(NUMBERS) % (1 << 8 * size)
    data[place : place + size] = number.to_bytes(size, chance.choice(("little", "little", "big")))


def _line(data: bytearray, chance: random.Random) -> None:
    """Among the lines that text begins with: drops, doubles or swaps one, or changes a word of it."""
    end = data.find(b"end_header")
    text, rest = (bytes(data[:end]), bytes(data[end:])) if end > 0 else (bytes(data), b"")
    lines = text.split(b"\n")
    at, other = chance.randrange(len(lines)), chance.randrange(len(lines))
    way = chance.randrange(5)
    if way == 0:
        del lines[at]
    elif way == 1:
        lines.insert(other, lines[at])
    elif way == 2:
        lines[at], lines[other] = lines[other], lines[at]
    else:
        words = lines[at].split(b" ")
        words[chance.randrange(len(words))] = chance.choice(WORDS)
        lines[at] = b" ".join(words)
    data[:] = b"\n".join(lines) + rest


def _place(data: bytearray, chance: random.Random) -> int:
    """Anywhere, but every third time near the start, where the counts are."""
    return chance.randrange(max(1, min(len(data), 200) if chance.random() < 0.33 else len(data)))


INSIDE = {
    ".safetensors": _describe, ".pt": _repack, ".json": _document, ".spz": _packed, ".glb": _glb,
}  # fmt: skip
WAYS = (_flip, _cut, _cut, _put, _put, _put, _number, _number, _line, _line)
