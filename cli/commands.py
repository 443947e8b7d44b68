"""The commands: what ``--help`` says of each. What a command does is in its module, imported to run it."""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable
from dataclasses import dataclass

from clod_adapter.cli.dials import BUDGETS
from clod_adapter.cli.help_plan import PLAN
from clod_adapter.cli.options import (
    adapt_options,
    apply_options,
    demo_options,
    evaluate_options,
    render_options,
    robustness_options,
)


@dataclass(frozen=True)
class Command:
    """What ``--help`` says of a command, and its options.

    Attributes:
        module: of ``clod_adapter.cli``; its ``run(args)`` returns the object that --json prints. It may import torch.
        add_arguments: adds the options to a parser.
    """

    module: str
    summary: str
    description: str
    usage: str
    epilog: str
    add_arguments: Callable[[ArgumentParser], None]


ADAPT = Command(
    module="adapt",
    summary="Give a trained 3D Gaussian splat a quality dial.",
    description="""\
Give a trained 3D Gaussian splat a quality dial: one file for every budget.

Learns one number per Gaussian, sigma_d, with which a renderer fades detail out
smoothly with distance, and tunes the rest lightly. The dial s is set when
rendering: 1 is full quality, at s roughly s^-1.5 of the Gaussians are drawn.
""",
    usage="PLY [--images DIR] [--max-sv S] [--out OUT.ply] [options]",
    epilog=f"""\
outputs, side by side; a file of that name is replaced:
  OUT.ply          the splat with one more property, sigma_d
  OUT.safetensors  the adapter: only what changed; "clod-adapt apply" makes
                   OUT.ply again from it and the checkpoint
  OUT.json         the report: settings, machine, times, and per dial value the
                   quality on held-out photographs (every 8th by name)
with --report, which needs pip install 'clod-adapter[plots]':
  OUT.html         one self-contained page: a view under a slider, error against
                   the time of a frame and against seconds of training, all rows
  OUT_rendering.png, OUT_adapting.png  its charts
The PLY's header and the adapter hold the report's rows too: dial value, count,
PSNR, SSIM and frame time, from which --psnr-drop and --fps find a dial value
elsewhere. The same seed gives the same Gaussians, bit for bit; the frame times
in the calibration are those of the run.

without --images cameras are placed where the checkpoint looks photographed, and
the pictures are its own, at full detail: it is its own teacher. The numbers are
then against the checkpoint, on placed views held out. With the photographs the
result is better; give them where there are any.

{PLAN}
Before training eight of the photographs are compared with what the checkpoint
shows there. Where that is worse than their own mean colours, or another frame
fits clearly better, it stops, with what was found: other axes, scale or offset,
gsplat's or nerfstudio's normalised frame, a white background.
--misaligned-ok goes on with a warning.

While training its state is saved in OUT.resume.safetensors, after the first
step and then now and then, for at most 2 % of the time. After a crash, a kill,
a full disk or Ctrl-C the same command with --resume goes on from there, and
ends with the very Gaussians, bit for bit, that it would have ended with
undisturbed (on as many threads). Without such a file it starts from the
beginning, and says so; the finished run removes it. No file has its final name
before it is whole.

--memory 8GB plans what every phase takes, prints it, and adapts in chunks what
does not fit: blocks of the scene, each with the views that see it, in two
passes. Chunks can be jobs: with --chunk start, and then --chunk 1 and so on
(once for each pass), in any order; the same command without --chunk does what
is missing and writes the outputs, the same ones. Killed, it is repeated.

torchrun starts several processes, on one machine or many, which train together:
each takes its part of a step's views, one by default. The outcome is that of
one process with the same --batch, but for rounding. docs/many_processes.md.

Ctrl-C, or SIGTERM, while training stops after the step under way and writes the
state for --resume and what was learned so far (exit code 0, "interrupted": true
in the report); once more aborts, and the state last saved stays. While the
result is written it is finished first; while it is measured the rest is
skipped. Before training nothing is written. A background job of a
script ignores Ctrl-C; SIGTERM stops it.

The state is also saved where training ends, so that no error after it loses
what was learned; where that cannot be beside the output, it is in the folder
for temporary files, and stderr says what to do with it.

exit codes: 0 written; 1 a loss that is not finite ended training early (what
was learned before is written), or a fault of this program (a traceback, and
where to report it); 2 bad input or a full disk, one line on stderr and no
output written; 130 interrupted with nothing to write, or aborted

examples:
  clod-adapt garden.ply --images garden --max-sv 5
  clod-adapt garden.ply --images garden --time-budget 120 --out out/dial.ply
  clod-adapt garden.ply --images garden --quiet --json > report.json
  clod-adapt garden.ply --max-sv 5
  torchrun --nproc-per-node 8 -m clod_adapter garden.ply --images garden
""",
    add_arguments=adapt_options,
)
EVALUATE = Command(
    module="evaluate",
    summary="Measure quality, count and time at some dial values.",
    description="Measure quality, Gaussians kept and frame time at several dial values.",
    usage="MODEL.ply --images DIR [--sv S [S ...]] [options]",
    epilog=f"""\
{BUDGETS}
All numbers are over the held-out photographs (every 8th by name):
  PSNR, SSIM  means against the photographs
  kept        Gaussians that the dial leaves in, and their share of all
  in view     those of them that have their centre in the picture
  frame ms    median time to render a picture
  LPIPS, FLIP the picture's distance as seen: LPIPS with AlexNet, the mean of
              FLIP; where pip install 'clod-adapter[eval]' put their packages,
              and LPIPS its network's weights, which are not downloaded here
A checkpoint without a dial shows the same at every value: the baseline.

With --base each row is followed by the base, untouched, at the same count: the
Gaussians of highest opacity, and those of highest removal error, the error that
leaving one out alone makes in the photographs trained on. With --against a file
that has a dial itself is measured at every dial value; the model keeps as many
as a mean over the held-out views, at most what it keeps at s = 1.

--popping turns the dial from 1 to the largest S in 200 equal ratios before two
held-out cameras, and moves through five neighbouring cameras in 200 steps at
that S; of a moving camera only what the dial does is counted, not the motion.
Per step: the change of the picture (root mean square, levels of 255), the
largest against the mean (1 is even, 200 a single switch), and how much of the
largest is left when the step is halved: 0.5 of a fade, 1.0 of a jump.

--report writes one self-contained page: a held-out view under a slider, error
against milliseconds a frame, all rows, the settings; and OUT_rendering.png.

Ctrl-C skips the dial values that are not finished (exit code 0, "interrupted":
true); before the first one is, there is nothing to print (exit code 130).

examples:
  clod-adapt eval garden_clod.ply --images garden
  clod-adapt eval garden.ply --images garden --sv 1
  clod-adapt eval garden_clod.ply --images garden --sv 1 4 --json > eval.json
  clod-adapt eval garden_clod.ply --images garden --base garden.ply --popping
  clod-adapt eval garden_clod.ply --images garden --against merged.ply cut.ply
  clod-adapt eval garden_clod.ply --images garden --keep 500000 200000
  clod-adapt eval garden_clod.ply --images garden --report garden.html
""",
    add_arguments=evaluate_options,
)
RENDER = Command(
    module="render",
    summary="Render a scene's cameras at some dial values to PNG.",
    description="""\
Render the cameras of a scene's photographs at some dial values, to PNG files.

One picture for each photograph, named like it; several dial values are side by
side in it, from left to right as given.
""",
    usage="MODEL.ply --images DIR -o FOLDER [options]",
    epilog=f"""\
{BUDGETS}
Ctrl-C leaves the pictures that are finished (exit code 0, "interrupted": true).

examples:
  clod-adapt render garden_clod.ply --images garden -o out --sv 3
  clod-adapt render garden_clod.ply --images garden -o out --sv 1 2 5 --beside
  clod-adapt render garden_clod.ply --images garden -o out --views a.jpg --sv 2
""",
    add_arguments=render_options,
)
APPLY = Command(
    module="apply",
    summary="Make the adapted PLY from checkpoint and adapter.",
    description="Make the adapted PLY again from the checkpoint and the small adapter file.",
    usage="BASE.ply ADAPTER.safetensors -o OUT.ply [--json]",
    epilog="""\
OUT.ply is bit for bit what clod-adapt wrote. BASE.ply must be the very file
that was adapted: its SHA-256 is compared with the one in the adapter.

example:
  clod-adapt apply garden.ply garden_clod.safetensors -o again.ply
""",
    add_arguments=apply_options,
)
ROBUSTNESS = Command(
    module="robustness",
    summary="Adapt checkpoints at several ranges, and plot them.",
    description="""\
The robustness experiment of CLoD-GS: does a dial take on any checkpoint?

Adapts each checkpoint, say a plain and a mask-pruned one of the same scene, at
each range of the dial, and measures all of them at the same dial values on the
held-out photographs, beyond their own range too. The baseline of each is the
untouched checkpoint with only its most opaque Gaussians kept, nothing tuned.
""",
    usage="PLY [PLY ...] --images DIR [options]",
    epilog="""\
in DIR afterwards (default: robustness):
  robustness.png   a row a checkpoint: PSNR and SSIM against Gaussians kept,
                   distributions of opacity and sigma_d, a line a range
  robustness.csv   a line a measurement
  robustness.json  all of it, with settings, machine and histograms
  cells/           what each adaptation learned, and its rows; a model is made
                   from it with "clod-adapt apply PLY cells/NAME_sv5.safetensors
                   -o NAME_sv5.ply"

Interrupted runs resume: a cell that is on disk, of the same files, photographs,
settings and version, is not run again. Ctrl-C drops the cell under way and
writes figure, CSV and JSON of those there are (exit code 0, "interrupted":
true); with none, exit code 130. To start afresh, remove DIR.

example:
  clod-adapt robustness 3dgs.ply mask.ply --images garden --max-sv 1 3 5 7
""",
    add_arguments=robustness_options,
)
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
)
