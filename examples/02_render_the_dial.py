"""Render one view of an adapted file at several dial values, as PNGs.

    python examples/02_render_the_dial.py adapted.ply [scene/]

The view is the scene's first held-out camera, or its first one where none is held out; without a
scene, one that looks at the middle of the splat.
"""

import sys
from pathlib import Path

import torch
from PIL import Image

import clod_adapter as clod

DIALS = (1, 2, 3, 5)


def main(model: str, folder: str | None = None) -> None:
    checkpoint = clod.load(model)
    gaussians = checkpoint.gaussians
    scene = clod.load_scene(folder, origin=checkpoint.origin) if folder else None
    camera = (scene.test or scene.train)[0].camera if scene else camera_facing(gaussians)
    for virtual_scale in DIALS:
        rendering = clod.render(gaussians, camera, virtual_scale)
        name = f"{Path(model).stem}_sv{virtual_scale}.png"
        Image.fromarray(rendering.pixels.numpy()).save(name)
        print(f"wrote {name}: {int(rendering.kept.sum()):,} of {gaussians.whole:,} Gaussians")


def camera_facing(gaussians: clod.Gaussians, width: int = 320, height: int = 240) -> clod.Camera:
    """Along +z at the median of the centres, from far enough to have nine tenths of them in
    view.
    """
    middle = gaussians.means.median(dim=0).values
    radius = float((gaussians.means - middle).norm(dim=1).sort().values[int(0.9 * len(gaussians))])
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([0.0, 0.0, 2.5 * radius]) - middle
    K = torch.tensor([[height, 0.0, width / 2], [0.0, height, height / 2], [0.0, 0.0, 1.0]])
    return clod.Camera(viewmat, K, width, height)


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except clod.ClodError as error:
        sys.exit(f"error: {error}")
