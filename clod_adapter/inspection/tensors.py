"""Safetensors files of this package other than models: adapters, and the states of interrupted runs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from clod_adapter.adapter import Adapter
from clod_adapter.inspection.statistics import Spread
from clod_adapter.io.adapter_file import FORMAT, KEY, load_adapter
from clod_adapter.io.tensor_file import read_tensor_header
from clod_adapter.training.state import KEY as STATE_KEY
from clod_adapter.training.state import load_state


def inspect_tensors(path: Path) -> tuple[str, dict[str, Any], tuple[str, ...]] | None:
    """The kind of such a file, plain JSON about it, and notes; None where it is neither.

    Raises:
        ClodError: it cannot be read, or is damaged.
    """
    metadata = read_tensor_header(path)[1]
    if STATE_KEY in metadata:
        return "the state of an interrupted run, for --resume", _state(path), ()
    if KEY in metadata and f'"{FORMAT}"' in metadata[KEY]:
        adapter = load_adapter(path)
        return "an adapter: what clod-adapt learned, without its checkpoint", _adapter(adapter), adapter.notes
    return None


def _adapter(adapter: Adapter) -> dict[str, Any]:
    kinds = {name: f"{str(t.dtype).removeprefix('torch.')} {list(t.shape)}" for name, t in adapter.updates.items()}
    growth = None if adapter.growth_d is None else asdict(Spread.of(adapter.growth_d.numpy()))
    return {
        "kind": "adapter", "writer": f"clod-adapter {adapter.version}", "count": len(adapter.sigma_d),
        "base": adapter.base_fingerprint, "attenuation": asdict(adapter.attenuation), "config": adapter.config,
        "updates": kinds, "origin": list(adapter.origin), "sigma": asdict(Spread.of(adapter.sigma_d.numpy())),
        "growth": growth,
        "calibration": adapter.calibration and adapter.calibration.as_dict(),
    }  # fmt: skip


def _state(path: Path) -> dict[str, Any]:
    state, belongs = load_state(path)
    return {
        "kind": "state", "writer": None, "count": next((len(t) for t in state.tensors.values() if t.ndim), 0),
        "steps": state.steps, "seconds": state.seconds, "loss": state.loss, "belongs": belongs,
        "attenuation": asdict(state.attenuation),
    }  # fmt: skip
