"""Whole models as safetensors files: every tensor of the Gaussians as it is, and what they mean.

Tensors, float32: those of ``Gaussians`` by their names there. The metadata key ``clod_adapter`` holds the description
(``card``), whose format tells a model from an adapter.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from safetensors.numpy import save

from clod_adapter.calibration import Calibration
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.formats.arrays import arrays_of, gaussians_of
from clod_adapter.io.formats.metadata import KEY, Model, metadata_text, read_card, settings_of, write_metadata
from clod_adapter.io.tensor_file import load_tensors
from clod_adapter.origin import NOWHERE, Origin

_NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")


def write_safetensors(
    path: str | Path,
    gaussians: Gaussians,
    about: Sequence[str] = (),
    *,
    origin: Origin = NOWHERE,
    calibration: Calibration | None = None,
) -> tuple[str, ...]:
    """Writes every value as it is; ``writers.write`` has the arguments and errors."""
    path = Path(path)
    arrays = arrays_of(path, gaussians)
    metadata = {KEY: metadata_text(write_metadata(gaussians, about, origin, calibration))}
    with atomic_path(path) as temporary:
        # Not save_file, which makes files that only their owner can read.
        temporary.write_bytes(save(arrays, metadata))
    return ()


def read_model_safetensors(path: str | Path) -> Gaussians:
    """The Gaussians of a file; ``load_safetensors`` gives what it says about them too."""
    return load_safetensors(path).gaussians


def load_safetensors(path: str | Path) -> Model:
    """Reads a model.

    Raises:
        ClodError: the file cannot be read, is damaged, an adapter or another safetensors file.
    """
    path = Path(path)
    tensors, metadata = load_tensors(path)
    if KEY not in metadata:
        raise ClodError(f"{path}: is a safetensors file but no model of clod-adapter; give a file that it wrote")
    total = len(tensors["means"]) if "means" in tensors and tensors["means"].ndim else 0
    card, notes = read_card(path, metadata[KEY], total)
    if missing := [name for name in _NAMES if name not in tensors]:
        raise ClodError(f"{path}: has no tensor {missing[0]!r}; export it again")
    wanted = (*_NAMES, "sigma_d") if "sigma_d" in tensors else _NAMES
    if odd := [name for name in wanted if not tensors[name].is_floating_point()]:
        raise ClodError(f"{path}: tensor {odd[0]!r} is not of floating-point numbers; export it again")
    attenuation = settings_of(card) if "sigma_d" in tensors else None
    arrays = {name: tensors[name].float().numpy() for name in wanted}
    return Model(gaussians_of(path, arrays, attenuation, card.screen_filter), card, tuple(notes))
