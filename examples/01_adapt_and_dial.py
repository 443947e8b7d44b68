"""Give a checkpoint its dial, in a few lines, and see what each dial value costs.

    python examples/01_adapt_and_dial.py pretrained.ply scene/ [adapted.ply]

``scene/`` has the photographs in ``images/`` and their COLMAP model in ``sparse/0/``. A short run,
for a look; ``clod-adapt`` is the same with progress, reports and the full number of steps.
"""

import sys

import clod_adapter as clod

ITERS = 200


def main(checkpoint: str, folder: str, out: str = "adapted.ply") -> None:
    base = clod.load(checkpoint)
    # relative to what the checkpoint is, if it is far from 0
    scene = clod.load_scene(folder, origin=base.origin)
    result = clod.adapt_checkpoint(base, scene, clod.AdaptConfig(max_sv=5, iters=ITERS))
    result.save(out)  # and the adapter beside it, the difference from the base
    for row in result.rows:
        print(
            f"dial {row.virtual_scale:g}: {row.psnr:.2f} dB with {row.kept_share:.0%} of the"
            " Gaussians"
        )
    print(f"wrote {out}")


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except clod.ClodError as error:
        sys.exit(f"error: {error}")
