"""Makes viewers/kit: an adapted file of 2,000 Gaussians, its cameras, and reference pictures at
dial values.

    clod-adapt demo
    python benchmarks/kit.py

The Gaussians are a random part of the demo's, enlarged to cover the same area. Values and pictures
are those of ``clod_adapter.render``; a test compares them.
"""

import json
import math

import clod_adapter as clod
from clod_adapter.cameras import intrinsics
from common import ROOT, arguments

import torch
from PIL import Image

KIT = ROOT / "viewers" / "kit"
COUNT = 2000
SHARE = 0.25  # of the full enlargement
DIALS = (0.0, 1.0, 3.0, 5.0)
VIEWS = (1, 3)
WIDTH = 192


def main():
    parser = arguments(__doc__)
    parser.add_argument("--demo", default="demo", help="the folder that the demo has written")
    folder = parser.parse_args().demo
    model, scene = clod.load(f"{folder}/gallery.ply"), clod.load_scene(f"{folder}/capture")
    order = torch.randperm(len(model.gaussians), generator=torch.Generator().manual_seed(0))
    few = model.gaussians[order[:COUNT].sort().values]
    few = few.replace(
        log_scales=few.log_scales + SHARE * math.log(len(model.gaussians) / COUNT) / 2
    )
    KIT.mkdir(exist_ok=True)
    for suffix in ("ply", "spz"):
        clod.save(KIT / f"kit.{suffix}", few)
    cameras = [pictured(few, number, scene.test[k].camera) for number, k in enumerate(VIEWS)]
    about = {"background": [0, 0, 0], "dials": DIALS, "cameras": cameras}
    (KIT / "cameras.json").write_text(json.dumps(about, indent=1) + "\n")


def resized(camera):
    """The camera with WIDTH square pixels and the principal point in the middle, as viewers have
    it.
    """
    height = round(camera.height * WIDTH / camera.width)
    focal = float(camera.K[0, 0]) * WIDTH / camera.width
    K = intrinsics(focal, focal, WIDTH / 2, height / 2)
    return clod.Camera(camera.viewmat, K, WIDTH, height)


def pictured(gaussians, number, camera):
    """Writes the pictures of a camera; what cameras.json has of it."""
    camera = resized(camera)
    frames = []
    for s in DIALS:
        frame = clod.render(gaussians, camera, s)
        name = f"camera{number}_s{s:g}.png"
        Image.fromarray(frame.pixels.numpy()).save(KIT / name, optimize=True)
        frames.append({"s": s, "kept": int(frame.kept.sum()), "picture": name})
    return {
        "world_to_camera": camera.viewmat.tolist(),
        "focal": float(camera.K[0, 0]),
        "width": camera.width,
        "height": camera.height,
        "frames": frames,
    }


if __name__ == "__main__":
    main()
