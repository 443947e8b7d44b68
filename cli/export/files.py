"""Writes the files of an export, and reads them back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from clod_adapter.bake import bake
from clod_adapter.cameras import Camera
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.geometric_error import geometric_errors
from clod_adapter.evaluation.level_errors import level_errors, looking
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.checkpoint import Checkpoint, load
from clod_adapter.io.file_formats import write
from clod_adapter.io.formats.lod_meta import cutting_options, read_leaves, write_errors
from clod_adapter.io.formats.splat_transform import SplatTransform, time_limit
from clod_adapter.io.formats.tileset import write_tileset
from clod_adapter.origin import NOWHERE
from clod_adapter.viewer.page import write_viewer_page

from ..commands.export_formats import LOD_META, PACKED, PAGE, suffix_of
from ..shared.console import Console, duration
from ..shared.inputs import prepare_kernels
from .baking import Target
from .packing import packing_bar, page_psnr


@dataclass(frozen=True)
class Export:
    """A model and how to write it.

    Attributes:
        model: as read.
        gaussians: the model's, sorted if ``ordered``.
        target: the cameras to bake for.
        cameras: of the scene, for the views of a page.
        ordered: whether the rows are sorted by extinction.
        exact: whether a page has float32 values.
        console: for splat-transform's progress.
    """

    model: Checkpoint
    gaussians: Gaussians
    target: Target
    cameras: list[Camera]
    ordered: bool
    exact: bool
    console: Console

    def content(self, virtual_scale: float | None) -> tuple[Gaussians, tuple[str, ...]]:
        """The Gaussians of one file, baked if there is a dial value; and its comments, those of the model first."""
        about, gaussians = [*self.model.comments], self.gaussians
        if virtual_scale is not None:
            baked, camera = f"baked at s = {virtual_scale:.6g} by clod-adapter", self.target.camera
            if camera:
                about.append(f"{baked} for the camera at {self._position(camera)}: exact from there only")
                gaussians = bake(gaussians, virtual_scale, camera)
            else:
                about.append(f"{baked} for {self.target.about}")
                gaussians = bake(gaussians, virtual_scale, cameras=self.target.cameras)
        about += ["rows in the order in which the dial keeps them longest"] if self.ordered else []
        return gaussians, tuple(dict.fromkeys(about))

    def write(self, path: Path, suffix: str, virtual_scale: float | None) -> tuple[int, tuple[str, ...]]:
        """Writes a file; its number of Gaussians, and notes on losses of the format."""
        if suffix == PAGE:
            return len(self.gaussians), self._write_page(path, virtual_scale)
        gaussians, about = self.content(virtual_scale)
        if suffix in PACKED:
            return len(gaussians), self._pack(path, suffix, gaussians, about)
        calibration = self.model.calibration if virtual_scale is None else None
        notes = write(path, gaussians, about, origin=self.model.origin, calibration=calibration)
        if suffix == ".ply" and any(self.model.origin):
            notes += ("x, y and z are doubles, which SIBR and some other readers misread",)
        return len(gaussians), notes

    def candidate(self, out: Path, virtual_scale: float) -> Gaussians:
        """The Gaussians in the file of a dial value, as read back; without the rounding of splat-transform."""
        suffix = suffix_of(out)
        if suffix in PACKED:
            return self.content(virtual_scale)[0]
        with TemporaryDirectory(dir=out.parent, prefix=".tmp-") as folder:
            path = Path(folder) / f"candidate{suffix}"
            self.write(path, suffix, virtual_scale)
            return self.read_back(path, suffix)

    def read_back(self, path: Path, suffix: str) -> Gaussians:
        """The Gaussians of a written file, on the model's device and relative to its origin."""
        origin = NOWHERE if suffix in (".splat", *PACKED) else self.model.origin
        return load(path, origin=origin).gaussians.to(self.gaussians.means.device)

    def write_levels(self, folder: Path, levels: list[float]) -> tuple[list[int], tuple[str, ...]]:
        """Writes a streaming set to ``folder``; the number of Gaussians per level, and notes."""
        folder.mkdir()
        contents = [self.content(level) for level in levels]
        counts = [len(gaussians) for gaussians, _ in contents]
        with TemporaryDirectory(dir=folder) as temporary:
            words: list[str | Path] = [*cutting_options(sum(counts))]
            for k, (gaussians, about) in enumerate(contents):
                source = Path(temporary) / f"{k}.ply"
                write(source, gaussians, about)
                words += [source, "-l", str(k)]
            notes = self._transform(words, folder / LOD_META, sum(counts))
        return counts, notes + self._add_errors(folder / LOD_META, [gaussians for gaussians, _ in contents])

    def write_tiles(self, folder: Path, levels: list[float]) -> tuple[list[int], tuple[str, ...]]:
        """Writes a 3D Tiles set to ``folder``; the number of Gaussians per level, and notes."""
        folder.mkdir()
        contents = [self.content(level)[0] for level in levels]
        prepare_kernels(self.console, contents[0].means.device, training=False)
        with self.console.meter("errors of levels") as meter:
            errors = geometric_errors(contents, looking(self.target.cameras, contents[-1]), progress=meter)
        notes = write_tileset(folder, contents, errors.tolist(), origin=self.model.origin)
        return [len(each) for each in contents], notes

    def _add_errors(self, index: Path, levels: list[Gaussians]) -> tuple[str, ...]:
        """Adds the leaves' errors at each level to a streaming set; a note if its leaves are unknown."""
        try:
            meta, leaves = read_leaves(index, [level.means.cpu().numpy() for level in levels])
        except ClodError as error:
            return (f"without tables of errors, viewers judge levels by their counts: {error}",)
        prepare_kernels(self.console, levels[0].means.device, training=False)
        with self.console.meter("errors of levels") as meter:
            errors = level_errors(levels, leaves, looking(self.target.cameras, levels[-1]), progress=meter)
        write_errors(index, meta, leaves, errors.tolist())
        return ()

    def _write_page(self, path: Path, virtual_scale: float | None) -> tuple[str, ...]:
        """Writes the page; notes on its losses."""
        prepare_kernels(self.console, self.gaussians.means.device, training=False)
        shown, losses = write_viewer_page(
            path, self.model, cameras=self.cameras, virtual_scale=virtual_scale, exact=self.exact
        )
        if self.exact:
            return ()
        cameras = self.cameras or self.model.cameras
        found, views = page_psnr(shown, self.gaussians, cameras, self.console)
        note = f"renders of the page have a PSNR of {found:.1f} dB against the exact file ({views} views, s = 1)"
        return (*losses, f"{note}; --exact keeps all digits")

    def _pack(self, path: Path, suffix: str, gaussians: Gaussians, about: tuple[str, ...]) -> tuple[str, ...]:
        with TemporaryDirectory(dir=path.parent, prefix=".tmp-") as folder:
            source, packed = (
                Path(folder) / "plain.ply",
                Path(folder) / f"packed{suffix}",
            )  # the tool tells formats by their suffix
            write(source, gaussians, about)
            notes = self._transform([source], packed, len(gaussians))
            with atomic_path(path) as temporary:
                packed.replace(temporary)
        return notes

    def _transform(self, words: list[str | Path], out: Path, count: int) -> tuple[str, ...]:
        tool = SplatTransform.find()
        with packing_bar(self.console, count) as tick:
            seconds = tool.run(*words, out, timeout=time_limit(count), progress=tick)
        self.console.say(f"splat-transform {tool.version} took {duration(seconds)}")
        notes = ["splat-transform rounds values and sorts the Gaussians"]
        if any(self.model.origin):
            notes.append("coordinates are relative to the model's origin, which is dropped")
        if not tool.gpu and self.gaussians.sh_degree > 0 and out.suffix != ".ply":
            notes.append("splat-transform runs without a GPU: its palette of spherical harmonics is coarser")
        return tuple(notes)

    def _position(self, camera: Camera) -> str:
        place = camera.position.double().tolist()
        return f"({', '.join(f'{x + by:.9g}' for x, by in zip(place, self.model.origin, strict=True))})"
