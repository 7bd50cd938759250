"""Images and films of executed plans, rendered by MuJoCo without a screen."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.addons.benchmark.simulator import hockey
from cnpgen.addons.benchmark.simulator.execute import (
    Execution,
    compile_scene,
    load_mujoco,
)
from cnpgen.addons.benchmark.simulator.reference import TICK_S
from cnpgen.errors import MachineError, MissingExtraError, requires_extra
from cnpgen.store.files.atomic import machine_error, machine_errors

IMAGE_WIDTH = 800
IMAGE_HEIGHT = 600
FILM_FRAMES_PER_S = 25
SLOW_MOTION_FACTOR = 4
FILM_TAIL_S = 1.0  # shown after the plan
# Target of the camera [m], distance [m], azimuth and elevation [deg].
HOCKEY_VIEW = 1.3, 0.0, 0.1, 2.6, 150.0, -30.0
OBJECT_VIEW = (0.3, 0.0, 0.35, 2.4, 180.0, -20.0)

Image = NDArray[np.uint8]


def save_picture(path: Path, execution: Execution) -> None:
    """Render the world at the end of a plan as ``.png``; an existing file is replaced.

    Raise MachineError if this machine cannot render, or the file cannot be written.
    """
    imageio = _imageio()
    with _renderer(execution) as draw:
        image = draw(min(execution.reference.ticks, len(execution.states) - 1))
    with machine_errors("write", path):
        imageio.imwrite(path, image)


def save_film(
    path: Path, execution: Execution, *, max_frames: int | None = None
) -> None:
    """Render a film of a plan and of the second after it, in slow motion, as ``.mp4`` or ``.gif``, as ``save_picture``.

    Motions with more than ``max_frames`` are shown faster. Raise MachineError without
    ffmpeg, too.
    """
    imageio = _imageio()
    last = min(
        execution.reference.ticks + round(FILM_TAIL_S / TICK_S), len(execution.states)
    )
    step = round(1 / (FILM_FRAMES_PER_S * SLOW_MOTION_FACTOR * TICK_S))
    ticks_shown = range(
        0, last, step if max_frames is None else max(step, -(-last // max_frames))
    )
    with _renderer(execution) as draw:
        images = [draw(tick) for tick in ticks_shown]
    options = (
        {"duration": 1000 / FILM_FRAMES_PER_S, "loop": 0}
        if path.suffix == ".gif"
        else {"format": "FFMPEG", "fps": FILM_FRAMES_PER_S, "macro_block_size": 1}
    )
    try:
        imageio.mimsave(path, images, **options)
    except OSError as error:
        raise machine_error("write", path, error) from error
    except (
        ImportError,
        RuntimeError,
        ValueError,
    ) as error:
        # Raised by imageio without ffmpeg.
        text = " ".join(str(error).split())
        raise MissingExtraError(
            f"{path.suffix} films cannot be written here ({text:.200}): pip install 'cnpgen[benchmark]'"
        ) from error


def _imageio() -> Any:
    with requires_extra("benchmark", "imageio"):
        import imageio.v2 as imageio
    return imageio


@contextmanager
def _renderer(execution: Execution) -> Iterator[Callable[[int], Image]]:
    """Open a renderer of the ticks of an execution."""
    mujoco = load_mujoco()
    scene = execution.scene
    model = compile_scene(execution.scene)
    try:
        renderer = mujoco.Renderer(model, IMAGE_HEIGHT, IMAGE_WIDTH)
    except Exception as error:
        # MuJoCo, EGL and OSMesa raise different exceptions
        text = " ".join(str(error).split())
        raise MachineError(
            f"this machine cannot draw without a screen ({text}): install the libraries of EGL, or of OSMesa with"
            " MUJOCO_GL=osmesa"
        ) from error
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    view = OBJECT_VIEW if scene.height is None else HOCKEY_VIEW
    camera.lookat[:] = view[:3]
    camera.distance, camera.azimuth, camera.elevation = view[3:]

    def draw(tick: int) -> Image:
        data.qpos[:] = execution.states[tick]
        if model.nmocap and scene.height is not None:
            data.mocap_pos[0] = (
                execution.tip[tick]
                - hockey.MALLET_HEIGHT_M * scene.table_rotation[:, 2]
            )
            mujoco.mju_mat2Quat(data.mocap_quat[0], np.ravel(scene.table_rotation))
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, camera)
        return np.array(renderer.render())

    try:
        yield draw
    finally:
        renderer.close()
