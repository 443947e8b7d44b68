"""``clod-adapt doctor``: its text."""

from __future__ import annotations

from .command import Command

DOCTOR = Command(
    module="doctor.run",
    summary="Check backends and tools, and say how to fix them.",
    description="""\
Check which backends and tools work on this machine. For each that does not,
print the reason and a command that fixes it.
""",
    usage="[--json] [--quiet]",
    epilog="""\
Each line has a name, ok or off, the result, and after -> the fix. ok means that
the check ran the thing itself: a rasterizer rendered the reference's image, a
metric measured, a file was packed. Only the browser is not opened.

  cpu, gpu       backends of all commands
  driver, cuda, gsplat
                 what gpu needs, in this order: fix the first that is off
  gsplat, inria  backends of the integrations of these names
  processes      torch.distributed, for several processes
  plots, glb, splat-transform, lpips, flip
                 optional: figures, reports and the demo, .glb files, packed
                 files, two columns of clod-adapt eval
  cores, memory, cache
                 limits of this process, and folders for cached files

Nothing is installed or downloaded, and gsplat is not compiled; the first run
leaves the compiled CPU kernels.

exit codes: 0 cpu or gpu works; 1 neither does

examples:
  clod-adapt doctor
  clod-adapt doctor --json > doctor.json
""",
    add_arguments=lambda parser: None,
    check=lambda args: None,
)
