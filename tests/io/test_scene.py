"""Scenes as ``load_scene`` gives them: COLMAP models, photographs that are missing or distorted,
what is held out.
"""

import importlib
import math
import os
import shutil
import sys

import numpy as np
import pycolmap
import pytest
import torch
from numpy.testing import assert_array_equal
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from refusals import refused
from skimage.metrics import peak_signal_noise_ratio as psnr_of
from torch.testing import assert_close

from clod_adapter.io.scene import colmap
from clod_adapter.io.scene.colmap import load_points
from clod_adapter.io.scene.folder import scene_files
from clod_adapter.io.scene.load import load_cameras, load_scene
from clod_adapter.progress import Stopped
from models import write_model
from photographs import (
    LENSES,
    SIZE,
    camera,
    model_of,
    names_of,
    pixels,
    seen,
    views_of,
    write_images,
    write_scene,
)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


PINHOLES = {"kind": "PINHOLE", "params": [9, 9, 4, 3], "width": 8, "height": 6}
PINHOLES |= {"names": ("a.png", "sub/b.png")}


@pytest.mark.parametrize("form", ["binary", "text", "before rigs"])
def test_scene_round_trips(tmp_path, form):
    cameras, names = write_scene(tmp_path)
    folder = tmp_path / "sparse" / "0"
    if form == "text":
        pycolmap.Reconstruction(str(folder)).write_text(str(folder))
    for pattern in {"text": ["*.bin"], "before rigs": ["rigs.bin", "frames.bin"]}.get(form, ()):
        for file in folder.glob(pattern):
            file.unlink()
    progress = []
    loaded = load_scene(str(tmp_path), progress=lambda now: progress.append((now.done, now.total)))
    assert loaded.notes == () and progress == [(k + 1, 10) for k in range(10)]
    assert dict(loaded.left_out) == {
        "undistortion": "all 10 cameras are pinholes",
        "scaling": "all 10 photographs are used at full resolution",
    }
    order = sorted(range(10), key=lambda i: names[i])
    assert names_of(loaded.test) == [names[order[0]], names[order[8]]]
    assert names_of(loaded.train) == [names[i] for i in order if i not in (order[0], order[8])]
    for view in (*loaded.train, *loaded.test):
        i = names.index(view.camera.name)
        assert_close(view.camera.viewmat, cameras[i].viewmat, atol=1e-6, rtol=0)
        assert_close(view.camera.K, cameras[i].K, atol=0, rtol=0)
        assert view.camera.viewmat.dtype == view.camera.K.dtype == torch.float32
        assert_array_equal(view.image, pixels(i))


def test_train_and_test_split(tmp_path):
    for count in (10, 1, 2):
        (tmp_path / str(count)).mkdir()
        names = write_scene(tmp_path / str(count), count)[1]
    for count, every, train in ((10, 3, 6), (10, 8, 8), (1, 8, 1)):
        loaded = load_scene(tmp_path / str(count), test_every=every)
        assert (len(loaded.train), len(loaded.test)) == (train, count - train)
    (tmp_path / "2" / "images" / max(names)).unlink()
    for folder, every, message in (
        ("1", 1, "test_every is 1"),
        ("2", 8, "no photograph to train on"),
    ):
        with refused(message):
            load_scene(tmp_path / folder, test_every=every)
    with pytest.raises(Stopped):
        load_scene(tmp_path / "10", progress=lambda now: False)


def test_split_of_the_scene_is_used(tmp_path):
    """Names in test.txt; other folders and suffixes, where only one name is meant; and others."""
    names = sorted(write_scene(tmp_path, 10)[1])
    held = "held out are 2 photographs, those of test.txt"
    unknown = "names in test.txt are of no photograph, such as other.png"
    none = "test.txt holds out none of the photographs and is not used"
    there = f"/there/images/{names[9].rsplit('.')[0].upper()}.JPEG"
    for lines, notes, want in (
        (["# of 2026", names[2], "", names[9], "other.png"], (held, unknown), [2, 9]),
        (["\ufeff" + names[2].rsplit(".")[0], there.replace("/", "\\")], (held,), [2, 9]),
        (["other.png"], (none, unknown), [0, 8]),
        (names, (none.replace("none", "all"),), [0, 8]),
    ):
        text = "\r\n".join(lines)
        (tmp_path / "sparse" / "0" / "test.txt").write_text(text, "utf-8")
        loaded, cameras = load_scene(tmp_path), load_cameras(tmp_path, training=True)[0]
        held_out = names_of(loaded.test)
        assert loaded.notes == notes
        assert held_out == [names[k] for k in want]
        assert [camera.name for camera in cameras] == [
            name for name in names if name not in held_out
        ]


