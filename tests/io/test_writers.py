from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import load
from clod_adapter.io.file_formats import LOADERS, WRITERS, load_model, write, writer_of
from formats import model
from scenes import gaussians


def test_the_table_is_light() -> None:
    code = "import sys, clod_adapter.io.file_formats; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_suffixes(tmp_path: Path) -> None:
    assert writer_of("a/B.PLY") is WRITERS[".ply"]
    for name in ("a.obj", "a"):
        with pytest.raises(ClodError, match="no format to write"):
            write(tmp_path / name, gaussians(3, 0, 0))


def test_ply(tmp_path: Path) -> None:
    g = gaussians(20, 3, 0).replace(sigma_d=torch.rand(20), attenuation=AttenuationConfig(tau=0.02))
    assert write(tmp_path / "a.ply", g, ("why",), origin=(1e6, 0.0, 0.0)) == ()
    again = load(tmp_path / "a.ply", origin=(1e6, 0.0, 0.0))
    assert again.gaussians.attenuation == g.attenuation and "why" in again.comments
    for name, tensor in g.tensors().items():
        assert torch.equal(tensor, again.gaussians.tensors()[name]), name


def test_opaque_gaussians_are_finite_in_a_ply(tmp_path: Path) -> None:
    (note,) = write(tmp_path / "a.ply", model())
    assert note == "1 opacities of +inf are written as 20, which is 1 too"
    again = load(tmp_path / "a.ply").gaussians
    assert torch.equal(again.opacities, model().opacities) and again.opacity_logits.isfinite().all()


@pytest.mark.parametrize("suffix", LOADERS)
def test_what_is_written_is_read(tmp_path: Path, suffix: str) -> None:
    g = model(1)
    g = g if WRITERS[suffix].carries_sigma else g.replace(sigma_d=None, attenuation=None)
    write(tmp_path / f"a{suffix.upper()}", g)
    again = load_model(tmp_path / f"a{suffix.upper()}").gaussians
    assert len(again) == len(g) and again.attenuation == g.attenuation
    assert set(WRITERS) == {".ply", *LOADERS}
    with pytest.raises(ClodError, match="is none of .glb"):
        load_model(tmp_path / "a.ply")


@pytest.mark.parametrize("suffix", LOADERS)
def test_files_that_are_not_there(tmp_path: Path, suffix: str) -> None:
    for name in (f"missing{suffix}", f"folder{suffix}"):
        (tmp_path / f"folder{suffix}").mkdir(exist_ok=True)
        with pytest.raises(ClodError, match=f"{name}: cannot be read"):
            load_model(tmp_path / name)


@pytest.mark.parametrize("suffix", WRITERS)
def test_nothing_is_half_written(tmp_path: Path, suffix: str) -> None:
    plain = model(1).replace(sigma_d=None, attenuation=None)
    unfit = (
        plain.select(torch.zeros(40, dtype=torch.bool)), plain.replace(sh0=plain.sh0 * torch.nan),
        plain.replace(quats=plain.quats * 0),
    )  # fmt: skip
    for g in unfit:
        with pytest.raises(ClodError, match="a" + suffix):
            write(tmp_path / f"a{suffix}", g)
    with pytest.raises(ClodError, match="does not exist"):
        write(tmp_path / "folder" / f"a{suffix}", plain)
    assert not list(tmp_path.iterdir())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("suffix", WRITERS)
def test_colours_of_any_size(tmp_path: Path, suffix: str) -> None:
    plain = model(1).replace(sigma_d=None, attenuation=None)
    most = torch.finfo(torch.float32).max
    write(tmp_path / f"a{suffix}", plain.replace(sh0=plain.sh0.sign() * most, shN=plain.shN.sign() * most))
    again = load(tmp_path / f"a{suffix}").gaussians
    assert len(again) == 40 and torch.equal(again.sh0.sign().unique(), torch.tensor([-1.0, 1.0]))
