"""Output files: their names; compared with existing files and inputs, and locked, before a command
begins; reports.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from clod_adapter import ClodError
from clod_adapter._support.text import as_text
from clod_adapter.io.atomic import atomic_path, check_target, output_lock, remove_leftovers
from clod_adapter.io.file_formats import check_suffix, read_source
from clod_adapter.io.ranks import ranks_of
from clod_adapter.io.scene.folder import scene_files

# What --json prints, and parts of it.
Report = dict[str, Any]


@dataclass(frozen=True)
class AdaptFiles:
    """The three output files of adapting."""

    ply: Path
    adapter: Path
    report: Path

    @classmethod
    def of(cls, checkpoint: str, out: str | None) -> AdaptFiles:
        ply = Path(out or f"{Path(checkpoint).stem}_clod.ply")
        return cls(ply, ply.with_suffix(".safetensors"), ply.with_suffix(".json"))

    @property
    def state(self) -> Path:
        """The state for ``--resume``; exists only until the run is finished."""
        return self.ply.with_suffix(".resume.safetensors")


def check_ply_name(path: Path, option: str) -> None:
    if path.suffix.lower() != ".ply":
        raise ClodError(f"{path}: {option} names the PLY to write, so it must end in .ply")
    check_suffix(path)  # .compressed.ply


def labels(paths: Sequence[str]) -> list[str]:
    """A distinct label per file: its stem, with the folder's name where two stems are equal."""
    resolved = [Path(path).resolve() for path in paths]
    stems = [path.stem for path in resolved]
    names = [f"{p.parent.name}_{p.stem}" if stems.count(p.stem) > 1 else p.stem for p in resolved]
    for k, path in enumerate(paths):
        if resolved[k] in resolved[:k]:
            raise ClodError(f"{path}: is given twice")
        if names[k] in names[:k]:
            raise ClodError(
                f"{path}: has the same name as {paths[names.index(names[k])]}; rename one of them"
            )
    return names


def size(of: Path | int) -> str:
    """The size of a file, or a number of bytes, as text: ``4 kB``, ``12.3 MB``, ``3.1 GB``."""
    count = of if isinstance(of, int) else of.stat().st_size
    if count >= 1e9:
        return f"{count / 1e9:.1f} GB"
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{max(count / 1e3, 1):.0f} kB"


