"""``clod-adapt demo``: its text and options."""

from __future__ import annotations

from argparse import ArgumentParser

from .command import Command


def demo_options(parser: ArgumentParser) -> None:
    parser.add_argument("-o", "--out", metavar="DIR", default="demo", help="where everything goes (default: demo)")
    parser.add_argument("--quiet", action="store_true", help="no progress, no notes")


DEMO = Command(
    module="demo",
    summary="Run everything on a built-in scene; nothing to download.",
    description="""\
Run the whole job on a scene that comes with the package.

Ray-traces a small gallery (its ground truth owes nothing to splatting), trains
a plain checkpoint on it, gives that a dial, measures it on held-out views and
draws two pictures. A few minutes on two cores without a GPU, the first time;
the gallery and the checkpoint are kept and used again.
""",
    usage="[--out DIR] [options]",
    epilog="""\
in DIR afterwards:
  capture/          64 images and their COLMAP model
  base.ply          the checkpoint, as any 3DGS trainer would leave it
  gallery.ply       the same with a dial; gallery.safetensors, gallery.json
  dial.png          one held-out view at several dial values
  curve.png         quality against the number of Gaussians
""",
    add_arguments=demo_options,
    check=lambda args: None,
)
