"""Turn the dial in the browser while it trains: viser (pip install viser), a slider, and the CPU's
rasterizer.

python examples/08_viewer_slider.py pretrained.ply scene/     # trains; Ctrl-C writes slider.ply
python examples/08_viewer_slider.py adapted.ply scene/ --look # only shows
"""

import sys

import numpy as np
import torch

import clod_adapter as clod
from clod_adapter.losses import photometric_loss


def main(model: str, folder: str, look: str = "") -> None:
    import viser
    from viser.transforms import SE3, SO3

    base = clod.load(model)
    views, server, steps = clod.load_scene(folder, origin=base.origin).train, viser.ViserServer(), 0
    trained = {
        name: value.clone().requires_grad_() for name, value in base.gaussians.tensors().items()
    }
    dial = None if look else clod.attach(base.gaussians.replace(**trained), views)
    optimizer = torch.optim.Adam(dial.param_groups(splats=True), eps=1e-15) if dial else None
    slider = server.gui.add_slider(
        "dial s", 0.0, (dial or base.gaussians).attenuation.max_sv, 0.01, 1.0
    )
    count = server.gui.add_text("drawn", "", disabled=True)

    @server.on_client_connect
    def _(client) -> None:  # viser's poses are camera-to-world in OpenCV's axes
        pose = SE3.from_matrix(views[0].camera.viewmat.double().numpy()).inverse()
        client.camera.wxyz, client.camera.position = pose.rotation().wxyz, pose.translation()
        client.camera.fov = 2 * np.arctan(
            views[0].camera.height / 2 / float(views[0].camera.K[1, 1])
        )

    try:
        while True:
            if dial:
                s, view = dial.sample(), views[int(torch.randint(len(views), ()))]
                loss = photometric_loss(
                    clod.render(dial.gaussians(), view.camera, s).image, view.image
                )
                dial.loss(s, loss).backward()
                optimizer.step()
                optimizer.zero_grad()
                steps += 1
            for client in server.get_clients().values():
                seen, height, width = client.camera, 360, round(360 * client.camera.aspect)
                viewmat = (
                    SE3.from_rotation_and_translation(SO3(seen.wxyz), seen.position)
                    .inverse()
                    .as_matrix()
                )
                focal = height / 2 / np.tan(seen.fov / 2)
                camera = clod.Camera(viewmat, np.diag([focal, focal, 1.0]), width, height)
                camera.K[:2, 2] = torch.tensor([width / 2, height / 2])
                with torch.no_grad():
                    shown = clod.render(
                        dial.gaussians() if dial else base.gaussians, camera, slider.value
                    )
                client.scene.set_background_image(shown.pixels.numpy())
                count.value = f"{int(shown.kept.sum()):,} of {len(shown.kept):,}, step {steps}"
    except KeyboardInterrupt:
        if dial:
            clod.save("slider.ply", dial.gaussians(), base)


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) in (3, 4) else sys.exit(__doc__)
