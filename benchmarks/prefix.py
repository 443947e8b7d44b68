"""PSNR of the first n rows of a file, by the order of its rows.

    python benchmarks/prefix.py plush_clod.ply plush_half --base pretrained
    python benchmarks/prefix.py --table                    # the rows as a Markdown table

The model is an adapted file of the capture. The count at a dial value is the dial's mean over the held-out views. At
each count: ``dial``; ``baked``, a file baked for the training cameras; and prefixes of ordered files, drawn with the
opacities in the file:

- ``extinction``: by falling s* for the training cameras, as ``clod-adapt export --order extinction --images`` writes;
- ``extinction, s = 1 baked``: the same with ``--sv 1``;
- ``own``, ``opacity``, ``removal error``: the adapted file as it is, by falling opacity, by falling removal error;
- ``base, ...``: the untouched checkpoint in the adapted one's order of extinction, by opacity, by removal error.

Each run adds a row to ``results/prefix.jsonl``; those of commit c0ce1ea use the one distance d' = 1.
"""

from __future__ import annotations

from pathlib import Path

import clod_adapter as clod
from clod_adapter.cli.shared.console import Console
from clod_adapter.initialization.importance import removal_error
from common import append, arguments, checkpoint, falling, head, photographs, print_rows

FILE = "prefix.jsonl"
COLUMNS = ("scene", "model", "count", "psnr")
DIALS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)


def main() -> None:
    parser = arguments(__doc__, table=lambda: print_rows(FILE, *COLUMNS))
    parser.add_argument("model", help="an adapted PLY")
    parser.add_argument("scene", help="its capture")
    parser.add_argument("--base", default="pretrained", help="the capture's checkpoint that was adapted")
    args = parser.parse_args()
    adapted, base = clod.load(args.model).gaussians, checkpoint(f"{args.scene}/{args.base}").gaussians
    views, console = photographs(args.scene), Console()

    def psnr(gaussians: clod.Gaussians, what: str, s: float = 1.0) -> tuple[float, float]:
        row = clod.evaluate(gaussians, views.test, [s])[0]
        console.say(f"{what}: {row.psnr:.2f} dB with {row.kept:,.0f}")
        return row.psnr, row.kept

    ordered, cameras = orders(adapted, base, views.train), [view.camera for view in views.train]
    rows = []
    for s in [s for s in DIALS if adapted.attenuation and s <= adapted.attenuation.max_sv]:
        found, kept = psnr(adapted, f"dial {s:g}", s)
        count = round(kept)
        drawn = {"dial": found}
        at = clod.dial_for(adapted, keep=count, cameras=cameras, baked=True).virtual_scale
        baked = clod.bake(adapted, at, cameras=cameras)
        drawn["baked"] = psnr(baked, "baked")[0] if len(baked) == count else None
        for what, gaussians in ordered.items():
            drawn[what] = psnr(head(gaussians, count), what)[0] if count <= len(gaussians) else None
        rows.append({"virtual_scale": s, "count": count, "share": count / len(adapted), "psnr": drawn})
    append(FILE, {
        "benchmark": "prefix", "model": Path(args.model).name, "scene": args.scene, "gaussians": len(adapted),
        "all": {"adapted": psnr(clod.detach(adapted), "all, unfaded")[0], "base": psnr(base, "base")[0]}, "rows": rows,
    })  # fmt: skip


def orders(adapted: clod.Gaussians, base: clod.Gaussians, views: tuple[clod.View, ...]) -> dict[str, clod.Gaussians]:
    """What stands in each file, without a dial, in its order."""
    cameras = [view.camera for view in views]
    plain, rows = clod.detach(adapted), clod.order_by_extinction(adapted, cameras)
    return {
        "extinction": plain.select(rows),
        "extinction, s = 1 baked": clod.bake(adapted.select(rows), 1.0, cameras=cameras),
        "own": plain,
        "opacity": plain.select(falling(plain.opacity_logits)),
        "removal error": plain.select(falling(removal_error(plain, views, seed=0))),
        "base, extinction": base.select(rows),
        "base, opacity": base.select(falling(base.opacity_logits)),
        "base, removal error": base.select(falling(removal_error(base, views, seed=0))),
    }


if __name__ == "__main__":
    main()
