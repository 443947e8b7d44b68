"""``clod-adapt export``: a model in another format, with its dial or with one dial value baked in."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from clod_adapter.cameras import Camera
from clod_adapter.cli.budgets import solve_dials
from clod_adapter.cli.console import Console, duration
from clod_adapter.cli.devices import on_device, pick_device
from clod_adapter.cli.dials import opens_at
from clod_adapter.cli.evaluate import choose_dials
from clod_adapter.cli.export_formats import LOD_META, PACKED, PAGE, level_paths, suffix_of
from clod_adapter.cli.files import size
from clod_adapter.cli.inputs import read_checkpoint
from clod_adapter.cli.render import named
from clod_adapter.cli.report import Stopwatch
from clod_adapter.errors import ClodError
from clod_adapter.export import bake, order_by_extinction
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.atomic import atomic_path, atomic_paths
from clod_adapter.io.claims import claimed
from clod_adapter.io.ply import Checkpoint
from clod_adapter.io.ply_columns import MASKS, SIGMA, inria_dtype
from clod_adapter.io.ply_header import PREFIX
from clod_adapter.io.poses import load_cameras
from clod_adapter.io.splat_transform import SplatTransform, time_limit
from clod_adapter.io.version import package_version
from clod_adapter.io.writers import write
from clod_adapter.viewer.page import write_page


@dataclass(frozen=True)
class Export:
    """What is written from where.

    Attributes:
        model: as read.
        gaussians: the model's, in the order asked for.
        camera: what is baked for; None for the normalised distance 1.
        cameras: of the scene, for a page to jump between.
        ordered: whether the rows have been put in order.
        console: for splat-transform's progress.
    """

    model: Checkpoint
    gaussians: Gaussians
    camera: Camera | None
    cameras: list[Camera]
    ordered: bool
    console: Console

    def piece(self, virtual_scale: float | None) -> tuple[Gaussians, tuple[str, ...]]:
        """The Gaussians of one file, baked if there is a dial value; lines on how they came about, its own too."""
        about = [comment for comment in self.model.comments if not comment.startswith(PREFIX)]
        gaussians = self.gaussians
        if virtual_scale is not None:
            place = "d' = 1" if self.camera is None else f"the camera at {self._position()}"
            about.append(f"baked at s = {virtual_scale:.6g} and {place} by clod-adapter: exact there only")
            gaussians = bake(gaussians, virtual_scale, self.camera)
        about += ["rows in the order in which the dial keeps them longest"] if self.ordered else []
        return gaussians, tuple(dict.fromkeys(about))

    def write(self, path: Path, suffix: str, virtual_scale: float | None) -> tuple[int, tuple[str, ...]]:
        """Writes a file; how many Gaussians are in it, and notes on what has no room there."""
        if suffix == PAGE:
            return len(self.gaussians), self._write_page(path, virtual_scale or 1.0)
        gaussians, about = self.piece(virtual_scale)
        if suffix in PACKED:
            return len(gaussians), self._pack(path, suffix, gaussians, about)
        calibration = self.model.calibration if virtual_scale is None else None
        notes = write(path, gaussians, about, origin=self.model.origin, calibration=calibration)
        if suffix == ".ply" and any(self.model.origin):
            notes += ("x, y and z are doubles, which SIBR and some other readers take for something else",)
        return len(gaussians), notes

    def write_levels(self, folder: Path, levels: list[float]) -> tuple[list[int], tuple[str, ...]]:
        """Makes ``folder`` a streaming set; how many Gaussians each level has, and notes."""
        folder.mkdir()
        with TemporaryDirectory(dir=folder) as temporary:
            words, counts = list[str | Path](), list[int]()
            for k, level in enumerate(levels):
                gaussians, about = self.piece(level)
                source = Path(temporary) / f"{k}.ply"
                write(source, gaussians, about)
                words += [source, "-l", str(k)]
                counts.append(len(gaussians))
            notes = self._transform(words, folder / LOD_META, sum(counts))
        return counts, notes

    def _write_page(self, path: Path, virtual_scale: float) -> tuple[str, ...]:
        """Writes the page, packed where there is something to pack it with."""
        try:
            tool = SplatTransform.find()
        except ClodError as error:
            write_page(path, self.model, cameras=self.cameras, virtual_scale=virtual_scale)
            return (f"the splat is in the page as it is; packed, the page would be a fifth of this: {error}",)
        with ticking(self.console, f"splat-transform {tool.version}, {len(self.gaussians):,} Gaussians") as tick:
            write_page(
                path, self.model, cameras=self.cameras, virtual_scale=virtual_scale, tool=tool, progress=tick
            )  # fmt: skip
        return ("the splat is packed: values are rounded",)

    def _pack(self, path: Path, suffix: str, gaussians: Gaussians, about: tuple[str, ...]) -> tuple[str, ...]:
        with TemporaryDirectory(dir=path.parent, prefix=".tmp-") as folder:
            source, packed = Path(folder) / "plain.ply", Path(folder) / f"packed{suffix}"  # named as the tool wants it
            write(source, gaussians, about)
            notes = self._transform([source], packed, len(gaussians))
            with atomic_path(path) as temporary:
                packed.replace(temporary)
        return notes

    def _transform(self, words: list[str | Path], out: Path, count: int) -> tuple[str, ...]:
        tool = SplatTransform.find()
        with ticking(self.console, f"splat-transform {tool.version}, {count:,} Gaussians") as tick:
            seconds = tool.run(*words, out, timeout=time_limit(count), progress=tick)
        self.console.say(f"splat-transform took {duration(seconds)}")
        notes = ["values are rounded, and the rows are in an order of splat-transform's"]
        if any(self.model.origin):
            notes.append("the origin is dropped: coordinates are relative to it")
        if not tool.gpu and self.gaussians.sh_degree > 0 and out.suffix != ".ply":
            notes.append("splat-transform has no GPU here: the palette of spherical harmonics is a rougher one")
        return tuple(notes)

    def _position(self) -> str:
        assert self.camera is not None
        place = self.camera.position.double().tolist()
        return f"({', '.join(f'{x + by:.9g}' for x, by in zip(place, self.model.origin, strict=True))})"


def run(args: argparse.Namespace) -> dict[str, Any]:
    console, watch, out = Console(args.quiet), Stopwatch(), Path(args.out)
    model = read_checkpoint(args.model, console, args.activated)
    camera, cameras, notes = reference(args, model)
    dials, more = dial_values(args, model, camera, console)
    gaussians = model.gaussians
    if args.order:
        gaussians = gaussians.select(order_by_extinction(gaussians, cameras))
    notes += [*more, *left_out(model)]
    for note in notes:
        console.say(note)
    export = Export(model, gaussians, camera, cameras, bool(args.order), console)
    with claimed(out):
        if args.lod_meta:
            outputs, lost = write_set(export, out, dials)
        else:
            outputs, lost = write_files(export, level_paths(out, args.levels) if args.levels else [out], dials)
    for note in dict.fromkeys(lost):
        console.say(f"  note: {note}")
    baked = None if out.suffix.lower() == PAGE else dials
    print("\n".join([*(describe(output, len(gaussians)) for output in outputs), *exactness(export, baked)]))
    return {
        "command": "export", "version": package_version(), "model": args.model, "base_count": len(gaussians),
        "camera": camera.name if camera else None, "order": args.order, "outputs": outputs,
        "notes": [*model.notes, *notes, *dict.fromkeys(lost)], "seconds": watch.report(),
    }  # fmt: skip


def reference(args: argparse.Namespace, model: Checkpoint) -> tuple[Camera | None, list[Camera], list[str]]:
    """The camera to bake for, if one is asked for; those to order by, that one or the scene's; and notes on these."""
    if args.images is None:
        return None, [], []
    cameras, notes = load_cameras(args.images, model.origin)
    if args.camera is None:
        return None, cameras, notes
    found = named(cameras, args.camera, "--camera")
    if len(found) > 1:
        both = f"{found[0].name} and {found[1].name}"
        raise ClodError(f"--camera has {args.camera!r}, which {both} are; give the whole name")
    return found[0], found, notes


