"""Reports: JSON for scripts, tables for the console."""

from __future__ import annotations

import json
import math
import os
import platform
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clod_adapter._support.text import as_text
from clod_adapter.io.atomic import atomic_path

if TYPE_CHECKING:
    from clod_adapter.evaluation.evaluate import Row
    from clod_adapter.evaluation.popping import Popping

# Round values, each about 1.4 times the last, or more between 1 and 5; max_sv < 1/tau = 50.
DIALS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0)


class Stopwatch:
    """Named wall times, for the report."""

    def __init__(self) -> None:
        self.began = time.perf_counter()
        self.seconds: dict[str, float] = {}

    @contextmanager
    def time(self, name: str) -> Iterator[None]:
        """Adds the time of the block to ``name``."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began

    def report(self) -> dict[str, float]:
        return {name: round(value, 3) for name, value in {**self.seconds, "total": self.total()}.items()}

    def total(self) -> float:
        return time.perf_counter() - self.began


def machine() -> dict[str, Any]:
    """The hardware and software that times were measured on."""
    import numba
    import torch

    gpu = {"gpu": torch.cuda.get_device_name()} if torch.cuda.is_available() else {}
    return {
        **gpu,
        "cpu": _cpu_name(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numba": numba.__version__,
    }


def machine_name(device: str = "cpu") -> str:
    """The machine in one line: the hardware that determines frame times on that type of device."""
    about = machine()
    if device == "cuda":
        return about["gpu"]
    return f"{about['cpu']}, {about['threads']} threads"


def _cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def jsonable(value: Any) -> Any:
    """``value`` with numbers that JSON cannot represent (an infinite PSNR) as null, and file names as text."""
    if isinstance(value, dict):
        return {jsonable(key): jsonable(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(entry) for entry in value]
    if isinstance(value, str):
        return as_text(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Writes the report as an indented JSON file."""
    with atomic_path(path) as temporary:
        text = json.dumps(jsonable(report), indent=2, allow_nan=False, ensure_ascii=False)
        temporary.write_text(text + "\n", encoding="utf-8")


def report_dials(max_sv: float) -> list[float]:
    """The dial values of a report, in about even steps of their logarithm; the last one is ``max_sv``."""
    return [s for s in DIALS if s < max_sv] + [max_sv]


def table(rows: Sequence[Row], base_rows: Sequence[Row] = (), plain_rows: Sequence[Row] = ()) -> str:
    """A table: the base first, then the dial values, then the rows without the dial."""
    marked = [("base", row) for row in base_rows] + [(f"{row.virtual_scale:.5g}", row) for row in rows]
    return rows_table(marked + [("plain", row) for row in plain_rows])


def rows_table(marked: Sequence[tuple[str, Row]]) -> str:
    """A table of labelled rows; LPIPS and FLIP if they were measured."""
    width = max(6, *(len(label) for label, _ in marked))
    more = [name for name in ("lpips", "flip") if any(getattr(row, name) is not None for _, row in marked)]
    heads = "".join(f"  {name.upper():>6}" for name in more)
    lines = [f"{'dial':>{width}}  PSNR dB    SSIM{heads}        kept            in view  frame ms"]
    for label, row in marked:
        extra = "".join(f"  {getattr(row, name):6.4f}" for name in more)
        kept = f"{row.kept:10,.0f}  {row.kept_share:6.1%}  {row.in_view:9,.0f}  {row.frame_ms:8.1f}"
        lines.append(f"{label:>{width}}  {row.psnr:7.2f}  {row.ssim:.4f}{extra}  {kept}")
    return "\n".join(lines)


def popping_table(results: Sequence[tuple[str, Popping]]) -> str:
    """A table of popping measurements, with an explanation; what moves is above its numbers."""
    lines = [
        "popping: change of the image per step, in levels of 255 (RMS over the image,",
        "largest change of a pixel). Halving the step halves the largest change of a",
        "fade (0.5), but not that of a jump (1.0):",
        "  steps     mean  largest     at  / mean  halved   pixel  halved",
    ]
    for moved, p in results:
        lines.append(moved)
        lines.append(
            f"  {p.steps:5}  {p.mean:7.4f}  {p.largest:7.4f}  {p.at:5.2f}  {p.ratio:6.1f}"
            f"  {p.persistence:6.2f}  {p.pixel:6.1f}  {p.pixel_persistence:6.2f}"
        )
    return "\n".join(lines)
