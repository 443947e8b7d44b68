"""``clod-adapt bake``: one dial value as a plain file, for viewers that do not know the dial."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from clod_adapter.cli.budgets import solve_dials
from clod_adapter.cli.console import Console
from clod_adapter.cli.evaluate import choose_dials
from clod_adapter.cli.files import size
from clod_adapter.cli.inputs import read_checkpoint
from clod_adapter.config import AttenuationConfig
from clod_adapter.export import bake
from clod_adapter.io.ply import blank, save
from clod_adapter.io.version import package_version


def run(args: argparse.Namespace) -> dict[str, Any]:
    console = Console(args.quiet)
    model = read_checkpoint(args.model, console, args.activated)
    attenuation = model.gaussians.attenuation
    assert attenuation is not None  # check_bake has seen to it
    solved, notes = solve_dials(args, model, (), console)
    assert solved is not None  # one option is required
    (virtual_scale,), beyond = choose_dials(solved, attenuation)
    notes += beyond
    for note in notes:
        console.say(note)
    baked = bake(model.gaussians, virtual_scale)
    about = f"baked at s = {virtual_scale:.6g} and d' = 1 by clod-adapter: exact at one distance only"
    base = replace(blank(len(baked), baked.sh_degree, model.origin), comments=(about,))
    save(args.out, baked, base)
    print(
        f"wrote {args.out} ({size(Path(args.out))}): {len(baked):,} of {len(model.gaussians):,} Gaussians, "
        f"s = {virtual_scale:.5g}\n"
        f"exact {where(attenuation)} only, and lossy: the dial and the other Gaussians are gone"
    )
    return {
        "command": "bake", "version": package_version(), "model": args.model, "virtual_scale": virtual_scale,
        "base_count": len(model.gaussians), "kept": len(baked), "notes": [*model.notes, *notes],
        "outputs": {"ply": args.out},
    }  # fmt: skip


def where(attenuation: AttenuationConfig) -> str:
    """The normalised distance 1 in words."""
    if attenuation.normalizer == "scene":
        return f"at {attenuation.scene_distance:.4g} world units from the camera"
    return "at the distance that the picture's own are divided by"
