"""The files of an export: one of them as it is written, and as a reader finds it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from clod_adapter.bake import bake
from clod_adapter.cameras import Camera
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.checkpoint import Checkpoint, load
from clod_adapter.io.file_formats import write
from clod_adapter.io.formats.splat_transform import SplatTransform, time_limit
from clod_adapter.io.ply.header import PREFIX
from clod_adapter.origin import NOWHERE
from clod_adapter.viewer.page import write_page

from ..commands.export_formats import LOD_META, PACKED, PAGE, suffix_of
from ..shared.console import Console, duration
from .baking import Target


@dataclass(frozen=True)
class Export:
    """What is written from where.

    Attributes:
        model: as read.
        gaussians: the model's, in the order asked for.
        target: the cameras that are baked for.
        cameras: of the scene, for a page to jump between.
        ordered: whether the rows have been put in order.
        console: for splat-transform's progress.
    """

    model: Checkpoint
    gaussians: Gaussians
    target: Target
    cameras: list[Camera]
    ordered: bool
    console: Console

    def piece(self, virtual_scale: float | None) -> tuple[Gaussians, tuple[str, ...]]:
        """The Gaussians of one file, baked if there is a dial value; lines on how they came about, its own too."""
        about = [comment for comment in self.model.comments if not comment.startswith(PREFIX)]
        gaussians = self.gaussians
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

    def candidate(self, out: Path, virtual_scale: float) -> Gaussians:
        """What a reader finds in the file of a dial value; what splat-transform rounds is not rounded yet."""
        suffix = suffix_of(out)
        if suffix in PACKED:
            return self.piece(virtual_scale)[0]
        with TemporaryDirectory(dir=out.parent, prefix=".tmp-") as folder:
            path = Path(folder) / f"candidate{suffix}"
            self.write(path, suffix, virtual_scale)
            return self.read_back(path, suffix)

    def read_back(self, path: Path, suffix: str) -> Gaussians:
        """What is in a file that was written, where the model is."""
        origin = NOWHERE if suffix in (".splat", *PACKED) else self.model.origin
        return load(path, origin=origin).gaussians.to(self.gaussians.means.device)

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

    def _position(self, camera: Camera) -> str:
        place = camera.position.double().tolist()
        return f"({', '.join(f'{x + by:.9g}' for x, by in zip(place, self.model.origin, strict=True))})"


@contextmanager
def ticking(console: Console, text: str) -> Iterator[Callable[[float], None]]:
    """Shows the seconds that a part takes whose length is not known."""
    with console.status(f"{text} ...") as show:
        yield lambda seconds: show(f"{text}, {duration(seconds)} so far")
