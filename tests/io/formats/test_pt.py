from __future__ import annotations

import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import load, save

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


@pytest.mark.parametrize("bands", DEGREES)
def test_gsplats_checkpoint(tmp_path: Path, bands: int) -> None:
    values = splats(bands=bands)
    parameters = torch.nn.ParameterDict(values)
    base = load(write(tmp_path / "a.pt", {"step": 6999, "splats": parameters.state_dict()}))
    g = base.gaussians
    assert g.sh_degree == DEGREES[bands] and g.sigma_d is None and "normalised" in base.notes[0]
    pairs = {"log_scales": "scales", "opacity_logits": "opacities"}
    for name, tensor in g.tensors().items():
        assert torch.equal(tensor, values[pairs.get(name, name)]), name
    save(tmp_path / "out.ply", g, base)
    again = load(tmp_path / "out.ply")
    assert all(torch.equal(a, b) for a, b in zip(again.gaussians.tensors().values(), g.tensors().values(), strict=True))
    assert again.vertex.dtype.names[3:6] == ("nx", "ny", "nz") and len(base.fingerprint) == 64


def test_other_numbers_and_what_else_is_in_it(tmp_path: Path) -> None:
    values = splats() | {"means": torch.randn(12, 3, dtype=torch.float64), "quats": torch.randn(4, 12).half().T}
    values["scales"][3] = torch.nan
    extra = {"app_module": torch.nn.Linear(2, 2).state_dict(), "optimizer": [torch.zeros(3)]}
    base = load(write(tmp_path / "a.PT", {"splats": values, **extra}))
    assert len(base.gaussians) == 11 and "1 of 12 Gaussians dropped" in base.notes[0]
    np.testing.assert_array_equal(base.gaussians.means[0], values["means"][0].float())


class Runs:
    def __init__(self, *what: Any) -> None:
        self.what = what

    def __reduce__(self) -> Any:
        return self.what[0], self.what[1:]


def test_a_pickle_that_runs_code_is_refused_unrun(tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    for evil in (Runs(os.mkdir, str(mark)), Runs(eval, f"__import__('os').mkdir({str(mark)!r})")):
        write(tmp_path / "a.pt", {"splats": splats() | {"means": evil}})
        with pytest.raises(ClodError, match="more than tensors, and is not unpickled"):
            load(tmp_path / "a.pt")
        (tmp_path / "b.pt").write_bytes(pickle.dumps({"splats": evil}))
        with pytest.raises(ClodError, match="format before 1.6"):
            load(tmp_path / "b.pt")
    assert not mark.exists()


def test_claims_take_no_memory(tmp_path: Path) -> None:
    for claim in (torch.zeros(1).expand(1 << 40, 3), Runs(bytearray, 1 << 33), torch.zeros(3, 3, device="meta")):
        write(tmp_path / "a.pt", {"splats": splats() | {"means": claim}})
        with pytest.raises(ClodError, match="no plain tensor|more than tensors"):
            load(tmp_path / "a.pt")
    names = zipfile.ZipFile(write(tmp_path / "a.pt", {"splats": splats()}))
    with names as old, zipfile.ZipFile(tmp_path / "bomb.pt", "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name) + bytes(1 << 20))
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
        ({"splats": splats() | {"quats": torch.zeros(11, 4)}}, "quats.*shape .11, 4., not .12, 4."),
        ({"splats": splats() | {"means": torch.tensor(1.0)}}, "shape"),
        ({"splats": splats() | {"means": torch.zeros(12, 3).int()}}, "no plain tensor"),
        ({"splats": splats() | {"means": torch.eye(3).to_sparse()}}, "more than tensors"),
        ({"splats": splats(0)}, "has no Gaussians"),
    ],
)  # fmt: skip
def test_other_checkpoints(tmp_path: Path, checkpoint: Any, message: str) -> None:
    with pytest.raises(ClodError, match=f"a.pt: .*{message}"):
        load(write(tmp_path / "a.pt", checkpoint))


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damage_is_never_another_exception(tmp_path: Path, data: st.DataObject) -> None:
    whole = write(tmp_path / "a.pt", {"splats": splats(4, 0)}).read_bytes()
    path = tmp_path / "damaged.pt"
    path.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    with pytest.raises(ClodError):
        load(path)
    with zipfile.ZipFile(tmp_path / "a.pt") as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            entry = bytearray(old.read(name))
            if name.endswith("data.pkl"):
                for _ in range(data.draw(st.integers(1, 4))):
                    entry[data.draw(st.integers(0, len(entry) - 1))] = data.draw(st.integers(0, 255))
            new.writestr(name, bytes(entry))
    try:
        load(path)
    except ClodError as error:
        assert str(path) in str(error)
