from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import load
from clod_adapter.io.file_formats import write
from clod_adapter.io.formats.pt_model import load_pt
from formats import ABOUT, CALIBRATION, ORIGIN, damaged, model

NAMES = {"scales": "log_scales", "opacities": "opacity_logits"}


@pytest.mark.parametrize("degree", range(5))
def test_the_same_again(tmp_path: Path, degree: int) -> None:
    g = model(degree)
    assert write(tmp_path / "a.pt", g, ABOUT, origin=ORIGIN, calibration=CALIBRATION) == ()
    again, card, notes = load_pt(tmp_path / "a.pt")
    assert again.attenuation == g.attenuation and notes == ()
    assert (card.origin, card.about, card.calibration) == (ORIGIN, ABOUT, CALIBRATION)
    assert all(torch.equal(tensor, again.tensors()[name]) for name, tensor in g.tensors().items())
    read = load(tmp_path / "a.pt")
    rows = read.gaussians.tensors()
    assert all(torch.equal(tensor, rows[name]) for name, tensor in g.tensors().items() if name != "means")
    torch.testing.assert_close(rows["means"], g.means, rtol=1e-6, atol=1e-9)  # by way of coordinates in doubles
    assert (read.origin, read.calibration) == (ORIGIN, CALIBRATION)
    write(tmp_path / "b.pt", again, ABOUT, origin=ORIGIN, calibration=CALIBRATION)
    assert (tmp_path / "a.pt").read_bytes() == (tmp_path / "b.pt").read_bytes()


def test_as_gsplats_trainer_and_viewer_take_it(tmp_path: Path) -> None:
    """As in examples/simple_trainer.py (--ckpt) and simple_viewer.py: by name, with weights_only."""
    g = model(2)
    write(tmp_path / "a.pt", g)
    checkpoint = torch.load(tmp_path / "a.pt", map_location="cpu", weights_only=True)
    empty = {"means": 3, "scales": 3, "quats": 4}
    theirs = torch.nn.ParameterDict({name: torch.zeros(1, width) for name, width in empty.items()})
    theirs.update({"opacities": torch.zeros(1), "sh0": torch.zeros(1, 1, 3), "shN": torch.zeros(1, 15, 3)})
    for name in theirs:
        theirs[name].data = torch.cat([each["splats"][name] for each in [checkpoint]])
        assert torch.equal(theirs[name].data, getattr(g, NAMES.get(name, name)))
    assert torch.cat([theirs["sh0"], theirs["shN"]], dim=-2).shape == (40, 9, 3)
    assert checkpoint["step"] == 0 and torch.equal(checkpoint["splats"]["sigma_d"], g.sigma_d)


def test_a_trainers_own_has_no_dial(tmp_path: Path) -> None:
    g = model(0)
    values = {
        name: getattr(g, NAMES.get(name, name)) for name in ("means", "quats", "scales", "opacities", "sh0", "shN")
    }
    torch.save({"step": 6999, "splats": values}, tmp_path / "a.pt")
    again, card, notes = load_pt(tmp_path / "a.pt")
    assert again.sigma_d is None and card.version == "" and "normalised" in notes[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"clod_adapter": 3}, "description is damaged .a int"),
        ({"clod_adapter": "[" * 100_000}, "description is damaged"),
        ({"clod_adapter": json.dumps({"format": "clod-model"})}, "description is damaged"),
        ({"splats": {"sigma_d": torch.ones(3)}}, "sigma_d.*shape .3,., not .40,."),
        ({"splats": {"sigma_d": torch.ones(40).int()}}, "no plain tensor"),
        ({"splats": {"sigma_d": "1"}}, "no plain tensor"),
    ],
)
def test_odd_ones(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    write(tmp_path / "a.pt", model())
    checkpoint = torch.load(tmp_path / "a.pt", weights_only=True)
    change = {**change, "splats": checkpoint["splats"] | change.get("splats", {})}
    torch.save(checkpoint | change, tmp_path / "b.pt")
    with pytest.raises(ClodError, match=message):
        load_pt(tmp_path / "b.pt")


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damage_is_never_another_exception(tmp_path: Path, data: st.DataObject) -> None:
    write(tmp_path / "a.pt", model(0, 5), calibration=CALIBRATION)
    path = tmp_path / "damaged.pt"
    path.write_bytes(damaged((tmp_path / "a.pt").read_bytes(), data))
    try:
        assert isinstance(load_pt(path).gaussians, Gaussians)
    except ClodError as error:
        assert str(error).isprintable()
