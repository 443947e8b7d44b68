"""``clod-adapt demo``: its text and options."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from clod_adapter.report.style import check_matplotlib

from ..shared.command import Command, run_of
from ..shared.outputs import AdaptFiles, Outputs


def demo_options(parser: ArgumentParser) -> None:
    output = parser.add_argument_group("output")
    output.add_argument("-o", "--out", metavar="DIR", default="demo", help="output folder (default: demo)")


def demo_outputs(args: Namespace) -> Outputs:
    folder = Path(args.out)
    model = AdaptFiles.of("", str(folder / "gallery.ply"))
    return Outputs(derived=[*vars(model).values(), *picture_files(folder).values()], folders=[folder])


def picture_files(folder: Path) -> dict[str, Path]:
    return {"dial": folder / "dial.png", "curve": folder / "curve.png"}


DEMO = Command(
    summary="Run everything on a built-in scene; nothing to download.",
    description="""\
Run all steps on a scene that comes with the package.

Unpacks photographs of a ray-traced gallery and a checkpoint that was trained
on them to its end, adapts the checkpoint, measures the result and draws two
pictures. Takes about a minute on two CPU cores.
""",
    usage="[--out DIR] [options]",
    epilog="""\
outputs in DIR:
  capture/          80 images and their COLMAP model
  base.ply          the checkpoint
  gallery.ply       the adapted file; gallery.safetensors, gallery.json
  dial.png          one held-out view: photograph, base, several dial values
  curve.png         quality against the number of Gaussians
""",
    add_arguments=demo_options,
    check=lambda args: check_matplotlib(),  # before a minute is spent
    run=run_of("demo"),
    outputs=demo_outputs,
)
