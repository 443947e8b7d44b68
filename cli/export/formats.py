"""The output formats of ``clod-adapt export``, by suffix; without torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from clod_adapter.errors import ClodError

LOD_META = "lod-meta.json"
TILESET = "tileset.json"
PAGE = ".html"
STORE_FILTER = (".spz", ".safetensors", PAGE)  # formats in which every reader finds the screen-space filter


@dataclass(frozen=True)
class ExportFormat:
    """A format and its lines in --help.

    Attributes:
        about: precision of the values, lines of at most 54 letters.
        ordered: whether the rows keep their order.
        sigma: whether it stores the dial; if not, a dial value has to be baked.
    """

    about: tuple[str, ...]
    ordered: bool = True
    sigma: bool = True


# Written by splat-transform, which sorts rows along a space-filling curve.
PACKED = {
    ".sog": ExportFormat(("8 to 16 bits, SH from a palette; by splat-transform",), ordered=False, sigma=False),
    ".compressed.ply": ExportFormat(("8 to 11 bits; by splat-transform",), ordered=False, sigma=False),
}
FORMATS = {
    ".ply": ExportFormat(("exact; baked, in Inria's layout",)),
    ".glb": ExportFormat(("float32, SH degree up to 3", "(KHR_gaussian_splatting, _SIGMA_D, _GROWTH_D)")),
    ".spz": ExportFormat(("6 to 24 bits, SH degree up to 3, the dial 16-bit floats",)),
    ".safetensors": ExportFormat(("exact; for Python",)),
    ".pt": ExportFormat(("exact; layout of gsplat's trainer",)),
    ".splat": ExportFormat(("8 bits, SH degree 0",), ordered=False, sigma=False),
    **PACKED,
    PAGE: ExportFormat(
        ("the viewer with the splat, in one file;", "as .spz, or with --exact as float32"),
        ordered=False,
    ),
}


def format_table() -> str:
    """The table of formats for --help."""
    lines = []
    for suffix in FORMATS:
        first, *more = FORMATS[suffix].about
        lines.append(f"  {suffix:<17}{'kept' if FORMATS[suffix].sigma else '-':<6}{first}")
        lines += [f"{'':25}{line}" for line in more]
    return "\n".join(lines)


def suffix_of(out: Path) -> str:
    """The known suffix of ``out``, in lower case.

    Raises:
        ClodError: it has none.
    """
    found = [suffix for suffix in FORMATS if out.name.lower().endswith(suffix) and len(out.name) > len(suffix)]
    if not found:
        raise ClodError(f"{out}: --out must end in one of {', '.join(FORMATS)}, which is the format")
    return max(found, key=len)  # .compressed.ply ends in .ply


def level_paths(out: Path, levels: Sequence[float]) -> list[Path]:
    """``out`` with ``_s2`` before its suffix for each dial value."""
    suffix = out.name[-len(suffix_of(out)) :]
    return [out.with_name(f"{out.name.removesuffix(suffix)}_s{level:g}{suffix}") for level in levels]
