"""Files that are no splats, damaged or hostile: an error that names the file, in one line, and
little memory.
"""

import gzip
import io
import json
import os
import struct
import tracemalloc
import zipfile
from copy import copy
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyElement
from refusals import refused

from clod_adapter.io.checkpoint import load
from clod_adapter.io.file_formats import FORMATS, check_readable, write
from formats import (
    model,
    needed,
    random_rows,
    with_columns,
    write_elements,
    write_rows,
)

# its own errors: test_splat_transform.py
pytestmark = pytest.mark.usefixtures("without_splat_transform")
LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 248\n"


def rows(*names, count=2, without=(), **types):
    return random_rows(
        count, [name for name in names or needed(1) if name not in without], types=types
    )


def filled(name, value):
    return with_columns(
        rows(count=3), **{column: value for column in needed(1) if column.startswith(name)}
    )


def with_a_list(path):
    lists = np.ones(2, [(name, "f4") for name in needed()] + [("bones", "O")])
    lists["bones"] = [np.array([1], "i4"), np.array([2, 3], "i4")]
    write_rows(path, lists)


def header(form, count, before="", after=""):
    properties = "".join(f"property float {name}\n" for name in needed())
    vertex = f"{before}element vertex {count}\n{properties}{after}"
    return f"ply\nformat {form} 1.0\n{vertex}end_header\n".encode()


def claiming(count):
    return gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 3, count, 3, 12, 0, 0), mtime=0)


def with_record(columns, values):
    """An .spz of a model of 40 whose record of the dial names these columns and has so many
    values.
    """

    def make(path):
        write(path, model(0))
        data, at = gzip.decompress(path.read_bytes()), 16 + 40 * 20 + 12
        size = struct.unpack_from("<I", data, at + 8)[0]
        text = json.dumps(
            json.loads(data[at + 12 : at + 12 + size]) | {"columns": columns}
        ).encode()
        body = struct.pack("<I", len(text)) + text + bytes(2 * values)
        path.write_bytes(
            gzip.compress(data[:at] + struct.pack("<II", 0x434C0001, len(body)) + body)
        )

    return make


def splats(count=12, **changes):
    shapes = {
        "means": (count, 3),
        "quats": (count, 4),
        "scales": (count, 3),
        "opacities": (count,),
        "sh0": (count, 1, 3),
        "shN": (count, 15, 3),
    }
    return {"splats": {name: torch.zeros(shape) for name, shape in shapes.items()} | changes}


class Call:
    def __init__(self, *what):
        self.what = what

    def __reduce__(self):
        return self.what[0], self.what[1:]


def archive(kind, names):
    """A .pt packed again, with so many names of the same megabyte."""

    def make(path):
        torch.save(splats(), path)
        buffer = io.BytesIO(path.read_bytes())
        with zipfile.ZipFile(buffer) as old, zipfile.ZipFile(path, "w", kind) as new:
            for each in old.namelist():
                new.writestr(each, old.read(each))
            new.writestr("a/data/99", bytes(1 << 20))
            for k in range(names):
                new.filelist.append(copy(new.getinfo("a/data/99")))
                new.filelist[-1].filename = f"a/data/{k + 100}"

    return make


def claiming_rows(form, body, kind):
    """Another element of 2^40 rows before and after the vertex; refused before the test's time
    limit, in which no loop counts that far.
    """
    other = f"element a {1 << 40}\n{kind}"
    return (header(form, 1, other) + body, ""), (header(form, 1, "", other) + body, "")


