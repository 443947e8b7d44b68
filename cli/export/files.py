"""What ``clod-adapt export`` does: the cameras that it bakes for, and the files that it writes."""

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

from torch import Tensor

from clod_adapter import (
    Camera,
    ClodError,
    Gaussians,
    Phase,
    View,
    bake,
    bake_levels,
    detach,
    place_cameras,
    tune,
)
from clod_adapter.bake import Level
from clod_adapter.cameras import spread
from clod_adapter.evaluation.agreement import agreement, merged_if_nearer
from clod_adapter.harmonics import with_sh_degree
from clod_adapter.initialization.importance import importance
from clod_adapter.inspection.report import extra_columns
from clod_adapter.io.atomic import atomic_path, atomic_paths
from clod_adapter.io.file_formats import write
from clod_adapter.io.formats import splat_transform
from clod_adapter.io.formats.tileset import write_tileset
from clod_adapter.io.settings import Metadata
from clod_adapter.quality_table import Viewpoint
from clod_adapter.viewer.page import write_viewer_page

from ..shared import inputs
from ..shared.command import given_budget, initial_dial
from ..shared.console import Console, duration
from ..shared.measure import Stopwatch, choose_dials, solve_dials
from ..shared.outputs import Report, size
from .names import AGREE, CONVERTED, FOLDERS, PAGE, STORE_FILTER, is_page, level_paths, suffix_of

PLACED = 16  # cameras placed where none are known
# by the option of a set, what to set in its viewer: printed after it is written
SETTINGS = {
    "--lod-meta": (
        "in PlayCanvas: lodBaseDistance = {:.4g}, lodMultiplier = {:g},"
        " minPixelSize = 0, as it else leaves out what is small, and a splatBudget below the finest"
        " level's number; within the budget it draws that level everywhere"
    ),
    "--3dtiles": (
        "in CesiumJS with maximumScreenSpaceError = 16, its default, level 1 begins at {:.4g}"
        " on a screen of 1,080 lines"
    ),
}
COMPARED = 4  # views on which a page is compared with the exact values


def export(args: Namespace) -> Report:
    """Reads, bakes and writes; prints what was written, and returns the report."""
    watch, export = Stopwatch(), Export(args)
    export.note_losses()
    total, written = export.gaussians.whole, export.write()
    for output in written:
        print(line_of(output, total))
        if args.folder and len(output["levels"]) > 1:
            print(SETTINGS[args.folder].format(output["levels"][1]["begins"], args.multiplier))
    if export.dials and not export.page:
        print(f"baked for {export.about}; lossy: without the dial and what it culls here")
    return {
        "model": args.model,
        "files": [args.model, *args.others],
        "base_count": total,
        "camera": export.camera and export.camera.name,
        "cameras": len(export.cameras),
        "outputs": written,
        "notes": export.console.notes,
        "seconds": watch.report(),
    }


def line_of(output: Report, total: int) -> str:
    """Describes an output of a model of ``total`` Gaussians in a line."""
    line = f"wrote {output['file']} ({size(output['bytes'])}): {output['count']:,}"
    if levels := output.get("levels"):
        shown = ", ".join(f"{level['count']:,} from {level['begins']:.3g}" for level in levels)
        return f"{line} Gaussians in {len(levels)} levels, by distance: {shown}"
    if output["virtual_scale"] is None:
        return f"{line} Gaussians"
    of = f" of {total:,}" if output["count"] < total else ""
    return f"{line}{of} Gaussians, s = {output['virtual_scale']:.5g}"


