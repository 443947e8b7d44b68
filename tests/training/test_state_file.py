"""Training states on disk: exact round trips, and other files are refused."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.training.state import KEY, TrainingState, load_state, save_state

BELONGS = {"config": {"seed": 2**63 - 1, "lr": 0.1}, "base": "abc"}


@pytest.fixture
def state() -> TrainingState:
    return TrainingState(
        tensors={
            "parameter.means": torch.tensor([[-0.0, 1e-45, math.inf], [math.nan, 1 / 3, 2.0]]),
            "steps.kept": torch.tensor([3, 7], dtype=torch.int32),
            "mean.means": torch.zeros(3, 2).T,  # not contiguous
        },
        attenuation=AttenuationConfig(tau=0.01 + 0.02, scene_distance=1e-7),
        random=np.random.default_rng(5).bit_generator.state,
        order=(4, 0, 2), loss=0.1, averaged=2, steps=9, seconds=1 / 3, start_seconds=7.0,
    )  # fmt: skip


def test_round_trip_keeps_every_bit(tmp_path: Path, state: TrainingState) -> None:
    save_state(tmp_path / "state", state, BELONGS)
    found, belongs = load_state(tmp_path / "state")
    assert belongs == BELONGS and found.tensors.keys() == state.tensors.keys()
    for name, value in state.tensors.items():
        assert found.tensors[name].dtype == value.dtype
        assert torch.equal(found.tensors[name].view(torch.int32), value.contiguous().view(torch.int32)), name
    assert {**vars(found), "tensors": 0} == {**vars(state), "tensors": 0}


CHANGES: list[dict[str, Any]] = [
    {"steps": 9.0}, {"loss": True}, {"order": [1.0]}, {"attenuation": {"tau": 7}}, {"belongs": 1}, {"more": 1.0},
]  # fmt: skip


def test_other_files_are_refused(tmp_path: Path, state: TrainingState) -> None:
    good, bad = tmp_path / "good", tmp_path / "bad"
    save_state(good, state, BELONGS)
    tensors = load_file(good)
    with safe_open(good, framework="pt") as file:
        about = json.loads(file.metadata()[KEY])
    (tmp_path / "short").write_bytes(good.read_bytes()[:-5])
    for text in ("[]", *(json.dumps(about | changes) for changes in CHANGES), None):  # the last as of an adapter
        save_file(tensors, bad, {KEY: text} if text else None)
        for path in (bad, tmp_path / "short"):
            with pytest.raises(ClodError, match=f"^{path}: is not a training state or is damaged"):
                load_state(path)
    with pytest.raises(ClodError, match="cannot be read.*No such file"):
        load_state(tmp_path / "none")
    os.mkfifo(tmp_path / "pipe.resume.safetensors")  # is not waited for
    with pytest.raises(ClodError, match="not a regular file"):
        load_state(tmp_path / "pipe.resume.safetensors")
