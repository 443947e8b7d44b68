"""Damaged states: whatever a file to resume from holds, it is gone on from to a finite end, or refused in one line."""

from __future__ import annotations

import json
import math
from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from clod_adapter.cli.adapt.resume import Resumed, RunKey, Saver, find_state, identify
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.shared.interrupts import GracefulStop
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.training.loop import adapt
from clod_adapter.training.state_file import KEY
from scenes import capture

CONFIG = AdaptConfig(iters=3, max_sv=3.0, average=0.7)
QUIET = Console(quiet=True)
ASKED = {"--with": ["means"], "--without": []}


class Saved:
    """A state after two of three steps, what it belongs to, and going on from a file like it."""

    def __init__(self, path: Path) -> None:
        self.base, self.scene = capture(40, views=4, width=16, height=12)
        run_of = self._key(None) | {"overruled": ASKED, "frozen": ["scales"]}
        saver = Saver(path, run_of, None, QUIET, GracefulStop())
        adapt(self.base, self.scene, CONFIG, saver.saving(lambda now: now.done < 2 or not now.state))
        self.tensors = load_file(path)
        with safe_open(path, framework="pt") as file:
            self.about = json.loads(file.metadata()[KEY])

    def _key(self, resumed: Resumed | None) -> RunKey:
        files = Namespace(ply="base.ply", images="images")
        return identify(resumed, self.base, self.scene, CONFIG, files, QUIET)

    def go_on(self, path: Path) -> Gaussians:
        """All that the command does with a state."""
        resumed = find_state(path, True, CONFIG, QUIET)
        assert resumed
        self._key(resumed)
        resumed.check_override(ASKED)
        assert all(isinstance(name, str) for name in resumed.frozen)
        json.dumps(resumed.run_of, allow_nan=True)
        return adapt(self.base, self.scene, CONFIG, resume=resumed.state).gaussians


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Saved:
    return Saved(tmp_path_factory.mktemp("saved") / "dial.resume.safetensors")


def assert_read_or_refused(saved: Saved, path: Path, tensors: dict[str, torch.Tensor], about: Any) -> None:
    save_file(tensors, path, {KEY: json.dumps(about)})
    try:
        found = saved.go_on(path)
    except ClodError as error:
        assert "\n" not in str(error) and ("start over" in str(error) or "use " in str(error)), error
    else:
        assert all(value.isfinite().all() for value in found.tensors().values()), about


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Of every entry of a JSON document, at any depth."""
    below = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [*([path] if path else []), *(place for key, each in below for place in places(each, (*path, key)))]


VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.lists(st.integers(-2, 9), max_size=3),
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
    st.sampled_from([2**31, 2**63, 2**64, -1, 10**400, 1e308, math.inf, math.nan, "nan", [[]], {"a": []}, 5]),
)  # fmt: skip
HOW = settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@HOW
@given(data=st.data())
def test_a_record_with_entries_that_are_wrong(saved: Saved, tmp_path: Path, data: Any) -> None:
    """Of another type, out of range, missing, or too many, at any depth."""
    about = json.loads(json.dumps(saved.about))
    for _ in range(data.draw(st.integers(1, 2))):
        *way, last = data.draw(st.sampled_from(places(about)))
        parent = about
        for key in way:
            parent = parent[key]
        how = data.draw(st.sampled_from(["replace", "remove", "add"]))
        if how == "remove":
            del parent[last]
        elif how == "add" and isinstance(parent, dict):
            parent[data.draw(st.text(max_size=4))] = data.draw(VALUES)
        else:
            parent[last] = data.draw(VALUES)
    assert_read_or_refused(saved, tmp_path / "state", saved.tensors, about)


def change(tensor: torch.Tensor, how: str, value: float, row: int) -> torch.Tensor | None:
    if how == "remove":
        return None
    if how == "type":
        return tensor.double()
    if how == "shape":
        return tensor[:-1] if row % 2 else tensor.unsqueeze(-1)
    changed = tensor.clone()
    changed.view(-1)[row % changed.numel()] = int(max(min(value, 2**31 - 1), -(2**31))) if how == "steps" else value
    return changed


@HOW
@given(data=st.data())
def test_tensors_that_are_wrong(saved: Saved, tmp_path: Path, data: Any) -> None:
    tensors = dict(saved.tensors)
    name = data.draw(st.sampled_from(sorted(tensors)))
    how = data.draw(st.sampled_from(["remove", "type", "shape", "value", "value", "value"]))
    value = data.draw(st.sampled_from([math.nan, math.inf, -math.inf, 3e38, -3e38, -1.0, 1e9, 0.0]))
    if how == "value" and name.startswith("steps."):
        how, value = "steps", 0.0 if math.isnan(value) else value
    changed = change(tensors.pop(name), how, value, data.draw(st.integers(0, 500)))
    if changed is not None:
        tensors[name] = changed
    assert_read_or_refused(saved, tmp_path / "state", tensors, saved.about)


@pytest.mark.parametrize(
    ("entry", "value", "said"),
    [("frozen", 5, "frozen 5"), ("frozen", [1], r"frozen \[1\]"), ("overruled", 7, "overruled 7"),
     ("overruled", {"--with": 3}, "overruled {'--with': 3}"), ("config", 3, "is of other settings"),
     ("version", None, "is of version None"), ("base_sha256", [1], "is of another checkpoint")],
)  # fmt: skip
def test_a_record_of_the_wrong_type_is_named(saved: Saved, tmp_path: Path, entry: str, value: Any, said: str) -> None:
    path = tmp_path / "state"
    belongs = saved.about["belongs"] | {entry: value}
    save_file(saved.tensors, path, {KEY: json.dumps(saved.about | {"belongs": belongs})})
    with pytest.raises(ClodError, match=f"^{path}: .*{said}"):
        saved.go_on(path)


def test_the_undamaged_state_is_gone_on_from(saved: Saved, tmp_path: Path) -> None:
    save_file(saved.tensors, tmp_path / "state", {KEY: json.dumps(saved.about)})
    found, want = saved.go_on(tmp_path / "state"), adapt(saved.base, saved.scene, CONFIG).gaussians
    for name, value in want.tensors().items():
        assert torch.equal(found.tensors()[name], value), name
    assert saved.about["belongs"]["config"] == asdict(CONFIG)
