"""The report on one model: what its dial gives and costs, and, of an adaptation, how the error fell with time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os.path import abspath
from pathlib import Path, PurePath
from typing import Any

from clod_adapter.io.atomic import atomic_paths
from clod_adapter.report import page
from clod_adapter.report.charts import chart_file, inline_svg, rendering_chart, training_chart, write_png
from clod_adapter.report.page import Picture
from clod_adapter.report.series import Series, series_of

READING = (
    "The dial s is set when rendering. At s = 1 the file is at its best; as s grows, Gaussians fade and leave, those "
    "that matter least first, so a frame takes less time. It is one file throughout: nothing is reloaded or swapped.",
    "PSNR and SSIM are means over {truth}, never trained on. Higher is better; 0.1 dB of PSNR is hardly seen, 1 dB is. "
    "The charts show the mean squared error that the mean PSNR stands for.",
    "The time of a frame is the median over the held-out views, rendering alone, on the machine named below.",
)
PHOTOGRAPHS = "photographs that were held out: every 8th by name"
OWN_PICTURES = (
    "held-out views of cameras placed without photographs, against the checkpoint's own pictures: how well these are "
    "kept, not how true they are"
)


def own_teacher(report: Mapping[str, Any]) -> bool:
    """Whether the numbers are against the checkpoint's own pictures, for want of photographs."""
    return report.get("teacher") == "checkpoint"


def write_tradeoff_report(
    path: str | Path,
    report: Mapping[str, Any],
    frames: Sequence[Picture],
    others: Mapping[str, Picture],
    training: Mapping[str, Any] | None = None,
) -> dict[str, Path]:
    """Writes the page, and beside it its charts as PNGs, which appear together; returns their paths.

    Args:
        report: what ``clod-adapt`` or ``clod-adapt eval`` prints with --json; see ``series_of`` for its rows.
        frames: one held-out view at dial values, ascending.
        others: the same view otherwise: the photograph where there are any, the base; by the name it is to have.
        training: ``curves`` and ``base_psnr`` as ``charts.training_chart`` has them, and the number of ``views``.

    Raises:
        ClodError: matplotlib is missing, or a file cannot be written.
    """
    path = Path(path)
    series, own = series_of(report), own_teacher(report)
    # Against its own pictures the base has only their rounding for an error, far below all that the charts are about.
    drawn = [one for one in series if not (own and _is_base(one))]
    charts = {"rendering": rendering_chart(drawn)} if drawn else {}
    if training:
        charts["adapting"] = training_chart(training["curves"], None if own else training["base_psnr"])
    outputs = {name: chart_file(path, name) for name in charts}
    body = [page.paragraph(text, "lead") for text in _lead(report, series)]
    body += [page.tiles(_tiles(drawn)), *_pictures(frames, others)]
    if drawn:
        svg = inline_svg(charts["rendering"], "error against milliseconds a frame")
        body.append(page.section("Error against the time of a frame", page.chart(svg, _rendering_caption(drawn))))
    if training:
        svg, caption = (
            inline_svg(charts["adapting"], "error against seconds of adapting"),
            _training_caption(training, own),
        )
        body.append(page.section("Error against the time of adapting", page.chart(svg, caption)))
    reading = [text.format(truth=OWN_PICTURES if own else PHOTOGRAPHS) for text in READING]
    body += [_rows(series), page.section("How to read this", *map(page.paragraph, reading))]
    body += [_plan(report), _settings(report)]
    kicker = f"clod-adapter {report['version']}, {'evaluation' if report['command'] == 'eval' else 'adaptation'} report"
    with atomic_paths(path, *outputs.values()) as (temporary, *pngs):
        for chart, draw in zip(pngs, charts.values(), strict=True):
            write_png(chart, draw)
        page.write_page(temporary, _title(report), kicker, body, {"report": report, "training": training})
    return {"page": path, **outputs}


def _training_caption(training: Mapping[str, Any], own: bool) -> str:
    seen = "placed views that were held out" if own else "held-out photographs"
    return (
        f"One adaptation, looked at as it went, on {training['views']} {seen}. The state was copied at "
        "points spaced evenly on this axis and measured after the end, so that measuring took no time from training. "
        "The clock includes the pass that finds the start."
    )


def _title(report: Mapping[str, Any]) -> str:
    return f"{PurePath(report.get('outputs', {}).get('ply', report['model'])).name}: quality against time"


