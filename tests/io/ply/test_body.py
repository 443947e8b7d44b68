from __future__ import annotations

import hashlib
import itertools
import threading
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyElement

from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import load
from clod_adapter.io.ply import inria_dtype, read_head
from formats import write_elements, write_rows


def rows(count: int, seed: int = 0) -> np.ndarray:
    vertex = np.zeros(count, [*inria_dtype(0).descr, ("label", "u1"), ("time", "f8")])
    rng = np.random.default_rng(seed)
    for name in vertex.dtype.names:
        vertex[name] = rng.integers(0, 99, count) if name == "label" else rng.normal(size=count)
    return vertex


def header(form: str, count: object, before: str = "", after: str = "") -> bytes:
    properties = "".join(f"property float {name}\n" for name in inria_dtype(0).names or ())
    return f"ply\nformat {form} 1.0\n{before}element vertex {count}\n{properties}{after}end_header\n".encode()


@pytest.mark.parametrize(
    ("form", "count"), [("ascii", 1 << 31), ("binary_little_endian", (1 << 64) - 1), ("binary_big_endian", 10)]
)
def test_false_row_counts_allocate_nothing(tmp_path: Path, form: str, count: int) -> None:
    path = tmp_path / "in.ply"
    path.write_bytes(header(form, count) + b"0 " * 30)
    read_head(path)  # so that nothing is imported while it is measured
    tracemalloc.start()
    try:
        with pytest.raises(ClodError, match=rf"in.ply: is truncated.*claims {count} of vertex.*the file has"):
            load(path)
        assert tracemalloc.get_traced_memory()[1] < 3 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("form", "other"),
    [
        ("ascii", "property uchar a\n"), ("ascii", "property list uchar int a\n"), ("binary_little_endian", ""),
        ("binary_big_endian", "property list uchar int a\n"),
    ],
)  # fmt: skip
def test_false_counts_of_other_elements_are_refused(tmp_path: Path, form: str, other: str) -> None:
    body = "".join("0 " * 17 + "\n").encode() if form == "ascii" else bytes(17 * 4)
    for before, after in ((f"element a {1 << 40}\n{other}", ""), ("", f"element a {1 << 40}\n{other}")):
        (tmp_path / "in.ply").write_bytes(header(form, 1, before, after) + body)
        with pytest.raises(ClodError):  # before the test's time limit, in which no loop counts that far
            load(tmp_path / "in.ply")


@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_extreme_values_raise_no_warning(tmp_path: Path, kind: str) -> None:
    vertex = np.zeros(20, [(name, kind) for name in inria_dtype(0).names or ()])
    vertex["rot_0"], vertex["opacity"] = 1, np.linspace(-3, 3, 20)
    vertex["x"] = np.linspace(-1, 1, 20)
    vertex["x"][:2] = -np.finfo(kind).max, np.finfo(kind).max
    for name in ("x", "opacity", "scale_0"):  # NaNs that signal
        vertex[name].view("u4" if kind == "f4" else "u8")[3] = 0x7F800001 if kind == "f4" else 0x7FF0000000000001
    write_rows(tmp_path / "in.ply", vertex)
    with warnings.catch_warnings(action="error"):
        loaded = load(tmp_path / "in.ply", activated="none")
    assert 0 < len(loaded.gaussians) < 20


@pytest.mark.parametrize("order", ["<", ">", "ascii"])
def test_rows_are_those_of_the_file_whatever_happens_to_it_later(tmp_path: Path, order: str) -> None:
    """The fingerprint is of the whole file; elements around the rows, with lists too, do not matter."""
    camera = PlyElement.describe(np.zeros(3, [("fx", "f8"), ("n", "i2")]), "intrinsic")
    face = PlyElement.describe(np.array([([0, 1],)], [("corners", "O")]), "face", val_types={"corners": "i4"})
    path, vertex = tmp_path / "in.ply", rows(50)
    write_elements(path, [camera, PlyElement.describe(vertex, "vertex"), face], order)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    found = load(path, activated="none")
    path.write_bytes(bytes(path.stat().st_size))
    assert found.fingerprint == digest and found.vertex.dtype == vertex.dtype and found.vertex.dtype.isnative
    for name in vertex.dtype.names:
        np.testing.assert_array_equal(found.vertex[name], vertex[name])


GOOD = "1.0 " * 17 + "\n"


COMMENTED = header("ascii", 0).replace(b"element", b"comment @\nelement")


LIST = "element face 1\nproperty list uchar int a\n"


def test_the_fingerprint_is_of_the_rows_that_were_read(tmp_path: Path) -> None:
    """Another program writes the file in place all the while, as trainers do."""
    path, start, ended = tmp_path / "in.ply", header("binary_little_endian", 20_000), threading.Event()
    path.write_bytes(start + np.ones((20_000, 17), "<f4").tobytes())

    def rewrite() -> None:
        with open(path, "r+b", buffering=0) as file:
            for k in itertools.takewhile(lambda _: not ended.is_set(), itertools.count()):
                file.seek(len(start))
                file.write(np.full((20_000, 17), (1 + k % 100) / 100, "<f4").tobytes())

    writer = threading.Thread(target=rewrite)
    writer.start()
    try:
        for _ in range(8):
            found = load(path, activated="none")
            assert found.vertex is not None
            assert found.fingerprint == hashlib.sha256(start + found.vertex.tobytes()).hexdigest()
    finally:
        ended.set()
        writer.join()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        *((header("binary_little_endian", count) + bytes(300), "header is damaged")
          for count in (-1, "nan", "0x10", "1_0", "9" * 21, "9" * 5000, "2.0", "+3", "")),
        *((header("ascii", 3) + f"{GOOD}{bad}\n{GOOD}".encode(), "in.ply: damaged or truncated")
          for bad in ("1.0 " * 16, "1.0 " * 18, "1.0 " * 16 + "x", "1.0 " * 16 + "\u0661")),
        (header("binary_little_endian", 1, LIST) + bytes(100), "no usable Gaussian"),  # lists before it are read
        (COMMENTED.replace(b"@", b"\x1b[2J"), "not printable ASCII"),
        (COMMENTED.replace(b"@", "\u00e9".encode()), "not printable ASCII"),
        (b"ply\nformat ascii 1.0\n" + b"comment x\n" * 200_000 + b"end_header\n", "no end"),
    ],
)  # fmt: skip
def test_malformed_files_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "in.ply").write_bytes(content)
    with pytest.raises(ClodError, match=message):
        load(tmp_path / "in.ply")


def test_a_row_of_any_length_is_not_copied(tmp_path: Path) -> None:
    path = tmp_path / "in.ply"
    path.write_bytes(header("ascii", 1) + b"0 " * 16 + b"1" * (1 << 23))
    tracemalloc.start()
    try:
        with pytest.raises(ClodError, match="in.ply: damaged or truncated .a row of more than"):
            load(path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 23
    finally:
        tracemalloc.stop()