def jsonable(value: Any) -> Any:
    """``value`` with numbers that JSON cannot represent (an infinite PSNR) as null, and file names
    as text.
    """
    if isinstance(value, dict):
        return {jsonable(key): jsonable(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(entry) for entry in value]
    if isinstance(value, str | Path):
        return as_text(str(value))
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_report(path: Path, report: Report) -> None:
    with atomic_path(path) as temporary:
        text = json.dumps(jsonable(report), indent=2, allow_nan=False, ensure_ascii=False)
        temporary.write_text(text + "\n", encoding="utf-8")


# Found at the beginning of the files that clod-adapt writes: in PLY comments, metadata, pages,
# reports and tables. An .spz is compressed; what splat-transform writes has no such text.
OURS = re.compile(rb'clod[-_]adapter|\A\{\s+"(command|checkpoint)": "|\Acheckpoint,max_sv,')
# The same of the files that adapting writes beside its PLY: adapter, state, report and page.
BESIDE = re.compile(
    rb'\\"clod-adapter\\"|clod_adapter_state|\A\{\s+"command": "adapt"|, adaptation report'
)
SUFFIXES = (".safetensors", ".resume.safetensors", ".json", ".html")  # of these files
BEGINNING = 1 << 16  # bytes


@dataclass(frozen=True)
class Outputs:
    """What a command writes, and what it reads."""

    named: Sequence[Path] = ()  # files named on the command line; existing ones are replaced
    # files named after these; existing ones are replaced if clod-adapt wrote them
    derived: Sequence[Path] = ()
    # made if missing; the first is locked in place of the files, and contains the others
    folders: Sequence[Path] = ()
    whole: bool = False  # whether ``named`` is a new folder, not a file
    inputs: Sequence[str] = ()  # files named to be read
    scene: str | None = None  # a scene folder, all of whose files are inputs (``scene_files``)

    @property
    def files(self) -> tuple[Path, ...]:
        return *self.named, *self.derived


@contextmanager
def claimed(outputs: Outputs) -> Iterator[None]:
    """Checks the outputs, and in the body holds their locks; there the folders exist, afterwards no
    empty one.
    """
    check_outputs(outputs)
    with ExitStack() as stack:
        for folder in outputs.folders:
            for parent in (*reversed(folder.parents), folder):
                if not parent.exists():
                    stack.callback(_remove_empty, parent)
            make_folder(folder)
        for folder in outputs.folders[:1]:
            stack.enter_context(output_lock(folder / "outputs", of=folder))
        for path in () if outputs.folders else outputs.files:
            stack.enter_context(output_lock(path))
        for path in outputs.files:
            remove_leftovers(path)
        yield


def check_outputs(outputs: Outputs) -> None:
    """Refuses outputs that cannot be written, or would replace an input, what is beside it, or a
    foreign file.
    """
    for folder in outputs.folders:
        parent = next(parent for parent in (folder, *folder.parents) if parent.exists())
        if not parent.is_dir():
            raise ClodError(f"{folder}: {parent} is a file; choose another --out")
        if not os.access(parent, os.W_OK | os.X_OK):
            raise ClodError(f"{folder}: folder {parent} is not writable; choose another --out")
    for path in outputs.files:
        if path.parent.exists() or not set(outputs.folders) & set(path.parents):
            check_target(path)
        if path.is_dir() and not outputs.whole:
            raise ClodError(f"{path}: is a folder; give the name of a file in it")
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise ClodError(f"{path}: is no regular file; choose another output")
    taken = {key: path for path in outputs.files if (key := _key(path))}
    for file, what in _inputs(outputs) if taken else ():
        if (key := _key(file)) in taken:
            other = "" if os.path.abspath(file) == os.path.abspath(taken[key]) else f" ({file})"
            raise ClodError(
                f"{taken[key]}: is {what}{other}, which is never overwritten; choose another output"
            )
    for path in outputs.derived:
        if path.exists() and not _is_ours(path):
            raise ClodError(
                f"{path}: exists, and clod-adapt did not write it; move it, or choose another"
                " output"
            )


def _inputs(outputs: Outputs) -> Iterator[tuple[Path, str]]:
    """The files that must not be overwritten, and what they are."""
    for file in map(Path, outputs.inputs):
        yield from ((each, "an input file") for each in (file, *ranks_of(file).values()))
        for name, suffix in product((file, file.resolve()), SUFFIXES):
            beside = name.with_suffix(suffix)
            if BESIDE.search(_beginning(beside)):
                yield beside, "the adapter, state or report of an input"
    if outputs.scene is not None:
        yield from ((file, "an input file") for file in scene_files(Path(outputs.scene)))


def _key(path: Path) -> tuple[int, int] | None:
    """Equal for two names of one file."""
    with suppress(OSError, ValueError):  # does not exist, or no valid name
        found = os.stat(path)
        return found.st_dev, found.st_ino
    return None


def _is_ours(path: Path) -> bool:
    """Whether clod-adapt wrote the file; True of an empty one."""
    start = _beginning(path)
    if path.suffix.lower() != ".spz":
        return not start or OURS.search(start) is not None
    with suppress(ClodError):
        return read_source(path).metadata.described
    return not start


def _beginning(path: Path) -> bytes:
    if not path.is_file():
        return b""
    with open(path, "rb") as file:
        return file.read(BEGINNING)


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):  # it is not empty, or could not be made
        folder.rmdir()


def make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ClodError(
            f"{folder}: cannot be made ({error.strerror or error}); choose another --out"
        ) from error
