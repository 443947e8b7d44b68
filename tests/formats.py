"""Helpers of the tests of file formats: models with extreme values, damaged files,
splat-transform.
"""

import gzip
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from clod_adapter.config import SH_COUNTS, AttenuationConfig
from clod_adapter.io.checkpoint import load, save
from clod_adapter.quality_table import QualityRow, QualityTable
from scenes import gaussians, seeded

ATTENUATION = AttenuationConfig(reference_distance=3.217, max_sv=7.0)
QUALITY_TABLE = QualityTable((QualityRow(1, 30, 29.1, 0.9, 2.5),), 40, 3, 64, 48, "a machine")
ORIGIN = (5.1e5, -4096.0, 0.25)
# of the fixture ``capture``
PACKED = Path(__file__).parent / "io" / "of_splat_transform" / "capture.compressed.ply"


def examples(count):
    """Settings of a property test that uses a fixture, such as tmp_path, for all its examples."""
    shared = [HealthCheck.function_scoped_fixture]
    return settings(deadline=None, max_examples=count, suppress_health_check=shared)


def model(degree=3, count=40, *, growth=True):
    """With extreme values: opacity 1, sigma_d of 0 to 1e9, quaternions of length 1e-14 to 1e14,
    growth_d of -1 to 3.
    """
    g = gaussians(count, degree, seed=degree)
    sigma = torch.rand(count, generator=seeded(1)) * 4
    sigma[:4] = torch.tensor([1e9, 0.0, 1e-3, 65504.0])
    logits = g.opacity_logits.clone()
    logits[0] = torch.inf
    quats = g.quats.clone()
    quats[1:4] *= torch.tensor([1e-14, 1e14, 3.0])[:, None]
    growth_d = (
        torch.linspace(-1, 3, count).where(torch.arange(count) % 5 != 2, 0) if growth else None
    )
    return g.replace(
        opacity_logits=logits,
        quats=quats,
        sigma_d=sigma,
        growth_d=growth_d,
        attenuation=ATTENUATION,
    )


def axes_of(quats):
    """``[N, 3, 3]`` float64, an axis in each column."""
    return torch.from_numpy(Rotation.from_quat(quats.double().roll(-1, 1).numpy()).as_matrix())


def turned(a, b):
    """The sine of the largest angle between the axes of two ellipsoids, whose half turns are the
    same.
    """
    return float(torch.linalg.cross(axes_of(a), axes_of(b), dim=1).norm(dim=1).max())


def covariances(g):
    """``[N, 3, 3]`` float64, the same for every rotation that gives the same ellipsoid."""
    axes = axes_of(g.quats) * g.log_scales.double().exp()[:, None]
    return axes @ axes.mT


def damaged(whole, data):
    """A truncated file, or one with a few values overwritten, at its beginning more often than in
    the rest.
    """
    if data.draw(st.booleans()):
        return whole[: data.draw(st.integers(0, len(whole) - 1))]
    changed = bytearray(whole)
    words = st.sampled_from(
        [b"\xff" * 8, b"\xff" * 4, b"\0" * 8, b"\0\0\0\x80", b"nan", b" ", b"-1", b"\n", b"#"]
    )
    for _ in range(data.draw(st.integers(1, 4))):
        end = min(data.draw(st.sampled_from([16, 64, 1024, len(whole)])), len(whole))
        at = data.draw(st.integers(0, end - 1))
        value = data.draw(st.binary(min_size=1, max_size=1) | words)
        changed[at : at + len(value)] = value
    return bytes(changed)


