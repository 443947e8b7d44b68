from __future__ import annotations

import os
import pickle
import zipfile
from copy import copy
from pathlib import Path
from typing import Any

import pytest
import torch

from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.file_formats import write as write_model
from formats import model

DEGREES = {0: 0, 3: 1, 8: 2, 15: 3, 24: 4}


def splats(count: int = 12, bands: int = 15) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(bands)
    shapes = {
        "means": (count, 3), "quats": (count, 4), "scales": (count, 3), "opacities": (count,), "sh0": (count, 1, 3),
        "shN": (count, bands, 3),
    }  # fmt: skip
    return {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}


def write(path: Path, checkpoint: Any) -> Path:
    torch.save(checkpoint, path)
    return path


@pytest.mark.parametrize("bands", [0, 15, 24])
def test_gsplat_checkpoint(tmp_path: Path, bands: int) -> None:
    """Also with other number types and strides, other entries, and a row that is not finite."""
    values = splats(bands=bands) | {"means": torch.randn(12, 3).double(), "quats": torch.randn(4, 12).half().T}
    values["scales"][3] = torch.nan
    parameters = torch.nn.ParameterDict(values).state_dict()
    extra = {"app_module": torch.nn.Linear(2, 2).state_dict(), "optimizer": [torch.zeros(3)]}
    base = load(write(tmp_path / "a.PT", {"step": 6999, "splats": parameters, **extra}))
    g = base.gaussians
    assert g.sh_degree == DEGREES[bands] and g.sigma_d is None and "normalised" in base.notes[1]
    assert "1 of 12 Gaussians dropped" in base.notes[0] and len(base.fingerprint) == 64
    names = {"log_scales": "scales", "opacity_logits": "opacities"}
    for name, tensor in g.tensors().items():
        assert torch.equal(tensor, values[names.get(name, name)][torch.arange(12) != 3].float()), name
    save(tmp_path / "out.ply", g, base)
    again = load(tmp_path / "out.ply")
    assert all(torch.equal(a, b) for a, b in zip(again.gaussians.tensors().values(), g.tensors().values(), strict=True))
    assert again.vertex.dtype.names[3:6] == ("nx", "ny", "nz")


class Call:
    def __init__(self, *what: Any) -> None:
        self.what = what

    def __reduce__(self) -> Any:
        return self.what[0], self.what[1:]


def test_pickle_with_code_is_refused_and_not_run(tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    for evil in (Call(os.mkdir, str(mark)), Call(eval, f"__import__('os').mkdir({str(mark)!r})")):
        write(tmp_path / "a.pt", {"splats": splats() | {"means": evil}})
        with pytest.raises(ClodError, match="more than tensors, and is not unpickled"):
            load(tmp_path / "a.pt")
        (tmp_path / "b.pt").write_bytes(pickle.dumps({"splats": evil}))
        with pytest.raises(ClodError, match="format before 1.6"):
            load(tmp_path / "b.pt")
    assert not mark.exists()


def test_false_sizes_allocate_nothing(tmp_path: Path) -> None:
    for claim in (torch.zeros(1).expand(1 << 40, 3), Call(bytearray, 1 << 33), torch.zeros(3, 3, device="meta")):
        write(tmp_path / "a.pt", {"splats": splats() | {"means": claim}})
        with pytest.raises(ClodError, match="no plain tensor|more than tensors"):
            load(tmp_path / "a.pt")
    names = zipfile.ZipFile(write(tmp_path / "a.pt", {"splats": splats()}))
    with names as old, zipfile.ZipFile(tmp_path / "bomb.pt", "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name) + bytes(1 << 20))
    with pytest.raises(ClodError, match="torch.save does not write"):
        load(tmp_path / "bomb.pt")


def test_overlapping_entries_are_refused(tmp_path: Path) -> None:
    """A hundred names of the same megabyte."""
    with zipfile.ZipFile(write(tmp_path / "a.pt", {"splats": splats()})) as old:
        entries = {name: old.read(name) for name in old.namelist()}
    with zipfile.ZipFile(tmp_path / "bomb.pt", "w") as new:
        for name, data in entries.items():
            new.writestr(name, data)
        new.writestr("a/data/99", bytes(1 << 20))
        for k in range(100):
            more = copy(new.getinfo("a/data/99"))
            more.filename = f"a/data/{k + 100}"
            new.filelist.append(more)
    with pytest.raises(ClodError, match="torch.save does not write"):
        load(tmp_path / "bomb.pt")


@pytest.mark.parametrize(
    ("checkpoint", "message"),
    [
        ([1], "no dictionary 'splats'.*list"),
        ({"model": 1}, "no dictionary 'splats'.*'model'"),
        ({"splats": [1]}, "no dictionary 'splats'"),
        ({"splats": {}}, "no 'means'"),
        ({"splats": splats() | {"shN": None, "features": torch.zeros(12, 32)}}, "no 'shN'; with appearance"),
        ({"splats": splats() | {"shN": torch.zeros(12, 7, 3)}}, "7 coefficients"),
        ({"splats": splats() | {"shN": torch.zeros(12)}}, "shape"),
        ({"splats": splats() | {"quats": torch.zeros(11, 4)}}, "quats has shape .11, 4., expected .12, 4."),
        ({"splats": splats() | {"means": torch.tensor(1.0)}}, "shape"),
        ({"splats": splats() | {"means": torch.zeros(12, 3).int()}}, "no plain tensor"),
        ({"splats": splats() | {"means": torch.eye(3).to_sparse()}}, "more than tensors"),
        ({"splats": splats(0)}, "it has 0 rows"),
        ({"splats": splats(), "clod_adapter": 3}, "settings are damaged .*a int, not text"),
        ({"splats": splats(), "clod_adapter": "[" * 100_000}, "settings are damaged"),
        ({"splats": splats(), "clod_adapter": '{"format": "clod-model"}'}, "settings are damaged"),
        ({"splats": splats() | {"sigma_d": torch.ones(3)}}, "sigma_d has shape .3,., expected .12,."),
        ({"splats": splats() | {"sigma_d": torch.ones(12).int()}}, "no plain tensor"),
        ({"splats": splats() | {"sigma_d": "1"}}, "no plain tensor"),
        ({"splats": splats() | {"sigma_d": torch.ones(12), "growth_d": torch.ones(3)}}, "growth_d has shape .3,."),
    ],
)  # fmt: skip
def test_invalid_checkpoint_is_refused(tmp_path: Path, checkpoint: Any, message: str) -> None:
    with pytest.raises(ClodError, match=f"a.pt: .*{message}"):
        load(write(tmp_path / "a.pt", checkpoint))


def test_written_tensors_are_those_of_gsplat(tmp_path: Path) -> None:
    """As in examples/simple_trainer.py (--ckpt) and simple_viewer.py: by name, with weights_only."""
    g = model(2)
    write_model(tmp_path / "a.pt", g)
    checkpoint = torch.load(tmp_path / "a.pt", map_location="cpu", weights_only=True)
    splats = checkpoint["splats"]
    for theirs, ours in {"means": "means", "quats": "quats", "scales": "log_scales", "opacities": "opacity_logits",
                         "sh0": "sh0", "shN": "shN", "sigma_d": "sigma_d", "growth_d": "growth_d"}.items():  # fmt: skip
        assert torch.equal(splats[theirs], getattr(g, ours))
    assert torch.cat([splats["sh0"], splats["shN"]], dim=-2).shape == (40, 9, 3) and checkpoint["step"] == 0
