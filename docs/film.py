"""Render the film of the README: python docs/film.py (extra `benchmark`).

MuJoCo executes a hit, a transport and a transport among obstacles; the film has half the speed of the motions.
"""

import tempfile
from pathlib import Path

import gallery
import imageio.v3 as iio
import numpy as np
from PIL import Image

import cnpgen
from cnpgen.cli.main import main as run

FILM = Path(__file__).parent / "images" / "film.gif"
CLIPS = {
    "airhockey-pucks": 36,
    "heavy-object": 0,
    "clutter": 0,
}  # recipe or page of the gallery -> problem
SIZE = (800, 600)  # [pixels]
FRAMES_PER_S = (
    25  # every second frame of a film of `cnpgen simulate`, which is four times slower
)
COLORS = 256


def solved_plan(clip: str, index: int) -> cnpgen.Plans:
    """Return the plan of a clip."""
    if clip == "clutter":
        return gallery.clutter()[0][index : index + 1]
    problems = cnpgen.draw_boundary_problems(clip, index + 1, seed=1)[index : index + 1]
    return cnpgen.solve_plans(problems, workers=1).plans


def frames(recipe: str, index: int) -> list[Image.Image]:
    """Solve a problem, execute its plan and return every second frame."""
    plans = solved_plan(recipe, index)
    with tempfile.TemporaryDirectory() as folder:
        file, clip = f"{folder}/plan.h5", f"{folder}/clip.mp4"
        cnpgen.save_plans(file, plans)
        if run(["simulate", file, "--plan", "0", "--video", clip]):
            raise SystemExit(
                f"{recipe}: the execution of plan {index} fails, choose another one"
            )
        images = iio.imread(clip)[::2]
    return [
        Image.fromarray(np.asarray(image)).resize(SIZE, Image.Resampling.LANCZOS)
        for image in images
    ]


def main() -> None:
    """Render the film with one palette, so that unchanged pixels stay equal."""
    images = [
        image for recipe, index in CLIPS.items() for image in frames(recipe, index)
    ]
    strip = Image.new("RGB", (SIZE[0], SIZE[1] * 4))
    for row in range(4):
        strip.paste(images[row * (len(images) - 1) // 3], (0, row * SIZE[1]))
    palette = strip.quantize(COLORS)
    first, *others = (
        image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images
    )
    first.save(
        FILM,
        save_all=True,
        append_images=others,
        duration=round(1000 / FRAMES_PER_S),
        loop=0,
        optimize=True,
    )
    print(f"{len(images) / FRAMES_PER_S:.1f} s, {FILM.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