def test_model_and_images_are_found_in_other_folders(tmp_path):
    write_scene(tmp_path, 2)
    folder = tmp_path / "sparse" / "0"
    assert len(load_scene(folder).train) == 1  # images beside the model's parent
    for file in folder.iterdir():
        file.rename(tmp_path / "sparse" / file.name)
    folder.rmdir()
    assert len(load_scene(tmp_path).train) == 1
    assert len(load_scene(tmp_path / "images").train) == 1  # the images' own folder
    (tmp_path / "images" / "sub").rename(tmp_path / "sub")  # images beside sparse/
    assert len(load_scene(tmp_path).train) == 1
    with refused("no COLMAP model"):
        load_scene(tmp_path / "images" / "deeper")


def test_other_models_are_found_and_noted(tmp_path):
    """nerfstudio's folder; and the parts that COLMAP makes of photographs which it cannot join."""
    names, sparse = write_scene(tmp_path, 3)[1], tmp_path / "sparse"
    (sparse / "0").rename(sparse / "10")
    assert (loaded := load_scene(tmp_path)).notes == () and len(loaded.train) == 2
    (tmp_path / "colmap").mkdir()
    sparse.rename(tmp_path / "colmap" / "sparse")
    assert len(load_scene(tmp_path).train) == 2
    shutil.move(tmp_path / "colmap" / "sparse", sparse)
    write_model(tmp_path, [camera(0), camera(1)], names[:2])
    (sparse / "0").rename(sparse / "2")
    (note,) = (loaded := load_scene(tmp_path)).notes
    assert len(loaded.train) == 1
    assert note.startswith(f"{sparse / '10'} is another model, of 3 images: give this folder")
    assert (loaded := load_scene(sparse / "10")).notes == () and len(loaded.train) == 2
    (sparse / "10" / "images.bin").write_bytes(b"damaged")
    assert load_scene(tmp_path).notes == ()


@pytest.mark.parametrize(
    ("model", "photographs"),
    [
        ("colmap/0", "images"),
        ("dense/sparse", "dense/images"),
        ("dense/sparse/0", "dense/images"),
        ("distorted/sparse/0", "input"),
    ],
)
def test_models_and_their_own_photographs(tmp_path, model, photographs):
    """Not those of the same names beside them, of which there are more here."""
    names = write_scene(tmp_path, 3)[1]
    (tmp_path / model).parent.mkdir(parents=True)
    (tmp_path / "sparse" / "0").rename(tmp_path / model)
    if photographs != "images":
        shutil.copytree(tmp_path / "images", tmp_path / photographs)
        for name in names:
            Image.new("RGB", (40, 30)).save(tmp_path / "images" / name)
        (tmp_path / photographs / names[0]).unlink()
    loaded = load_scene(tmp_path)
    assert all(view.image.any() for view in (*loaded.train, *loaded.test))
    notes = ("1 of 3 photographs are missing and left out (sub/003.png)",)
    assert loaded.notes == (notes if photographs != "images" else ())


@pytest.mark.parametrize("file", ["cameras", "images", "points3D"])
def test_another_number_of_records_than_stated_is_refused(tmp_path, file):
    path = model_of(tmp_path, **PINHOLES) / f"{file}.bin"
    data = path.read_bytes()
    stated = int.from_bytes(data[:8], "little")
    counts = (stated - 1, stated + 1, 1 << 31, (1 << 64) - 1)
    miscounted = [count.to_bytes(8, "little") + data[8:] for count in counts]
    for content in (*miscounted, b"", data[: len(data) // 2], data[:-1], data + b"a"):
        path.write_bytes(content)
        with refused(f"{file}.bin: is truncated or damaged"):
            (load_points if file == "points3D" else load_scene)(tmp_path)


IMAGE = b"%d %b 0 0 0 0 0 0 1 a.png\n\n"


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        (
            "images",
            b"\n1 nonsense\n",
            "images.txt: is truncated or damaged .line 2 is neither an image",
        ),
        ("images", IMAGE % (1, b"1") + IMAGE % (2, b"1"), "has image a.png more than once"),
        ("images", IMAGE % (1, b"0"), "has no rotation"),
        ("images", IMAGE % (1, b"nan"), "has no rotation"),
        ("cameras", b"2 PINHOLE 40 30 33 33 20 15\n", "camera 1, .*not in cameras"),
        ("cameras", b"1 PINHOLE 40 30 33 33 20\n", "camera 1 has 3 parameters"),
        (
            "cameras",
            b"1 PINHOLE 40 30 %b 33 20 15\n" % (b"1" * 10_000),
            "cameras.txt: .*a number of more than 1,000 digits",
        ),
    ],
)
def test_unusable_text_models_are_refused(tmp_path, file, content, message):
    (model_of(tmp_path, **PINHOLES, form="text") / f"{file}.txt").write_bytes(content)
    with refused(message):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("kind", "params", "message"),
    [
        ("EQUIRECTANGULAR", [160, 120], "EQUIRECTANGULAR, no perspective camera"),
        ("OPENCV", [140, 140, 80, 60, math.nan, 0, 0, 0], "not usable"),
        ("SIMPLE_RADIAL", [-140, 80, 60, 0.1], "not usable"),
        ("PINHOLE", [0, 140, 80, 60], "not usable"),
    ],
)
def test_unusable_lenses_are_refused(tmp_path, kind, params, message):
    model_of(tmp_path, kind, params, **SIZE)
    with refused(f"image 'a.png' has .*{message}"):
        load_scene(tmp_path)


