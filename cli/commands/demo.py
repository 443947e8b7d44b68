"""``clod-adapt demo``: its text and options."""

from __future__ import annotations

from argparse import ArgumentParser

from .command import Command


def demo_options(parser: ArgumentParser) -> None:
    output = parser.add_argument_group("output")
    output.add_argument("-o", "--out", metavar="DIR", default="demo", help="output folder (default: demo)")


DEMO = Command(
    module="demo",
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
    check=lambda args: None,
)
