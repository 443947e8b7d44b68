"""The HTML report of one model: quality and cost by dial value, and error against adapting time.

``page.html`` is its template. Style, script, charts and images are in the file; nothing is loaded
from a network.
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
from clod_adapter.report import charts

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
        image = self.image
        if image.dtype != np.uint8:
            image = (image.clip(0, 1) * 255).round().astype("u1")
        file = io.BytesIO()
        picture = Image.fromarray(image)
        if picture.width > WIDEST:
            height = round(picture.height * WIDEST / picture.width)
            picture = picture.resize((WIDEST, height), Image.Resampling.LANCZOS)
        picture.save(file, "WEBP", quality=QUALITY)
        return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode("ascii")


def from_checkpoint(report: Mapping[str, Any]) -> bool:
    """Whether the reference of the metrics is renders of the checkpoint, without photographs."""
    return report.get("supervision") == "checkpoint"


def write_page(
    path: str | Path,
    report: Mapping[str, Any],
    frames: Sequence[Picture],
    others: Mapping[str, Picture],
    training: Mapping[str, Any] | None = None,
) -> dict[str, Path]:
    """Writes the page and its charts as PNGs in the same folder, atomically; returns the paths.

    ``report`` is the output of ``clod-adapt`` or ``clod-adapt eval`` with --json; ``frames`` are
    one held-out view at ascending dial values, ``others`` the photograph and the base by name;
    ``training`` has ``curves`` and ``base_psnr`` of ``charts.draw_training``, and the number of
    ``views``.
    """
    import jinja2

    path = Path(path)
    against_base = from_checkpoint(report)
    series = charts.series_of(report)
    # Against its own renders, the base has only rounding errors, far below the range of the charts.
    drawn = [line for line in series if not (against_base and line.label == charts.BASE)]
    draws: dict[str, charts.Draw] = {}
    for name in charts.QUANTITIES if drawn else ():
        draws[name] = partial(charts.draw_rows, series=drawn, quantity=name)
    if training:
        curves = training["curves"]
        base_psnr = None if against_base else training["base_psnr"]
        draws["adapting"] = partial(charts.draw_training, curves=curves, base_psnr=base_psnr)
    tiles = [(line.label, line.rows[0]) for line in drawn if line.label == charts.BASE]
    if drawn and drawn[0].dial:
        rows = sorted(drawn[0].rows, key=lambda row: row["virtual_scale"])
        for k in dict.fromkeys((0, len(rows) // 2, len(rows) - 1)):  # the ends and the middle
            tiles.append((f"s = {rows[k]['virtual_scale']:g}", rows[k]))
    settings = {
        "model": report["model"],
        "scene": "none (synthetic views)" if against_base else report["scene"],
        "version": report["version"],
        **report["machine"],
        "device": report["device"],
    }
    settings |= {f"{name}, seconds": f"{value:.1f}" for name, value in report["seconds"].items()}
    chosen_frames = dict.fromkeys(round(k * (len(frames) - 1) / 3) for k in range(4))
    strip = [*others.values(), *(frames[k] for k in chosen_frames)] if frames else []
    source = files("clod_adapter.report")
    template = (source / "page.html").read_text("utf-8")
    page = jinja2.Environment(autoescape=True).from_string(template)
    text = page.render(
        report=report,
        own=against_base,
        name=PurePath(report.get("outputs", {}).get("ply", report["model"])).name,
        model=PurePath(report["model"]).name,
        scene="" if against_base else PurePath(abspath(report["scene"])).name,
        series=series,
        drawn=drawn,
        tiles=tiles,
        frames=frames,
        others=others,
        strip=strip,
        training=training,
        settings=settings,
        charts={name: partial(charts.inline_svg, draw, name) for name, draw in draws.items()},
        data=script_json({"report": report, "training": training}),
        style=(source / "style.css").read_text("utf-8"),
        script=(source / "dial.js").read_text("utf-8"),
    )
    outputs = {name: charts.chart_file(path, name) for name in draws}
    with atomic_paths(path, *outputs.values()) as (temporary, *pngs):
        for png, draw in zip(pngs, draws.values(), strict=True):
            with charts.chart(draw) as figure:
                charts.save_figure(figure, png)
        temporary.write_text(as_text(text), encoding="utf-8")
    return {"page": path, **outputs}