def test_text_models_of_other_programs(tmp_path):
    """Files without blank lines or points, with names that have spaces and quaternions of any
    length.
    """
    write_model(
        tmp_path, [camera(0), camera(1), camera(2)], names := ["a b.png", "c.png", "d  e 2.png"]
    )
    write_images(tmp_path / "images", names)
    folder = tmp_path / "sparse" / "0"
    pycolmap.Reconstruction(str(folder)).write_text(str(folder))
    for file in (
        *folder.glob("*.bin"),
        folder / "points3D.txt",
        folder / "rigs.txt",
        folder / "frames.txt",
    ):
        file.unlink()
    file, header, images = folder / "images.txt", [], []
    for line in file.read_text().splitlines():
        if line.startswith("#"):
            header.append(line)
        elif line:
            number, *quat, rest = line.split(maxsplit=5)
            images.append(" ".join([number, *(str(1.02 * float(value)) for value in quat), rest]))
    for end in ("\n", "\n\n", "\n1.5 2.5 -1 3 4 7\n", "\r\n\r\n"):
        file.write_text("\ufeff" + "\n".join(header) + "\n" + end.join(images), "utf-8")
        loaded = load_scene(tmp_path)
        assert loaded.notes == () and len(load_points(tmp_path)) == 0
        for view in (*loaded.train, *loaded.test):
            viewmat = camera(names.index(view.camera.name)).viewmat
            assert_close(view.camera.viewmat, viewmat, atol=1e-6, rtol=0)
    file.write_text("\n".join([*header, *images[1:]]))
    assert load_scene(tmp_path).notes == (
        "images.txt has 2 images, but its header says 3: it may be incomplete",
    )


