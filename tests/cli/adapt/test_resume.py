"""Resuming: after an error, and that the state of another run, or a damaged one, is refused."""

import copy
import json
import math
import shutil
import signal
from dataclasses import replace
from functools import reduce
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from clod_adapter import AdaptConfig, ClodError, Phase, Progress, adapt
from clod_adapter._support.text import package_version
from clod_adapter.cli.adapt import listeners
from clod_adapter.cli.adapt.listeners import Saver
from clod_adapter.cli.shared.console import Console
from clod_adapter.progress import GracefulStop
from clod_adapter.training.state import KEY
from runs import OUTPUTS, STATE, change_step, fail, names, pressed, results
from scenes import capture as small_capture

CONFIG = AdaptConfig(iters=3, max_sv=3.0)
QUIET = Console(quiet=True)
HASHES = {
    "base_sha256": "of the base",
    "views_sha256": "of the views",
    "overruled": {"--with": ["means"]},
}
VALUES = [
    None,
    True,
    "",
    [[]],
    {"a": []},
    [1, 2],
    5,
    0.5,
    2**31,
    2**64,
    -1,
    10**400,
    1e308,
    math.inf,
    math.nan,
]


@pytest.fixture(scope="module")
def state(tmp_path_factory):
    """The file of a state after two of three steps, the base and scene, and what is in it."""
    path = tmp_path_factory.mktemp("saved") / STATE
    pair = small_capture(40, views=4, width=16, height=12)
    saver = Saver(path, CONFIG, QUIET, GracefulStop(), resume=False)
    saver.identify("base.ply", "images", **HASHES)
    adapt(*pair, CONFIG, saver.saving(lambda now: now.done < 2 or not now.state))
    with safe_open(path, framework="pt") as file:
        return path, pair, load_file(path), json.loads(file.metadata()[KEY])


def places(value, path=()):
    """The paths of all entries of a JSON document, at any depth."""
    if path:
        yield path
    if isinstance(value, list):
        value = dict(enumerate(value))
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from places(entry, (*path, key))


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_damaged_states_are_refused_or_harmless(state, data):
    """Entries of another type or out of range, or missing, at any depth; tensors of other shapes,
    types or values.
    """
    path = state[0]
    pair = state[1]
    tensors = dict(state[2])
    about = copy.deepcopy(state[3])
    name = data.draw(st.sampled_from(sorted(tensors)))
    how = data.draw(st.sampled_from(["entry", "type", "shape", "value"]))
    changed = tensors[name].clone()
    if how == "entry":
        *way, last = data.draw(st.sampled_from([*places(about)]))
        parent = reduce(lambda above, key: above[key], way, about)
        parent[last] = data.draw(st.sampled_from(VALUES))
        if data.draw(st.booleans()):
            del parent[last]
    if how == "value":
        values = (
            [math.nan, math.inf, -3e38, 3e38, -1.0, 0.0]
            if changed.is_floating_point()
            else [2**31 - 1, -1, 0]
        )
        changed.view(-1)[data.draw(st.integers(0, changed.numel() - 1))] = data.draw(
            st.sampled_from(values)
        )
    tensors[name] = (
        changed.double() if how == "type" else changed[:-1] if how == "shape" else changed
    )
    save_file(tensors, path, {KEY: json.dumps(about)})
    try:
        saver = Saver(path, CONFIG, QUIET, GracefulStop(), resume=True)
        saver.identify("base.ply", "images", **HASHES)
        found = adapt(*pair, CONFIG, resume=saver.state).gaussians.tensors()
    except ClodError as error:
        assert "\n" not in str(error), error
        assert "start over" in str(error) or "use " in str(error), error
    else:
        assert all(value.isfinite().all() for value in found.values()), about


TINY = "--iters 12 --max-sv 4 --out dial.ply"
ADAPT = f"BASE --images SCENE {TINY}"


def test_states_of_other_runs_are_refused(clod, capture, tmp_path, monkeypatch):
    """Of other settings, inputs or versions, or damaged; of the same inputs with other names they
    are not.
    """

    def refused(message, *words):
        assert f"error: {STATE}: {message}" in clod(*words, code=2).err

    with pressed(listeners, "save_state", signal.SIGINT, signal.SIGTERM, at=2):
        clod(ADAPT, code=130)
    state = (tmp_path / STATE).read_bytes()
    capture.write(tmp_path / "other.ply", capture.gaussians.select(torch.arange(300) < 299))
    for scene in ("fewer", "moved"):
        shutil.copytree(capture.scene, tmp_path / scene)
    Image.new("RGB", (64, 48)).save(tmp_path / "fewer" / "images" / "003.png")
    for words, message in (
        (f"{ADAPT} --iters 13", "is of a run with --iters 12; use the original arguments"),
        (f"{ADAPT} --seed 5 --time-budget 9", "is of a run with no --time-budget, --seed 0; use"),
        (f"{ADAPT} --form paper", "is of a run with another --form"),
        (f"{ADAPT} --growth off", "is of a run with --growth on; use"),
        (f"{ADAPT} --antialiasing on", "is of another checkpoint than"),
        (f"{ADAPT} --without quats", "is of a run with other --with or --without, {'--with': [], "),
        (f"other.ply --images SCENE {TINY}", "is of another checkpoint than other.ply; use the"),
        (f"BASE --images fewer {TINY}", "is of other photographs than fewer; use the"),
    ):
        refused(message, words, "--resume")
    with monkeypatch.context() as patch:
        patch.setattr(listeners, "package_version", lambda: "0.0.7")
        refused(f"is of version {package_version()} of this package, not 0.0.7", ADAPT, "--resume")
    (tmp_path / STATE).write_bytes(state[:-9])
    for more in ("--resume", ""):  # nor is a file of another kind, such as an adapter, replaced
        refused("is not a training state or is damaged", ADAPT, more)
    (tmp_path / STATE).write_bytes(state)
    shutil.copy(capture.ply, tmp_path / "moved.ply")
    assert f"resuming {STATE} from step 1" in clod(f"moved.ply --images moved {TINY} --resume").err


