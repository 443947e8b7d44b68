"""Photographs that are none by their content: refused with one line, and no other program is started."""

import shutil
import struct
from pathlib import Path
from typing import Any

import pytest

HELPERS = (
    "gs", "gswin32c", "gswin64c", "djpeg", "cjpeg", "ffmpeg", "convert", "magick", "gm", "display", "xv", "netpbm",
)  # fmt: skip
SIZE = (64, 48)  # the camera's
CONTENT = {
    "PostScript": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\n%%EndComments\nshowpage\n%%EOF\n",
    "PDF": b"%PDF-1.4\n1 0 obj\n<< /Type /Catalog >>\nendobj\n%%EOF\n",
    "GIF": b"GIF89a" + struct.pack("<HH", *SIZE) + bytes(40),
    "WMF": b"\xd7\xcd\xc6\x9a\0\0" + struct.pack("<4hHLH", 0, 0, *SIZE, 72, 0, 0) + b"\x01\x00\x09\x00" + bytes(100),
    "PPM": b"P6 64 48 255\n" + bytes(3 * 64 * 48),
}


def test_no_program_is_started(clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mark, tools, scene = tmp_path / "mark", tmp_path / "tools", tmp_path / "scene"
    tools.mkdir()
    for name in HELPERS:
        (tools / name).write_text(f"#!/bin/sh\n: > '{mark}'\n")
        (tools / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tools), prepend=":")
    shutil.copytree(capture.scene, scene)
    for kind, content in CONTENT.items():
        (scene / "images" / "001.png").write_bytes(content)
        done = clod("eval", capture.ply, "--images", scene, "--quiet")
        found = kind if kind in ("PostScript", "PDF", "GIF") else "damaged or none of PNG, JPEG, TIFF, WEBP, BMP"
        why = f"images/001.png: cannot be decoded, is {found}; export it as JPEG or PNG\n"
        assert not mark.exists(), kind
        assert done.code == 2 and done.err.endswith(why) and done.err.count("\n") == 1, done
