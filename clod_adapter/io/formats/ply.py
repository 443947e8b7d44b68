"""Writes Gaussians without a base as a PLY: Inria's layout, and the columns of the dial where they have one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from clod_adapter.gaussians import OPAQUE, Gaussians
from clod_adapter.io.checkpoint import blank, save
from clod_adapter.io.file_formats import History
from clod_adapter.io.formats.arrays import arrays_of


def write_ply(path: Path, gaussians: Gaussians, history: History) -> tuple[str, ...]:
    """Writes every value unchanged but opacity = +inf, ``about`` as comments; else as ``file_formats.write``."""
    arrays_of(path, gaussians)  # refuses rows that load would drop
    base = replace(blank(len(gaussians), gaussians.sh_degree, history.origin), comments=history.about)
    opaque = gaussians.opacity_logits == torch.inf
    finite = torch.where(opaque, torch.full_like(gaussians.opacity_logits, OPAQUE), gaussians.opacity_logits)
    save(path, gaussians.replace(opacity_logits=finite), base, calibration=history.calibration)
    return (f"{int(opaque.sum())} opacities of +inf are written as {OPAQUE:g}, which is 1 too",) if opaque.any() else ()
