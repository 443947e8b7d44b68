"""One view with 5 % of the Gaussians: merged, adapted without and with growth, and the photograph. Of the demo's scene.

    clod-adapt demo                        # makes demo/base.ply and demo/capture
    python benchmarks/growth_picture.py    # docs/images/growth.webp; four minutes

The PSNR in the captions is that of the view shown.
"""

from __future__ import annotations

import io
from pathlib import Path

import clod_adapter as clod
from clod_adapter.evaluation.baselines import matching_dial
from clod_adapter.losses import psnr
from common import ROOT, arguments
from pictures import keep
from tuning import merge

import torch
from PIL import Image, ImageDraw, ImageFont

SHARE, VIEW, MAX_SV, STEPS = 0.05, 0, 20.0, 600
GAP, CAPTION, ZOOM = 8, 58, 2  # pixels; factor of enlargement


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("demo", nargs="?", default="demo", help="the folder of clod-adapt demo (default: demo)")
    folder = Path(parser.parse_args().demo)
    base, scene = clod.load(folder / "base.ply"), clod.load_scene(folder / "capture")
    view, count = scene.test[VIEW], round(SHARE * len(clod.load(folder / "base.ply").gaussians))
    panels = [("merged", clod.render(merge(base, count)[0], view.camera).image)]
    for label, growth in (("adapted without growth", "off"), ("adapted with growth", "on")):
        plan = clod.make_plan(base.gaussians, scene, clod.AdaptConfig(max_sv=MAX_SV, iters=STEPS, growth=growth))
        model = plan.whole(base.gaussians, plan.adapt(scene).gaussians)
        dial = matching_dial(model, [each.camera for each in scene.test], count)
        panels.append((label, clod.render(model, view.camera, dial).image))
    captions = [f"{label}\n{count:,} Gaussians, {psnr(image, view.image):.1f} dB" for label, image in panels]
    images = [(image.clamp(0, 1) * 255).round().byte() for _, image in panels]
    file = io.BytesIO()
    strip([*images, view.image], [*captions, f"photograph\nthe checkpoint has {len(base.gaussians):,} Gaussians"]).save(
        file, "PNG"
    )
    keep(ROOT / "docs" / "images" / "growth.webp", file.getvalue())


def strip(images: list[torch.Tensor], captions: list[str]) -> Image.Image:
    """The images side by side, enlarged, each above its caption."""
    height, width = (ZOOM * side for side in images[0].shape[:2])
    sheet = Image.new("RGB", (len(images) * (width + GAP) - GAP, height + CAPTION), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(20)
    for k, (image, caption) in enumerate(zip(images, captions, strict=True)):
        left = k * (width + GAP)
        sheet.paste(Image.fromarray(image.numpy()).resize((width, height), Image.Resampling.LANCZOS), (left, 0))
        pen.multiline_text(
            (left + width / 2, height + 6), caption, fill="black", font=font, anchor="ma", align="center"
        )
    return sheet


if __name__ == "__main__":
    main()
