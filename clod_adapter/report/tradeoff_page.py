"""The HTML report of one model: quality and cost by dial value, and error against adapting time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os.path import abspath
from pathlib import Path, PurePath
from typing import Any

from clod_adapter.io.atomic import atomic_paths
from clod_adapter.report import page
from clod_adapter.report.charts import chart_file, inline_svg, rendering_chart, training_chart, write_chart
from clod_adapter.report.page import Picture
from clod_adapter.report.series import Series, series_of

READING = (
    "The dial s is set when rendering. Quality is highest at s = 1. As s grows, Gaussians fade out and are culled, the "
    "least important first, so a frame takes less time. All dial values use the same file; nothing is reloaded.",
    "PSNR and SSIM are means over {truth}, which training does not use. Higher is better; 0.1 dB of PSNR is hardly "
    "visible, 1 dB is. The charts show the mean squared error of the mean PSNR.",
    "Frame time is the median over the held-out views, of rendering alone, on the machine named below.",
)
PHOTOGRAPHS = "held-out photographs (every 8th by name)"
OWN_PICTURES = (
    "held-out synthetic views, rendered by the checkpoint without photographs: they measure the similarity to the "
    "checkpoint"
)


def own_teacher(report: Mapping[str, Any]) -> bool:
    """Whether the reference of the metrics is renders of the checkpoint, without photographs."""
    return report.get("teacher") == "checkpoint"


def write_tradeoff_report(
    path: str | Path, report: Mapping[str, Any], frames: Sequence[Picture], others: Mapping[str, Picture],
    training: Mapping[str, Any] | None = None,
) -> dict[str, Path]:  # fmt: skip
    """Writes the page and its charts as PNGs in the same folder, atomically; returns the paths.

    Args:
        report: output of ``clod-adapt`` or ``clod-adapt eval`` with --json; see ``series_of`` for its rows.
        frames: one held-out view at ascending dial values.
        others: images of the same view to compare with, by name: the photograph, if any, and the base.
        training: ``curves`` and ``base_psnr`` of ``charts.training_chart``, and the number of ``views``.

    Raises:
        ClodError: matplotlib is missing, or a file cannot be written.
    """
    path = Path(path)
    series, own = series_of(report), own_teacher(report)
    # Against its own renders, the base has only rounding errors, far below the range of the charts.
    drawn = [one for one in series if not (own and _is_base(one))]
    charts = {"rendering": rendering_chart(drawn)} if drawn else {}
    if training:
        charts["adapting"] = training_chart(training["curves"], None if own else training["base_psnr"])
    outputs = {name: chart_file(path, name) for name in charts}
    body = [page.paragraph(text, "lead") for text in _lead(report, series)]
    body += [page.tiles(_tiles(drawn)), *_pictures(frames, others)]
    if drawn:
        svg = inline_svg(charts["rendering"], "error against milliseconds per frame")
        body.append(page.section("Error against frame time", page.chart(svg, _rendering_caption(drawn))))
    if training:
        svg = inline_svg(charts["adapting"], "error against seconds of adapting")
        body.append(page.section("Error against adapting time", page.chart(svg, _training_caption(training, own))))
    reading = [text.format(truth=OWN_PICTURES if own else PHOTOGRAPHS) for text in READING]
    body += [_rows(series), page.section("How to read this", *map(page.paragraph, reading))]
    body += [_plan(report), _settings(report)]
    kicker = f"clod-adapter {report['version']}, {'evaluation' if report['command'] == 'eval' else 'adaptation'} report"
    with atomic_paths(path, *outputs.values()) as (temporary, *pngs):
        for chart, draw in zip(pngs, charts.values(), strict=True):
            write_chart(chart, draw)
        page.write_page(temporary, _title(report), kicker, body, {"report": report, "training": training})
    return {"page": path, **outputs}


def _training_caption(training: Mapping[str, Any], own: bool) -> str:
    seen = "held-out synthetic views" if own else "held-out photographs"
    return (
        f"One run, measured on {training['views']} {seen}. The state was copied at evenly spaced points of this axis "
        "and measured after the end, so measuring took no training time. Times include the initialization."
    )


def _title(report: Mapping[str, Any]) -> str:
    return f"{PurePath(report.get('outputs', {}).get('ply', report['model'])).name}: quality against time"


def _lead(report: Mapping[str, Any], series: Sequence[Series]) -> list[str]:
    """Summary sentences: inputs and results."""
    own, count = own_teacher(report), report["base_count"]
    scene = "" if own else PurePath(abspath(report["scene"])).name
    if report["command"] == "eval":
        first = f"{report['model']} holds {count:,} Gaussians. It was measured on held-out photographs of {scene}."
    else:
        seconds = sum(report["seconds"].get(phase, 0) for phase in ("plan", "start", "train"))
        seen = "synthetic views" if own else f"the photographs of {scene}"
        first = (
            f"{PurePath(report['model']).name}, a trained splat of {count:,} Gaussians, was given a quality dial: "
            f"{report['steps']:,} steps on {seen}, {seconds:.0f} seconds."
        )
        first += " Training was interrupted." if report["interrupted"] else ""
    if not series:
        return [first, "Nothing was measured: " + " ".join(report["notes"])]
    rows = sorted(series[0].rows, key=lambda row: row.get("virtual_scale", 1))
    base = next((one.rows[0] for one in series if _is_base(one)), None)
    if not series[0].dial or rows[0]["kept"] == rows[-1]["kept"]:
        return [first, f"It reaches {rows[0]['psnr']:.2f} dB at {rows[0]['frame_ms']:.1f} ms per frame."]
    best, last = rows[0], rows[-1]
    second = (
        f"At s = {best['virtual_scale']:g} it reaches {best['psnr']:.2f} dB with {best['kept_share']:.0%} of the "
        f"Gaussians, at {best['frame_ms']:.1f} ms per frame; at s = {last['virtual_scale']:g}, {last['psnr']:.2f} dB "
        f"with {last['kept_share']:.0%}, at {last['frame_ms']:.1f} ms."
    )
    if base and own:
        second += f" The reference is the unadapted file's own renders, which take {base['frame_ms']:.1f} ms per frame."
    elif base:
        second += f" The unadapted base has {base['psnr']:.2f} dB at {base['frame_ms']:.1f} ms."
    return [first, second]


def _is_base(series: Series) -> bool:
    return series.label.startswith("base, ")


def _tiles(series: Sequence[Series]) -> list[tuple[str, str, str]]:
    found = []
    for one in series:
        if _is_base(one):
            found.append(("base, unadapted", f"{one.rows[0]['psnr']:.2f} dB", _count_and_time(one.rows[0])))
    if series and series[0].dial:
        rows = sorted(series[0].rows, key=lambda row: row["virtual_scale"])
        picked = dict.fromkeys((0, len(rows) // 2, len(rows) - 1))
        found += [
            (f"s = {rows[k]['virtual_scale']:g}", f"{rows[k]['psnr']:.2f} dB", _count_and_time(rows[k])) for k in picked
        ]
    return found


def _count_and_time(row: Mapping[str, Any]) -> str:
    return f"{row['kept']:,.0f} Gaussians, {row['frame_ms']:.1f} ms"


def _pictures(frames: Sequence[Picture], others: Mapping[str, Picture]) -> list[str]:
    if not frames:
        return []
    found = []
    if len(frames) > 1:
        text = (
            "One held-out view. Each position of the slider is a render at that dial value; hold a button to compare."
        )
        found.append(page.section("The dial", page.paragraph(text, "quiet"), page.dial_figure(frames, others)))
    few = [frames[k] for k in dict.fromkeys(round(k * (len(frames) - 1) / 3) for k in range(4))]
    found.append(page.section("Side by side", page.strip([*others.values(), *few])))
    return found


def _rendering_caption(series: Sequence[Series]) -> str:
    text = "Lower left is better: less error, less time."
    if len(series) > 1 and series[-1].label.startswith("plain"):
        text += " A plain viewer ignores the dial and shows all Gaussians of the adapted file unfaded."
    return text


def _rows(series: Sequence[Series]) -> str:
    head = ("dial", "PSNR dB", "SSIM", "Gaussians", "share", "in view", "ms per frame")
    groups = []
    for one in series:
        rows = [
            [
                f"s = {row['virtual_scale']:g}" if one.dial else "", f"{row['psnr']:.2f}", f"{row['ssim']:.4f}",
                f"{row['kept']:,.0f}", f"{row['kept_share']:.1%}", f"{row['in_view']:,.0f}", f"{row['frame_ms']:.1f}",
            ]
            for row in one.rows
        ]  # fmt: skip
        groups.append((one.label, rows))
    return page.section("All rows", page.html_table(head, groups)) if groups else ""


def _plan(report: Mapping[str, Any]) -> str:
    """The plan: parts of the checkpoint that training skips for this scene."""
    decisions = (report.get("plan") or {}).get("decisions", ())  # none of a training in blocks
    rows = [[made[name] for name in ("what", "verdict", "measured", "why")] for made in decisions]
    columns = ("part", "action", "measured effect", "reason")
    return page.section("Plan", page.html_table(columns, [("", rows)])) if rows else ""


def _settings(report: Mapping[str, Any]) -> str:
    scene = "none (synthetic views)" if own_teacher(report) else report["scene"]
    flat = {"model": report["model"], "scene": scene, "version": report["version"]}
    flat |= report["machine"] | {"device": report["device"]}
    flat |= {f"{name}, seconds": value for name, value in report["seconds"].items()}
    config = report.get("config") or report.get("attenuation") or {}
    shown = {name: f"{v:.4g}" if isinstance(v, float) else v for name, v in config.items()}
    parts = [page.facts(flat), f"<details><summary>All settings</summary>{page.facts(shown)}</details>"]
    notes = page.section("Notes", page.bullets(report["notes"])) if report["notes"] else ""
    return page.section("Settings and machine", *parts) + notes
