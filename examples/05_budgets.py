"""Find the dial value for a budget: a number of Gaussians, a loss of quality, or a frame rate.

    python examples/05_budgets.py adapted.ply scene/

The file must be one that ``clod-adapt`` wrote, for the loss is read off the quality table in its
header. Counts are solved for exactly, over the scene's held-out cameras; for the frame rate some
frames are timed here and now.
"""

import sys

import clod_adapter as clod

SHARES = (0.5, 0.25, 0.1)  # of all Gaussians
DROPS = (0.1, 0.5, 1.0)  # dB below s = 1
RATES = (10, 30, 60)  # frames a second


def main(model: str, folder: str) -> None:
    checkpoint = clod.load(model)
    gaussians = checkpoint.gaussians
    scene = clod.load_scene(folder, origin=checkpoint.origin)
    cameras = [view.camera for view in scene.test or scene.train]
    for share in SHARES:
        show(
            f"{share:.0%} of the Gaussians",
            gaussians,
            keep=share * gaussians.whole,
            cameras=cameras,
        )
    for drop in DROPS:
        show(
            f"{drop:g} dB given up",
            gaussians,
            psnr_drop=drop,
            quality_table=checkpoint.quality_table,
        )
    for rate in RATES:
        show(f"{rate} frames a second", gaussians, fps=rate, cameras=cameras)


def show(name: str, gaussians: clod.Gaussians, **budget: object) -> None:
    """A budget that is out of reach is an error that says what can be had."""
    try:
        found = clod.dial_for(gaussians, **budget)
    except clod.ClodError as error:
        print(f"{name}: {error}")
    else:
        print(f"{name}: s = {found.virtual_scale:.3f}{f' ({found.note})' if found.note else ''}")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except clod.ClodError as error:
        sys.exit(f"error: {error}")
