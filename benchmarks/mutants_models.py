"""Inputs for fuzz.py in the formats besides PLY that hold a whole model, and damage in what they pack or describe."""

from __future__ import annotations

import gzip
import json
import random
import sys
from collections.abc import Callable
from pathlib import Path

import torch

import clod_adapter as clod
from clod_adapter.io.file_formats import FORMATS, WRITABLE, write

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from packing import write_packed  # noqa: E402

Input = dict[str, bytes]
Damage = Callable[[bytearray, random.Random], None]
COUNT = 6
SUFFIXES = [suffix for suffix in WRITABLE if suffix != ".ply"]


def model_inputs(folder: Path, base: clod.Gaussians) -> list[Input]:
    """Of each format one with a dial, where it has room for it, and one without; and a compressed PLY."""
    dial = clod.attach(base, torch.rand(len(base)) + 0.1, clod.AttenuationConfig())
    inputs = []
    for suffix in SUFFIXES:
        for gaussians in (base, dial)[: 1 + FORMATS[suffix].carries_sigma]:
            write(folder / f"whole{suffix}", gaussians, ("a comment",))
            inputs.append({f"whole{suffix}": (folder / f"whole{suffix}").read_bytes()})
    packed = write_packed(folder / "whole.compressed.ply", base)
    return [*inputs, {packed.name: packed.read_bytes()}]


def unpacked(data: bytes, chance: random.Random, damage: Damage) -> bytearray:
    """An SPZ file damaged within what its gzip holds."""
    inner = bytearray(gzip.decompress(data))
    damage(inner, chance)
    return bytearray(gzip.compress(bytes(inner)))


def described(data: bytes, chance: random.Random, damage: Damage, replace: Callable[..., None]) -> bytearray:
    """A glb whose JSON is damaged, as text or in a value, its lengths right again."""
    size = int.from_bytes(data[12:16], "little")
    text = bytearray(data[20 : 20 + size])
    if chance.random() < 0.3:
        damage(text, chance)
    else:
        document = json.loads(text)
        replace(document, chance)
        text = bytearray(json.dumps(document).encode())
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = data[:8] + (20 + len(text) + len(rest)).to_bytes(4, "little")
    return bytearray(head + len(text).to_bytes(4, "little") + b"JSON" + bytes(text) + rest)