LITTLE, BIG, GOOD = "binary_little_endian", "binary_big_endian", "1.0 " * 14 + "\n"
LIST = "property list uchar int a\n"
# name of the file, what it holds, the message after the name
OTHER_KINDS = (
    ("a.ply", b"\r\n<!DOCTYPE html><html>", "web page.*download the file itself"),
    ("a.ply", b"<?xml version='1.0'?><Error>", "XML document"),
    ("a.ply", gzip.compress(b"ply\n", mtime=0), "gzip.*gunzip"),
    ("a.ply", b"NGSP", "an SPZ file; call it .spz"),
    ("a.ply", b"glTF", "a glTF model; adapt the PLY that it was made from"),
    ("a.ply", b"PK\x03\x04rest", "zip archive"),
    ("a.ply", b"solid teapot", "is not a PLY file"),
    ("a.spz", b"NGSP" + bytes(60), "SPZ of another version than 3 is read through splat-transform"),
    ("a.spz", bytes(64), "not a .spz file by its first bytes"),
    ("a.spz", b"ply\nformat ascii 1.0\n", "a PLY file; call it .ply"),
    ("a.glb", b"glTF" + bytes(60), "a glTF model; adapt the PLY that it was made from"),
    ("a.pt", bytes(64), "no file of torch.save"),
    ("a.safetensors", bytes(64), "perhaps an adapter; clod-adapt apply"),
    ("a.lcc", bytes(64), "LCC.*splat-transform IN.lcc OUT.ply"),
    ("a.hier", bytes(64), "Hierarchical-3DGS.*point_cloud.ply"),
    ("a.ckpt", b"PK\x03\x04rest", "Nerfstudio.*ns-export gaussian-splat"),
    ("chkpnt30000.pth", b"PK\x03\x04rest", "Inria.*point_cloud.ply"),
    ("meta.json", b"{}", "SOG.*splat-transform"),
)
OF_PLY = (
    (rows("packed_position", "packed_rotation"), "compressed PLY; call it in.compressed.ply"),
    (rows(*needed(1), "f_offset_0", "f_anchor_feat_0"), "Scaffold-GS"),
    (rows(without=("scale_2",)), "2DGS"),
    (rows(*needed()[:3], "red", *needed()[6:]), "colours in the place.*--ply-color-mode"),
    (rows("x", "y", "z", "nx", "ny", "nz"), "mesh or a point cloud"),
    *((rows(without=(name,)), f"property {name} is missing") for name in ("rot_3", "y")),
    (rows(without=("f_rest_4",)), "8 f_rest"),
    (rows(*needed(1), "f_rest_9", without=("f_rest_4",)), "property f_rest_4 is missing"),
    (rows(x="i4"), "property x is not float"),
    (rows(count=0), "no usable Gaussian"),
    (filled("x", np.nan), "no usable Gaussian.*of 3 rows"),
    (filled("rot", 0), "no usable Gaussian.*of 3 rows"),
    (
        lambda path: write_elements(path, [PlyElement.describe(rows(), "point")]),
        "no vertex element.*point",
    ),
    (with_a_list, "property bones is a list"),
    (
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nelement face"
        b" 999999999\n"
        # without reading its faces
        b"property list uchar int vertex_indices\nend_header\n",
        "mesh or a point cloud",
    ),
    *(
        (header(LITTLE, count) + bytes(300), "header is damaged")
        for count in (-1, "nan", "0x10", "1_0", "9" * 21, "9" * 5000, "2.0", "+3", "")
    ),
    *(
        (header("ascii", 3) + f"{GOOD}{bad}\n{GOOD}".encode(), "damaged or truncated")
        for bad in ("1.0 " * 13, "1.0 " * 15, "1.0 " * 13 + "x", "1.0 " * 13 + "\u0661")
    ),
    # lists before it are read
    (header(LITTLE, 1, f"element face 1\n{LIST}") + bytes(100), "no usable Gaussian"),
    (
        header("ascii", 1).replace(b"float x", b"float \x1b[2J"),
        "a name that is not printable ASCII",
    ),
    (b"ply\nformat ascii 1.0\n" + b"comment x\n" * 200_000 + b"end_header\n", "no end"),
    *(
        (header(form, count) + b"0 " * 24, rf"is truncated.*claims {count} of vertex.*the file has")
        for form, count in (("ascii", 1 << 31), (LITTLE, (1 << 64) - 1), (BIG, 10))
    ),
    *claiming_rows("ascii", GOOD.encode(), "property uchar a\n"),
    *claiming_rows("ascii", GOOD.encode(), LIST),
    *claiming_rows(LITTLE, bytes(56), ""),
    *claiming_rows(BIG, bytes(56), LIST),
    (
        header("ascii", 1) + b"0 " * 13 + b"1" * (1 << 23),
        "damaged or truncated .a row of more than",
    ),
)
OF_SPZ = (
    (gzip.compress(bytes(1 << 26), mtime=0), "unpacks to more"),
    (claiming(9_999_999), "truncated"),
    (claiming(1 << 31), "no SPZ file of version"),
    (claiming(0), "no Gaussians"),
    (gzip.compress(b"short", mtime=0), "truncated"),
    *(
        (with_record(columns, values), "its record of sigma_d is damaged")
        for columns, values in (
            (["sigma_d", "growth_d"], 40),
            (["sigma_d"], 80),
            (["growth_d", "sigma_d"], 80),
            (7, 40),
        )
    ),
)
OF_PT = (
    ([1], "no dictionary 'splats'.*list"),
    ({"model": 1}, "no dictionary 'splats'.*'model'"),
    ({"splats": [1]}, "no dictionary 'splats'"),
    ({"splats": {}}, "no 'means'"),
    (splats(shN=None, features=torch.zeros(12, 32)), "no 'shN'; with appearance"),
    (splats(quats=torch.zeros(11, 4)), "quats has shape .11, 4., expected .12, 4."),
    (splats(means=torch.tensor(1.0)), "shape"),
    (splats(means=torch.zeros(12, 3).int()), "no plain tensor"),
    (splats(means=torch.eye(3).to_sparse()), "more than tensors"),
    (splats(0), "of 0 rows"),
    (splats() | {"clod_adapter": 3}, "settings are damaged .*not int"),
    (splats() | {"clod_adapter": "[" * 100_000}, "settings are damaged"),
    (splats() | {"clod_adapter": '{"format": "clod-model"}'}, "settings are damaged"),
    (splats(sigma_d=torch.ones(3)), "sigma_d has shape .3,., expected .12,."),
    (splats(sigma_d=torch.ones(12), growth_d=torch.ones(3)), "growth_d has shape .3,."),
    # claims that would allocate, and code, which is not run
    (splats(means=torch.zeros(1).expand(1 << 40, 3)), "no plain tensor|more than tensors"),
    (splats(means=torch.zeros(3, 3, device="meta")), "no plain tensor|more than tensors"),
    (splats(means=Call(bytearray, 1 << 33)), "no plain tensor|more than tensors"),
    (splats(means=Call(os.mkdir, "ran")), "more than tensors, and is not unpickled"),
    (
        splats(means=Call(eval, "__import__('os').mkdir('ran')")),
        "more than tensors, and is not unpickled",
    ),
)
REFUSED = (
    *OTHER_KINDS,
    *(("in.ply", *each) for each in OF_PLY),
    *(("a.spz", *each) for each in OF_SPZ),
    *(("a.pt", partial(torch.save, checkpoint), message) for checkpoint, message in OF_PT),
    ("packed.pt", archive(zipfile.ZIP_DEFLATED, 0), "torch.save does not write"),
    ("many.pt", archive(zipfile.ZIP_STORED, 100), "torch.save does not write"),
    ("old.pt", b"\x80\x04]\x94.", "format before 1.6"),
)


