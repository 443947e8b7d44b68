"""Put the dial into a renderer of your own: one call between its opacities and its drawing.

    python examples/04_hook.py adapted.ply

The renderer here is ten lines of numpy that draw each Gaussian as one pixel.
docs/writing_a_renderer.md is for renderers in other languages.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import clod_adapter as clod

WIDTH, HEIGHT = 320, 240


def main(model: str) -> None:
    checkpoint = clod.load(model)
    gaussians = checkpoint.gaussians
    means, opacities = gaussians.means.numpy(), gaussians.opacities.numpy()
    colors = np.clip(0.5 + 0.2820948 * gaussians.sh0[:, 0].numpy(), 0, 1)
    viewmat, K = camera_facing(means)

    for virtual_scale in (1, 2, 3, 5):
        hook = checkpoint.hook(virtual_scale)
        # growth: pixels have no scales
        drawn, keep, _ = hook(means, opacities, viewmat, K, WIDTH, HEIGHT)
        picture = dots(
            means[keep] @ viewmat[:3, :3].T + viewmat[:3, 3], drawn[keep], colors[keep], K
        )
        name = f"{Path(model).stem}_dots_sv{virtual_scale}.png"
        Image.fromarray((picture * 255).round().astype(np.uint8)).save(name)
        print(f"wrote {name}: {keep.sum():,} of {gaussians.whole:,} Gaussians")


def dots(seen: np.ndarray, opacities: np.ndarray, colors: np.ndarray, K: np.ndarray) -> np.ndarray:
    """``[H, W, 3]``: the farthest of what is ``seen`` (camera coordinates) first, each blended over
    its pixel.
    """
    x, y, z = K @ seen.T
    pixels = np.stack([y, x]) // np.maximum(z, 1e-6)
    inside = (z > 0.01) & (pixels >= 0).all(0) & (pixels[0] < HEIGHT) & (pixels[1] < WIDTH)
    picture = np.zeros((HEIGHT, WIDTH, 3))
    for i in sorted(np.flatnonzero(inside), key=lambda i: -z[i]):
        row, column = pixels[:, i].astype(int)
        picture[row, column] += opacities[i] * (colors[i] - picture[row, column])
    return picture


def camera_facing(means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Along +z at the median of the centres, from far enough to have nine tenths of them in
    view.
    """
    middle = np.median(means, axis=0)
    radius = np.quantile(np.linalg.norm(means - middle, axis=1), 0.9)
    viewmat = np.eye(4)
    viewmat[:3, 3] = np.array([0, 0, 2.5 * radius]) - middle
    return viewmat, np.array([[HEIGHT, 0, WIDTH / 2], [0, HEIGHT, HEIGHT / 2], [0, 0, 1]])


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    try:
        main(sys.argv[1])
    except clod.ClodError as error:
        sys.exit(f"error: {error}")
