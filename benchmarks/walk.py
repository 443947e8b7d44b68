"""Near to far: from a door in a made-up town to a hundred times as far, by the dial at s = 1 and by
its base.

    python benchmarks/walk.py --record     # adds a row to results/walk.jsonl

The town is ``city.py``'s, and the checkpoint the perturbed town, tuned on photographs from the
streets, from the air and from as far as the walk; both are kept in ``benchmarks/cache``. The
default command adapts it to these photographs. Every frame is compared with the supersampled,
unperturbed town.
"""

import json
import math
import tempfile
from pathlib import Path

import clod_adapter as clod
from city import HOUSE, PITCH, SKY, city, city_cameras, direction, look_at, lots, perturb
from clod_adapter.config import FILTERS
from clod_adapter.io.atomic import atomic_path
from common import CACHE, Table, append, arguments, clod_adapt, stored
from models import write_photographs
from tuning import Tuning, tune

import numpy as np
import torch

FILE = "walk.jsonl"
COUNT = 80_000
DISTANCES = [round(4 * 100 ** (k / 24), 2) for k in range(25)]  # metres from the door
EYE = 1.7  # metres above the ground at the door
RISE = 30.0  # degrees of elevation at the last frame
SKY_RADIUS = 1000.0  # metres; a small town's own sky would hide it from afar
SIZE = (480, 320)
PHOTOGRAPHS = 96
STEPS = 400  # of tuning
SAMPLES = 2  # along each side of a pixel of a photograph
BANDS = {"within 12 m": 12.0, "12 to 40 m": 40.0, "40 to 120 m": 120.0, "beyond": math.inf}


def main():
    parser = arguments(__doc__, record=FILE)
    append(FILE, measure(COUNT), parser.parse_args().record)


def measure(count):
    folder = made(count)
    base = folder / "base.ply"
    truth = town(count)
    with tempfile.TemporaryDirectory() as place:
        out = Path(place) / "dial.ply"
        run = clod_adapt(base, "--images", folder, "--out", out, "--json", "--accept-loss")
        models = {"base": clod.load(base).gaussians, "dial": clod.load(out).gaussians}
    row = {
        "count": count,
        "steps": json.loads(run.out)["steps"],
        **run.cost(),
    }
    row |= {"distances": DISTANCES, "base": [], "dial": []}
    for distance in DISTANCES:
        camera = walker(count, distance)
        view = clod.View(camera, supersampled(truth, camera))
        for name, gaussians in models.items():
            (quality,) = clod.evaluate(gaussians, view, 1.0)
            row[name].append({"psnr": round(quality.psnr, 3), "in_view": quality.in_view})
    return row


def town(count):
    """The truth, with a sky that is farther away than the walk."""
    truth = city(count).replace(screen_filter=FILTERS["on"])
    sky = slice(count - round(SKY * count), count)
    farther = SKY_RADIUS / (3 * lots(count) * PITCH)
    truth.means[sky] *= farther
    truth.log_scales[sky] += math.log(farther)
    return truth


def made(count):
    """A folder of photographs with their checkpoint, ``base.ply``, made now if it is not in the
    cache.
    """
    folder = CACHE / f"walk-{count}"
    if not folder.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        truth = town(count)
        with atomic_path(folder) as part:
            cameras = photographers(count)
            pictures = (supersampled(truth, camera).numpy() for camera in cameras)
            write_photographs(part, cameras, pictures)
            tuned, _ = tune(perturb(truth), clod.load_scene(part).train, Tuning(iters=STEPS))
            clod.save(part / "base.ply", tuned)
    return folder


def photographers(count):
    """A third each in the streets, in the air, and on all sides as far away as the walk."""
    third = PHOTOGRAPHS // 3
    random = np.random.default_rng(2)
    cameras = city_cameras(PHOTOGRAPHS - third, *SIZE, count=count)
    for _ in range(third):
        turn = random.uniform(0, 2 * math.pi)
        rise = math.radians(random.uniform(15, 40))
        away = DISTANCES[-1] * math.exp(random.uniform(math.log(0.3), 0.1))
        cameras.append(look_at(away * direction(turn, rise), np.zeros(3), *SIZE, "far"))
    random.shuffle(cameras)  # every 8th is held out
    return cameras


def walker(count, distance):
    """From a door in the middle of the town into its street, then along that and up; always facing
    the door.
    """
    across = (PITCH - HOUSE) / 2  # to the middle of the street, which runs along z
    odd = lots(count) % 2
    door = np.array([odd * PITCH / 2 - across, -EYE, (odd - 1) * PITCH / 2])
    share = math.log(distance / DISTANCES[0]) / math.log(DISTANCES[-1] / DISTANCES[0])
    up = distance * math.sin(math.radians(RISE * share))
    side = min(0.8 * distance, across)
    eye = door + np.array([side, -up, -math.sqrt(distance**2 - up**2 - side**2)])
    return look_at(eye, door, *SIZE, f"{distance:g} m")


def page_table():
    """Means over the frames of each band of distance, of the last row."""
    row = stored(FILE)[-1]
    distances = np.array(row["distances"])
    lines = []
    nearest = 0.0
    for name, farthest in BANDS.items():
        inside = (nearest < distances) & (distances <= farthest)
        base_psnr, base_in_view = means(row["base"], inside)
        dial_psnr, dial_in_view = means(row["dial"], inside)
        share = dial_in_view / base_in_view
        gain = f"{dial_psnr - base_psnr:+.2f}"
        lines.append([name, f"{base_psnr:.1f}", gain, f"{100 * share:.0f} %"])
        nearest = farthest
    heads = ["from the door", "base, dB", "dial, dB against it", "Gaussians in view"]
    return Table(heads, lines, [row], 1)


def means(frames, rows):
    """Mean PSNR and number of Gaussians in view."""
    return np.array([(frame["psnr"], frame["in_view"]) for frame in frames])[rows].mean(0)


@torch.no_grad()
def supersampled(gaussians, camera):
    """``[H, W, 3]`` uint8, a render with SAMPLES by SAMPLES samples in a pixel."""
    larger = camera.resized(SAMPLES * camera.width, SAMPLES * camera.height)
    image = clod.render(gaussians, larger).image
    image = image.clamp(0, 1).reshape(camera.height, SAMPLES, camera.width, SAMPLES, 3).mean((1, 3))
    return (255 * image).round().to(torch.uint8)


if __name__ == "__main__":
    main()
