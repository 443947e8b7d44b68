"""Quality, count and seconds of adapted checkpoints, by dial value.

    python benchmarks/adapt.py plush_half bonsai146 --set max_sv=14.0 --label "max_sv 14" --seeds 0 1 2
    python benchmarks/adapt.py plush_half --ablations      # one row for each choice in docs/method.md
    python benchmarks/adapt.py plush_half bonsai146 --leave-out    # the rows of docs/performance.md
    python benchmarks/adapt.py --table                     # the rows as a Markdown table
    python benchmarks/adapt.py plush_half --questions      # the rows of the ablations, one table per question

A scene is a folder of the shared data, followed by the name of the checkpoint where it is not ``pretrained``. Each run
adds one row to ``results/adapt.jsonl``: settings, commit, machine, the base and the dial.
"""

from __future__ import annotations

import ast
from collections.abc import Sequence
from dataclasses import asdict
from statistics import fmean
from typing import Any

import clod_adapter as clod
from clod_adapter.evaluation.popping import dial_popping, path_popping
from common import append, arguments, checkpoint, photographs, stored, table

FILE = "adapt.jsonl"
DIALS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 14.0)
SHARES = (0.62, 0.35, 0.12, 0.05, 0.02)  # of the base's Gaussians, where the file is also measured
ABLATION = {"iters": 300, "max_sv": 14.0}
PATH_STEPS, DIAL_STEPS = 60, 100  # of the popping measures; max_sv 14 in 100 steps: 2.7 % each

FROZEN = {"lr_means": 0.0, "lr_quats": 0.0, "lr_scales": 0.0, "lr_opacities": 0.0, "lr_sh0": 0.0}
HALF, TWICE = ({name: getattr(clod.AdaptConfig(), name) * k for name in FROZEN} for k in (0.5, 2.0))
# By question; each changes one thing of ours, or, where it says so, of the paper's form.
QUESTIONS: dict[str, dict[str, dict[str, object]]] = {
    "form": {"ours": {}, "paper": {"paper": True}},
    "ablations of the paper": {
        "paper, without w_s": {"paper": True, "weight_slope": 0.0},
        "paper, without L_reg": {"paper": True, "reg_weight": 0.0},
    },
    "start": {
        "by removal error alone": {"start": "error"},
        "start constant": {"start": "constant"},
        "start identity": {"start": "identity"},
    },
    "parameter": {
        "linear sigma, 1e-2": {"parameter": "linear", "lr_sigma": 1e-2},
        "log sigma, 1e-2": {"lr_sigma": 1e-2},
    },
    "normaliser": {"quantile": {"normalizer": "quantile"}, "max (the paper's)": {"normalizer": "max"}},
    "cut": {"hard": {"cut": "hard"}, "hard, tau 1/255": {"cut": "hard", "tau": 1 / 255}, "tau 0.05": {"tau": 0.05}},
    "count": {
        "none": {"reg_weight": 0.0},
        "a quarter": {"reg_weight": clod.AdaptConfig().reg_weight / 4},
        "four times": {"reg_weight": 4 * clod.AdaptConfig().reg_weight},
        "sigmoid 0.5 wide": {"temperature": 0.5},
        "the paper's L_reg, straight through": {"count_term": "paper", "reg_weight": 1.0},
    },
    "sampling": {
        "uniform": {"sampling": "uniform"},
        "20 % at s = 1": {"full_share": 0.2},
        "60 % at s = 1": {"full_share": 0.6},
        "whole photographs": {"coarse": 0.0},
    },
    "weights": {
        "w_s = 1": {"weight_slope": 0.0},
        "w_s as the paper's": {"weight_slope": 0.5},
    },
    "light update": {
        "frozen": FROZEN,
        **{f"{name.removeprefix('lr_')} frozen": {name: 0.0} for name in FROZEN},
        "half as fast": HALF,
        "twice as fast": TWICE,
        "higher bands too": {"lr_shN": 1e-4},
    },
    "schedule and its end": {
        "no mean": {"average": 0.0},
        "no mean, steps fall to a twentieth": {"average": 0.0, "lr_final": 0.05},
        "steps stay long": {"lr_final": 1.0},
    },
}
ABLATIONS = {label: changed for rows in QUESTIONS.values() for label, changed in rows.items()}


# Steps without some attributes, at three lengths each: held-out error against time.
GEOMETRY = {"lr_means": 0.0, "lr_quats": 0.0, "lr_scales": 0.0}
LEAVE_OUT: dict[str, dict[str, object]] = {
    f"{label}, {iters} steps": {"iters": iters, **changed}
    for label, changed in (("default", {}), ("geometry frozen", GEOMETRY), ("higher bands tuned", {"lr_shN": 1e-4}))
    for iters in (500, 1000, 1500)
}


def main() -> None:
    parser = arguments(__doc__, table=print_table)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--ablations", action="store_true", help=f"every choice by itself, {ABLATION}")
    parser.add_argument("--leave-out", action="store_true", help="steps without some attributes, at three lengths each")
    parser.add_argument("--questions", action="store_true", help="print a table for each question, of the scenes")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a field of AdaptConfig")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--label", default="default", help="name of the row")
    args = parser.parse_args()
    if args.questions:
        for scene in args.scenes:
            print_questions(scene)
        return
    runs = {args.label: dict(_setting(text) for text in args.set)}
    if args.ablations:
        runs = {label: {**ABLATION, **ABLATIONS[label]} for label in ABLATIONS}
    if args.leave_out:
        runs = LEAVE_OUT
    for scene in args.scenes:
        for label, changed in runs.items():
            for seed in args.seeds:
                run(scene, label, make_config(changed, seed), changed, popping=args.ablations)


