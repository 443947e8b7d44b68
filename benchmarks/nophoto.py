"""Quality after adapting with few photographs or none, on real held-out photographs.

    python benchmarks/nophoto.py plush_half bonsai146 --kinds photographs placed
    python benchmarks/nophoto.py plush_half --few 12 --kinds complemented
    python benchmarks/nophoto.py --table                  # the rows as a Markdown table

The kinds of views: ``photographs``, ``placed`` (placed cameras, renders of the checkpoint) and
``complemented`` (few photographs and pseudo views, as clod-adapt combines them). Each run adds one
row to ``results/nophoto.jsonl``.
"""

import time
from dataclasses import asdict

import clod_adapter as clod
from adapt import at_shares, psnr_at
from clod_adapter.training.pseudo_views import with_pseudo_views
from common import append, arguments, checkpoint, quality, stored, table
from common import photographs as photographs_of

FILE = "nophoto.jsonl"
KINDS = ("photographs", "placed", "complemented")
DIALS = (1.0, 2.0, 3.0, 5.0, 7.0)


def main() -> None:
    parser = arguments(__doc__, table=print_table)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS[:2])
    parser.add_argument(
        "--few", type=int, metavar="K", help="of the photographs to train on, only K, evenly spread"
    )
    parser.add_argument(
        "--iters", type=int, help="training steps (default: by the number of views, as clod-adapt)"
    )
    args = parser.parse_args()
    for scene in args.scenes:
        for kind in args.kinds:
            make = clod.AdaptConfig.placed if kind == "placed" else clod.AdaptConfig
            run(scene, kind, make(iters=args.iters, max_sv=DIALS[-1]), args.few)


def run(scene: str, kind: str, config: clod.AdaptConfig, few: int | None) -> None:
    base, photographs = checkpoint(scene).gaussians, photographs_of(scene)
    if few:
        train = photographs.train[:: max(len(photographs.train) // few, 1)][:few]
        photographs = clod.Scene(train, photographs.test)
    (base_row,) = quality(base, photographs.test, 1.0)
    began = time.perf_counter()
    views = photographs
    if kind != "photographs":
        views = with_pseudo_views(base, None if kind == "placed" else photographs, config.seed)
    seconds = time.perf_counter() - began
    adapted = clod.make_plan(base, views, config).adapt(views)
    append(
        FILE,
        {
            "benchmark": "nophoto",
            "scene": scene,
            "kind": kind,
            "config": asdict(config),
            "views": len(views.train),
            "photographs": len(photographs.train),
            "base": base_row,
            "rows": quality(adapted.gaussians, photographs.test, DIALS),
            "at_shares": at_shares(adapted.gaussians, photographs.test),
            "steps": adapted.steps,
            "views_seconds": round(seconds, 2),
            "train_seconds": round(adapted.seconds, 2),
        },
    )


def print_table() -> None:
    lines = []
    for row in stored(FILE):
        line = [row["scene"], row["steps"], row["photographs"], row["kind"]]
        line.append(f"{row['base']['psnr']:.2f}")
        line += [f"{point['psnr']:.2f} @ {point['kept_share']:.1%}" for point in row["rows"]]
        matched = psnr_at(row, 0.12)
        line.append("" if matched is None else f"{matched:.2f}")
        lines.append(line)
    heads = ["scene", "steps", "photographs", "views", "base"]
    print(table([*heads, *(f"s = {s:g}" for s in DIALS), "12 %"], lines))


if __name__ == "__main__":
    main()
