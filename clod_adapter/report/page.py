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
    """An image, ``[H, W, 3]`` uint8, with its caption."""

    image: np.ndarray
    title: str
    detail: str = ""

    @property
    def url(self) -> str:
        """The image as WebP in a data: URL, at most WIDEST pixels wide."""
        picture = Image.fromarray(self.image)
        picture.thumbnail((WIDEST, picture.height), Image.Resampling.LANCZOS)
        file = io.BytesIO()
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
    draws = _draws(drawn, training, against_base)
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
        tiles=_tiles(drawn),
        frames=frames,
        others=others,
        strip=[*others.values(), *frames[:: max(len(frames) // 3, 1)]],
        training=training,
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


def _draws(
    series: Sequence[charts.Series],
    training: Mapping[str, Any] | None,
    against_base: bool,
) -> dict[str, charts.Draw]:
    """The functions that draw the charts, by name."""
    draws: dict[str, charts.Draw] = {}
    if series:
        for name in charts.QUANTITIES:
            draws[name] = partial(charts.draw_rows, series=series, quantity=name)
    if training:
        base_psnr = None if against_base else training["base_psnr"]
        curves = training["curves"]
        draws["adapting"] = partial(charts.draw_training, curves=curves, base_psnr=base_psnr)
    return draws


def _tiles(series: Sequence[charts.Series]) -> list[tuple[str, Mapping[str, Any]]]:
    """The rows at the top of the page, by label: the base, and the ends and middle of the dial."""
    tiles = [(line.label, line.rows[0]) for line in series if line.label == charts.BASE]
    if series and series[0].dial:
        rows = sorted(series[0].rows, key=lambda row: row["virtual_scale"])
        for k in sorted({0, len(rows) // 2, len(rows) - 1}):
            tiles.append((f"s = {rows[k]['virtual_scale']:g}", rows[k]))
    return tiles
