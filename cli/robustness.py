"""``clod-adapt robustness``: adapts checkpoints at several ranges of the dial; writes a figure, a
CSV and a JSON.
"""

from __future__ import annotations

import csv
import json
from argparse import ArgumentParser, Namespace
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from clod_adapter import AdaptConfig, ClodError, Stopped
from clod_adapter._support.text import as_text, package_version
from clod_adapter.io.atomic import atomic_path
from clod_adapter.progress import GracefulStop, Listener
from clod_adapter.report.charts import check_matplotlib

from .shared import command as common
from .shared.console import Console, ProgressDisplay
from .shared.outputs import Outputs, Report, labels, write_report

if TYPE_CHECKING:
    from clod_adapter import Checkpoint, Scene


ADAPTER = ".safetensors"  # suffix


def add_arguments(parser: ArgumentParser) -> None:
    given = parser.add_argument_group("input")
    given.add_argument(
        "ply", metavar="PLY", nargs="+", help="checkpoints of one scene; never modified"
    )
    common.add_reading(given)
    text = "output folder; resumed if it exists (default: robustness)"
    common.add_out(parser, "DIR", text, "robustness")
    training = parser.add_argument_group("training")
    text = "largest dial value of each adaptation; 1 trains at full detail only (default: 1 3 5 7)"
    training.add_argument(
        "--max-sv", metavar="S", type=float, nargs="+", default=[1.0, 3.0, 5.0, 7.0], help=text
    )
    common.add_settings(training, without=["max_sv"])


def check(args: Namespace) -> None:
    check_matplotlib()
    common.make_configs(args)
    labels(args.ply)
    common.check_inputs(args.images, *args.ply)


def outputs(args: Namespace) -> Outputs:
    folder, cells = Path(args.out), Path(args.out) / "cells"
    files = [*result_files(folder).values()]
    for label in labels(args.ply):
        rows = [cell_file(cells, label, max_sv) for max_sv in (None, *args.max_sv)]
        files += [*rows, *(path.with_suffix(ADAPTER) for path in rows)]
    return Outputs(derived=files, folders=[folder, cells], inputs=args.ply, scene=args.images)


def result_files(folder: Path) -> dict[str, Path]:
    """The figure and the measurements, by suffix."""
    return {kind: folder / f"robustness.{kind}" for kind in ("png", "csv", "json")}


def cell_file(folder: Path, label: str, max_sv: float | None) -> Path:
    """The rows of a checkpoint's cell: at a range, or of the baseline for None. The adapter is
    beside them.
    """
    return folder / (f"{label}_base.json" if max_sv is None else f"{label}_sv{max_sv:g}.json")


