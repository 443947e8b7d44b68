"""``clod-adapt inspect``: the kind and contents of a file, on one screen."""

from __future__ import annotations

import textwrap
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING

from clod_adapter.io.file_formats import check_readable
from clod_adapter.io.settings import WARNING

from .shared.command import add_input
from .shared.outputs import Report, size

if TYPE_CHECKING:
    from clod_adapter import QualityTable
    from clod_adapter.inspection.report import Inspection
    from clod_adapter.inspection.statistics import Splat, Spread

WIDTH = 13  # of the labels
MOST_LINES = 6  # under one label
LONGEST = 100  # characters of a comment


def add_arguments(parser: ArgumentParser) -> None:
    add_input(parser, "file", "FILE", "a splat")
    parser.set_defaults(quiet=True)


def check(args: Namespace) -> None:
    check_readable(Path(args.file))


def execute(args: Namespace) -> Report:
    from clod_adapter.inspection.report import inspect

    found = inspect(args.file)
    print("\n".join(lines_of(found)))
    return found.as_dict()


def lines_of(found: Inspection) -> list[str]:
    lines = [f"{found.path} ({size(Path(found.path))})", _line("what", found.what)]
    if found.writer:
        ours = found.writer.startswith("clod-adapter")
        lines.append(_line("written by" if ours else "looks like", found.writer))
    lines += splat_lines(found.splat)
    lines += _block("anomaly", [anomaly.says for anomaly in found.anomalies])
    lines += _block("excluded", found.left_out)
    warnings = [note for note in found.notes if note.startswith(WARNING)]
    lines += _block("note", [note for note in found.notes if note not in warnings])
    return lines + _block("warning", [warning.removeprefix(WARNING) for warning in warnings])


def splat_lines(splat: Splat) -> list[str]:
    count = f"{splat.count:,}"
    if splat.count < splat.total:
        count += f" usable of {splat.total:,}"
    degree = f"degree {splat.sh_degree}"
    if splat.used_sh_degree < splat.sh_degree:
        degree += f", of which only {splat.used_sh_degree} is used"
    lines = [_line("Gaussians", count), _line("harmonics", degree)]
    if splat.encoding:
        names = textwrap.shorten(", ".join(splat.extra), 80, placeholder=" ...")
        more = f", not read: {names}" if names else ""
        lines.append(_line("layout", f"{splat.encoding}, {len(splat.columns)} properties{more}"))
    lines += _block("says", [comment[:LONGEST] for comment in splat.comments])
    rows: list[tuple[str, Spread | None]] = [
        *zip("xyz", splat.position, strict=True),
        ("scale", splat.scale),
        ("opacity", splat.opacity),
    ]
    rows += [("sigma_d", splat.sigma), ("growth_d", splat.growth)]
    lines += spread_table(rows)
    shares = f"{splat.fainter_than_visible:.1%} fainter than 1/255; {splat.needles:.1%} needles"
    lines.append(_line("shares", shares))
    if splat.dial is None:
        return [*lines, _line("dial", "none: no sigma_d")]
    attenuation = splat.dial.attenuation
    form = "the paper's form" if attenuation.form == "paper" else "distances in world units"
    settings = f"{splat.dial_columns}, s = 1 to {attenuation.max_sv:g}, {form}"
    lines.append(_line("dial", settings))
    return lines + quality_lines(splat.dial.calibration)


def spread_table(rows: Sequence[tuple[str, Spread | None]]) -> list[str]:
    """A table of those that there are, between empty lines."""
    lines = ["", _line("", ("{:>11}" * 5).format("least", "1 %", "median", "99 %", "greatest"))]
    numbers = "{:>11.4g}" * 5
    lines += [_line(name, numbers.format(*astuple(spread))) for name, spread in rows if spread]
    return [*lines, ""]


def quality_lines(quality_table: QualityTable | None) -> list[str]:
    """The quality table of the file."""
    if quality_table is None:
        return [_line("quality", "none, so --fps and --psnr-drop cannot be solved from it")]
    about = (
        f"against {quality_table.against}, {quality_table.views} views of"
        f" {quality_table.width}x{quality_table.height}, on {quality_table.machine}"
    )
    lines = [
        _line("quality", about),
        _line("", f"{'s':>6}{'Gaussians':>12}{'PSNR':>9}{'SSIM':>8}{'frame ms':>10}"),
    ]
    numbers = "{:>6.3g}{:>12,.0f}{:>9.2f}{:>8.3f}{:>10.1f}"
    return lines + [_line("", numbers.format(*astuple(row))) for row in quality_table.rows]


def _block(name: str, says: Sequence[str]) -> list[str]:
    lines = [_line(name if k == 0 else "", line) for k, line in enumerate(says[:MOST_LINES])]
    if len(says) > MOST_LINES:
        lines.append(_line("", f"and {len(says) - MOST_LINES} more: --json"))
    return lines


def _line(name: str, says: str) -> str:
    return f"{name:<{WIDTH}}{''.join(c if c.isprintable() else ' ' for c in says)}"


DESCRIPTION = "Print what a file is, who wrote it, what is in it, and what adapting excludes."
USAGE = "FILE [--json]"
EPILOG = """\
FILE can be a PLY, gsplat's .pt, an .spz, and, with splat-transform installed,
a compressed PLY, .sog, .splat or .ksplat.

  looks like   by comments of the file
  needle       a Gaussian more than 10 times as long as its second axis

examples:
  clod-adapt inspect garden.ply
  clod-adapt inspect garden_clod.ply --json
"""
