"""``clod-adapt doctor``: its text, options."""

from __future__ import annotations

from argparse import ArgumentParser

from .command import Command


def doctor_options(parser: ArgumentParser) -> None:
    parser.add_argument("--quiet", action="store_true", help="no progress")


DOCTOR = Command(
    module="doctor.run",
    summary="Say what works here, and what mends the rest.",
    description="""\
Say which backends and tools work here, why the others do not, and the line that
mends each.
""",
    usage="[--json] [--quiet]",
    epilog="""\
Each line has a name, ok or off, what was found, and behind -> what to type.
ok means that it was done: a rasterizer has drawn what the reference draws, a
metric has measured, a file was packed. Only the browser is found, not opened.

  cpu, gpu       what the commands draw and train with
  driver, cuda, gsplat
                 what gpu needs, in this order: mend the first that is off
  gsplat, inria  what the integrations of these names draw with
  processes      torch.distributed, for several processes
  plots, glb, splat-transform, demo, lpips, flip
                 optional: figures and reports, .glb files, packed files, the
                 demo, two columns of clod-adapt eval
  cores, memory, cache
                 what this process may use, and where things are kept

Nothing is installed or fetched, and gsplat is not compiled. All that stays is
the compiled kernels of the CPU, on the first run.

exit codes: 0 something draws; 1 nothing does, neither cpu nor gpu

examples:
  clod-adapt doctor
  clod-adapt doctor --json > doctor.json
""",
    add_arguments=doctor_options,
    check=lambda args: None,
)
