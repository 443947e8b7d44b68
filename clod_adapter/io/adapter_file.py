"""Adapters as safetensors files: tensors, and one JSON document that says what they are.

Tensors: ``sigma_d`` float32, and under its attribute's name each update, whose type tells what it is:
float16 a difference from the base, float32 the new values. The JSON stands under the metadata key
``clod_adapter``; being one key it is written in one order, so equal adapters give equal files. Where the result has
fewer rows than the base there is ``kept`` too, uint8: a bit a row of the base, the first row the highest bit.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save

from clod_adapter.adapter import Adapter
from clod_adapter.calibration import Calibration
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.formats.metadata import FORMAT as MODEL
from clod_adapter.io.screen_filter import entry_of, parse_entry
from clod_adapter.io.settings import as_before
from clod_adapter.io.tensor_file import load_tensors
from clod_adapter.origin import NOWHERE, parse_origin

KEY = "clod_adapter"
FORMAT = "clod-adapter"
FORMAT_VERSION = 2
UNTRIMMED = 1  # what is not trimmed is written as before, for earlier versions of this package


def save_adapter(path: str | Path, adapter: Adapter) -> None:
    """Writes an adapter; loading it gives the same tensors and settings, bit for bit.

    Raises:
        ClodError: its config is not plain JSON, or the file cannot be written.
    """
    trimmed = adapter.kept is not None or adapter.sh_degree is not None
    about = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION if trimmed else UNTRIMMED,
        "package_version": adapter.version,
        "base_sha256": adapter.base_fingerprint,
        "attenuation": asdict(adapter.attenuation),
        "config": adapter.config,
        **entry_of(adapter.screen_filter),
    }
    if any(adapter.origin):
        about["origin"] = adapter.origin
    if adapter.calibration is not None:
        about["calibration"] = adapter.calibration.as_dict()
    if trimmed:
        about["trimmed"] = {"base_count": adapter.base_count, "sh_degree": adapter.sh_degree}
    check_config(adapter.config)
    metadata = {KEY: json.dumps(about, sort_keys=True, allow_nan=False)}
    tensors = {"sigma_d": adapter.sigma_d, **adapter.updates}
    if adapter.kept is not None:
        tensors["kept"] = torch.from_numpy(np.packbits(adapter.kept.cpu().numpy()))
    with atomic_path(path) as temporary:
        # Not save_file, which makes files that only their owner can read.
        temporary.write_bytes(save({name: tensor.cpu().contiguous() for name, tensor in tensors.items()}, metadata))


def check_config(config: dict[str, Any]) -> None:
    """Raises the ClodError of a config that ``save_adapter`` would refuse; to be called before time is spent on it."""
    try:
        json.dumps(config, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ClodError(f"the adapter's config is not plain JSON ({error}); use finite numbers and strings") from error


def load_adapter(path: str | Path) -> Adapter:
    """Reads an adapter.

    Raises:
        ClodError: the file cannot be read, is damaged, no adapter, or of a newer format.
    """
    tensors, metadata = load_tensors(Path(path))
    if KEY not in metadata:
        raise ClodError(f"{path}: is a safetensors file but no clod-adapter; give a file that this package wrote")
    try:
        about = json.loads(metadata[KEY])
        if about["format"] == MODEL:
            raise ClodError("is a whole model and no adapter; it needs no base, give it in the model's place")
        if about["format"] != FORMAT:
            raise ClodError(f"is not a clod-adapter file but {about['format']!r}; give a file that this package wrote")
        if about["format_version"] > FORMAT_VERSION:
            raise ClodError(f"its format {about['format_version']} is too new for this version; upgrade clod-adapter")
        for name in ("base_sha256", "package_version"):
            if not isinstance(about[name], str):
                raise TypeError(f"{name} is {about[name]!r}, not a string")
        if not isinstance(about["config"], dict):
            raise TypeError(f"config is {about['config']!r:.40}, not an object")
        trimmed = about.get("trimmed", {})
        kept = _rows(tensors.pop("kept"), trimmed["base_count"]) if "kept" in tensors else None
        return Adapter(
            sigma_d=tensors.pop("sigma_d"),
            attenuation=AttenuationConfig(**as_before(about["attenuation"])[0]),
            updates=tensors,
            base_fingerprint=about["base_sha256"],
            config=about["config"],
            version=about["package_version"],
            calibration=Calibration.from_dict(about["calibration"]) if "calibration" in about else None,
            origin=parse_origin(about.get("origin", NOWHERE)),
            kept=kept,
            sh_degree=trimmed.get("sh_degree"),
            screen_filter=parse_entry(about),
        )
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise ClodError(f"{path}: its description is damaged ({error!r}); copy or export the adapter again") from error
    except ClodError as error:
        raise ClodError(f"{path}: {error}") from error


def _rows(packed: torch.Tensor, count: int) -> torch.Tensor:
    """``[count]`` bool of a bit a row."""
    if packed.dtype != torch.uint8 or len(packed) != -(-count // 8):
        raise ValueError(f"kept has {len(packed)} bytes for {count} rows")
    return torch.from_numpy(np.unpackbits(packed.numpy(), count=count).astype(bool))
