"""``clod-adapt view``: its text, options and checks."""

from __future__ import annotations

import math
from argparse import ArgumentParser, Namespace

from clod_adapter.errors import ClodError

from .checks import check_checkpoint, check_scene
from .command import Command
from .options import add_activated, add_antialiasing


def view_options(parser: ArgumentParser) -> None:
    parser.add_argument("model", metavar="MODEL.ply", help="an adapted file, or a plain one: then without a dial")
    parser.add_argument("--base", metavar="BASE.ply", help="the unadapted checkpoint, or another file, to wipe against")
    parser.add_argument("--images", metavar="DIR", help="the scene: a COLMAP model or transforms.json, for its cameras")
    parser.add_argument("--sv", metavar="S", type=float, default=1.0, help="the dial when the page opens (default: 1)")
    parser.add_argument("--port", metavar="P", type=int, default=0, help="where to listen (default: a free port)")
    parser.add_argument("--no-browser", action="store_true", help="print the address, and open nothing")
    add_activated(parser)
    add_antialiasing(parser, photographs=False)
    parser.add_argument("--quiet", action="store_true", help="no progress, no notes")


def check_view(args: Namespace) -> None:
    if not 0 <= args.port < 1 << 16:
        raise ClodError(f"--port is {args.port}, it must be between 1 and 65535, or 0 for a free one")
    if not 1 <= args.sv < math.inf:
        raise ClodError(f"--sv is {args.sv:g}, it must be at least 1 (1 is full quality)")
    for path in (args.model, *([args.base] if args.base else [])):
        check_checkpoint(path)
    if args.images is not None:
        check_scene(args.images)


VIEW = Command(
    module="view",
    summary="Look at a file in the browser, and turn its dial.",
    description="""\
Look at a file in the browser, turn its dial, and move through the scene.

Serves a page on this machine's loopback address, prints the address, opens it
in the browser, and stays until Ctrl-C.
""",
    usage="MODEL.ply [--base BASE.ply] [--images DIR] [options]",
    epilog="""\
The page shows how many Gaussians the dial leaves in and what a frame takes,
switches the equation off and on, and puts two dial values, or the file and its
--base, on both sides of a line that is dragged. Another file can be dropped on
it. The address in the browser holds the view: who has the page open at the same
port sees the same.

--images is for the cameras only, which the page then jumps between; photographs
need not be there. Without it the page looks at the middle of the scene.

No other machine can reach the page: it listens on 127.0.0.1, and nothing is
fetched from elsewhere or sent. To see it from another one, forward the port
(with -t, or Ctrl-C ends ssh alone):
  ssh -t -L 8000:127.0.0.1:8000 HOST \\
      clod-adapt view MODEL.ply --no-browser --port 8000
To send what you see to somebody, write it as a file:
  clod-adapt export MODEL.ply -o page.html

--json prints its object at once, as the command stays: {"url": ..., ...}.

exit codes: 0 ended by Ctrl-C or SIGTERM; 2 bad input, or the port is taken

examples:
  clod-adapt view garden_clod.ply
  clod-adapt view garden_clod.ply --base garden.ply --images garden --sv 3
  clod-adapt view garden.ply --no-browser --port 8000
""",
    add_arguments=view_options,
    check=check_view,
)
