"""Writes COLMAP models of synthetic scenes, for the benchmarks and the tests."""

import numpy as np
import pycolmap
from PIL import Image


def write_model(
    folder,
    cameras,
    names,
    points=(),
    colors=(),
):
    """Writes a binary model of pinhole cameras to ``folder/sparse/0``; ``points [M, 3]``,
    ``colors [M, 3]`` uint8.
    """
    model = pycolmap.Reconstruction()
    for number, (camera, name) in enumerate(zip(cameras, names, strict=True), start=1):
        params = camera.K.double()[[0, 1, 0, 1], [0, 1, 2, 2]].numpy()
        size = {"width": camera.width, "height": camera.height}
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(model="PINHOLE", params=params, camera_id=number, **size)
        )
        image = pycolmap.Image(name=name, camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(camera.viewmat[:3].double().numpy())
        )
    for position, color in zip(points, colors, strict=True):
        model.add_point3D(position.astype(np.float64), pycolmap.Track(), color)
    target = folder / "sparse" / "0"
    target.mkdir(parents=True, exist_ok=True)
    model.write_binary(str(target))


def write_photographs(
    folder,
    cameras,
    pictures,
    points=(),
    colors=(),
):
    """Writes pictures and their model, as ``write_model`` does, named by their numbers."""
    names = [f"{number:04}.png" for number in range(len(cameras))]
    (folder / "images").mkdir(parents=True)
    for name, picture in zip(names, pictures, strict=True):
        Image.fromarray(picture).save(folder / "images" / name)
    write_model(folder, cameras, names, points, colors)
