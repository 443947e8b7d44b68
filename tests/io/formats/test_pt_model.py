from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import write
from clod_adapter.io.formats.pt_model import load_pt
from formats import model

NAMES = {"scales": "log_scales", "opacities": "opacity_logits"}


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
    again, card, notes = load_pt(tmp_path / "a.pt")[:3]
    assert again.sigma_d is None and card.version == "" and "normalised" in notes[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"clod_adapter": 3}, "settings are damaged .*a int, not text"),
        ({"clod_adapter": "[" * 100_000}, "settings are damaged"),
        ({"clod_adapter": json.dumps({"format": "clod-model"})}, "settings are damaged"),
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