def groups() -> dict[tuple[str, str, int], list[dict[str, Any]]]:
    """The last row of each seed, by scene, label and steps; rows of before the matched shares are left out."""
    last = {}
    for row in stored(FILE):
        if "at_shares" in row:
            last[row["scene"], row["label"], row["steps"], row["config"]["seed"]] = row
    found: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for (scene, label, steps, _), row in last.items():
        found.setdefault((scene, label, steps), []).append(row)
    return found


def cells_of(rows: list[dict[str, Any]]) -> list[str]:
    """PSNR at s = 1 and the matched shares; the range of counts relative to s^-1.5 from s = 2 on."""
    first = fmean(row["rows"][0]["psnr"] for row in rows), fmean(row["rows"][0]["kept_share"] for row in rows)
    cells = [f"{first[0]:.2f} @ {first[1]:.0%}"]
    for share in SHARES:
        found = [r["psnr"] for row in rows for r in row["at_shares"] if r["share"] == share]
        cells.append(f"{fmean(found):.2f}" if len(found) == len(rows) else "")
    from_2 = (r for row in rows for r in row["rows"] if r["virtual_scale"] >= 2)
    ratios = [r["kept_share"] * r["virtual_scale"] ** 1.5 for r in from_2]
    return [*cells, f"{min(ratios):.2f} to {max(ratios):.2f}" if ratios else ""]


HEADS = ["s = 1", *(f"{share:.0%}" for share in SHARES), "count s^1.5"]


def print_table() -> None:
    """PSNR at s = 1 and at the matched shares, means over the seeds, a line a setting."""
    lines = []
    for (scene, label, steps), rows in groups().items():
        seconds = fmean(row["start_seconds"] + row["train_seconds"] for row in rows)
        head = [scene, label, steps, len(rows), f"{seconds:.0f}", f"{rows[0]['base']['psnr']:.2f}"]
        lines.append([*head, *cells_of(rows)])
    print(table(["scene", "settings", "steps", "seeds", "seconds", "base", *HEADS], lines))


def print_questions(scene: str) -> None:
    """A table a question, ours and the paper's form above each, with the popping measures."""
    all_rows = groups()
    for question, settings in QUESTIONS.items():
        lines = []
        for label in {**QUESTIONS["form"], **settings}:
            rows = all_rows.get((scene, label, int(str(ABLATION["iters"]))), [])
            # Of other defaults than today's a row would be no neighbour of the rest.
            changed = {**ABLATION, **ABLATIONS[label]}
            rows = [r for r in rows if r["config"] == asdict(make_config(changed, r["config"]["seed"]))]
            if rows:
                popping = [f"{rows[-1]['popping'][what]['largest']:.2f}" for what in ("dial", "path")]
                lines.append([label, *cells_of(rows), *popping])
        print(f"\n### {question.capitalize()}\n\n{table(['settings', *HEADS, 'dial: jump', 'path: jump'], lines)}")


def make_config(changed: dict[str, Any], seed: int) -> clod.AdaptConfig:
    """Ours, or the paper's form, with these fields changed."""
    changed = {"seed": seed, **changed}
    return clod.AdaptConfig.paper(**changed) if changed.pop("paper", False) else clod.AdaptConfig(**changed)


def _setting(text: str) -> tuple[str, object]:
    name, _, value = text.partition("=")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def run(scene: str, label: str, config: clod.AdaptConfig, changed: dict[str, object], popping: bool) -> None:
    base, views = checkpoint(scene), photographs(scene)
    dials = sorted({s for s in DIALS if s < config.max_sv} | {config.max_sv})
    base_row = clod.evaluate(base.gaussians, views.test, [1.0])[0]
    plan = clod.make_plan(base.gaussians, views, config)
    adapted = plan.adapt(views)
    adapter = clod.extract(
        base.gaussians,
        plan.whole(base.gaussians, adapted.gaussians),
        fingerprint=base.fingerprint,
        config=asdict(config),
    )
    result = adapter.apply(base.gaussians)
    rows = clod.evaluate(result, views.test, dials)
    append(FILE, {
        "benchmark": "adapt", "scene": scene, "label": label, "changed": changed, "config": asdict(config),
        "base_count": len(base.gaussians), "base": base_row.as_dict(), "rows": [row.as_dict() for row in rows],
        "at_shares": at_shares(result, views.test), "steps": adapted.steps, "share": plan.config.share,
        "start_seconds": round(sum(plan.seconds.values()) + adapted.start_seconds, 2),
        "train_seconds": round(adapted.seconds, 2),
        "popping": jumps(result, views.test) if popping else None,
    })  # fmt: skip


def at_shares(model: clod.Gaussians, views: Sequence[clod.View]) -> list[dict[str, float]]:
    """Rows at the dial values that keep SHARES of the Gaussians, as far as the dial goes."""
    found = []
    for share in SHARES:
        try:
            solved = clod.dial_for(model, keep=share * len(model), cameras=[view.camera for view in views])
        except clod.ClodError:
            continue  # out of the dial's reach
        if not solved.note:
            found.append({"share": share, **clod.evaluate(model, views, [solved.virtual_scale])[0].as_dict()})
    return found


def jumps(model: clod.Gaussians, views: Sequence[clod.View]) -> dict[str, dict[str, float]]:
    """How evenly the picture changes as the dial turns, and as the camera moves at a dial value of 3."""
    assert model.attenuation is not None
    cameras = [view.camera for view in views[:4]]
    measured = {
        "dial": dial_popping(model, cameras[0], model.attenuation.max_sv, steps=DIAL_STEPS),
        "path": path_popping(model, cameras, 3.0, steps=PATH_STEPS),
    }
    return {name: {k: v for k, v in found.as_dict().items() if k != "changes"} for name, found in measured.items()}


if __name__ == "__main__":
    main()
