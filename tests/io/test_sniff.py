from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import load

LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 248\n"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", LFS, "Git LFS pointer.*git lfs pull"),
        ("a.ply", b"\r\n<!DOCTYPE html><html>", "web page.*download the file itself"),
        ("a.ply", b"<html lang=en>", "web page"),
        ("a.ply", b"<?xml version='1.0'?><Error>", "XML document"),
        ("a.ply", gzip.compress(b"ply\n", mtime=0), "gzip.*gunzip"),
        ("a.spz", b"NGSP" + bytes(60), "(spz of version 4 is read through splat-transform|cannot be read)"),
        ("a.spz", bytes(64), "not a .spz file by its first bytes"),
        ("a.glb", b"ply\nformat ascii 1.0\n", "a PLY file; call it .ply"),
        ("a.pt", b"ply\r\nformat ascii 1.0\n", "a PLY file; call it .ply"),
        ("a.pt", bytes(64), "no file of torch.save"),
        ("a.spz", b"glTF", "a glTF model; call it .glb"),
        ("a.ply", b"NGSP", "an SPZ file; call it .spz"),
        ("a.ply", b"glTF", "glTF model; call it .glb"),
        ("a.ply", b"PK\x03\x04rest", "zip archive"),
        ("a.lcc", bytes(64), "LCC.*splat-transform IN.lcc OUT.ply"),
        ("a.splat", bytes(63), "not a .splat file, whose rows have 32"),
        ("a.hier", bytes(64), "Hierarchical-3DGS.*point_cloud.ply"),
        ("a.ckpt", b"PK\x03\x04rest", "Nerfstudio.*ns-export gaussian-splat"),
        ("chkpnt30000.pth", b"PK\x03\x04rest", "Inria.*point_cloud.ply"),
        ("a.safetensors", bytes(64), "not a safetensors file, or damaged"),
        ("meta.json", b"{}", "SOG.*splat-transform"),
        ("a.ply", b"solid teapot", "is not a PLY file"),
        ("a.ply", b"plyx", "is not a PLY file"),
    ],
)  # fmt: skip
def test_error_names_the_kind_of_file(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ClodError, match=f"{name}: .*{message}"):
        load(tmp_path / name)