def test_without_a_state_training_starts_over(clod, tmp_path, state, monkeypatch):
    """An earlier state stays until a new one replaces it; a state that cannot be saved costs
    nothing else.
    """
    done = clod(ADAPT, "--resume --json")
    assert f"there is no {STATE} to resume from: starting from the beginning" in done.err
    assert done.report["resumed_from"] is None and names(tmp_path) == OUTPUTS
    save_file(state[2], tmp_path / STATE, {KEY: json.dumps(state[3])})
    before = (tmp_path / STATE).read_bytes()
    full = Mock(side_effect=ClodError(f"{STATE}: cannot be written: No space left on device"))
    with monkeypatch.context() as patch:
        for name, value in (("save_state", full), ("SAVE_EVERY", 0.0), ("SAVE_COST", 1e9)):
            patch.setattr(listeners, name, value)
        done = clod(ADAPT, "--seed 4")
    assert done.err.count(f"will not find it: {STATE}: cannot be written: No space") == 1
    assert names(tmp_path) == sorted([*OUTPUTS, STATE])
    assert (tmp_path / STATE).read_bytes() == before
    done = clod(ADAPT, "--seed 4")
    assert f"{STATE} has step 2 of an interrupted run" in done.err and names(tmp_path) == OUTPUTS


def test_a_state_that_cannot_be_removed_is_a_note(clod, monkeypatch):
    unlink = Path.unlink

    def refuse(path, missing_ok=False):
        if path.name == STATE:
            raise PermissionError(1, "Operation not permitted", str(path))
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", refuse)
    assert f"note: {STATE}: cannot be removed (Operation not permitted)" in clod(ADAPT).err
    assert names(Path()) == sorted([*OUTPUTS, STATE])


@pytest.mark.parametrize(
    "step, save, oldest, share",
    [(0.1, 0.1, 15.0, 0.015), (25.0, 3.0, 80.0, 0.15), (1.0, 30.0, 220.0, 0.2)],
)
def test_the_state_is_recent_and_saving_takes_a_small_share_of_the_time(
    monkeypatch, step, save, oldest, share
):
    """Seconds of a step and of a save; the largest age of the state, unless a save takes very long,
    and the share.
    """
    clock = 0.0
    saved = [0.0]
    ages = [0.0]

    def save_state(path, state, run_of):
        nonlocal clock
        clock += save
        ages.append(clock - saved[-1])  # of the file that is replaced now
        saved.append(state)

    monkeypatch.setattr("clod_adapter.cli.adapt.listeners.time.perf_counter", lambda: clock)
    monkeypatch.setattr(listeners, "save_state", save_state)
    follow = Saver(Path(STATE), CONFIG, QUIET, GracefulStop(), resume=False).saving(
        lambda progress: None
    )
    for done in range(1, 601):
        clock += step
        follow(Progress(Phase.TRAINING, done, 600, clock, state=lambda now=clock: now))
    assert saved[1] == step and len(saved) > 4
    assert max(ages[2:]) <= oldest and save * (len(saved) - 1) / clock <= share


@pytest.mark.parametrize(
    "change, files",
    [(fail, [STATE]), (lambda found: replace(found, loss=math.nan), sorted([*OUTPUTS, STATE]))],
    ids=["step", "loss"],
)
def test_resuming_after_an_error(clod, attenuated, tmp_path, change, files):
    """The same command with --resume then writes the files of a run without an error."""
    with pytest.MonkeyPatch.context() as patch:
        change_step(patch, 6, change)
        done = clod(ADAPT, "--quiet" if change is fail else "--json", code=1)
    assert names(tmp_path) == files, done
    assert f"--resume resumes from step 5, which is in {STATE}\n" in done.err
    for said in ("please report it", "ZeroDivisionError: of ours"):
        assert (said in done.err) == (change is fail)
    if change is not fail:
        report = done.report
        assert report["interrupted"] and report["steps"] == 5 and len(report["rows"]) > 2
        assert done.note("the result so far is written: the loss of step 6 is not finite")
    assert f"resuming {STATE} from step 5" in clod(ADAPT, "--resume").err
    assert names(tmp_path) == OUTPUTS and results(tmp_path) == results(attenuated.parent)