class Export:
    """A model as read, and how it is written."""

    camera: Camera | None = None  # of --camera, for which the result is exact

    def __init__(self, args: Namespace) -> None:
        self.args, self.page, self.console = args, is_page(args), Console(args.quiet)
        renders = args.tune or (args.images and args.fps)
        device = inputs.pick_device(args.device, self.console) if renders else inputs.CPU
        self.model = inputs.read_model(args, args.model, self.console, device=device)
        self.tuning_views = self._find_tuning_views() if args.tune else ()
        self.others = [
            inputs.read_model(args, path, self.console, self.model.origin, device)
            for path in args.others
        ]
        # cameras to bake or fit for, none where that is not asked for, and what they are
        self.cameras, self.about = self._find_cameras()
        given = self.page and args.images  # whose cameras a page has
        self.views = inputs.read_cameras(self.model, given, self.console) if given else []
        if args.sh_degree:
            self._reduce_sh_degree(args.sh_degree)
        self.gaussians = self.model.gaussians
        baked = self.camera is None and not self.page
        dials = args.levels or solve_dials(
            args, self.model, self.cameras, self.console, baked=baked
        )
        if dials and self.page:
            dials = [initial_dial(dials[0], self.gaussians.attenuation, self.console)]
        elif dials:
            dials = choose_dials(dials, self.model, self.console)
        self.dials: list[float] = dials or []  # which are baked, or the one at which a page opens

    def _find_tuning_views(self) -> Sequence[View]:
        """The photographs to train on of --images, in the model's frame."""
        inputs.prepare_kernels(self.console, self.model.gaussians.means.device)
        scene = inputs.read_scene(self.args.images, self.console, self.model.origin)
        return inputs.align_shown(self.model, scene, self.console, required=False)[0].train

    def _find_cameras(self) -> tuple[Sequence[Camera | Viewpoint], str]:
        """The cameras of --camera, --images or the model's file, else placed ones; and what they
        are.
        """
        args, model = self.args, self.model
        counts = given_budget(args) and not (self.page and args.psnr_drop)
        if not (args.levels or counts or args.sh_degree or (args.sv and not self.page)):
            return (), ""
        if args.images:
            cameras = inputs.read_cameras(
                model, args.images, self.console, training=args.camera is None
            )
            if args.camera is None:
                return cameras, f"{len(cameras)} training cameras"
            found = inputs.named(cameras, args.camera, "--camera")
            if len(found) > 1:
                raise ClodError(
                    f"--camera: {args.camera!r} matches {found[0].name} and {found[1].name}; give"
                    " the full name"
                )
            self.camera = found[0]
            return found, f"the camera of {found[0].name} only"
        if model.viewpoints:
            return model.viewpoints, f"{len(model.viewpoints)} training cameras"
        try:
            with self.console.meter("placing cameras") as meter:
                cameras = place_cameras(model.gaussians, views=PLACED, progress=meter)
        except ClodError as error:
            raise ClodError(
                f"{model.path}: no cameras stored to bake for, and {error}; give --images"
            ) from error
        self.console.note(
            f"{model.path} stores no cameras: baked for {len(cameras)} placed ones; --images gives"
            " a better result"
        )
        return cameras, f"{len(cameras)} placed cameras"

    def _reduce_sh_degree(self, wanted: str) -> None:
        """Replaces the model's Gaussians, with a note on what that changes."""
        before = self.model.gaussians
        self._prepare()
        for degree in range(before.sh_degree):
            if wanted not in ("auto", str(degree)):
                continue
            after = with_sh_degree(before, degree, self.cameras)
            alike = agreement(after, before, self._compared)
            if wanted == "auto" and alike < AGREE:
                continue
            self.console.note(
                f"SH degree {degree}: renders have a PSNR of {alike:.1f} dB against those with"
                f" degree {before.sh_degree} (fitted to {self.about})"
            )
            self.model = replace(self.model, gaussians=after, vertex=None)
            return
        self.console.note(
            f"--sh-degree {wanted}: the file has SH degree {before.sh_degree}, and stays as it is"
        )

    def _prepare(self) -> None:
        """Compiles what renders need."""
        inputs.prepare_kernels(self.console, self.model.gaussians.means.device, training=False)

    @cached_property
    def _compared(self) -> Sequence[Camera]:
        """Views on which two versions of the model are compared."""
        given = [each for each in self.cameras if isinstance(each, Camera)]
        known = self.views or given or self.model.cameras
        return spread(known or place_cameras(self.model.gaussians, views=COMPARED), COMPARED)

    def note_losses(self) -> None:
        """Notes dropped columns, and a screen-space filter that most readers do not find."""
        for model in (self.model, *self.others):
            names = (model.vertex.dtype.names if model.vertex is not None else None) or ()
            if dropped := extra_columns(names, model.gaussians.sh_degree):
                self.console.note(f"columns dropped: {', '.join(dropped)}")
        screen_filter = self.gaussians.screen_filter
        plain = self.gaussians.sigma_d is None or self.dials
        lost = self.args.folder or suffix_of(Path(self.args.out)) not in STORE_FILTER
        if screen_filter.compensate and plain and lost:
            self.console.note(
                f"trained antialiased ({screen_filter.description}): most readers need an option"
                ' for it: antiAlias in PlayCanvas, rasterize_mode="antialiased" in gsplat'
            )

    def write(self) -> list[Report]:
        """Writes all files of the command, all or none; a description of each."""
        out, written = Path(self.args.out), list[Report]()
        if option := self.args.folder:
            with atomic_path(out) as folder:
                folder.mkdir()
                found = self._write_set(folder / FOLDERS[option])
                taken = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
            return [
                {
                    "file": str(out / FOLDERS[option]),
                    "levels": [
                        {"begins": level.begins, "count": len(level.gaussians)} for level in found
                    ],
                    "count": sum(len(level.gaussians) for level in found),
                    "bytes": taken,
                }
            ]
        paths = level_paths(out, self.args.levels) if self.args.levels else [out]
        dials: Sequence[float | None] = self.dials or [None]
        with atomic_paths(*paths) as temporaries:
            for path, temporary, dial in zip(paths, temporaries, dials, strict=True):
                count = self._write_file(temporary, suffix_of(path), dial)
                taken = temporary.stat().st_size
                written.append(
                    {"file": str(path), "virtual_scale": dial, "count": count, "bytes": taken}
                )
        return written

    def _content(self, virtual_scale: float | None) -> tuple[Gaussians, tuple[str, ...]]:
        """The Gaussians of one file, baked if there is a dial value; and its comments, those of the
        model first.
        """
        about, gaussians = [*self.model.comments], self.gaussians
        if virtual_scale is not None:
            baked = bake(
                gaussians, virtual_scale, self.camera, cameras=() if self.camera else self.cameras
            )
            merged = self._merged(baked)
            how = "the checkpoint merged to as many as are kept" if merged else "baked"
            about.append(f"{how} at s = {virtual_scale:.6g} by clod-adapter for {self.about}")
            gaussians = merged or baked
            if self.args.tune:
                about.append("tuned for this dial value")
                with self.console.meter(Phase.TUNING) as meter:
                    gaussians = tune(gaussians, self.tuning_views, progress=meter)
        return gaussians, tuple(dict.fromkeys(about))

    def _merged(self, baked: Gaussians) -> Gaussians | None:
        """The checkpoint merged to as many; None where there are photographs, and where the
        checkpoint's renders are nearer to those of what is ``baked``.
        """
        if self.args.images or not self.model.placed or len(baked) == self.gaussians.whole:
            return None
        rival = self._rival
        with self.console.meter(Phase.MERGING) as meter:
            merged = merged_if_nearer(baked, *rival, meter)
        if merged:
            self.console.note(
                f"{len(merged):,} Gaussians are the checkpoint's, merged: their renders are nearer"
                " to its own than those of what the dial keeps"
            )
        return merged

    @cached_property
    def _rival(self) -> tuple[Gaussians, Tensor, Sequence[Camera]]:
        """The checkpoint, its importance, and views to compare in, which neither that nor the dial
        is from.
        """
        self._prepare()
        checkpoint = detach(self.gaussians)
        with self.console.meter("placing cameras") as meter:
            # where what is near counts most, few views disagree by decibels
            views = place_cameras(checkpoint, views=64, seed=1, progress=meter)
            seen = place_cameras(checkpoint, progress=meter)
            meter.begin("importance")
            weights = importance(checkpoint, seen, unseen=True, progress=meter)
        return checkpoint, weights, views

    def _write_file(self, path: Path, suffix: str, virtual_scale: float | None) -> int:
        """Writes a file, with notes on losses of the format; returns its number of Gaussians."""
        if suffix == PAGE:
            self._write_page(path, virtual_scale)
            return sum(model.gaussians.whole for model in (self.model, *self.others))
        gaussians, about = self._content(virtual_scale)
        if suffix in CONVERTED:
            with TemporaryDirectory(dir=path.parent, prefix=".tmp-") as folder:
                # splat-transform tells the format by the suffix
                source, packed = Path(folder) / "plain.ply", Path(folder) / f"packed{suffix}"
                write(source, gaussians, Metadata(about=about))
                self._transform([source], packed, len(gaussians))
                packed.replace(path)
            return len(gaussians)
        kept = self.model.quality_table if virtual_scale is None else None
        self.console.note(
            *write(
                path, gaussians, Metadata(quality_table=kept, origin=self.model.origin, about=about)
            )
        )
        if suffix == ".ply" and any(self.model.origin):
            self.console.note("x, y and z are doubles, which SIBR and some other readers misread")
        return gaussians.whole

    def _write_set(self, index: Path) -> list[Level]:
        """Writes a streaming or 3D Tiles set to the folder of ``index``; returns its levels."""
        levels = bake_levels(self.gaussians, self.args.multiplier)
        if self.args.folder == "--3dtiles":
            self.console.note(*write_tileset(index.parent, levels, origin=self.model.origin))
            return levels
        total = sum(len(level.gaussians) for level in levels)
        with TemporaryDirectory(dir=index.parent) as temporary:
            words: list[str | Path] = [*splat_transform.cutting_options(total)]
            for k, level in enumerate(levels):
                source = Path(temporary) / f"{k}.ply"
                write(source, level.gaussians, Metadata(about=self.model.comments))
                words += [source, "-l", str(k)]
            self._transform(words, index, total)
        return levels

    def _write_page(self, path: Path, virtual_scale: float | None) -> None:
        """Writes a page, and notes the PSNR of its renders against those of the exact Gaussians."""
        self._prepare()
        shown, losses = write_viewer_page(
            path,
            self.model,
            others=self.others,
            cameras=self.views,
            virtual_scale=virtual_scale,
            exact=self.args.exact,
        )
        self.console.note(*losses)
        if self.args.exact:
            return
        with self.console.status("comparing with the exact values ..."):
            alike = agreement(shown, self.gaussians, self._compared)
        self.console.note(
            f"renders of the page have a PSNR of {alike:.1f} dB against the exact file (s = 1);"
            " --exact keeps all digits",
            of=str(self.model.path),
        )

    def _transform(self, words: list[str | Path], out: Path, count: int) -> None:
        tool = splat_transform.SplatTransform.find()
        text = f"splat-transform packs {count:,} Gaussians"
        with self.console.status(f"{text} ...") as show:
            limit = splat_transform.LIMIT + splat_transform.LIMIT_EACH * count
            seconds = tool.run(
                *words, out, timeout=limit, progress=lambda s: show(f"{text}, {duration(s)} so far")
            )
        self.console.say(f"splat-transform {tool.version} took {duration(seconds)}")
        if any(self.model.origin):
            self.console.note("coordinates are relative to the model's origin, which is dropped")
        if out.suffix == ".glb":  # float32, the rows in their order
            return
        self.console.note("splat-transform rounds values and sorts the Gaussians")
        if not tool.gpu and self.gaussians.sh_degree > 0 and out.suffix != ".ply":
            self.console.note(
                "splat-transform runs without a GPU: its palette of spherical harmonics is coarser"
            )
