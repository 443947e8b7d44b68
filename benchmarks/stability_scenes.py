"""Extreme scenes, each adapted for 200 steps and rendered over its dial: all finite, and no loss of quality.

The cases are those of ``extreme_scenes.py``. A case holds when every picture over the dial is finite and the
full-quality end is at most 0.3 dB below the checkpoint itself on the same held-out views.
"""

from __future__ import annotations

import time
from typing import Any

import clod_adapter as clod
from clod_adapter.training.pseudo_views import add_pseudo_views
from common import checkpoint, photographs, table
from extreme_scenes import CAPTURE, CASES, Case

STEPS, ALLOWED = 200, 0.3  # dB


def measure() -> list[dict[str, Any]]:
    base, scene = checkpoint(CAPTURE).gaussians, photographs(CAPTURE)
    rows = [run(name, make(base, scene)) for name, make in CASES.items()]
    try:  # settings that cannot work
        clod.AdaptConfig(max_sv=100.0)
    except clod.ClodError as error:
        return [*rows, {"part": "scenes", "case": "max_sv 100 with the default tau", "error": str(error)}]
    raise AssertionError("max_sv 100 with the default tau was not refused")


def run(name: str, case: Case) -> dict[str, Any]:
    started = time.perf_counter()
    scene, config = add_pseudo_views(case.base, case.scene, clod.AdaptConfig(**{"iters": STEPS, **case.settings}))
    adapted = clod.adapt(case.base, scene, config)
    seconds = time.perf_counter() - started
    result = clod.extract(case.base, adapted.gaussians, fingerprint="", config={}).apply(case.base)
    dials = sorted({1.0, config.max_sv**0.5, config.max_sv})
    base_psnr = clod.evaluate(case.base, case.scene.test, [1.0])[0].psnr
    rows = clod.evaluate(result, case.scene.test, dials)
    finite = all(
        bool(clod.render(result, view.camera, s).image.isfinite().all()) for view in case.scene.test[:1] for s in dials
    ) and all(bool(tensor.isfinite().all()) for tensor in result.tensors().values())
    attenuation = result.attenuation
    assert attenuation is not None
    return {
        "part": "scenes", "case": name, "finite": finite, "base_psnr": base_psnr, "tau": attenuation.tau,
        "rows": [{"virtual_scale": r.virtual_scale, "psnr": r.psnr, "kept_share": r.kept_share} for r in rows],
        "holds": finite and rows[0].psnr >= base_psnr - ALLOWED, "seconds": round(seconds, 1),
    }  # fmt: skip


def tables(rows: list[dict[str, Any]]) -> str:
    """PSNR @ share kept at both ends of the dial, and which cases hold."""
    lines, refused = [], [f"{row['case']}: `{row['error']}`" for row in rows if "error" in row]
    for row in (row for row in rows if "error" not in row):
        ends = [f"{r['psnr']:.2f} @ {r['kept_share']:.0%}" for r in (row["rows"][0], row["rows"][-1])]
        marks = ["yes" if row[key] else "**no**" for key in ("finite", "holds")]
        lines.append([row["case"], f"{row['base_psnr']:.2f}", *ends, *marks, row["seconds"]])
    found = table(["scene", "base", "s = 1", "far end", "finite", "holds", "seconds"], lines)
    return "\n\n".join([found, f"{sum(line[5] == 'yes' for line in lines)} of {len(lines)} hold", *refused])
