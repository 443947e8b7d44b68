"""Training states as safetensors files: the tensors, and a JSON document in the metadata with everything else."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.sniff import refuse_irregular
from clod_adapter.io.tensor_file import read_tensors, write_tensors
from clod_adapter.training.state import TrainingState

KEY = "clod_adapter_state"  # of the JSON document in the metadata


def save_state(path: str | Path, state: TrainingState, belongs: dict[str, Any]) -> None:
    """Writes a state; loading it gives the same bits.

    Args:
        belongs: identifies the run; plain JSON.

    Raises:
        ClodError: the file cannot be written.
    """
    # Not asdict of the whole, which would copy the tensors.
    about = {f.name: getattr(state, f.name) for f in fields(state) if f.name != "tensors"}
    metadata = {KEY: json.dumps({**about, "attenuation": asdict(state.attenuation), "belongs": belongs})}
    with atomic_path(path) as temporary:
        write_tensors(temporary, state.tensors, metadata)


def load_state(path: str | Path) -> tuple[TrainingState, dict[str, Any]]:
    """Reads a state, and ``belongs`` of the run that saved it.

    Raises:
        ClodError: the file cannot be read, is damaged, or is not a training state.
    """
    path = Path(path)
    refuse_irregular(path, "delete it to start over")
    try:
        tensors, metadata = read_tensors(path)
        about = _typed(json.loads(metadata[KEY]), dict)
        belongs, random = _typed(about.pop("belongs"), dict), _typed(about.pop("random"), dict)
        settings = _typed(about.pop("attenuation"), dict)
        attenuation = AttenuationConfig(**{name: _typed(each, float, int, str) for name, each in settings.items()})
        order = tuple(_typed(view, int) for view in _typed(about.pop("order"), list))
        counts = {name: _typed(about.pop(name), int) for name in ("averaged", "steps")}
        rest = {name: float(_typed(value, float, int)) for name, value in about.items()}
        return TrainingState(tensors, attenuation, random, order, **counts, **rest), belongs  # type: ignore[arg-type]
    except OSError as error:
        raise ClodError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    except MemoryError:  # of a file that is whole
        raise
    except Exception as error:  # SafetensorError, and whatever a crafted file provokes
        raise ClodError(f"{path}: is not a training state or is damaged ({error}); delete it to start over") from error


def _typed(value: Any, *kinds: type) -> Any:
    """The value, if it is of one of these JSON types (a bool is not a number); raises TypeError otherwise."""
    if type(value) not in kinds:
        raise TypeError(f"{value!r:.40} is not of the type {kinds[0].__name__}")
    return value
