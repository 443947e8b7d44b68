"""``clod-adapt demo``: adapts a scene that comes with the package, and draws figures of the
result.
"""

from argparse import ArgumentParser, Namespace
from pathlib import Path

from clod_adapter import ClodError
from clod_adapter.report.charts import check_matplotlib

from . import adapt
from .shared.command import add_out, parser_of
from .shared.console import Console, duration
from .shared.outputs import AdaptFiles, Outputs, Report, claimed

MAX_SV = 5.0
PICTURES = {"dial": "dial.png", "curve": "curve.png"}


def add_arguments(parser: ArgumentParser) -> None:
    add_out(parser, "DIR", "output folder (default: demo)", "demo")


def check(args: Namespace) -> None:
    check_matplotlib()  # before a minute is spent


def outputs(args: Namespace) -> Outputs:
    folder = Path(args.out)
    model = AdaptFiles.of("", str(folder / "gallery.ply"))
    pictures = [folder / file for file in PICTURES.values()]
    return Outputs(derived=[*vars(model).values(), *pictures], folders=[folder])


def execute(args: Namespace) -> Report:
    from clod_adapter.demo import draw, unpack

    from .shared.inputs import prepare_kernels
    from .shared.measure import Stopwatch

    console, watch, folder = Console(args.quiet), Stopwatch(), Path(args.out)
    capture, base, model = folder / "capture", folder / "base.ply", folder / "gallery.ply"
    pictures = {name: folder / file for name, file in PICTURES.items()}
    if base.exists() and not capture.exists():
        raise ClodError(
            f"{base}: exists without {capture}, so the demo did not make it; choose another --out"
        )
    prepare_kernels(console)
    unpack(capture, base)
    console.say(f"the scene is in {capture}, its checkpoint is {base}")
    words = [f"--images={capture}", f"--max-sv={MAX_SV:g}", f"--out={model}"]
    words += [f"--{name}" for name in ("quiet", "json") if getattr(args, name)]
    words += ["--resume"] if AdaptFiles.of(str(base), str(model)).state.exists() else []
    arguments = parser_of(adapt, "clod-adapt").parse_args([*words, "--", str(base)])
    with claimed(adapt.outputs(arguments)):
        report = adapt.execute(arguments)
    for path in pictures.values():  # of an earlier run
        path.unlink(missing_ok=True)
    if report["rows"]:
        draw(capture, base, model, report, pictures)
        drawn = "dial.png shows a view, curve.png quality against count, beside merging"
    else:
        pictures, drawn = {}, "no figures: the measurements were interrupted"
    print(f"\n{duration(watch.total())} for the demo; everything is in {folder.resolve()}\n{drawn}")
    print("next, a splat of your own:\n  clod-adapt YOURS.ply --images YOUR_SCENE")
    return report | {"command": "demo", "folder": folder, "pictures": pictures}


DESCRIPTION = """\
Run all steps on photographs of a ray-traced gallery and a checkpoint that was
trained on them, which come with the package; about a minute on two CPU cores.
"""
USAGE = "[--out DIR] [options]"
EPILOG = """\
outputs in DIR:
  capture/          80 images and their COLMAP model
  base.ply          the checkpoint
  gallery.ply       the adapted file; gallery.safetensors, gallery.json
  dial.png          one held-out view: the checkpoint, the dial at a fifth of
                    its Gaussians, and the checkpoint merged to as many
  curve.png         quality against the number of Gaussians, merging beside it
"""
