"""What can be seen to be wrong with an export before torch is imported."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from clod_adapter.cli import checks
from clod_adapter.cli.dials import given_budget
from clod_adapter.cli.export_formats import FORMATS, LOD_META, PACKED, PAGE, level_paths, suffix_of, suffixes
from clod_adapter.cli.outputs import check_outputs
from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import check_target
from clod_adapter.io.splat_transform import SplatTransform


def check_export(args: Namespace) -> None:
    bakes = bool(args.levels) or args.sv is not None or given_budget(args) is not None
    check_together(args, bakes)
    if args.images is not None:
        checks.check_scene(args.images)
    check_export_outputs(args)
    checks.check_dials(args, args.model, measured=measured(args))
    checks.check_checkpoint(args.model)
    dial = checks.has_dial(args.model)
    if bakes and not dial:
        raise ClodError(f"{args.model}: has no sigma_d, so there is no dial value to bake; it is plain already")
    if args.order and not dial:
        raise ClodError(f"{args.model}: has no sigma_d, so there is no order to put its rows in; adapt it first")
    if not args.lod_meta:
        check_format(args, bakes, dial)
    if args.lod_meta or suffix_of(Path(args.out)) in PACKED:
        SplatTransform.find()


def measured(args: Namespace) -> tuple[str, ...]:
    """The budgets that are measured: frame times from a scene's cameras, the PSNR of a file on its photographs."""
    if args.images is None:
        return ()
    page = Path(args.out).suffix.lower() == PAGE
    return ("fps",) if page or args.camera is not None else ("fps", "psnr_drop")


def check_together(args: Namespace, bakes: bool) -> None:
    """Refuses options that do not go together."""
    if args.levels and (args.sv is not None or given_budget(args) is not None):
        raise ClodError("--levels has the dial values; give no other with it")
    if args.lod_meta and not args.levels:
        raise ClodError("--lod-meta is a set of levels; give them, as in --levels 1,2,4,7")
    if args.lod_meta and args.order:
        raise ClodError("a streaming set has an order of its own; leave out --order")
    if args.camera is not None and args.images is None:
        raise ClodError("--camera names a photograph of a scene; give that too, with --images")
    page = Path(args.out).suffix.lower() == PAGE
    if page and (args.levels or args.camera is not None or args.order):
        raise ClodError(f"a {PAGE} shows the whole dial; leave out --levels, --camera and --order")
    if args.camera is not None and not bakes:
        raise ClodError("--camera is where a dial value is baked for; give one, as in --sv 2")
    if args.images is not None and not (bakes or args.order or page):
        raise ClodError(f"--images is for baking, --order and a {PAGE}; give one of them with it, as in --sv 2")


def check_export_outputs(args: Namespace) -> None:
    out = Path(args.out)
    if not args.lod_meta:
        for path in level_paths(out, args.levels) if args.levels else [out]:
            suffix_of(path)
            check_outputs([path], [args.model], args.images)
        return
    if out.suffix.lower() in (".json", *suffixes()):
        raise ClodError(f"{out}: with --lod-meta, --out names the folder that {LOD_META} is to be in, not a file")
    if out.exists() and not out.is_dir():
        raise ClodError(f"{out}: is a file; with --lod-meta give --out the name of a new folder")
    if not out.name:  # ".", the folder one is in, which cannot be put in the place of itself
        raise ClodError(f"{out}: is the folder you are in; give --out the name of a new one")
    check_target(out)


def check_format(args: Namespace, bakes: bool, dial: bool) -> None:
    """Refuses what the format of --out has no room for."""
    suffix = suffix_of(Path(args.out))
    if dial and not bakes and not FORMATS[suffix].sigma:
        others = ", ".join(other for other in suffixes() if FORMATS[other].sigma)
        raise ClodError(
            f"{args.out}: {suffix} has no room for sigma_d; choose a dial value to bake, as in --sv 1, or another "
            f"format ({others})"
        )
    if args.order and not FORMATS[suffix].ordered:
        raise ClodError(f"{args.out}: {suffix} has an order of its own; leave out --order")