@pytest.mark.parametrize("suffix", sorted({Path(name).suffix for name, _, _ in REFUSED}))
def test_damaged_and_hostile_files(tmp_path, monkeypatch, suffix):
    """The error is one printable line. Nothing is allocated for what a file claims, and none of its
    code runs.
    """
    monkeypatch.chdir(tmp_path)
    write_rows(tmp_path / "whole.ply", random_rows(9, needed()), "ascii")
    # so that nothing is imported while it is measured
    load(tmp_path / "whole.ply", activated="none")
    for name, content, message in REFUSED:
        if Path(name).suffix != suffix:
            continue
        path = tmp_path / name
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            write_rows(path, content) if isinstance(content, np.ndarray) else content(path)
        tracemalloc.start()
        try:
            with refused(f"{name}: .*{message}") as caught:
                load(path)
            assert tracemalloc.get_traced_memory()[1] < (40 << 20), (name, message)
        finally:
            tracemalloc.stop()
        assert str(caught.value).isprintable()
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("suffix", FORMATS)
def test_what_is_no_file_of_the_format(tmp_path, suffix):
    (tmp_path / f"folder{suffix}").mkdir()
    os.mkfifo(tmp_path / f"pipe{suffix}")
    for name, content in (("empty", b""), ("pointer", LFS), ("other", b"an unknown format")):
        (tmp_path / f"{name}{suffix}").write_bytes(content)
    for name, message in (
        ("missing", "cannot be read .No such file"),
        ("folder", "cannot be read"),
        ("pipe", "not a regular file"),
        ("empty", "is empty"),
        ("pointer", "is a Git LFS pointer.*git lfs pull"),
        ("other", ""),
    ):
        # of some kinds splat-transform tells
        for read in (load,) if name == "other" else (check_readable, load):
            with refused(f"{name}{suffix}: .*{message}"):
                read(tmp_path / f"{name}{suffix}")
