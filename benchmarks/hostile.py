"""Runs the command in hostile surroundings, each as one shell line with the exit code that is right.

    python benchmarks/hostile.py                # several minutes
    python benchmarks/hostile.py --only ulimit  # the lines with this text

A failure is another exit code, a traceback or a warning, an error that is not one last line, an input that changed, or
other new files than expected.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import io
import json
import math
import os
import re
import shutil
import struct
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import clod_adapter
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.scene.colmap import write_model

# isort: split
import torch
from PIL import Image

SCENE = "base.ply --images scene --iters 2 --max-sv 2 --accept-loss -o new.ply"
EVAL = "eval base.ply --images scene --sv 1 --quiet"
FILES = ("new.json", "new.ply", "new.safetensors")
NOISE = re.compile(r"Traceback|\w+Warning:|warn\(|Segmentation|core dumped|FATAL|terminate called|this is a bug")
SECONDS = 120


@dataclass(frozen=True)
class Case:
    """A shell line, in which ``clod-adapt`` is the command.

    Attributes:
        code: the exit code; None for 0 or 2.
        new: the files that it leaves.
        told: whether stderr, and so the error, can be read.
    """

    line: str
    code: int | None = 2
    new: tuple[str, ...] = ()
    told: bool = True


def streams() -> Iterator[Case]:
    yield Case("clod-adapt --version >&-")
    yield Case("clod-adapt --help >/dev/full")
    for stdout in (">&-", ">/dev/full", "--json >&-", "--json >/dev/full"):
        yield Case(f"clod-adapt inspect base.ply {stdout}")
    yield Case("set -o pipefail; clod-adapt inspect base.ply | true")
    yield Case("clod-adapt inspect missing.ply 2>&-", told=False)
    yield Case(f"clod-adapt {SCENE} <&- >&- 2>&-", 0, FILES)
    yield Case(f"clod-adapt {SCENE} >/dev/full 2>/dev/full", 0, FILES)
    yield Case("clod-adapt export base.ply -o new.spz >&-", 0, ("new.spz",))


def environments() -> Iterator[Case]:
    for variables in (
        "NUMBA_NUM_THREADS=0", "NUMBA_NUM_THREADS=-1", "NUMBA_NUM_THREADS=x", "NUMBA_NUM_THREADS=9999999",
        "OMP_NUM_THREADS=abc", "OMP_NUM_THREADS=99999999", "TMPDIR=/missing", "-u HOME", "HOME=/missing", "HOME=",
        "COLUMNS=0", "COLUMNS=1", "COLUMNS=x", "TERM=dumb", "TERM=", "NO_COLOR=1", "LANG=xx_YY.z", "LC_ALL=C",
        "LC_ALL=tr_TR.UTF-8", "PYTHONOPTIMIZE=2", "PYTHONWARNINGS=error", "PYTHONHASHSEED=0", "PYTHONIOENCODING=ascii",
        "PYTHONUTF8=0", "PYTHONUNBUFFERED=1", "PYTHONDEVMODE=1", "XDG_CACHE_HOME=/proc/x", "NUMBA_CACHE_DIR=/proc/x",
        "TZ=no/zone", "CUDA_VISIBLE_DEVICES=x", "RANK=x", "WORLD_SIZE=3", "OMP_WAIT_POLICY=x", '-i PATH="$PATH"',
    ):  # fmt: skip
        yield Case(f"env {variables} clod-adapt {EVAL}", 0)
    report = (*FILES, "new.html", "new_adapting.png", "new_rendering.png")
    yield Case(f"env MPLBACKEND=nonsense NUMBA_NUM_THREADS=0 clod-adapt {SCENE} --report", 0, report)
    yield Case(f"env PYTHONWARNINGS=error PYTHONOPTIMIZE=2 clod-adapt {SCENE} --report", 0, report)
    yield Case(f"env TMPDIR=/missing HOME=/missing clod-adapt {SCENE}", 0, FILES)
    for suffix in (".glb", ".spz", ".pt", ".safetensors", ".html"):
        new = f"new{suffix}"
        yield Case(f"env PYTHONWARNINGS=error clod-adapt export base.ply -o {new}", 0, (new,))


def limits() -> Iterator[Case]:
    for limit in ("-n 16", "-v 500000", "-v 1700000", "-v 2000000", "-u 1", "-s 256"):
        yield Case(f"ulimit {limit}; clod-adapt {EVAL}", None)
    yield Case("ulimit -f 2; clod-adapt export base.ply -o new.ply")
    yield Case(f"umask 777; clod-adapt {EVAL}", 0)


def folders() -> Iterator[Case]:
    yield Case("mkdir gone; cd gone; rmdir ../gone; clod-adapt inspect ../base.ply")
    for words in (
        'base.ply -o ""', "base.ply --out=", 'base.ply --images ""', '""', 'inspect ""', 'export base.ply -o ""',
        "base.ply -o /proc/x.ply", "base.ply -o /dev/null", "inspect /dev/zero", "inspect /proc/self/mem", "inspect .",
        "inspect /proc/self/environ", "base.ply --images /proc/self", "base.ply --images /dev",
        'inspect "$(printf "a%.0s" $(seq 5000))"', "inspect $'a\\nb.ply'", "inspect $'\\xff.ply'",
        "export base.ply -o new", "export base.ply -o new.zip", "export base.ply -o missing/new.ply",
    ):  # fmt: skip
        yield Case(f"clod-adapt {words}")
    yield Case("mkfifo p.ply; timeout 20 clod-adapt inspect p.ply; code=$?; rm p.ply; exit $code")
    yield Case("ln -s loop.ply loop.ply; clod-adapt inspect loop.ply; code=$?; rm loop.ply; exit $code")


def options() -> Iterator[Case]:
    for words in (
        "--iters nan", "--iters 1e3", "--iters -1", "--iters 0x10", "--max-sv nan", "--max-sv inf", "--max-sv 0",
        "--max-sv 1e400", "--batch 0", "--batch 1000000", "--batch 1.5", "--seed -1", "--seed 99999999999999999999",
        "--time-budget 0", "--time-budget nan", "--time-budget inf", "--memory 0", "--memory nan", "--memory 8XB",
        "--memory 1e400GB", "--memory 8GB --block 0", "--memory 8GB --block ²", "--with x", "--missing",
        "--iters $(printf 1%.0s $(seq 100000))", "--max-sv",
    ):  # fmt: skip
        yield Case(f"clod-adapt base.ply --images scene -o new.ply {words}")
    for words in ("--sv nan", "--sv inf", "--sv -1", "--keep 0", "--keep nan", "--psnr-drop 0", "--fps inf", "--sv"):
        yield Case(f"clod-adapt eval base.ply --images scene {words}")
    for words in ("--levels nan", "--levels 1,,2", "--levels 1,1", "--camera ../x --images scene", "--order x"):
        yield Case(f"clod-adapt export base.ply -o new.ply {words}")
    for port in ("-1", "65536", "nan"):
        yield Case(f"clod-adapt view base.ply --no-browser --port {port}")


def damaged_files(folder: Path) -> Iterator[Case]:
    """Each written to ``folder`` and inspected."""
    ply, packed = (folder.parent / "base.ply").read_bytes(), zipped({"meta.json": b"{}"})
    code = b"\x80\x02cposix\nsystem\nX\x04\0\0\0exit\x85R."
    spz = partial(struct.pack, "<IIIBBBB", 0x5053474E)
    contents = {
        "empty.sog": b"", "none.sog": zipped({}), "cut.sog": packed[:-30], "text.sog": b"hello", "ply.sog": ply,
        "bomb.sog": zipped({"meta.json": b" " * 50_000_000}), "up.sog": zipped({"../../x": b"", "meta.json": b"{}"}),
        "in.sog": zipped({"a.sog": packed}), "sog.ply": packed, "meta.json": b'{"version":2,"count":1}',
        "ply.spz": ply, "ply.glb": ply, "ply.splat": ply, "ply.pt": ply, "ply.safetensors": ply, "ply.ksplat": ply,
        "count.spz": gzip.compress(spz(3, 2**31, 3, 12, 0, 0)), "gz.spz": b"\x1f\x8b",
        "bomb.spz": gzip.compress(spz(3, 3, 0, 12, 0, 0) + bytes(100_000_000)), "v9.spz": gzip.compress(spz(*[9] * 6)),
        "cut.spz": gzip.compress(spz(3, 1, 0, 12, 0, 0) + bytes(40))[:-9], "empty.glb": glb(b"{}"),
        "deep.glb": glb(b"[" * 100_000), "long.glb": glb(b'{"a":' + b"9" * 10**6 + b"}"), "nan.glb": glb(b'{"a":NaN}'),
        "uri.glb": glb(b'{"buffers":[{"byteLength":4,"uri":"../../etc/passwd"}]}'), "cut.glb": glb(b"{}")[:-2],
        "few.compressed.ply": packed_ply(1, 300), "huge.compressed.ply": packed_ply(2**40, 2**48),
        "none.compressed.ply": packed_ply(0, 0), "ply.ply": b"ply\n" * 1000, "gz.ply": gzip.compress(ply),
        "comment.ply": b"ply\nformat ascii 1.0\ncomment " + b"x" * 2_000_000 + b"\nend_header\n",
        "code.pt": zipped({"archive/data.pkl": code, "archive/version": b"3\n"}, zipfile.ZIP_STORED),
        "pickle.pt": code, "up.pt": zipped({"../../x/data.pkl": b"\x80\x02}."}, zipfile.ZIP_STORED),
        "size.safetensors": struct.pack("<Q", 2**60) + b"{}", "none.safetensors": struct.pack("<Q", 2) + b"{}",
        "deep.safetensors": struct.pack("<Q", 10**6) + b"[" * 10**6, "odd.splat": bytes(33), "none.splat": b"",
    }  # fmt: skip
    for name, data in contents.items():
        (folder / name).write_bytes(data)
        yield Case(f"clod-adapt inspect {folder}/{name}")


def damaged_scenes(folder: Path) -> Iterator[Case]:
    """Each written to ``folder`` and adapted to."""
    pose, photograph = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]], folder.parent / "scene/images/000.png"
    frame = {"file_path": "a.png", "transform_matrix": pose, "fl_x": 30, "w": 64, "h": 48}
    changes = (
        {"file_path": "../../etc/passwd.png"}, {"file_path": "/etc/passwd"}, {"file_path": "a\0b.png"},
        {"file_path": "missing.png"}, {"transform_matrix": [[0] * 4] * 4}, {"transform_matrix": [[math.nan] * 4] * 4},
        {"w": 2**31, "h": 2**31}, {"w": -1}, {"fl_x": 10**2000},
    )  # fmt: skip
    for number, change in enumerate(changes):
        scene = folder / f"transforms{number}"
        scene.mkdir()
        (scene / "transforms.json").write_text(json.dumps({"frames": [frame | change]}))
        shutil.copyfile(photograph, scene / "a.png")
        yield Case(f"clod-adapt base.ply --images {scene} -o new.ply")
    zeros = shutil.copytree(folder.parent / "scene", folder / "zeros")
    for name, at in (("images.bin", 12), ("frames.bin", 16)):
        if (path := zeros / "sparse" / "0" / name).exists():
            data = path.read_bytes()
            path.write_bytes(data[:at] + bytes(32) + data[at + 32 :])  # the first quaternion
    yield Case(f"clod-adapt base.ply --images {zeros} -o new.ply")


def zipped(files: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    found = io.BytesIO()
    with zipfile.ZipFile(found, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return found.getvalue()


def glb(document: bytes) -> bytes:
    document += b" " * (-len(document) % 4)
    return struct.pack("<IIIII", 0x46546C67, 2, 20 + len(document), len(document), 0x4E4F534A) + document


def packed_ply(chunks: int, count: int) -> bytes:
    bounds = [f"{end}_{kind}{axis}" for kind in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    head = f"ply\nformat binary_little_endian 1.0\nelement chunk {chunks}\n"
    head += "".join(f"property float {name}\n" for name in bounds) + f"element vertex {count}\n"
    head += "".join(f"property uint packed_{name}\n" for name in ("position", "rotation", "scale", "color"))
    return f"{head}end_header\n".encode() + bytes(5000)


def write_inputs(folder: Path) -> None:
    """A checkpoint of 200 Gaussians, ``base.ply``, and ten photographs of it, ``scene``."""
    random = torch.Generator().manual_seed(0)
    normal = partial(torch.randn, generator=random)
    gaussians = Gaussians(
        normal(200, 3), normal(200, 4), 0.5 * normal(200, 3) - 2, normal(200) + 1, normal(200, 1, 3),
        torch.zeros(200, 0, 3),
    )  # fmt: skip
    clod_adapter.save(folder / "base.ply", gaussians)
    cameras, names = clod_adapter.place_cameras(gaussians)[:10], [f"{number:03}.png" for number in range(10)]
    (folder / "scene" / "images").mkdir(parents=True)
    write_model(folder / "scene", cameras, names)
    for camera, name in zip(cameras, names, strict=True):
        pixels = clod_adapter.render(gaussians, camera).pixels
        Image.fromarray(pixels.numpy()).save(folder / "scene" / "images" / name)


def failures(case: Case, inputs: Path) -> list[str]:
    """What is wrong with the case, in a copy of the inputs."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copyfile(inputs / "base.ply", folder / "base.ply")
        shutil.copytree(inputs / "scene", folder / "scene")
        before = contents(folder)
        script = case.line.replace("clod-adapt", f"{sys.executable} -m clod_adapter")
        try:
            done = subprocess.run(["bash", "-c", script], cwd=folder, capture_output=True, timeout=SECONDS)
        except subprocess.TimeoutExpired:
            return [f"takes more than {SECONDS} s"]
        after = contents(folder)
    said, found = done.stderr.decode(errors="replace"), list[str]()
    if done.returncode not in ((0, 2) if case.code is None else (case.code,)):
        found.append(f"exit code {done.returncode}")
    if match := NOISE.search(said):
        found.append(f"prints {match[0]}")
    lines = [line for line in said.splitlines() if line]
    errors = [line for line in lines if line.startswith("clod-adapt: error: ")]
    if done.returncode == 2 and case.told and (errors != lines[-1:] or len(errors[0]) > 11_000):
        found.append("no error in one last line")
    if any(after.get(name) != data for name, data in before.items()):
        found.append("changes an input")
    if (new := {name for name in after.keys() - before.keys() if "/" not in name}) != set(case.new):
        found.append(f"leaves {sorted(new)}")
    return [*found, *lines[-5:]] if found else []


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).digest() for path in files}


def cases(inputs: Path) -> list[Case]:
    """All cases; the files that they read are written beside the inputs."""
    (inputs / "files").mkdir()
    groups = (streams(), environments(), limits(), folders(), options())
    read = (*damaged_files(inputs / "files"), *damaged_scenes(inputs / "files"))
    return [*(case for group in groups for case in group), *read]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="only the lines with this text")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(os.cpu_count()) as pool:
        write_inputs(inputs := Path(name))
        chosen = [case for case in cases(inputs) if args.only in case.line]
        wrong = 0
        for case, found in zip(chosen, pool.map(partial(failures, inputs=inputs), chosen), strict=True):
            if found:
                wrong += 1
                print(f"{case.line[:200]}\n  " + "\n  ".join(line[:300] for line in found), flush=True)
    print(f"{len(chosen)} cases, {wrong} failures")
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
