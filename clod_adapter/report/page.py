"""The HTML report of one model: quality and cost by dial value, and error against adapting time.

``page.html`` is its template. Style, script, charts and images are in the file; nothing is loaded from a network.
"""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from os.path import abspath
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from PIL import Image

from clod_adapter._support.text import as_text, script_json
from clod_adapter.io.atomic import atomic_paths
from clod_adapter.report.charts import (
    BASE,
    SIZE,
    Draw,
    Series,
    chart_file,
    draw_rendering,
    draw_training,
    inline_svg,
    series_of,
)  # fmt: skip
from clod_adapter.report.style import new_figure, save_figure

WIDEST = 1000  # pixels; wider pictures are scaled down
QUALITY = 88  # of WebP


@dataclass(frozen=True)
class Picture:
    """An image, ``[H, W, 3]`` uint8 or float in 0..1, with its caption."""

    image: np.ndarray
    title: str
    detail: str = ""

    @property
    def url(self) -> str:
        """The image as WebP in a data: URL, at most WIDEST pixels wide."""
        image, file = self.image, io.BytesIO()
        picture = Image.fromarray(image if image.dtype == np.uint8 else (image.clip(0, 1) * 255).round().astype("u1"))
        if picture.width > WIDEST:
            picture = picture.resize((WIDEST, round(picture.height * WIDEST / picture.width)), Image.Resampling.LANCZOS)
        picture.save(file, "WEBP", quality=QUALITY)
        return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode("ascii")


def own_teacher(report: Mapping[str, Any]) -> bool:
    """Whether the reference of the metrics is renders of the checkpoint, without photographs."""
    return report.get("teacher") == "checkpoint"


def write_page(
    path: str | Path, report: Mapping[str, Any], frames: Sequence[Picture], others: Mapping[str, Picture],
    training: Mapping[str, Any] | None = None,
) -> dict[str, Path]:  # fmt: skip
    """Writes the page and its charts as PNGs in the same folder, atomically; returns the paths.

    ``report`` is the output of ``clod-adapt`` or ``clod-adapt eval`` with --json; ``frames`` are one held-out view at
    ascending dial values, ``others`` the photograph and the base by name; ``training`` has ``curves`` and ``base_psnr``
    of ``charts.draw_training``, and the number of ``views``.
    """
    import jinja2

    path, own, series = Path(path), own_teacher(report), series_of(report)
    name = PurePath(report.get("outputs", {}).get("ply", report["model"])).name
    config = report.get("config") or report.get("attenuation") or {}
    # Against its own renders, the base has only rounding errors, far below the range of the charts.
    drawn = [one for one in series if not (own and one.label == BASE)]
    figures = _figures(drawn, training, own)
    few = dict.fromkeys(round(k * (len(frames) - 1) / 3) for k in range(4)) if frames else ()
    height, width = frames[0].image.shape[:2] if frames else (1, 1)
    source = files("clod_adapter.report")
    template, style, script = ((source / n).read_text("utf-8") for n in ("page.html", "style.css", "dial.js"))
    page = jinja2.Environment(autoescape=True).from_string(template).render(
        report=report, own=own, title=f"{name}: quality against time", lead=_lead(report, series), tiles=_tiles(drawn),
        frames=frames, others=others, aspect=f"{width} / {height}",
        strip=[*others.values(), *(frames[k] for k in few)] if few else [],
        figures=[(head, inline_svg(draw, name, head), text) for name, (head, draw, text) in figures.items()],
        series=series, decisions=(report.get("plan") or {}).get("decisions", ()), settings=_settings(report),
        config={name: f"{v:.4g}" if isinstance(v, float) else v for name, v in config.items()},
        data=script_json({"report": report, "training": training}), style=style, script=script,
    )  # fmt: skip
    outputs = {name: chart_file(path, name) for name in figures}
    with atomic_paths(path, *outputs.values()) as (temporary, *pngs):
        for png, (_, draw, _) in zip(pngs, figures.values(), strict=True):
            with new_figure(SIZE, layout="constrained") as figure:
                draw(figure.subplots())
                save_figure(figure, png)
        temporary.write_text(as_text(page), encoding="utf-8")
    return {"page": path, **outputs}


def _figures(
    drawn: Sequence[Series], training: Mapping[str, Any] | None, own: bool
) -> dict[str, tuple[str, Draw, str]]:
    """Heading, chart and caption by name."""
    found: dict[str, tuple[str, Draw, str]] = {}
    if drawn:
        caption = "Lower left is better: less error, less time."
        if len(drawn) > 1 and drawn[-1].label.startswith("plain"):
            caption += " A plain viewer ignores the dial and shows all Gaussians of the adapted file unfaded."
        found["rendering"] = ("Error against frame time", partial(draw_rendering, series=drawn), caption)
    if training:
        seen = "held-out synthetic views" if own else "held-out photographs"
        caption = (
            f"One run, measured on {training['views']} {seen}. The state was copied at evenly spaced points of this "
            "axis and measured after the end, so measuring took no training time. Times include the initialization."
        )
        base_psnr = None if own else training["base_psnr"]
        draw = partial(draw_training, curves=training["curves"], base_psnr=base_psnr)
        found["adapting"] = ("Error against adapting time", draw, caption)
    return found


def _lead(report: Mapping[str, Any], series: Sequence[Series]) -> list[str]:
    """Summary sentences: inputs and results."""
    own, count = own_teacher(report), report["base_count"]
    scene = "" if own else PurePath(abspath(report["scene"])).name
    if report["command"] == "eval":
        first = f"{report['model']} holds {count:,} Gaussians. It was measured on held-out photographs of {scene}."
    else:
        seen = "synthetic views" if own else f"the photographs of {scene}"
        minutes = divmod(round(report["seconds"]["total"]), 60)
        first = (
            f"{PurePath(report['model']).name}, a trained splat of {count:,} Gaussians, was given a quality dial: "
            f"{report['steps']:,} steps on {seen}, {minutes[0]}:{minutes[1]:02} minutes in all."
        )
        first += " Training was interrupted." if report["interrupted"] else ""
    if not series:
        return [first, "Nothing was measured: " + " ".join(report["notes"])]
    best = min(series[0].rows, key=lambda row: row.get("virtual_scale", 1))
    at = f" at s = {best['virtual_scale']:g}" if series[0].dial else ""
    return [first, f"It reaches {best['psnr']:.2f} dB{at}, in {best['frame_ms']:.1f} ms per frame."]


def _tiles(series: Sequence[Series]) -> list[tuple[str, Mapping[str, Any]]]:
    """Key figures: the base, and both ends and the middle of the dial."""
    found = [(one.label, one.rows[0]) for one in series if one.label == BASE]
    if series and series[0].dial:
        rows = sorted(series[0].rows, key=lambda row: row["virtual_scale"])
        picked = dict.fromkeys((0, len(rows) // 2, len(rows) - 1))
        found += [(f"s = {rows[k]['virtual_scale']:g}", rows[k]) for k in picked]
    return found


def _settings(report: Mapping[str, Any]) -> dict[str, Any]:
    scene = "none (synthetic views)" if own_teacher(report) else report["scene"]
    seconds = {f"{name}, seconds": value for name, value in report["seconds"].items()}
    flat = {"model": report["model"], "scene": scene, "version": report["version"]}
    return flat | report["machine"] | {"device": report["device"]} | seconds
