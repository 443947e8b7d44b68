"""What ``clod-adapt export`` writes, by the suffix of its output; without torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import WRITABLE

LOD_META = "lod-meta.json"
PAGE = ".html"


@dataclass(frozen=True)
class Format:
    """A format as --help has it.

    Attributes:
        about: what becomes of the values, lines of at most 54 letters.
        ordered: whether the rows stay in their order.
        sigma: whether it carries sigma_d; if not, a dial value has to be baked.
    """

    about: tuple[str, ...]
    ordered: bool = True
    sigma: bool = True


# Those that splat-transform packs. Their rows follow a space-filling curve.
PACKED = {
    ".sog": Format(("8 to 16 bits, SH from a palette; by splat-transform",), ordered=False, sigma=False),
    ".compressed.ply": Format(("8 to 11 bits; by splat-transform",), ordered=False, sigma=False),
}
FORMATS = {
    ".ply": Format(("exact; baked, in Inria's layout, which SIBR reads",)),
    ".glb": Format(("float32's rounding, SH degree 3 at most", "(KHR_gaussian_splatting, _SIGMA_D)")),
    ".spz": Format(("6 to 24 bits, SH degree 3 at most, sigma_d half floats",)),
    ".safetensors": Format(("exact; for Python",)),
    ".pt": Format(("exact; as gsplat's trainer saves its own",)),
    ".splat": Format(("8 bits, no view-dependent colour",), ordered=False, sigma=False),
    **PACKED,
    PAGE: Format(
        ("the viewer with the splat in it, one file to send;", "exact, or by splat-transform 8 to 16 bits"),
        ordered=False,
    ),
}


def suffixes() -> list[str]:
    """Those that can be written."""
    return [suffix for suffix in FORMATS if suffix in WRITABLE or suffix in PACKED or suffix == PAGE]


def format_table() -> str:
    """The formats for --help."""
    lines = []
    for suffix in suffixes():
        first, *more = FORMATS[suffix].about
        lines.append(f"  {suffix:<17}{'kept' if FORMATS[suffix].sigma else '-':<6}{first}")
        lines += [f"{'':25}{line}" for line in more]
    return "\n".join(lines)


def suffix_of(out: Path) -> str:
    """The suffix that says what is written to ``out``.

    Raises:
        ClodError: none of them does.
    """
    found = [suffix for suffix in suffixes() if out.name.lower().endswith(suffix) and len(out.name) > len(suffix)]
    if not found:
        raise ClodError(f"{out}: --out must end in one of {', '.join(suffixes())}, which says what to write")
    return max(found, key=len)  # .compressed.ply ends in .ply


def level_paths(out: Path, levels: Sequence[float]) -> list[Path]:
    """``out`` with ``_s2`` before its suffix for each dial value."""
    suffix = out.name[-len(suffix_of(out)) :]
    return [out.with_name(f"{out.name.removesuffix(suffix)}_s{level:g}{suffix}") for level in levels]
