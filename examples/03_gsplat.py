"""Draw an adapted file with gsplat: its own call, and the dial as four more arguments.

    python examples/03_gsplat.py adapted.ply scene/

All held-out cameras are drawn in one call at several dial values; the first one's pictures are
written. gsplat draws on CUDA devices only; 02_render_the_dial.py does the same without.
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
    cameras = [view.camera for view in scene.test or scene.train]
    width, height = cameras[0].width, cameras[0].height
    cameras = [camera for camera in cameras if (camera.width, camera.height) == (width, height)]
    viewmats = torch.stack([camera.viewmat for camera in cameras]).to(device)
    Ks = torch.stack([camera.K for camera in cameras]).to(device)
    colors = torch.cat([g.sh0, g.shN], dim=1)

    for virtual_scale in DIALS:
        images, _, meta = gsplat.rasterization(
            g.means,
            g.quats,
            g.scales,
            g.opacities,
            colors,
            viewmats,
            Ks,
            width,
            height,
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
        drawn = len(meta["gaussian_ids"]) / len(cameras)
        print(f"wrote {name}: {drawn:,.0f} of {g.whole:,} Gaussians a camera")


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