def dial_values(
    args: argparse.Namespace, model: Checkpoint, camera: Camera | None, console: Console
) -> tuple[list[float] | None, list[str]]:
    """The dial values to bake, for a page where it opens, None where the dial is to stay; and notes on them."""
    if camera and getattr(args, "fps", None):  # frames are timed
        model = on_device(model, pick_device(args.device, console))
    solved, notes = (args.levels, []) if args.levels else solve_dials(args, model, [camera] if camera else (), console)
    if solved is None:
        return None, notes
    if Path(args.out).suffix.lower() == PAGE and model.gaussians.attenuation is not None:
        opening, more = opens_at(solved[0], model.gaussians.attenuation.max_sv)
        return [opening], notes + more
    dials, beyond = choose_dials(solved, model.gaussians.attenuation)
    return dials, notes + beyond


def left_out(model: Checkpoint) -> list[str]:
    """A note on the columns that outputs do not have."""
    known = {*(inria_dtype(model.gaussians.sh_degree).names or ()), SIGMA, *MASKS}
    others = [name for name in model.vertex.dtype.names or () if name not in known]
    return [f"columns left out: {', '.join(others)}"] if others else []


def write_files(export: Export, paths: list[Path], dials: list[float] | None) -> tuple[list[dict[str, Any]], list[str]]:
    """Writes a file, or one for each of several dial values, together; what they are, and notes."""
    outputs, notes = list[dict[str, Any]](), list[str]()
    chosen: list[float | None] = [None] if dials is None else [*dials]
    with atomic_paths(*paths) as temporaries:
        for path, temporary, dial in zip(paths, temporaries, chosen, strict=True):
            count, more = export.write(temporary, suffix_of(path), dial)
            taken = temporary.stat().st_size
            outputs.append({"file": str(path), "virtual_scale": dial, "count": count, "bytes": taken})
            notes += more
    return outputs, notes