def splat_transform(*arguments):
    """Runs splat-transform, from PATH or $CLOD_SPLAT_TRANSFORM; skips the test if it is missing."""
    command = os.environ.get("CLOD_SPLAT_TRANSFORM") or shutil.which("splat-transform")
    if command is None:
        pytest.skip("splat-transform is not on PATH, and CLOD_SPLAT_TRANSFORM is not set")
    words = [*command.split(), "-q", "-w", *map(str, arguments)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stdout + done.stderr


def rows_by_place(means, others):
    """The row of ``others`` nearest to each of ``means``; all different."""
    rows = np.linalg.norm(means[:, None] - others[None], axis=2).argmin(1)
    assert len(set(rows)) == len(rows)
    return rows


def change_setting(path, name, old, new):
    """Changes a setting in a file of any format that stores it, or in an adapter: text of the same
    length.
    """
    assert len(old) == len(new)
    # of JSON, of JSON in JSON, and of the comments of a PLY
    pattern = rf'({name}\\?"?:? ?){old}(?![.\d])'.encode()

    def changed(whole):
        found, count = re.subn(pattern, rb"\g<1>" + new.encode(), whole)
        assert count, f"{name} is not in {path}"
        return found

    if path.suffix == ".pt":
        checkpoint = torch.load(path, weights_only=True)
        torch.save(
            checkpoint | {"clod_adapter": changed(checkpoint["clod_adapter"].encode()).decode()},
            path,
        )
    elif path.suffix == ".spz":
        path.write_bytes(gzip.compress(changed(gzip.decompress(path.read_bytes()))))
    else:
        path.write_bytes(changed(path.read_bytes()))
    return path


def resaved(base, gaussians=None):
    """What is read of the PLY that is saved from a base, or from its Gaussians once tuned."""
    path = base.path.with_name("out.ply")
    save(path, gaussians or base.gaussians, base)
    return load(path)


def write_rows(path, rows, order="<", comments=()):
    """A PLY of these vertices, in the byte order "<" or ">", or "ascii"."""
    return write_elements(
        path, [PlyElement.describe(rows, "vertex", comments=list(comments))], order
    )


def write_elements(path, elements, order="<"):
    PlyData(elements, text=order == "ascii", byte_order="=" if order == "ascii" else order).write(
        str(path)
    )
    return path


def without_comments(path, **columns):
    """The file as another tool writes it: without its comments, some columns added or changed in
    every row.
    """
    rows = with_columns(PlyData.read(str(path))["vertex"].data, **columns)
    return write_rows(path.with_name("rewritten.ply"), rows)


def with_columns(old, **columns):
    added = [(name, "f4") for name in columns if name not in old.dtype.names]
    rows = np.zeros(len(old), old.dtype.descr + added)
    for name in rows.dtype.names or ():
        rows[name] = columns[name] if name in columns else old[name]
    return rows


def needed(degree=0):
    """The columns that every reader needs, in Inria's order."""
    rest = [f"f_rest_{k}" for k in range(3 * (SH_COUNTS[degree] - 1))]
    shape = ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    return ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity", *shape]


def random_rows(count, names, seed=0, types=None):
    """Normal values in columns of float32 or of ``types``."""
    rng = np.random.default_rng(seed)
    rows = np.empty(count, [(name, (types or {}).get(name, "f4")) for name in names])
    for name in names:
        rows[name] = (
            rng.integers(0, 99, count) if rows.dtype[name].kind in "iu" else rng.normal(size=count)
        )
    return rows


def inria_rows(g):
    """The vertices that Inria's trainer writes of these Gaussians, normals included; the dial's
    columns last.
    """
    flat = g.shN.numpy().transpose(0, 2, 1).reshape(len(g), -1)  # channel by channel
    parts = [
        g.means,
        torch.zeros(len(g), 3),
        g.sh0[:, 0],
        flat,
        g.opacity_logits[:, None],
        g.log_scales,
        g.quats,
    ]
    names = needed(g.sh_degree)
    columns = dict(
        zip([*names[:3], "nx", "ny", "nz", *names[3:]], np.concatenate(parts, 1).T, strict=True)
    )
    columns |= {
        name: tensor.numpy()
        for name, tensor in g.tensors().items()
        if name in ("sigma_d", "growth_d")
    }
    return with_columns(np.empty(len(g), [(name, "f4") for name in columns]), **columns)
