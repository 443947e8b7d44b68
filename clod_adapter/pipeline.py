"""Everything that ``clod-adapt`` does to a checkpoint, as one function."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from clod_adapter.adapter import Adapter, detach
from clod_adapter.alignment.align import Note, align, detect_filter
from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.calibrate import make_quality_table, report_dials, with_frame_times
from clod_adapter.evaluation.evaluate import Row, evaluate_all
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.adapter_file import save_adapter
from clod_adapter.io.atomic import atomic_paths
from clod_adapter.io.checkpoint import Checkpoint, save
from clod_adapter.progress import Listener, Stopped
from clod_adapter.training.plan import Override, Plan
from clod_adapter.training.planner import make_plan
from clod_adapter.training.pseudo_views import with_pseudo_views
from clod_adapter.training.state import Adapted, extract_adapter


@dataclass(frozen=True)
class Result:
    """An adapted checkpoint, with all that its files need.

    Attributes:
        base: the checkpoint, with the screen-space filter that it was rendered with.
        scene: the views, in the checkpoint's frame, with the pseudo views that were added.
        against: what the rows compare with: "photographs", or renders of the "checkpoint".
        plan: what was trained, and why.
        adapted: the training: its steps, its seconds, whether it was interrupted.
        adapter: what changed; ``adapter.apply(base.gaussians) == gaussians``.
        gaussians: the result, near and far.
        base_rows, rows, plain: quality and frame times on the held-out views of the base, of the
            result at ``report_dials``, and of the result in a viewer that does not know the dial.
            Empty if nothing is held out.
        notes: lines that the user should read.
        alignment: how checkpoint and photographs match; None without photographs.
    """

    base: Checkpoint
    scene: Scene
    against: str
    plan: Plan
    adapted: Adapted
    adapter: Adapter
    gaussians: Gaussians
    base_rows: Sequence[Row] = ()
    rows: Sequence[Row] = ()
    plain: Sequence[Row] = ()
    notes: tuple[str, ...] = ()
    alignment: dict[str, Any] | None = None

    def save(self, path: str | Path) -> None:
        """Writes ``path``, a PLY, and the adapter, which has its name with ``.safetensors``; both
        or none.

        Raises:
            ClodError: as ``save``.
        """
        ply = Path(path)
        with atomic_paths(ply, ply.with_suffix(".safetensors")) as (large, small):
            self.write(large, small)

    def write(self, ply: Path, adapter: Path) -> None:
        """Writes the two files under these names."""
        save_adapter(adapter, self.adapter)
        version = self.adapter.version
        quality_table = self.adapter.quality_table
        save(ply, self.gaussians, self.base, version=version, quality_table=quality_table)


def adapt_checkpoint(
    base: Checkpoint,
    scene: Scene | None = None,
    config: AdaptConfig | None = None,
    *,
    override: Override | None = None,
    progress: Listener | None = None,
    misaligned_ok: bool = False,
) -> Result:
    """Gives a checkpoint its dial, as ``clod-adapt`` does: the same Gaussians, bit for bit.

    The cameras are brought into the checkpoint's frame, its screen-space filter is found, pseudo
    views are added to few photographs or take the place of none, a plan is made, the dial is
    learned and measured.

    Args:
        scene: posed photographs; without them the checkpoint's own renders are the truth.
        config: by default ``AdaptConfig()``, without photographs ``AdaptConfig.placed()``.
        override: decisions of the plan that are fixed in advance.
        progress: called after each step of each phase; stops if it returns False. In training the
            result so far is kept, and in the measurements after it the result without these.
        misaligned_ok: train although the checkpoint does not match the photographs.

    Raises:
        ClodError: as ``align``, ``make_plan`` and ``adapt``.
        Stopped: ``progress`` returned False before training.

    Example:
        >>> base = clod.load("base.ply")
        >>> scene = clod.load_scene("scene", origin=base.origin)
        >>> result = clod.adapt_checkpoint(base, scene, clod.AdaptConfig(max_sv=5))
        >>> result.save("model.ply")
    """
    notes = list[str]()
    alignment = None
    against = "checkpoint" if scene is None else "photographs"
    if config is None:
        config = AdaptConfig.placed() if scene is None else AdaptConfig()
    if scene is not None:
        scene, alignment = align(base, scene, notes.append, required=not misaligned_ok)
        base = detect_filter(base, [*scene.test, *scene.train], notes.append)
    scene = with_pseudo_views(base.gaussians, scene, config.seed, progress)
    config = config.for_views(len(scene.train))
    base_rows = evaluate_all(base.gaussians, scene.test, [1.0], progress) if scene.test else []
    plan = make_plan(base.gaussians, scene, config, override, progress)
    adapted = plan.adapt(scene, progress)
    notes += [*base.notes, *scene.notes, *adapted.notes]
    result = extract_result(base, scene, against, plan, adapted, config)
    result = replace(result, base_rows=base_rows, alignment=alignment)
    if scene.test and not adapted.interrupted:
        try:
            measured = _measured(result, config.max_sv, progress, notes.append)
            result = with_quality_table(measured, notes.append)
        except Stopped as stopped:
            notes.append(f"the result is not measured: {stopped}")
    return replace(result, notes=tuple(dict.fromkeys(notes)))


def extract_result(
    base: Checkpoint,
    scene: Scene,
    against: str,
    plan: Plan,
    adapted: Adapted,
    config: AdaptConfig,
) -> Result:
    """The result of a training, without measurements: the adapter, and the adapter applied to the
    base.
    """
    adapter = extract_adapter(base, adapted, config)
    return Result(base, scene, against, plan, adapted, adapter, adapter.apply(base.gaussians))


def with_quality_table(result: Result, note: Note) -> Result:
    """The result with the quality table of its rows in its adapter, or a note without one."""
    try:
        quality_table = make_quality_table(
            result.rows,
            result.gaussians,
            result.scene,
            result.against,
            result.base.origin,
        )
    except ClodError as error:
        note(f"the files have no quality table, so --fps and --psnr-drop will not work: {error}")
        return result
    return replace(result, adapter=replace(result.adapter, quality_table=quality_table))


def _measured(result: Result, max_sv: float, progress: Listener | None, note: Note) -> Result:
    """The result with its rows on the held-out views, and with frame times that can be compared."""
    views = result.scene.test
    plain = detach(result.gaussians)
    rows = evaluate_all(result.gaussians, views, report_dials(max_sv), progress)
    measured = [
        (result.base.gaussians, result.base_rows),
        (result.gaussians, rows),
        (plain, evaluate_all(plain, views, [1.0], progress)),
    ]
    (base_rows, rows, plain_rows), notes = with_frame_times(measured, views, progress)
    for line in notes:
        note(line)
    return replace(result, base_rows=base_rows, rows=rows, plain=plain_rows)
