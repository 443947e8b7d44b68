"""The formats that ``clod-adapt export`` writes, and the names of its files."""

from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

from clod_adapter import ClodError
from clod_adapter.io.file_formats import WRITABLE, Format

PAGE = ".html"
# written by splat-transform
CONVERTED = {
    ".glb": Format(about=("float32 (KHR_gaussian_splatting); by splat-transform",)),
    ".sog": Format(about=("8 to 16 bits, SH from a palette; by splat-transform",)),
    ".compressed.ply": Format(about=("8 to 11 bits; by splat-transform",)),
}
FORMATS = {
    **WRITABLE,
    **CONVERTED,
    PAGE: Format(
        about=("the viewer with the splat, in one file;", "as .spz, or with --exact as float32"),
        carries_sigma=True,
    ),
}
# formats in which every reader finds the screen-space filter
STORE_FILTER = (".spz", PAGE)
AGREE = 45.0  # dB between the renders of two SH degrees that look alike
# options that make OUT a folder, and its index
FOLDERS = {"--lod-meta": "lod-meta.json", "--3dtiles": "tileset.json"}


def suffix_of(out: Path) -> str:
    """The known suffix of ``out``, in lower case."""
    found = [
        suffix
        for suffix in FORMATS
        if out.name.lower().endswith(suffix) and len(out.name) > len(suffix)
    ]
    if not found:
        raise ClodError(
            f"{out}: --out must end in one of {', '.join(FORMATS)}, which is the format"
        )
    return max(found, key=len)  # .compressed.ply ends in .ply


def is_page(args: Namespace) -> bool:
    return Path(args.out).suffix.lower() == PAGE


def level_paths(out: Path, levels: Sequence[float]) -> list[Path]:
    suffix = out.name[-len(suffix_of(out)) :]
    return [
        out.with_name(f"{out.name.removesuffix(suffix)}_s{level:g}{suffix}") for level in levels
    ]
