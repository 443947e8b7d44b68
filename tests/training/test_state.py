"""States of training and their files: resumed runs end with the same bits, and other states are refused."""

from __future__ import annotations

import copy
import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from clod_adapter.adapter import ATTRIBUTES, with_dial
from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.progress import Phase, Progress
from clod_adapter.training.dial import TrainableSubset
from clod_adapter.training.loop import adapt
from clod_adapter.training.state import KEY, TrainingState, load_state, save_state
from runs import config_of, states_of
from scenes import assert_equal

Pair = tuple[Gaussians, Scene]


RESUMED = {
    "ours": {},
    "paper": vars(AdaptConfig.paper(iters=12, max_sv=4.0)),
    "without growth": {"lr_shN": 0.0, "growth": "off"},
    "sigma_d alone": {f"lr_{name}": 0.0 for name in ("means", "quats", "scales", "opacities", "sh0", "shN")},
}


@pytest.mark.parametrize("form", RESUMED)
def test_a_resumed_run_ends_with_the_same_bits(captured: Pair, form: str) -> None:
    """From states within and at the end of a round of views, and before, during and after averaging."""
    base, scene = captured
    if form == "without growth":
        base = base.replace(shN=torch.zeros_like(base.shN))
    if form == "paper":
        base = with_dial(base, torch.full((len(base),), 1.5), AttenuationConfig(scene_distance=4.0, max_sv=3.0))
    config, states = config_of(**{"iters": 12, **RESUMED[form]}), dict[int, TrainingState]()
    whole = adapt(base, scene, config, states_of({1, 6, 10, 11}, states))
    if form == "sigma_d alone":
        assert all(torch.equal(getattr(whole.gaussians, name), getattr(base, name)) for name in ATTRIBUTES)
    seen: list[Progress] = []
    for steps, state in states.items():
        again = adapt(base, scene, config, seen.append, copy.deepcopy(state))
        assert_equal(again.gaussians, whole.gaussians)
        assert (again.steps, again.interrupted, again.start_seconds) == (12, False, whole.start_seconds), steps
        assert again.seconds > state.seconds
    assert {p.phase for p in seen} == {Phase.TRAINING} and [p.done for p in seen[:11]] == list(range(2, 13))


@pytest.mark.parametrize("distance", [1.0, 4.0])
def test_untrained_rows_keep_their_units_when_resumed(captured: Pair, distance: float) -> None:
    """Their dial is not in the state, but the base's, sigma_d in its unit, growth 0 where it has none."""
    base, scene = captured
    settings = AttenuationConfig(scene_distance=distance, reference_distance=4.0)
    growth_d = torch.linspace(-0.5, 1, len(base)) if distance == 1 else None
    base = with_dial(base, torch.linspace(0.3, 3, len(base)) * 4 / distance, settings, growth_d)
    part, states = TrainableSubset(len(base) // 2), dict[int, TrainingState]()
    whole = adapt(base, scene, config_of(iters=4), states_of({2}, states), subset=part)
    again = adapt(base, scene, config_of(iters=4), None, states[2], subset=part)
    assert_equal(again.gaussians, whole.gaussians)
    rest = slice(len(base) // 2, None)
    torch.testing.assert_close(whole.gaussians.sigma_d[rest], base.sigma_d[rest] * distance)


def test_a_state_of_another_run_is_refused(captured: Pair) -> None:
    base, scene = captured
    config, states = config_of(iters=2), dict[int, TrainingState]()
    adapt(base, scene, config, states_of({1}, states))
    state = states[1]
    few, fewer = base.select(torch.arange(len(base)) < 9), Scene(scene.train[:1], ())
    for other in (
        (few, scene, config), (base, fewer, config), (base, scene, replace(config, form="paper")),
        (base, scene, replace(config, growth="off")),
    ):  # fmt: skip
        with pytest.raises(ClodError, match="of other Gaussians, views or settings"):
            adapt(*other, None, state)
    damaged = dict(state.tensors) | {"steps.kept": state.tensors["steps.kept"] - 2}
    for impossible in (
        {"tensors": damaged}, {"steps": 0}, {"averaged": -1}, {"averaged": 9}, {"seconds": math.nan}, {"seconds": -1.0},
    ):  # fmt: skip
        with pytest.raises(ClodError, match="impossible counts|impossible values of steps|of other Gaussians"):
            adapt(base, scene, config, None, replace(state, **impossible))
    for name, value in (
        ("parameter.means", math.nan), ("parameter.opacity_logits", math.inf), ("first.sh0", math.inf),
        ("second.sh0", -1.0), ("second.means", math.nan), ("parameter.log_sigma", 1e30),
    ):  # fmt: skip
        tensors = {n: t.clone() for n, t in state.tensors.items()}
        tensors[name][7] = value
        with pytest.raises(ClodError, match="the training state.*; start over"):
            adapt(base, scene, config, None, replace(state, tensors=tensors))
    for broken in ({}, {**state.random, "state": {"state": -1, "inc": "x"}}):
        with pytest.raises(ClodError, match="random state is damaged"):
            adapt(base, scene, config, None, replace(state, random=broken))


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
    {"steps": "x"}, {"order": 1}, {"attenuation": {"tau": 7}}, {"belongs": 1}, {"more": 1.0},
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
