"""The step for LeRobot inside its own pipelines, real-time chunking, select_action and asynchronous server."""

# ruff: noqa: E402 - without the framework nothing else is imported
import json
from math import ceil
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("lerobot")
torch = pytest.importorskip("torch")

from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.act.processor_act import make_act_pre_post_processors
from lerobot.policies.rtc.action_queue import ActionQueue
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.latency_tracker import LatencyTracker
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.control_utils import predict_action

import cnpgen
from cnpgen.addons.online.switches import SwitchOutcome
from cnpgen.errors import UsageError
from cnpgen.interop.lerobot import ChunkStep
from tests.examples.example_robots import needs_robots

pytestmark = [needs_robots, pytest.mark.slow]

RATE, LENGTH, WIDTH = 30.0, 50, 8  # seven joints and a gripper
HOME = np.radians([0, -45, 0, -135, 0, 90, 45])
AMPLITUDE = np.array([0.4, 0.3, 0.3, 0.3, 0.4, 0.4, 0.5])
OPTIONS = {
    "rate": RATE,
    "length": LENGTH,
    "join": 0.05,
    "max_distance": 0.1,
    "tracking_error": 0.05,
    "stale_after": 0.3,
}
STATE = "observation.state"
STATS = {
    key: {
        "mean": torch.linspace(-0.5, 0.5, WIDTH),
        "std": torch.linspace(0.5, 2.0, WIDTH),
    }
    for key in (STATE, "action")
}


class Clock:
    """Time that a test sets, in ticks of the robot."""

    ticks = 0

    def __call__(self):
        return self.ticks / RATE


def configuration():
    """Configuration of a small ACT policy without cameras, with normalized states and actions."""
    state = PolicyFeature(type=FeatureType.STATE, shape=(WIDTH,))
    return ACTConfig(
        device="cpu",
        chunk_size=LENGTH,
        n_action_steps=LENGTH,
        dim_model=16,
        n_heads=2,
        dim_feedforward=16,
        n_encoder_layers=1,
        n_vae_encoder_layers=1,
        latent_dim=4,
        input_features={
            STATE: state,
            "observation.environment_state": PolicyFeature(
                type=FeatureType.ENV, shape=(2,)
            ),
        },
        output_features={
            "action": PolicyFeature(type=FeatureType.ACTION, shape=(WIDTH,))
        },
        normalization_mapping=dict.fromkeys(
            ("STATE", "ACTION"), NormalizationMode.MEAN_STD
        ),
    )


def processors(clock, **options):
    """LeRobot's processors of ACT with the step in both of them, and the step."""
    before, after = make_act_pre_post_processors(configuration(), STATS)
    step = ChunkStep("panda-3kg", clock=clock, **OPTIONS | options)
    before.steps = [step, *before.steps]
    after.steps = [*after.steps, step]
    return before, after, step


def reference(ticks):
    """Positions of a smooth motion [rad], shape (K, 7)."""
    return (
        HOME
        + AMPLITUDE * (1 - np.cos(1.4 * np.asarray(ticks, float) / RATE))[:, None] / 2
    )


class Policy:
    """A policy that follows the reference with noise and an offset of every chunk, in normalized units."""

    config = SimpleNamespace(image_features={})

    def __init__(self, clock, unit=1.0):
        self.clock, self.unit, self.random = clock, unit, np.random.default_rng(3)
        self.is_faulty = False

    def predict_action_chunk(self, observation, **_):
        assert observation[STATE].shape == (1, WIDTH)
        q = reference(self.clock.ticks + np.arange(LENGTH))
        q += self.random.uniform(-5e-4, 5e-4, q.shape)
        q += self.random.uniform(-0.02, 0.02, 7)
        q[20] += 0.5 * self.is_faulty
        gripper = np.linspace(0, 1, LENGTH)
        chunk = torch.tensor(np.column_stack([self.unit * q, gripper])).float()
        return ((chunk - STATS["action"]["mean"]) / STATS["action"]["std"])[None]


