"""One arm at the table. The world's origin is the table's centre, as in the real environment."""

import mujoco
import numpy as np

from cnpgen.addons.benchmark.simulator.plant import PLANTS
from cnpgen.addons.benchmark.simulator.simulator_scene import SimulatorScene, scene_xml
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem

BASE = np.array([-1.51, 0.0, -0.1])
STEPS = 4  # of MuJoCo in a tick


def model() -> mujoco.MjModel:
    """The simulator's own scene under the environment's names, with the seventh joint as one that does nothing."""
    problem = load_problem("airhockey")
    text = scene_xml(
        SimulatorScene(
            problem,
            load_robot(problem),
            PLANTS["nominal"],
            np.zeros(0),
            np.array([1.0, 0.0]),
        )
    )
    for number in range(1, 7):
        text = text.replace(
            f'joint name="joint {number}"', f'joint name="iiwa_1/joint_{number}"'
        )
    for axis in "xy":
        text = text.replace(f'joint name="puck {axis}"', f'joint name="puck_{axis}"')
    idle = '<body pos="0 0 9" gravcomp="1"><joint name="iiwa_1/joint_7" type="hinge"/><inertial pos="0 0 0" mass="1"'
    return mujoco.MjModel.from_xml_string(
        text.replace("</worldbody>", f'{idle} diaginertia="1 1 1"/></body></worldbody>')
    )


class AirHockeySingle:
    """Steps of 20 ms, data by name."""

    def __init__(self) -> None:
        self._model = model()
        self._data = mujoco.MjData(self._model)
        frame = np.eye(4)
        frame[:3, 3] = BASE
        self.env_info = {"robot": {"base_frame": [frame]}}
        self.env_info |= {
            "joint_pos_ids": np.arange(7),
            "joint_vel_ids": np.arange(7, 14),
        }
        self.init_state = np.zeros(7)

    def reset(self, obs: object = None) -> np.ndarray:
        mujoco.mj_resetData(self._model, self._data)
        self.setup(obs)
        return np.zeros(0)

    def setup(self, obs: object) -> None:
        for number in range(7):
            self._data.joint(f"iiwa_1/joint_{number + 1}").qpos = self.init_state[
                number
            ]
        mujoco.mj_forward(self._model, self._data)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, dict]:
        assert action.shape == (20, 3, 7)
        self._step_init(action)
        for _ in range(20):
            self._data.qfrc_applied[:6] = self._compute_action(None, action)[:6]
            mujoco.mj_step(self._model, self._data, STEPS)
        away = abs(self._read_data("puck_x_pos")[0]) > 0.974
        return self._observation(), self.reward(), bool(away), {}

    def _observation(self) -> np.ndarray:
        joints = [self._data.joint(f"iiwa_1/joint_{number}") for number in range(1, 8)]
        return np.concatenate(
            [*(joint.qpos for joint in joints), *(joint.qvel for joint in joints)]
        )

    def _read_data(self, name: str) -> np.ndarray:
        joint = self._data.joint(name.rpartition("_")[0])
        return (
            joint.qvel.copy()
            if name.endswith("vel")
            else joint.qpos + BASE["xy".index(name[5])]
        )

    def _check_collision(self, one: str, other: str) -> bool:
        assert (one, other) == ("puck", "robot_1/ee")
        pair = {self._model.geom("mallet").id, self._model.geom("reach").id}
        return any(
            {contact.geom1, contact.geom2} == pair for contact in self._data.contact
        )

    def _write_data(self, name: str, value: float) -> None:
        joint = self._data.joint(name.rpartition("_")[0])
        if name.endswith("vel"):
            joint.qvel = value
        else:
            joint.qpos = value - BASE["xy".index(name[5])]