def write_set(export: Export, out: Path, dials: list[float] | None) -> tuple[list[dict[str, Any]], list[str]]:
    """Writes a streaming set; what is in it, and notes."""
    assert dials is not None  # check_export has seen to it
    with atomic_path(out) as folder:
        counts, notes = export.write_levels(folder, dials)
        total = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    levels = [{"virtual_scale": dial, "count": count} for dial, count in zip(dials, counts, strict=True)]
    return [{"file": str(out / LOD_META), "levels": levels, "count": sum(counts), "bytes": total}], list(notes)


def describe(output: dict[str, Any], total: int) -> str:
    """A line on an output of a model of ``total`` Gaussians."""
    line = f"wrote {output['file']} ({size(output['bytes'])}): {output['count']:,}"
    if levels := output.get("levels"):
        shown = ", ".join(f"{level['count']:,} at s = {level['virtual_scale']:.5g}" for level in levels)
        return f"{line} Gaussians in {len(levels)} levels, {shown}"
    if output["virtual_scale"] is None:
        return f"{line} Gaussians"
    if output["file"].lower().endswith(PAGE):
        return f"{line} Gaussians, the dial at s = {output['virtual_scale']:.5g} at first"
    return f"{line} of {total:,} Gaussians, s = {output['virtual_scale']:.5g}"


def exactness(export: Export, dials: list[float] | None) -> list[str]:
    """Where a baked file is exact, in words."""
    attenuation = export.model.gaussians.attenuation
    if dials is None or attenuation is None:
        return []
    if export.camera is not None:
        place = f"from the camera of {export.camera.name}"
    elif attenuation.normalizer == "scene":
        place = f"at {attenuation.scene_distance:.4g} world units from the camera"
    else:
        place = "at the distance that the picture's own are divided by"
    return [f"exact {place} only, and lossy: the dial and the Gaussians that it leaves out are gone"]


@contextmanager
def ticking(console: Console, text: str) -> Iterator[Callable[[float], None]]:
    """Shows the seconds that a part takes whose length is not known."""
    with console.status(f"{text} ...") as show:
        yield lambda seconds: show(f"{text}, {duration(seconds)} so far")