def real_time_chunking(clock, policy, before, after, inferences, *, unit=1.0):
    """LeRobot's loop of inference and actor (examples/rtc/eval_with_real_robot.py) on one clock; the sent actions."""
    queue, latencies = ActionQueue(RTCConfig(enabled=True)), LatencyTracker()
    sent = [np.append(unit * HOME, 0.0)]

    def act(ticks):
        for _ in range(ticks):
            action = queue.get()
            sent.append(sent[-1] if action is None else action.double().numpy())
            clock.ticks += 1

    for delay in inferences:
        start, index = clock(), queue.get_action_index()
        leftover = queue.get_left_over()
        observation = {STATE: torch.tensor(sent[-1])[None].float()}
        actions = policy.predict_action_chunk(
            before(observation),
            inference_delay=ceil((latencies.max() or 0) * RATE),
            prev_chunk_left_over=leftover,
        )
        act(delay)
        processed = after(actions).squeeze(0)
        latencies.add(clock() - start)
        queue.merge(
            actions.squeeze(0).clone(),
            processed,
            ceil((clock() - start) * RATE - 1e-6),
            index if leftover is not None else None,
        )
        act(12)
    act(LENGTH)
    return np.array(sent)


def use_of_limits(q):
    """Largest mean velocity and acceleration between samples as shares of the limits: lower bounds of every motion's."""
    robot = cnpgen.RobotModel("panda-3kg")
    return (
        (np.abs(np.diff(q, axis=0)) * RATE / robot.velocity_limit).max(),
        (np.abs(np.diff(q, n=2, axis=0)) * RATE**2 / robot.acceleration_limit).max(),
    )


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_real_time_chunking_sends_the_samples_of_one_valid_motion(unit):
    clock = Clock()
    factor = 1.0 if unit == "rad" else 180 / np.pi
    before, after, step = processors(clock, unit=unit)
    policy, joins = Policy(clock, factor), []
    call = step.__class__.__call__

    def noted(transition):
        result = call(step, transition)
        if transition.get("action") is not None:
            joins.append(step.last_join)
            assert result["action"].shape == (1, LENGTH, WIDTH)
        return result

    after.steps[-1] = noted
    sent = real_time_chunking(
        clock, policy, before, after, [2, 5, 8, 3, 7, 4, 2, 6], unit=factor
    )
    assert [join.outcome for join in joins] == [SwitchOutcome.ACCEPTED] * 8
    q = sent[:, :7] / factor
    velocity, acceleration = use_of_limits(q)
    assert velocity < 1
    assert acceleration < 1
    # The motion follows the chunks, and rests at the end of the last one.
    ticks = np.arange(len(q))[1:100]
    assert np.abs(q[ticks] - reference(ticks - 1)).max() < 0.1
    assert np.ptp(q[40:120, 6]) > 0.3
    np.testing.assert_array_equal(sent[-1], sent[-5])
    assert sent[-1, 7] > 0.4
    assert (sent[:, 7] <= 1).all()
    # Without the step, the same chunks jump.
    clock, (bare, raw, _) = Clock(), processors(Clock())
    bare.steps, raw.steps = bare.steps[1:], raw.steps[:-1]
    jumping = real_time_chunking(
        clock, Policy(clock), bare, raw, [2, 5, 8, 3, 7, 4, 2, 6]
    )
    assert use_of_limits(jumping[:, :7])[1] > 1.5


def test_a_faulty_chunk_is_replaced_by_the_running_motion():
    clock = Clock()
    before, after, step = processors(clock)
    policy = Policy(clock)
    observation = {STATE: torch.tensor(np.append(HOME, 0.3))[None].float()}
    policy.is_faulty = True
    commands = after(policy.predict_action_chunk(before(observation)))
    assert step.last_join.outcome is SwitchOutcome.OUTLIER
    assert step.stopped is None
    expected = np.tile(np.append(HOME, 0.3), (LENGTH, 1))
    np.testing.assert_allclose(commands[0].numpy(), expected, atol=1e-6)


def test_an_arm_that_does_not_follow_stops_until_the_pipelines_are_reset():
    clock = Clock()
    before, after, step = processors(clock)
    policy = Policy(clock)
    home = {STATE: torch.tensor(np.append(HOME, 0.0))[None].float()}
    after(policy.predict_action_chunk(before(home)))
    assert step.last_join.accepted
    clock.ticks += 20
    commands = after(policy.predict_action_chunk(before(home)))  # it has not moved
    assert step.last_join.outcome is step.stopped is SwitchOutcome.TRACKING
    tail = commands[0, -10:, :7].numpy()
    np.testing.assert_array_equal(tail, np.tile(tail[:1], (10, 1)))
    before.reset()
    with pytest.raises(UsageError, match="to stop"):
        before(home)
    clock.ticks += 60
    here = np.append(reference([clock.ticks])[0], 0.0)
    here = {STATE: torch.tensor(here)[None].float()}
    after(policy.predict_action_chunk(before(here)))
    assert step.last_join.accepted
    assert step.stopped is None


