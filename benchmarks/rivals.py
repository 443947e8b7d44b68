"""Other methods on the same checkpoint and photographs, at fixed shares of the base's Gaussians.

    python benchmarks/rivals.py plush_half bonsai146 --iters 1500

- ``merging``: ``splat-transform``, both of its methods, without training, one file per count;
- ``specialist``: each merged file, tuned for that count alone;
- ``tuned``: the whole base, tuned for as many steps;
- ``prefix``: one file whose prefixes are the counts, by removal error, tuned with random prefixes
  (``tuning.tune``);
- ``ranking``: prefixes by removal error without tuning;
- ``kept``: no rival, but what ``export --keep`` writes of one adapted file, a plain file per count,
  without and with ``--tune``.

A scene is named as for adapt.py. Each run adds a row to ``results/rivals.jsonl``.
"""

import tempfile
from dataclasses import asdict
from itertools import product
from pathlib import Path

import adapt
import clod_adapter as clod
from adapt import SHARES
from common import (
    Table,
    append,
    arguments,
    capture,
    checkpoint,
    clod_adapt,
    last,
    percent,
    photographs,
    psnr_kept,
    quality,
    stored,
    with_best,
)
from tuning import MERGINGS, Tuning, by_importance, find_tool, merge, tune

FILE = "rivals.jsonl"
RIVALS = ("merging", "specialist", "tuned", "prefix", "ranking", "kept")
MAX_SV = 20  # of the adapted file
SHOWN = {  # in the table, by rival and last option in the label
    ("kept", "--keep"): "exported from it, a plain file each",
    ("kept", "--tune"): "exported and tuned",
    ("specialist", "--decimate"): "specialist, uniform",
    ("specialist", "--decimate-adaptive"): "specialist, adaptive",
    ("prefix", ""): "prefixes, one file",
    ("merging", "--decimate"): "merging, uniform",
    ("merging", "--decimate-adaptive"): "merging, adaptive",
    ("ranking", ""): "pruned",
    ("tuned", ""): "whole base, fine-tuned",
}


def main():
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--iters", type=int, default=1500, help="steps of tuning")
    args = parser.parse_args()
    for scene in args.scenes:
        base, views = checkpoint(scene), photographs(scene)
        (untouched,) = quality(base.gaussians, views.test, 1.0)
        for rival in RIVALS:
            folder = capture(scene.partition("/")[0])
            for label, files, more in contest(rival, base, folder, views, args.iters):
                rows = []
                for share, gaussians in files.items():
                    (row,) = quality(gaussians, views.test, 1.0)
                    rows.append({"share": share, "count": len(gaussians), **row})
                append(
                    FILE,
                    {
                        "scene": scene,
                        "rival": rival,
                        "label": label,
                        "base_count": len(base.gaussians),
                        "base": untouched,
                        "rows": rows,
                        **more,
                    },
                )


def contest(rival, base, folder, views, iters):
    """For each row: label, file by share, and what else is recorded."""
    gaussians = base.gaussians
    train = views.train
    config = Tuning(iters=iters, prefixes=rival == "prefix")
    counts = {share: max(round(share * len(gaussians)), 1) for share in SHARES}
    about = {"config": asdict(config), "steps": iters}
    if rival == "merging":
        for method in MERGINGS:
            files, seconds = {}, []
            for share, count in counts.items():
                files[share], merging = merge(base, count, method)
                seconds.append(merging)
            label = f"splat-transform {find_tool().version} {method}"
            yield label, files, {"merge_seconds": seconds}
    elif rival == "specialist":
        for method, (share, count) in product(MERGINGS, counts.items()):
            start, merging = merge(base, count, method)
            tuned, seconds = tune(start, train, config)
            more = {"train_seconds": seconds, "merge_seconds": merging}
            yield f"merged {method}, then tuned", {share: tuned}, about | more
    elif rival == "tuned":
        tuned, seconds = tune(gaussians, train, config)
        yield "tuned base", {1.0: tuned}, about | {"train_seconds": seconds}
    elif rival == "prefix":
        tuned, seconds = tune(by_importance(gaussians, train), train, config)
        files = {1.0: tuned} | prefixes(tuned, counts)
        yield "prefixes by removal error, lengths log", files, about | {"train_seconds": seconds}
    elif rival == "kept":
        with tempfile.TemporaryDirectory() as place:
            dial = Path(place) / "dial.ply"
            settings = ("--max-sv", MAX_SV, "--quiet")
            clod_adapt(base.path, "--images", folder, *settings, "--out", dial)
            label = f"export --keep of one file, max_sv {MAX_SV}"
            yield label, kept(dial, counts), {}
            yield f"{label} --tune", kept(dial, counts, "--tune", "--images", folder), {}
    else:
        ranked = by_importance(gaussians, train)
        yield "untouched, by removal error", prefixes(ranked, counts), {}


def prefixes(gaussians, counts):
    return {share: gaussians[:count] for share, count in counts.items()}


def kept(dial, counts, *options):
    """By share, the plain file that ``export --keep`` writes of a file with a dial."""
    files = {}
    for share, count in counts.items():
        plain = dial.with_suffix(f".{count}.ply")
        clod_adapt("export", dial, "--keep", count, *options, "--quiet", "--out", plain)
        files[share] = clod.load(plain).gaussians
    return files


def page_table(scene):
    """PSNR at the shares; the best of each but the whole is bold."""
    (ours,) = last(adapt.FILE, "scene", scene=scene, label=f"max_sv {MAX_SV}").values()
    found = {label: {} for label in ("ours, one file", *SHOWN.values())}
    found["ours, one file"] = {point["share"]: point["psnr"] for point in ours["at_shares"]}
    found["pruned"] = {1.0: ours["base"]["psnr"]}
    rows = {}
    for row in stored(FILE):
        if row["scene"] == scene:
            options = [word.strip(",") for word in row["label"].split() if word.startswith("--")]
            label = SHOWN[row["rival"], options[-1] if options else ""]
            for point in row["rows"]:
                found[label][point["share"]] = point["psnr"]
                rows[label, point["share"]] = row
    shares = {}
    for label, line in found.items():
        shares[label] = [line.get(share) for share in SHARES]
    lines = []
    for label, *cells in with_best(shares, ".2f"):
        full = f"{found[label][1.0]:.2f}" if 1.0 in found[label] else ""
        lines.append([label, full, *cells])
    lines[0][1] = psnr_kept(ours["rows"][0])
    heads = [f"{scene} ({ours['base_count']:,})", "full or s = 1", *percent(SHARES)]
    return Table(heads, lines, [ours, *rows.values()])


if __name__ == "__main__":
    main()
