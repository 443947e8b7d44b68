"""The cameras that ``clod-adapt export`` bakes for, and the files that it writes."""

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory

from clod_adapter.bake import bake
from clod_adapter.calibration import Viewpoint
from clod_adapter.cameras import Camera, spread
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.level_errors import geometric_errors, looking
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.io.file_formats import WRITABLE, write
from clod_adapter.io.formats.splat_transform import SplatTransform, cutting_options, time_limit
from clod_adapter.io.formats.tileset import write_tileset
from clod_adapter.metrics import psnr
from clod_adapter.render import render
from clod_adapter.training.camera_placement import place_cameras
from clod_adapter.viewer.page import write_viewer_page

from ..shared.console import Console, duration
from ..shared.inputs import named, prepare_kernels, read_cameras

PLACED = 16  # cameras placed where none are known
COMPARED = 4  # views on which a page is compared with the exact values


def find_cameras(args: Namespace, model: Checkpoint, console: Console) -> tuple[Sequence[Camera | Viewpoint], str]:
    """The cameras of --camera, --images or the model's file, else placed ones; and what they are."""
    if args.images is not None:
        cameras = read_cameras(model, args.images, console, training=args.camera is None)
        if args.camera is None:
            return cameras, f"{len(cameras)} training cameras"
        found = named(cameras, args.camera, "--camera")
        if len(found) > 1:
            both = f"{found[0].name} and {found[1].name}"
            raise ClodError(f"--camera: {args.camera!r} matches {both}; give the full name")
        return found, "one camera"
    if model.viewpoints:
        return model.viewpoints, f"{len(model.viewpoints)} training cameras"
    try:
        with console.meter("placing cameras") as meter:
            cameras = place_cameras(model.gaussians, views=PLACED, progress=meter)
    except ClodError as error:
        raise ClodError(f"{model.path}: no cameras stored to bake for, and {error}; give --images") from error
    placed = f"baked for {len(cameras)} placed ones; --images gives a better result"
    console.note(f"{model.path} stores no cameras: {placed}")
    return cameras, f"{len(cameras)} placed cameras"


@dataclass(frozen=True)
class Export:
    """A model and how to write it.

    Attributes:
        model: as read; gaussians: the model's, sorted with ``--order``.
        cameras: to bake for, empty where nothing is baked; about: these cameras, in printable ASCII.
        views: cameras of the scene, for a page.
    """

    args: Namespace
    model: Checkpoint
    gaussians: Gaussians
    cameras: Sequence[Camera | Viewpoint]
    about: str
    views: list[Camera]
    console: Console

    @property
    def camera(self) -> Camera | None:
        """The one of ``--camera``, for which the result is exact."""
        return next((each for each in self.cameras if isinstance(each, Camera) and self.args.camera is not None), None)

    def content(self, virtual_scale: float | None) -> tuple[Gaussians, tuple[str, ...]]:
        """The Gaussians of one file, baked if there is a dial value; and its comments, those of the model first."""
        about, gaussians, camera = [*self.model.comments], self.gaussians, self.camera
        if virtual_scale is not None:
            cameras = f"the camera at {self._position(camera)}: exact from there only" if camera else self.about
            about.append(f"baked at s = {virtual_scale:.6g} by clod-adapter for {cameras}")
            gaussians = bake(gaussians, virtual_scale, camera, cameras=() if camera else self.cameras)
        about += ["rows in the order in which the dial keeps them longest"] if self.args.order else []
        return gaussians, tuple(dict.fromkeys(about))

    def write(self, path: Path, suffix: str, virtual_scale: float | None) -> int:
        """Writes a file, with notes on losses of the format; its number of Gaussians."""
        if suffix == ".html":
            self._write_page(path, virtual_scale)
            return len(self.gaussians)
        gaussians, about = self.content(virtual_scale)
        if suffix not in WRITABLE:
            with TemporaryDirectory(dir=path.parent, prefix=".tmp-") as folder:
                source, packed = Path(folder) / "plain.ply", Path(folder) / f"packed{suffix}"  # suffix: the format
                write(source, gaussians, about)
                self._transform([source], packed, len(gaussians))
                packed.replace(path)
            return len(gaussians)
        calibration = self.model.calibration if virtual_scale is None else None
        for note in write(path, gaussians, about, origin=self.model.origin, calibration=calibration):
            self.console.note(note)
        if suffix == ".ply" and any(self.model.origin):
            self.console.note("x, y and z are doubles, which SIBR and some other readers misread")
        return len(gaussians)

    def write_folder(self, index: Path, levels: list[float]) -> list[int]:
        """Writes a streaming or 3D Tiles set to a new folder; the number of Gaussians per level."""
        index.parent.mkdir()
        contents = [self.content(level) for level in levels]
        found = [gaussians for gaussians, _ in contents]
        counts = [len(gaussians) for gaussians in found]
        if self.args.folder == "--3dtiles":
            prepare_kernels(self.console, found[0].means.device, training=False)
            with self.console.meter("errors of levels") as meter:
                errors = geometric_errors(found, looking(self.cameras), progress=meter)
            for note in write_tileset(index.parent, found, errors.tolist(), origin=self.model.origin):
                self.console.note(note)
            return counts
        with TemporaryDirectory(dir=index.parent) as temporary:
            words: list[str | Path] = [*cutting_options(sum(counts))]
            for k, (gaussians, about) in enumerate(contents):
                source = Path(temporary) / f"{k}.ply"
                write(source, gaussians, about)
                words += [source, "-l", str(k)]
            self._transform(words, index, sum(counts))
        return counts

    def _write_page(self, path: Path, virtual_scale: float | None) -> None:
        """Notes the PSNR of its renders against those of the exact Gaussians."""
        prepare_kernels(self.console, self.gaussians.means.device, training=False)
        shown, losses = write_viewer_page(
            path, self.model, cameras=self.views, virtual_scale=virtual_scale, exact=self.args.exact
        )
        for note in losses:
            self.console.note(note)
        if self.args.exact:
            return
        views = spread(self.views or self.model.cameras or place_cameras(self.gaussians, views=COMPARED), COMPARED)
        with self.console.status("comparing with the exact values ..."):
            found = fmean(psnr(render(shown, each).image, render(self.gaussians, each).pixels) for each in views)
        about = f"renders of the page have a PSNR of {found:.1f} dB against the exact file ({len(views)} views, s = 1)"
        self.console.note(f"{about}; --exact keeps all digits")

    def _transform(self, words: list[str | Path], out: Path, count: int) -> None:
        tool = SplatTransform.find()
        text = f"splat-transform packs {count:,} Gaussians"
        with self.console.status(f"{text} ...") as show:
            limit = time_limit(count)
            seconds = tool.run(*words, out, timeout=limit, progress=lambda s: show(f"{text}, {duration(s)} so far"))
        self.console.say(f"splat-transform {tool.version} took {duration(seconds)}")
        self.console.note("splat-transform rounds values and sorts the Gaussians")
        if any(self.model.origin):
            self.console.note("coordinates are relative to the model's origin, which is dropped")
        if not tool.gpu and self.gaussians.sh_degree > 0 and out.suffix != ".ply":
            self.console.note("splat-transform runs without a GPU: its palette of spherical harmonics is coarser")

    def _position(self, camera: Camera) -> str:
        place = camera.position.double().tolist()
        return f"({', '.join(f'{x + by:.9g}' for x, by in zip(place, self.model.origin, strict=True))})"