def test_select_action_is_refused_with_the_place_of_chunks():
    before, after, _ = processors(Clock())
    observation = {
        STATE: np.append(HOME, 0.0).astype(np.float32),
        "observation.environment_state": np.zeros(2, np.float32),
    }
    with pytest.raises(
        UsageError, match=r"got \(1, 8\).*select_action.*predict_action_chunk"
    ):
        predict_action(
            observation,
            ACTPolicy(configuration()).eval(),
            torch.device("cpu"),
            before,
            after,
            use_amp=False,
        )


def test_the_loop_of_the_asynchronous_server_is_refused_with_the_place_of_chunks(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # its import makes a folder of logs
    from lerobot.async_inference.configs import PolicyServerConfig
    from lerobot.async_inference.helpers import TimedObservation
    from lerobot.async_inference.policy_server import PolicyServer

    clock = Clock()
    server = PolicyServer(PolicyServerConfig())
    server.policy, server.actions_per_chunk = Policy(clock), LENGTH
    server.preprocessor, server.postprocessor, _ = processors(clock)
    joints = [f"joint{index}" for index in range(WIDTH)]
    server.lerobot_features = {
        STATE: {"dtype": "float32", "shape": (WIDTH,), "names": joints}
    }
    raw = dict(zip(joints, np.append(HOME, 0.0), strict=True))
    observed = TimedObservation(timestamp=0.0, timestep=0, observation=raw)
    with pytest.raises(UsageError, match=r"_predict_action_chunk, its loop over steps"):
        server._predict_action_chunk(observed)


def test_the_configuration_is_saved_and_loaded_by_lerobot(tmp_path):
    zero = np.linspace(-0.1, 0.1, 7)
    step = ChunkStep("panda-3kg", unit="deg", zero=zero, **OPTIONS)
    PolicyProcessorPipeline(steps=[step], name="post").save_pretrained(tmp_path)
    loaded = PolicyProcessorPipeline.from_pretrained(
        tmp_path, config_filename="post.json"
    )
    (same,) = loaded.steps
    assert isinstance(same, ChunkStep)
    assert json.dumps(same.get_config()) == json.dumps(step.get_config())
    with pytest.raises(UsageError, match="no observation precedes the chunk"):
        same({"action": torch.zeros(1, LENGTH, WIDTH)})


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"unit": "percent"}, "unit must be rad or deg"),
        ({"zero": [0.0]}, r"zero must be finite and have shape \(7,\)"),
        ({"speed": 2.0}, "speed .*ChunkExecutor"),
        ({"length": 15}, "length.*15 samples leave 0.0833 s"),
        ({"rate": -1.0}, "rate must be from"),
        ({"stale_after": "soon"}, "stale_after"),
    ],
)
def test_wrong_options_are_refused(options, text):
    with pytest.raises(UsageError, match=text):
        ChunkStep("panda-3kg", **OPTIONS | options)


def test_wrong_observations_and_chunks_are_refused():
    step = ChunkStep("panda-3kg", clock=Clock(), **OPTIONS)
    for observation, text in (
        ({}, "has no 'observation.state'"),
        ({STATE: torch.zeros(2, WIDTH)}, r"must have shape \(1, D\)"),
        ({STATE: torch.zeros(1, 6)}, "at least 7 joints"),
    ):
        with pytest.raises(UsageError, match=text):
            step({"observation": observation})
    step({"observation": {STATE: torch.tensor(HOME)[None]}})
    for chunk, text in (
        (torch.zeros(2, LENGTH, 7), r"expected a chunk of shape \(1, T, D\)"),
        (torch.zeros(1, LENGTH, 8), "at most the 0 other columns"),
        (torch.zeros(1, 49, 7), r"chunk must have shape \(50, D\)"),
    ):
        with pytest.raises(UsageError, match=text):
            step({"action": chunk})
