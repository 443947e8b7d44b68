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
from adapt import at_shares
from clod_adapter.training.pseudo_views import with_pseudo_views
from common import append, arguments, checkpoint, stored, table
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
    parser.add_argument("--max-sv", type=float, default=7.0)
    args = parser.parse_args()
    for scene in args.scenes:
        for kind in args.kinds:
            run(scene, kind, clod.AdaptConfig(iters=args.iters, max_sv=args.max_sv), args.few)


def run(scene: str, kind: str, config: clod.AdaptConfig, few: int | None) -> None:
    base, photographs = checkpoint(scene).gaussians, photographs_of(scene)
    if few:
        train = photographs.train[:: max(len(photographs.train) // few, 1)][:few]
        photographs = clod.Scene(train, photographs.test)
    base_row = clod.evaluate(base, photographs.test, [1.0])[0]
    began, views = time.perf_counter(), photographs
    if kind != "photographs":
        shown = None if kind == "placed" else photographs
        views = with_pseudo_views(base, shown, config.seed)
    seconds = time.perf_counter() - began
    plan = clod.make_plan(base, views, config)
    adapted = plan.adapt(views)
    result = adapted.gaussians
    rows = clod.evaluate(result, photographs.test, [s for s in DIALS if s <= config.max_sv])
    append(
        FILE,
        {
            "benchmark": "nophoto",
            "scene": scene,
            "kind": kind,
            "config": asdict(config),
            "views": len(views.train),
            "photographs": len(photographs.train),
            "base": base_row.as_dict(),
            "rows": [row.as_dict() for row in rows],
            "at_shares": at_shares(result, photographs.test),
            "steps": adapted.steps,
            "views_seconds": round(seconds, 2),
            "train_seconds": round(adapted.seconds, 2),
        },
    )


def print_table() -> None:
    lines = []
    for row in stored(FILE):
        cells = [f"{r['psnr']:.2f} @ {r['kept_share']:.1%}" for r in row["rows"]]
        cells += [""] * (len(DIALS) - len(cells))
        cells.append(next((f"{r['psnr']:.2f}" for r in row["at_shares"] if r["share"] == 0.12), ""))
        head = [
            row["scene"],
            row["steps"],
            row["photographs"],
            row["kind"],
            f"{row['base']['psnr']:.2f}",
        ]
        lines.append([*head, *cells])
    heads = [
        "scene",
        "steps",
        "photographs",
        "views",
        "base",
        *(f"s = {s:g}" for s in DIALS),
        "12 %",
    ]
    print(table(heads, lines))


if __name__ == "__main__":
    main()
