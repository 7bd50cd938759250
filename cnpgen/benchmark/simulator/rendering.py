"""Pictures and films of executed plans, drawn by MuJoCo without a screen."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.simulator import hockey
from cnpgen.benchmark.simulator.execute import Execution, compile_scene, load_mujoco
from cnpgen.benchmark.simulator.reference import TICK
from cnpgen.benchmark.simulator.simulator_scene import Scene
from cnpgen.errors import MachineError
from cnpgen.store.files.atomic import machine_error

WIDTH, HEIGHT = 640, 480
FRAMES = 25  # per second
SLOWER = 4  # films show motions so many times slower than they are
AFTER = 1.0  # s: how much of what comes after the plan a film shows
HOCKEY_VIEW = (1.3, 0.0, 0.1, 2.6, 150.0, -30.0)  # where the camera looks [m], distance [m], azimuth, elevation [deg]
OBJECT_VIEW = (0.3, 0.0, 0.35, 2.4, 180.0, -20.0)

Image = NDArray[np.uint8]


def save_picture(path: Path, scene: Scene, execution: Execution, tick: int) -> None:
    """Draw the world as it was at a tick.

    Args:
        path: Picture file, ``.png``; replaced if it exists.
        scene: What was simulated.
        execution: What happened.
        tick: When.

    Raises:
        MachineError: This machine has no way to draw, or the file cannot be written.
    """
    imageio = _imageio()
    with _drawing(scene) as draw:
        image = draw(execution, min(tick, len(execution.states) - 1))
    try:
        imageio.imwrite(path, image)
    except OSError as error:
        raise machine_error("write", path, error) from error


def save_film(path: Path, scene: Scene, execution: Execution, ticks: int, *, most: int | None = None) -> None:
    """Draw a film of a plan and of the second after it, four times slower than it was.

    Args:
        path: Film file, ``.mp4`` or ``.gif``; replaced if it exists.
        scene: What was simulated.
        execution: What happened.
        ticks: How long the plan is.
        most: How many pictures it may have; a longer motion is shown faster. As many as it takes by default.

    Raises:
        MachineError: As ``save_picture`` does, or ffmpeg is missing.
    """
    imageio = _imageio()
    last = min(ticks + round(AFTER / TICK), len(execution.states))
    step = round(1 / (FRAMES * SLOWER * TICK))
    chosen = range(0, last, step if most is None else max(step, -(-last // most)))
    with _drawing(scene) as draw:
        images = [draw(execution, tick) for tick in chosen]
    options = (
        {"duration": 1000 / FRAMES, "loop": 0} if path.suffix == ".gif" else {"fps": FRAMES, "macro_block_size": 1}
    )
    try:
        imageio.mimsave(path, images, **options)
    except OSError as error:
        raise machine_error("write", path, error) from error
    except (ImportError, RuntimeError, ValueError) as error:  # so imageio says that it has no ffmpeg
        text = " ".join(str(error).split())
        raise MachineError(
            f"no film {path.suffix} can be made here ({text:.200}): pip install 'imageio[ffmpeg]'"
        ) from error


def _imageio() -> Any:
    try:
        import imageio.v2 as imageio
    except ImportError as error:
        raise MachineError(f"imageio cannot be imported ({error}): pip install 'cnpgen[benchmark]'") from error
    return imageio


@contextmanager
def _drawing(scene: Scene) -> Iterator[Any]:
    """Open what draws a tick of an execution."""
    mujoco, model = load_mujoco(), compile_scene(scene)
    try:
        renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
    except Exception as error:  # MuJoCo, EGL and OSMesa each have their own ways to fail
        text = " ".join(str(error).split())
        raise MachineError(
            f"this machine cannot draw without a screen ({text}): install the libraries of EGL, or of OSMesa with"
            " MUJOCO_GL=osmesa"
        ) from error
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    view = OBJECT_VIEW if scene.height is None else HOCKEY_VIEW
    camera.lookat[:], (camera.distance, camera.azimuth, camera.elevation) = view[:3], view[3:]

    def draw(execution: Execution, tick: int) -> Image:
        data.qpos[:] = execution.states[tick]
        if model.nmocap and scene.height is not None:
            data.mocap_pos[0] = execution.tip[tick] - [0.0, 0.0, hockey.MALLET_HEIGHT]
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, camera)
        return np.array(renderer.render())

    try:
        yield draw
    finally:
        renderer.close()
