"""``clod-adapt robustness``: its text, options and checks."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from clod_adapter.report.style import check_matplotlib

from ..shared.command import (
    Command,
    add_activated,
    add_antialiasing,
    add_device,
    add_images,
    add_misaligned_ok,
    check_checkpoint,
    check_scene,
    run_of,
)
from ..shared.outputs import Outputs, labels
from .settings import add_settings, make_configs


def robustness_options(parser: ArgumentParser) -> None:
    given = parser.add_argument_group("input")
    given.add_argument("ply", metavar="PLY", nargs="+", help="checkpoints of one scene; never modified")
    add_images(given)
    add_activated(given)
    add_antialiasing(given)
    output = parser.add_argument_group("output")
    output.add_argument(
        "-o",
        "--out",
        metavar="DIR",
        default="robustness",
        help="output folder; resumed if it exists (default: robustness)",
    )
    training = parser.add_argument_group("training")
    training.add_argument(
        "--max-sv", metavar="S", type=float, nargs="+", default=[1.0, 3.0, 5.0, 7.0],
        help="largest dial value of each adaptation; 1 trains at full detail only (default: 1 3 5 7)",
    )  # fmt: skip
    add_settings(training, without=["max_sv"])
    add_misaligned_ok(training)
    add_device(training, "train and measure")


def check_robustness(args: Namespace) -> None:
    check_matplotlib()
    make_configs(args)
    labels(args.ply)
    for path in args.ply:
        check_checkpoint(path)
    check_scene(args.images)


def robustness_outputs(args: Namespace) -> Outputs:
    folder, cells = Path(args.out), Path(args.out) / "cells"
    names = [cell_name(label, max_sv) for label in labels(args.ply) for max_sv in (None, *args.max_sv)]
    files = [*result_files(folder).values()]
    files += [cells / f"{name}{suffix}" for name in names for suffix in (".json", ".safetensors")]
    return Outputs(derived=files, folders=[folder, cells], inputs=args.ply, scene=args.images)


def result_files(folder: Path) -> dict[str, Path]:
    """The figure and the measurements, by suffix."""
    return {kind: folder / f"robustness.{kind}" for kind in ("png", "csv", "json")}


def cell_name(label: str, max_sv: float | None) -> str:
    """The name of a checkpoint's cell: at a range, or of the baseline for None."""
    return f"{label}_base" if max_sv is None else f"{label}_sv{max_sv:g}"


ROBUSTNESS = Command(
    summary="Adapt checkpoints at several ranges, and plot them.",
    description="""\
Run the robustness experiment of CLoD-GS: checkpoints adapted at several ranges.

Adapts each checkpoint at each --max-sv and measures all at the same dial values
on the held-out photographs, also beyond the trained range. The baseline is the
checkpoint itself, pruned to its most opaque Gaussians without tuning.
""",
    usage="PLY [PLY ...] --images DIR [options]",
    epilog="""\
outputs in DIR:
  robustness.png   PSNR and SSIM against Gaussians kept, histograms of opacity
                   and sigma_d; one row per checkpoint, one line per range
  robustness.csv, robustness.json
                   the measurements; with settings and histograms
  cells/           adapter and rows of each adaptation; "clod-adapt apply" makes
                   a model of PLY and its adapter

The same command resumes: it skips finished cells with the same files, settings
and version. Ctrl-C drops the current cell and writes the finished ones (exit
code 0, "interrupted": true; 130 if there are none). Remove DIR to start over.

example:
  clod-adapt robustness 3dgs.ply mask.ply --images garden --max-sv 1 3 5 7
""",
    add_arguments=robustness_options,
    check=check_robustness,
    run=run_of("robustness"),
    outputs=robustness_outputs,
)
