"""Train a dial in a loop of your own: the shape of gsplat's ``simple_trainer``, and the lines
marked ``# dial``.

    python examples/07_gsplat_loop.py pretrained.ply scene/ [dial.ply]

Splats, optimizers and rendering call are the trainer's. The splats are trained already: nothing is
densified, so there is no strategy. gsplat draws on CUDA devices only.
"""

import sys

import torch

import clod_adapter as clod
from clod_adapter.losses import photometric_loss

STEPS = 2000
RATES = {
    "means": 1.6e-4,
    "scales": 5e-3,
    "quats": 1e-3,
    "opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 2.5e-3 / 20,
}


def main(
    checkpoint: str, folder: str, out: str = "dial.ply", device: str = "cuda", steps: int = STEPS
) -> None:
    from clod_adapter.integrations.gsplat import rasterization  # dial: in place of gsplat's

    base = clod.load(checkpoint)
    scene = clod.load_scene(folder, origin=base.origin)
    values = clod.to_gsplat(base.gaussians)
    splats = torch.nn.ParameterDict(
        {name: torch.nn.Parameter(value.clone()) for name, value in values.items()}
    ).to(device)
    optimizers = {
        name: torch.optim.Adam([{"params": splats[name], "lr": rate, "name": name}], eps=1e-15)
        for name, rate in RATES.items()
    }
    dial = clod.attach(splats, scene)  # dial
    for group in dial.param_groups():  # dial
        optimizers[group["name"]] = torch.optim.Adam([group], eps=1e-15)  # dial
    schedulers = [
        torch.optim.lr_scheduler.ExponentialLR(each, 0.1 ** (1 / steps))
        for each in optimizers.values()
    ]

    ends = (1, dial.config.max_sv)
    before = clod.evaluate(dial.gaussians(), scene.train, ends)
    for _ in range(steps):
        view = scene.train[int(torch.randint(len(scene.train), ()))]
        colors = torch.cat([splats["sh0"], splats["shN"]], 1)
        s = dial.sample()  # dial
        renders, _, _ = rasterization(
            splats["means"],
            splats["quats"],
            splats["scales"].exp(),
            splats["opacities"].sigmoid(),
            colors,
            view.camera.viewmat[None].to(device),
            view.camera.K[None].to(device),
            view.camera.width,
            view.camera.height,
            sh_degree=base.gaussians.sh_degree,
            sigma_d=dial.sigma_d,  # dial
            growth_d=dial.growth_d,  # dial
            attenuation=dial.attenuation,  # dial
            virtual_scale=s,  # dial
        )
        loss = photometric_loss(renders[0], view.image.to(device), 0.2)
        loss = dial.loss(s, loss)  # dial
        loss.backward()
        for optimizer, scheduler in zip(optimizers.values(), schedulers, strict=True):
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
            scheduler.step()

    for old, new in zip(before, clod.evaluate(dial.gaussians(), scene.train, ends), strict=True):
        share = (
            f"{new.kept_share:.0%} of the Gaussians (target"
            f" {dial.target_share(new.virtual_scale):.0%})"
        )
        print(
            f"dial {new.virtual_scale:g}: {old.psnr:.2f} dB before, {new.psnr:.2f} dB after,"
            f" {share}"
        )
    clod.save(out, dial.gaussians().cpu(), base)  # dial
    print(f"wrote {out}")


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    try:
        if not torch.cuda.is_available():
            raise clod.ClodError(
                "gsplat draws on CUDA devices only, and there is none; call clod_adapter.adapt"
                " instead"
            )
        main(*sys.argv[1:])
    except (clod.ClodError, ImportError) as error:
        sys.exit(f"error: {error}")
