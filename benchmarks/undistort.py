"""Time to load photographs that need undistortion: the first time, and again from the cache.

python benchmarks/undistort.py              # 24 photographs of 4000x3000 in a temporary folder; a minute
python benchmarks/undistort.py --record     # and a row in results/undistort.jsonl
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import numpy as np
import pycolmap
from common import append, arguments
from PIL import Image

import clod_adapter as clod

FILE = "undistort.jsonl"
SIZE = {"width": 4000, "height": 3000}
LENSES = {
    "PINHOLE": [3000, 3000, 2000, 1500],
    "OPENCV": [3000, 3000, 2000, 1500, -0.1, 0.03, 0.001, -0.001],
}


def write_capture(folder: Path, lens: str, count: int) -> Path:
    """Photographs of blurred noise with a grain, as JPEG, and their model."""
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=lens, params=LENSES[lens], camera_id=1, **SIZE)
    reconstruction.add_camera_with_trivial_rig(camera)
    (folder / "images").mkdir(parents=True)
    for i in range(count):
        random = np.random.default_rng(i)
        coarse = Image.fromarray(random.integers(0, 256, (SIZE["height"] // 20, SIZE["width"] // 20, 3), np.uint8))
        smooth = np.asarray(coarse.resize((SIZE["width"], SIZE["height"]), Image.Resampling.BICUBIC))
        grain = random.integers(-4, 5, smooth.shape, np.int16)
        name = f"{i:03d}.jpg"
        Image.fromarray(np.clip(smooth + grain, 0, 255).astype(np.uint8)).save(folder / "images" / name, quality=90)
        image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    (folder / "sparse" / "0").mkdir(parents=True)
    reconstruction.write_binary(str(folder / "sparse" / "0"))
    return folder


def measured(name: str, scene: Path) -> dict[str, float]:
    """Seconds that loading takes, and those of the processor, which other work on the machine changes less."""
    began, used = time.perf_counter(), time.process_time()
    clod.load_scene(scene)
    wall, cpu = time.perf_counter() - began, time.process_time() - used
    return {f"{name}_seconds": round(wall, 2), f"{name}_cpu_seconds": round(cpu, 2)}


def main() -> None:
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("--photographs", type=int, default=24)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        cache = Path(work) / "cache"
        os.environ["XDG_CACHE_HOME"] = str(cache)
        plain, distorted = (write_capture(Path(work) / lens, lens, args.photographs) for lens in LENSES)
        row = {
            "benchmark": "undistort", "load": round(os.getloadavg()[0], 2), "photographs": args.photographs, **SIZE,
            **measured("pinhole", plain), **measured("first", distorted), **measured("again", distorted),
            "cache_bytes": sum(path.stat().st_size for path in cache.rglob("*.png")),
        }  # fmt: skip
    print(row)
    if args.record:
        append(FILE, row)


if __name__ == "__main__":
    main()
