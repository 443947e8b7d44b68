"""Draw an adapted file with gsplat: its own call, and the dial as four more arguments.

    python examples/03_gsplat.py adapted.ply scene/

The first held-out camera is drawn at several dial values. gsplat draws on CUDA devices only;
02_render_the_dial.py does the same without.
"""

import sys
from pathlib import Path

import torch
from PIL import Image

import clod_adapter as clod

DIALS = (1, 2, 3, 5)


def main(model: str, folder: str, device: str = "cuda") -> None:
    from clod_adapter.integrations import gsplat

    checkpoint = clod.load(model)
    g = checkpoint.gaussians.to(device)
    scene = clod.load_scene(folder, origin=checkpoint.origin)
    camera = (scene.test or scene.train)[0].camera
    colors = torch.cat([g.sh0, g.shN], dim=1)

    for virtual_scale in DIALS:
        images, _, meta = gsplat.rasterization(
            g.means,
            g.quats,
            g.scales,
            g.opacities,
            colors,
            camera.viewmat[None].to(device),
            camera.K[None].to(device),
            camera.width,
            camera.height,
            sh_degree=g.sh_degree,
            sigma_d=g.sigma_d,
            growth_d=g.growth_d,
            attenuation=g.attenuation,
            virtual_scale=virtual_scale,
        )
        name = f"{Path(model).stem}_gsplat_sv{virtual_scale}.png"
        Image.fromarray((images[0].clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()).save(
            name
        )
        # ids of the file's rows, as far as they are in sight
        drawn = len(meta["gaussian_ids"])
        print(f"wrote {name}: {drawn:,} of {g.whole:,} Gaussians")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    try:
        if not torch.cuda.is_available():
            raise clod.ClodError(
                "gsplat draws on CUDA devices only, and there is none; try 02_render_the_dial.py"
            )
        main(*sys.argv[1:])
    except (clod.ClodError, ImportError) as error:
        sys.exit(f"error: {error}")
