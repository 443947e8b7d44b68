"""Whole models as safetensors files: every tensor of the Gaussians unchanged, and their settings.

Tensors, float32: those of ``Gaussians`` by their names there. The metadata key ``clod_adapter`` holds the JSON document
(``metadata``), whose format distinguishes a model from an adapter.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from safetensors.numpy import save

from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.file_formats import KEY
from clod_adapter.io.settings import History, Metadata, Source, metadata_text, parse_metadata, write_metadata
from clod_adapter.io.tensor_file import load_tensors, read_tensor_header
from clod_adapter.io.values import SIGMA, arrays_of, dial_columns, float32

_NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")


def write_safetensors(path: Path, gaussians: Gaussians, history: History) -> tuple[str, ...]:
    """Writes every value unchanged; arguments and errors as ``file_formats.write``."""
    arrays = arrays_of(path, gaussians)
    metadata = {KEY: metadata_text(write_metadata(gaussians, history))}
    path.write_bytes(save(arrays, metadata))  # not save_file, which makes files that only their owner can read
    return ()


def open_safetensors(path: Path) -> bool:
    """Whether a model has sigma_d, without reading its tensors; errors as ``load_safetensors``."""
    names, stored = read_tensor_header(path)
    _metadata(path, names, stored)
    return SIGMA in names


def load_safetensors(path: Path) -> Source:
    """Reads a model.

    Raises:
        ClodError: the file cannot be read, is damaged, an adapter or another safetensors file.
    """
    tensors, stored, sha256 = load_tensors(path)
    metadata = _metadata(path, tensors, stored)
    wanted = (*_NAMES, *dial_columns(tensors))
    if odd := [name for name in wanted if not tensors[name].is_floating_point()]:
        raise ClodError(f"{path}: tensor {odd[0]!r} is not of floating-point numbers; export it again")
    arrays = {name: tensors[name].float().numpy() for name in wanted}
    return Source(float32(arrays), metadata, sha256, comments=metadata.about)


def _metadata(path: Path, names: Collection[str], stored: dict[str, str]) -> Metadata:
    """The settings of a file with these tensors; refuses another file than a model."""
    if KEY not in stored:
        raise ClodError(f"{path}: is a safetensors file but not a model of clod-adapter; give a file that it wrote")
    metadata = parse_metadata(path, stored[KEY], dial=SIGMA in names)
    if missing := [name for name in _NAMES if name not in names]:
        raise ClodError(f"{path}: has no tensor {missing[0]!r}; export it again")
    return metadata
