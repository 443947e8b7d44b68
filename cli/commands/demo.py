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

Ray-traces a gallery, trains a checkpoint on it, adapts and measures that, and
draws two pictures. Takes a few minutes on two CPU cores; later runs reuse the
gallery and the checkpoint.
""",
    usage="[--out DIR] [options]",
    epilog="""\
outputs in DIR:
  capture/          64 images and their COLMAP model
  base.ply          the checkpoint, as a 3DGS trainer writes it
  gallery.ply       the adapted file; gallery.safetensors, gallery.json
  dial.png          one held-out view at several dial values
  curve.png         quality against the number of Gaussians
""",
    add_arguments=demo_options,
    check=lambda args: None,
)