def _lead(report: Mapping[str, Any], series: Sequence[Series]) -> list[str]:
    """What was run on what, and what came of it, in sentences."""
    own, count = own_teacher(report), report["base_count"]
    scene = "" if own else PurePath(abspath(report["scene"])).name
    if report["command"] == "eval":
        first = f"{report['model']} holds {count:,} Gaussians. It was measured on held-out photographs of {scene}."
    else:
        seconds = sum(report["seconds"].get(phase, 0) for phase in ("plan", "start", "train"))
        seen = "its own pictures from placed cameras" if own else f"the photographs of {scene}"
        first = (
            f"{PurePath(report['model']).name}, a trained splat of {count:,} Gaussians, was given a quality dial: "
            f"{report['steps']:,} steps on {seen}, {seconds:.0f} seconds."
        )
        first += " It was interrupted before its end." if report["interrupted"] else ""
    if not series:
        return [first, "Nothing was measured: " + " ".join(report["notes"])]
    rows = sorted(series[0].rows, key=lambda row: row.get("virtual_scale", 1))
    base = next((one.rows[0] for one in series if _is_base(one)), None)
    if not series[0].dial or rows[0]["kept"] == rows[-1]["kept"]:
        return [first, f"It reaches {rows[0]['psnr']:.2f} dB at {rows[0]['frame_ms']:.1f} ms a frame."]
    best, last = rows[0], rows[-1]
    second = (
        f"At s = {best['virtual_scale']:g} it reaches {best['psnr']:.2f} dB with {best['kept_share']:.0%} of the "
        f"Gaussians, at {best['frame_ms']:.1f} ms a frame; at s = {last['virtual_scale']:g}, {last['psnr']:.2f} dB "
        f"with {last['kept_share']:.0%}, at {last['frame_ms']:.1f} ms."
    )
    if base and own:
        second += (
            f" These are against the unadapted file's own pictures, of which a frame takes {base['frame_ms']:.1f} ms."
        )
    elif base:
        second += f" Unadapted it was {base['psnr']:.2f} dB at {base['frame_ms']:.1f} ms."
    return [first, second]


def _is_base(series: Series) -> bool:
    return series.label.startswith("base, ")


def _tiles(series: Sequence[Series]) -> list[tuple[str, str, str]]:
    found = []
    for one in series:
        if _is_base(one):
            found.append(("base, unadapted", f"{one.rows[0]['psnr']:.2f} dB", _beside(one.rows[0])))
    if series and series[0].dial:
        rows = sorted(series[0].rows, key=lambda row: row["virtual_scale"])
        picked = dict.fromkeys((0, len(rows) // 2, len(rows) - 1))
        found += [(f"s = {rows[k]['virtual_scale']:g}", f"{rows[k]['psnr']:.2f} dB", _beside(rows[k])) for k in picked]
    return found


def _beside(row: Mapping[str, Any]) -> str:
    return f"{row['kept']:,.0f} Gaussians, {row['frame_ms']:.1f} ms"


def _pictures(frames: Sequence[Picture], others: Mapping[str, Picture]) -> list[str]:
    if not frames:
        return []
    found = []
    if len(frames) > 1:
        text = "One held-out view. Move the dial: each position was rendered at that value; hold a button to compare."
        found.append(page.section("The dial", page.paragraph(text, "quiet"), page.dial(frames, others)))
    few = [frames[k] for k in dict.fromkeys(round(k * (len(frames) - 1) / 3) for k in range(4))]
    found.append(page.section("Side by side", page.strip([*others.values(), *few])))
    return found


def _rendering_caption(series: Sequence[Series]) -> str:
    text = "Down and to the left is better: less error, less time."
    if len(series) > 1 and series[-1].label.startswith("plain"):
        text += " The plain viewer is one that does not know the dial and shows every Gaussian of the adapted file."
    return text


def _rows(series: Sequence[Series]) -> str:
    head = ("dial", "PSNR dB", "SSIM", "Gaussians", "share", "in view", "ms a frame")
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
    return page.section("All rows", page.table(head, groups)) if groups else ""


def _plan(report: Mapping[str, Any]) -> str:
    """What of the checkpoint the scene did not need."""
    decisions = (report.get("plan") or {}).get("decisions", ())  # none of a training in blocks
    rows = [[made[name] for name in ("what", "verdict", "measured", "why")] for made in decisions]
    return page.section("Plan", page.table(("what", "decision", "by", "which"), [("", rows)])) if rows else ""


def _settings(report: Mapping[str, Any]) -> str:
    scene = "none: its own pictures" if own_teacher(report) else report["scene"]
    flat = {"model": report["model"], "scene": scene, "version": report["version"]}
    flat |= report["machine"] | {"device": report["device"]}
    flat |= {f"{name}, seconds": value for name, value in report["seconds"].items()}
    config = report.get("config") or report.get("attenuation") or {}
    shown = {name: f"{v:.4g}" if isinstance(v, float) else v for name, v in config.items()}
    parts = [page.facts(flat), f"<details><summary>All settings</summary>{page.facts(shown)}</details>"]
    notes = page.section("Notes", page.bullets(report["notes"])) if report["notes"] else ""
    return page.section("What it was run with", *parts) + notes