def test_without_pycolmap_the_error_says_where_it_is(monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with refused("conda install -c conda-forge pycolmap$"):
        importlib.reload(colmap)


def test_missing_images_are_noted_or_refused(tmp_path):
    names = sorted(write_scene(tmp_path, 18)[1])
    for name in names[2:11]:
        (tmp_path / "images" / name).unlink()
    loaded = load_scene(tmp_path)
    missing = (
        "9 of 18 photographs are missing and left out (sub/003.png, sub/004.png, sub/005.png, ...)"
    )
    assert loaded.notes == (missing,)
    # the 8th is missing, the rest stay
    assert names_of(loaded.test) == [names[0], names[16]]
    assert names_of(loaded.train) == [names[1], *names[11:16], names[17]]
    (tmp_path / "images" / names[0]).unlink()
    text = (
        r"10 of 18 images of the model are missing \(sub/001.png, sub/003.png, sub/004.png,"
        r" \.\.\.\), more than half"
    )
    with refused(text):
        load_scene(tmp_path)


@pytest.mark.parametrize("name", ["masks", "Mask", "images_masks"])
def test_masks_are_noted(tmp_path, name):
    write_scene(tmp_path, 2)
    write_images(tmp_path / name, ["sub/001.png.png", "sub/002.png.png"])
    note = (
        f"the masks in {tmp_path / name} are not used: where the checkpoint is empty under them,"
        " put them into the"
    )
    for folder in (tmp_path, tmp_path / "sparse" / "0", tmp_path / "images"):
        assert load_scene(folder).notes == (f"{note} photographs' alpha channel",)


def test_smaller_copies_replace_missing_images(tmp_path):
    write_scene(tmp_path, 3)
    (tmp_path / "images").rename(tmp_path / "images_2")
    (tmp_path / "input" / "sub").mkdir(parents=True)
    for file in (tmp_path / "images_2" / "sub").iterdir():
        with Image.open(file) as image:
            image.resize((20, 15)).save(file)
            image.save(tmp_path / "input" / "sub" / file.name)
    loaded = load_scene(tmp_path)
    assert loaded.notes == (
        "the photographs are those in images_2, as there are more than in images",
        "3 of 3 images are 20x15 where the model has 40x30: intrinsics scaled",
    )
    assert_close(loaded.test[0].camera.K[:2] * 2, camera(2, focal=30.0).K[:2])
    for file in (tmp_path / "images_2" / "sub").iterdir():
        file.unlink()
    # the raw ones are of other cameras
    with refused("images: 3 of 3 images of the model"):
        load_scene(tmp_path)


@pytest.mark.skipif(os.fsdecode(b"\xc3\xa9") != "\u00e9", reason="an ASCII locale: no accents")
def test_photographs_of_another_suffix_or_case_are_found(tmp_path):
    """With accents apart too. One for each name: of two that differ in nothing else, or are claimed
    by two names, none is taken.
    """
    names = ["a.JPG", "b.png", "C/c.png", "d.png", "d.jpg", "e.png", "\u00e9.png"]
    write_model(tmp_path, [camera(i) for i in range(7)], names)
    write_images(
        tmp_path / "images",
        ["A.png", "b.PNG", "C/c.tif", "d.webp", "e.jpg", "e.bmp", "e\u0301.png"],
    )
    loaded = load_scene(tmp_path)
    found = views_of(loaded)
    assert names_of(found) == ["C/c.png", "a.JPG", "b.png", "\u00e9.png"]
    for view, seed in zip(found, (2, 0, 1, 6), strict=True):
        assert_array_equal(view.image, pixels(seed))
    assert loaded.notes == (
        "4 of 7 photographs have another suffix or case, such as c.tif in images",
        "3 of 7 photographs are missing and left out (d.jpg, d.png, e.png)",
    )


def test_wide_images_are_scaled_with_their_intrinsics(tmp_path):
    write_scene(tmp_path, 3)
    loaded = load_scene(tmp_path, max_width=15)
    assert loaded.notes == (
        "3 of 3 images scaled from 40x30 to 15x11 (Pillow bicubic, as in Inria's code)",
    )
    view = loaded.train[0]
    assert tuple(view.image.shape) == (11, 15, 3) and view.camera.name == "sub/002.png"
    scale = torch.tensor([[15 / 40], [11 / 30], [1.0]])
    assert_close(view.camera.K, camera(1, focal=31.0).K * scale)  # names count down
    expected = Image.fromarray(pixels(1)).resize((15, 11), Image.Resampling.BICUBIC)
    assert_array_equal(view.image, np.asarray(expected))
    assert load_scene(tmp_path, max_width=40).notes == ()


def capture_of(folder, kind, params):
    """A scene of one photograph, of ``seen``, by this lens."""
    model_of(folder, kind, params, **SIZE)
    (folder / "images").mkdir()
    Image.fromarray(seen(pycolmap.Camera(model=kind, params=params, **SIZE))).save(
        folder / "images" / "a.png"
    )
    return folder


def ideal(view, across=0.0, down=0.0):
    """The picture that the pinhole camera of the view would have seen, or one whose axis is these
    pixels beside.
    """
    K = view.camera.K.double().numpy()
    params = [K[0, 0], K[1, 1], K[0, 2] + across, K[1, 2] + down]
    size = {"width": view.camera.width, "height": view.camera.height}
    return seen(pycolmap.Camera(model="PINHOLE", params=params, **size))


@pytest.mark.parametrize("kind", LENSES)
def test_undistorted_image_is_that_of_the_pinhole_camera(tmp_path, cache, kind):
    loaded = load_scene(capture_of(tmp_path / "scene", kind, LENSES[kind]))
    view = loaded.train[0]
    right = psnr_of(view.image.numpy(), ideal(view))
    shifted = [
        psnr_of(view.image.numpy(), ideal(view, *by))
        for by in ((0.1, 0), (-0.1, 0), (0, 0.1), (0, -0.1))
    ]
    assert right > 45 and right > max(shifted), (right, shifted)
    assert "undistortion" not in dict(loaded.left_out)
    folder = next((cache / "clod-adapter" / "undistorted").iterdir())
    into = f"from {kind} into {folder}, which may be deleted; the sources are untouched"
    assert loaded.notes == (f"1 of 1 images undistorted {into}",)


def test_cached_images_are_reused(tmp_path, cache, monkeypatch):
    """The photograph, its camera and the width must be the same; a damaged one is made again."""
    scene = capture_of(tmp_path / "scene", "OPENCV", LENSES["OPENCV"])
    first = load_scene(scene, max_width=100)
    (file,) = cache.rglob("*.png")
    with Image.open(file) as kept:
        info, changed = PngInfo(), Image.new("RGB", kept.size, (1, 2, 3))
        info.add_text("clod-adapter", kept.info["clod-adapter"])
    changed.save(file, pnginfo=info)
    # the cached one is read
    assert load_scene(scene, max_width=100).train[0].image.unique().tolist() == [1, 2, 3]
    file.write_bytes(file.read_bytes()[:-50])
    again = load_scene(scene, max_width=100)
    assert again.train[0].image.equal(first.train[0].image)
    assert again.train[0].camera.K.equal(first.train[0].camera.K)
    assert again.notes == first.notes and len(list(cache.rglob("*.png"))) == 1
    load_scene(scene, max_width=90)
    os.utime(scene / "images" / "a.png", ns=(1, 1))
    load_scene(scene, max_width=100)
    # calibrated again
    model_of(tmp_path / "other", "OPENCV", [*LENSES["OPENCV"][:4], 0.01, 0, 0, 0], **SIZE)
    shutil.copytree(tmp_path / "other" / "sparse", scene / "sparse", dirs_exist_ok=True)
    load_scene(scene, max_width=100)
    assert len(list(cache.rglob("*.png"))) == 4


def test_cache_folder_must_be_writable(tmp_path, cache, monkeypatch):
    scene = capture_of(tmp_path / "scene", "OPENCV", LENSES["OPENCV"])
    (scene / "images" / "a.png").write_bytes(b"not read")
    message = "undistorted photographs cannot be kept there .*set XDG_CACHE_HOME"
    with monkeypatch.context() as patch, refused(message):
        patch.setattr(os, "access", lambda *_: False)  # root may write anywhere
        load_scene(scene)
    shutil.rmtree(cache)
    cache.write_text("a file, so that no folder can be made")
    with refused(message):
        load_scene(scene)
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setattr(os, "getuid", lambda: 2**31 - 5)  # nobody's
    with refused("no home folder to keep undistorted photographs in; set XDG_CACHE_HOME"):
        load_scene(scene)


def test_cameras_equal_those_of_load_scene(capture):
    scene = load_scene(capture.scene, origin=(origin := (10.0, -20.0, 30.0)))
    views = views_of(scene)
    cameras, notes = load_cameras(capture.scene, origin)
    assert notes == [] and [camera.name for camera in cameras] == names_of(views)
    for found, view in zip(cameras, views, strict=True):
        assert torch.equal(found.viewmat, view.camera.viewmat)
        assert torch.equal(found.K, view.camera.K)
        assert (found.width, found.height, found.near) == (
            view.camera.width,
            view.camera.height,
            view.camera.near,
        )
    training = [found.name for found in load_cameras(capture.scene, training=True)[0]]
    assert training == names_of(scene.train) and len(training) == 8


def there(folder):
    return {str(path.relative_to(folder)) for path in scene_files(folder) if path.is_file()}


def test_files_of_a_colmap_scene(tmp_path):
    """All that no output may overwrite, and nothing else in the scene's folder."""
    write_scene(tmp_path, 3)
    (tmp_path / "rendered.png").write_bytes(b"not of the scene")
    (tmp_path / "images_2" / "sub").mkdir(parents=True)
    (tmp_path / "images_2" / "sub" / "001.png").write_bytes(b"a smaller one")
    (tmp_path / "dataparser_transforms.json").write_text("{}")
    files = {str(path.relative_to(tmp_path)) for path in (tmp_path / "sparse" / "0").iterdir()}
    photographs = {f"images/sub/{k:03}.png" for k in (1, 2, 3)} | {"images_2/sub/001.png"}
    assert len(files) >= 3
    assert there(tmp_path) == files | photographs | {"dataparser_transforms.json"}
    for name in ("images", "images_2"):  # other folders of inputs do not stand for those
        (tmp_path / name).rename(tmp_path / name.replace("images", "cam"))
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "a.png").write_bytes(b"")
    assert {"cam/sub/001.png", "cam_2/sub/001.png", "masks/a.png"} <= there(tmp_path)
