"""Quality after adapting with few photographs or none, on real held-out photographs.

    python benchmarks/nophoto.py plush_half bonsai146 --kinds photographs placed
    python benchmarks/nophoto.py plush_half --few 12 --kinds complemented

The kinds of views: ``photographs``, ``placed`` (placed cameras, renders of the checkpoint) and
``complemented`` (few photographs and pseudo views, as clod-adapt combines them). Each run adds one
row to ``results/nophoto.jsonl``.
"""

import time

import clod_adapter as clod
from adapt import adapted
from clod_adapter.training.pseudo_views import with_pseudo_views
from common import Table, append, arguments, by_scene, checkpoint, last, psnr_at, quality
from common import photographs as photographs_of

FILE = "nophoto.jsonl"
KINDS = ("photographs", "placed", "complemented")
SHOWN = {  # in the table
    "photographs": "photographs",
    "complemented": "12 photographs and pseudo views",
    "placed": "none",
}
MAX_SV = 7.0


def main():
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS[:2])
    parser.add_argument(
        "--few", type=int, metavar="K", help="of the photographs to train on, only K, evenly spread"
    )
    args = parser.parse_args()
    for scene in args.scenes:
        for kind in args.kinds:
            make = clod.AdaptConfig.placed if kind == "placed" else clod.AdaptConfig
            run(scene, kind, make(max_sv=MAX_SV), args.few)


def run(scene, kind, config, few):
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
    about = {"scene": scene, "kind": kind, "base": base_row, "views_seconds": round(seconds, 2)}
    about |= {"views": len(views.train), "photographs": len(photographs.train)}
    append(FILE, about | adapted(base, views, photographs.test, config))


def page_table():
    """PSNR by the views that are trained on."""
    scenes, shares = ("plush_half", "bonsai146"), (0.35, 0.12)
    found = last(FILE, "scene", "kind")
    rows, lines = [], []
    for kind, label in SHOWN.items():
        line = [label]
        for scene in scenes:
            row = found[scene, kind]
            rows.append(row)
            line.append(f"{row['rows'][0]['psnr']:.2f}")
            line += [psnr_at(row["at_shares"], share) for share in shares]
        lines.append(line)
    return Table(["training views", *by_scene(scenes, shares)], lines, rows)


if __name__ == "__main__":
    main()