@dataclass(frozen=True)
class Cell:
    """One checkpoint at one range, or its baseline, where ``config`` is None; on disk."""

    label: str  # of the checkpoint
    checkpoint: Checkpoint
    config: AdaptConfig | None
    points: tuple[float, ...]  # dial values, or shares of the baseline, that are measured
    scene_sha256: str  # of the photographs
    # its rows, as JSON, which mark it as finished; the adapter, which a baseline has not, is beside
    # them
    file: Path

    @property
    def key(self) -> Report:
        """Everything that the result depends on, as JSON."""
        return {
            "version": package_version(),
            "config": self.config and asdict(self.config),
            "points": list(self.points),
            "checkpoint_sha256": self.checkpoint.fingerprint,
            "scene_sha256": self.scene_sha256,
            "screen_filter": repr(self.checkpoint.gaussians.screen_filter),
        }

    def read(self) -> Report | None:
        """The finished cell, or None if there is none with this key."""
        try:
            cell = json.loads(self.file.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        same = isinstance(cell, dict) and cell.get("key") == self.key
        complete = self.config is None or self.file.with_suffix(ADAPTER).is_file()
        return cell if same and complete else None

    def run(self, scene: Scene, progress: Listener) -> Report:
        """Measures; writes the adapter and then the rows."""
        from clod_adapter import save_adapter
        from clod_adapter._support.machine import machine
        from clod_adapter.evaluation.robustness import adapt_at_range, baseline

        base, adapter_file = self.checkpoint, self.file.with_suffix(ADAPTER)
        if self.config is None:
            result = baseline(base.gaussians, scene.test, self.points, progress)
        else:
            result = adapt_at_range(base, scene, self.config, self.points, progress)
        self.file.unlink(missing_ok=True)
        if result.adapter:
            save_adapter(adapter_file, result.adapter)
        cell = {
            "checkpoint": as_text(self.label),
            "max_sv": self.config and self.config.max_sv,
            "rows": result.rows,
            "adapter": adapter_file if result.adapter else None,
            "seconds": round(result.seconds, 3),
            "distribution": result.distribution,
            "machine": machine(),
            "key": self.key,
        }
        write_report(self.file, cell)
        return cell


def execute(args: Namespace) -> Report:
    from clod_adapter._support.machine import machine
    from clod_adapter.evaluation.calibrate import report_dials
    from clod_adapter.evaluation.robustness import BASELINE_SHARES, scene_fingerprint

    from .shared.inputs import align_shown, prepare_kernels, read_inputs
    from .shared.measure import Stopwatch

    console = Console(args.quiet)
    watch = Stopwatch()
    stop = GracefulStop()
    required = not args.misaligned_ok
    checkpoints, scene = read_inputs(args, args.ply, console, training=True, required=required)
    for each in checkpoints[1:]:
        if align_shown(each, scene, console, required=required)[1]["frame"]:
            raise ClodError(f"{each.path}: in another frame than {args.ply[0]}; give it alone")
    for each in checkpoints:
        if each.gaussians.sigma_d is not None:
            console.note(f"the dial of {each.path} is ignored")
        prepare_kernels(
            console, each.gaussians.means.device, screen_filter=each.gaussians.screen_filter
        )
    bases = dict(zip(labels(args.ply), checkpoints, strict=True))
    configs, sha256 = common.make_configs(args), scene_fingerprint(scene)
    # Every range is measured at the dial values of the widest one and at its own end.
    dials = tuple(
        sorted({*report_dials(configs[-1].max_sv), *(config.max_sv for config in configs)})
    )
    cells = dict[str, Cell]()
    for label, base in bases.items():
        for config in (None, *configs):
            points, max_sv = (BASELINE_SHARES, None) if config is None else (dials, config.max_sv)
            file = cell_file(Path(args.out) / "cells", label, max_sv)
            cells[file.stem] = Cell(label, base, config, points, sha256, file)
    found = {name: done for name, cell in cells.items() if (done := cell.read())}
    if found:
        console.say(f"{len(found)} of {len(cells)} cells are done already: {', '.join(found)}")
    with stop.listening():
        for k, (name, cell) in enumerate(cells.items(), 1):
            display = ProgressDisplay(console, stop, f"{name} ({k}/{len(cells)}) training")
            try:
                with closing(display):
                    found[name] = found.get(name) or cell.run(scene, display)
            except Stopped:
                console.say(f"{name} was not finished; the same command continues with it")
                break
        if not found:
            raise Stopped("stopped before the first cell was finished")
        files = result_files(Path(args.out))
        missing = [name for name in cells if name not in found]
        report = {
            "command": "robustness",
            "version": package_version(),
            "scene": args.images,
            "checkpoints": [
                {
                    "checkpoint": label,
                    "model": each.path,
                    "count": len(each.gaussians),
                    "sha256": each.fingerprint,
                }
                for label, each in bases.items()
            ],
            "cells": [found[name] for name in cells if name in found],
            "missing": missing,
            "interrupted": bool(missing),
            "notes": console.notes,
            "views": len(scene.test),
            "machine": machine(),
            "seconds": watch.report(),
            "outputs": files,
        }
        write_results(report, files, Path(args.images).resolve().name)
    for path in files.values():
        print(path)
    if missing:
        print(f"\nmissing: {', '.join(missing)}; the same command continues")
    return report


def write_results(report: Report, files: dict[str, Path], scene: str) -> None:
    from clod_adapter.report.robustness_figure import robustness_figure

    title = (
        f"{as_text(scene)}: the dial after the fact, by range; mean of {report['views']} held-out"
        " photographs"
    )
    robustness_figure(files["png"], report["cells"], title)
    with atomic_path(files["csv"]) as part, open(part, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(
            file, ["checkpoint", "max_sv", "within_range", *report["cells"][0]["rows"][0]]
        )
        writer.writeheader()
        for cell in report["cells"]:
            name, limit = cell["checkpoint"], cell["max_sv"]
            for row in cell["rows"]:
                inside = "" if limit is None else row["virtual_scale"] <= limit
                writer.writerow(
                    {"checkpoint": name, "max_sv": limit or "base", "within_range": inside, **row}
                )
    write_report(files["json"], report)


DESCRIPTION = """\
Run the robustness experiment of CLoD-GS: adapt each checkpoint at each --max-sv
and measure all at the same dial values, also beyond the trained range. The
baseline is the checkpoint pruned to its most opaque Gaussians, not adapted.
"""
USAGE = "PLY [PLY ...] --images DIR [options]"
EPILOG = """\
outputs in DIR:
  robustness.png   PSNR and SSIM against Gaussians kept, histograms of opacity
                   and sigma_d; one row per checkpoint, one line per range
  robustness.csv, robustness.json
                   the measurements; with settings and histograms
  cells/           adapter and rows of each adaptation; "clod-adapt apply" makes
                   a model of PLY and its adapter

The same command resumes: it skips finished cells with the same files, settings
and version. Ctrl-C drops the current cell and writes the finished ones (exit
code 0, "interrupted": true; 130 if there are none). Remove DIR to start over.

example:
  clod-adapt robustness 3dgs.ply mask.ply --images garden --max-sv 1 3 5 7
"""
