"""The preset of the paper: every setting against the paper, its metric, and models trained with it."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.planner.model_file import load_model
from cnpgen.planner.network.architecture import Architecture, initial_parameters
from cnpgen.planner.network.features import STATES
from cnpgen.problems.problem_record import with_control_points
from cnpgen.training.adam import learning_rate
from cnpgen.training.data import open_training_data
from cnpgen.training.prepare import prepare_run
from cnpgen.training.presets import PAPER
from cnpgen.training.settings import TrainingSettings
from cnpgen.training.train import train_model
from cnpgen.training.training_options import TrainingOptions
from tests.examples.models import interpreted, loaded_problem_of
from tests.refusals import is_refused

EPOCHS, BATCHES = 4, 4  # 600 rows in batches of 128
SMALL = replace(PAPER.settings, hidden=16, nodes=16)


@pytest.fixture(scope="module")
def trained(tiny, tmp_path_factory):
    """A small network, trained as published for four epochs."""
    out = tmp_path_factory.mktemp("paper") / "paper.h5"
    return train_model(
        tiny("airhockey-hit"),
        out,
        settings=SMALL,
        check_rows=2,
        workers=1,
        options=TrainingOptions(epochs=EPOCHS),
    )


def test_parameters_are_those_of_appendix_b():
    """Check the last paragraph of Appendix B: 15 and 20 control points, gamma 1e-2, rate 5e-5, batches of 128."""
    s = PAPER.settings
    assert (s.path_control_points, s.rate_control_points, s.metric.gamma) == (
        15,
        20,
        1e-2,
    )
    assert (s.learning_rate, s.batch_size) == (5e-5, 128)
    assert {
        learning_rate(step, 1000, peak=5e-5, final=s.final_rate, warm_up=s.warm_up)
        for step in (0, 7, 999)
    } == {5e-5}


def test_budgets_and_first_weights_are_those_of_appendix_b_and_its_errata():
    """Check C-bar^2 of Appendix B; e^alpha of hits by the authors' implementation, alpha = 0 of transports."""
    hit, transport = (
        PlanLoss(name, form="paper") for name in ("airhockey", "heavy-object")
    )
    budgets, weights = (
        dict(zip(hit.terms[1:], values.tolist(), strict=True))
        for values in (hit.budgets, hit.weights0)
    )
    names = ("table", "joint-velocity", "joint-acceleration", "joint-torque")
    assert [budgets[name] for name in names] == [2e-6, 6e-3, 6e-2, 6e-1]
    assert [weights[name] for name in names] == [1, 1e-2, 1e-4, 1e-2]
    assert {name for name, budget in budgets.items() if budget == 0} == {
        "joint-position",
        "puck-contact",
    }
    budgets = dict(zip(transport.terms[1:], transport.budgets.tolist(), strict=True))
    names = (
        "vertical",
        "robot-clearance",
        "object-contact",
        "joint-velocity",
        "joint-acceleration",
        "joint-torque",
    )
    assert [budgets[name] for name in names] == [1e-5, 1e-6, 1e-6, 6e-3, 6e-2, 6e-2]
    assert (transport.weights0 == 1).all()


def test_the_network_is_that_of_the_authors_and_its_outputs_are_those_of_the_paper(
    tiny,
):
    """Check the section on the neural network: tanh layers, exponential time head, pi phi on a straight line."""
    s = PAPER.settings
    assert (s.layers, s.hidden, s.path_scale, s.head_scale, s.rate_bias) == (
        5,
        2048,
        math.pi,
        1.0,
        0.0,
    )
    assert (
        s.line_projection_steps,
        s.projection_steps,
        s.within_limits,
        s.time_parametrized,
    ) == (0, 0, False, False)
    parameters = initial_parameters(
        Architecture(inputs=3, hidden=4, layers=1, path_outputs=5, rate_outputs=2),
        seed=0,
        head_scale=1,
        rate_bias=0,
    )
    assert not parameters[-2:].any()
    run, inference = prepare_run(
        open_training_data(tiny("airhockey-hit")), _airhockey(), SMALL, check_rows=2
    )
    assert (
        run.learner.architecture.path_outputs,
        run.learner.architecture.rate_outputs,
    ) == (60, 20)
    assert (run.learner.projection, run.rows.tasks.correction) == (None, None)
    points = inference.plan(
        run.model(np.zeros(run.learner.architecture.n_parameters, np.float32)),
        _one(tiny),
    )
    path, times = (
        points.path_control_points[0],
        np.abs(points.boundary.goal_q - points.boundary.start_q)[0],
    )
    along = np.linspace(0, 1, 10)[
        :, None
    ]  # clarified: ten interior points from C_2 to C_13
    np.testing.assert_allclose(
        path[3:13], path[2] + along * (path[13] - path[2]), atol=1e-12
    )
    expected = (
        times / _airhockey().robot.velocity_limit
    ).max()  # authors' implementation: r = e^0 / expected time
    np.testing.assert_allclose(points.rate_control_points[0], 1 / expected, rtol=1e-6)


def test_inputs_are_the_states_divided_by_pi_and_the_limits(tiny):
    """Check the network's inputs of the paper, normalized as in the authors' implementation."""
    source = open_training_data(tiny("airhockey-hit"))
    run, _ = prepare_run(source, _airhockey(), SMALL, check_rows=2)
    b, robot = source.training().boundary, _airhockey().robot
    parts = (
        b.start_q / np.pi,
        b.start_dq / robot.velocity_limit,
        b.start_ddq / robot.acceleration_limit,
    )
    expected = np.concatenate(
        [*parts, b.goal_q / np.pi, b.goal_dq / robot.velocity_limit], axis=1
    )
    assert run.learner.features.blocks == STATES
    np.testing.assert_allclose(run.rows.features, expected, rtol=1e-6, atol=1e-7)


def test_gradients_and_parameters_are_neither_clipped_nor_averaged():
    s = PAPER.settings
    assert (s.sample_clip, s.batch_clip, s.memory, s.imitation) == (
        math.inf,
        math.inf,
        0.0,
        0.0,
    )
    assert not s.usual_margins
    assert not s.margins


def test_the_loss_has_the_published_terms_without_tightening_or_time_varying_bounds(
    tiny,
):
    run, _ = prepare_run(
        open_training_data(tiny("airhockey-hit")), _airhockey(), SMALL, check_rows=2
    )
    loss = run.learner.loss
    assert loss.form == "paper"
    assert (loss.tightening[: len(loss.budgets)] == 1).all()
    assert not loss.tightening[len(loss.budgets) :].any()
    omitted = {
        name
        for name, weight in zip(loss.terms[1:], run.metric.weights(0.5), strict=True)
        if weight == 0
    }
    assert omitted == {"joint-position", "puck-contact"}
    rows = run.rows.take(np.arange(4))
    rows.tasks.start_xyz[:] += [0, 0, 4e-3]  # would relax the bounds of the verdict
    parameters = np.zeros(run.learner.architecture.n_parameters, np.float32)
    terms = run.learner.gradient(
        parameters,
        rows,
        run.metric.weights(0),
        shift=0.0,
        clipping=_clipping(),
        out=np.empty_like(parameters),
    )
    plain = replace(
        rows, tasks=replace(rows.tasks, start_xyz=rows.tasks.start_xyz * 0 + 9)
    )
    again = run.learner.gradient(
        parameters,
        plain,
        run.metric.weights(0),
        shift=0.0,
        clipping=_clipping(),
        out=np.empty_like(parameters),
    )
    np.testing.assert_array_equal(terms, again)


def test_the_metric_of_a_run_follows_the_published_update_rule(trained):
    """Compare the weights in the log with alpha_i += gamma log(mean L_i / C_i), clipped at 10, after every epoch."""
    lines = [json.loads(line) for line in trained.model.log.splitlines()]
    steps = [line for line in lines if "terms" in line]
    assert len(steps) == EPOCHS * BATCHES
    budgets, weights = steps[0]["budgets"], dict(steps[0]["weights"])
    assert weights["table"] == 1.0
    for epoch in range(EPOCHS):
        records = steps[epoch * BATCHES : (epoch + 1) * BATCHES]
        for name in [name for name, budget in budgets.items() if budget]:
            assert records[0]["weights"][name] == pytest.approx(
                weights[name], rel=1e-12
            )
            mean = np.mean([record["terms"][name] for record in records])
            with np.errstate(divide="ignore"):
                change = 1e-2 * np.clip(np.log(mean / budgets[name]), -10, 10)
            weights[name] *= math.exp(change)
            assert records[-1]["weights"][name] == pytest.approx(
                weights[name], rel=1e-9
            )
        assert {
            records[-1]["weights"][name] for name in ("joint-position", "puck-contact")
        } == {0.0}


def test_a_model_of_the_preset_is_the_last_one_plans_and_round_trips(
    trained, tiny, tmp_path
):
    model = trained.model
    assert model.training["best_step"] == model.training["steps"] == EPOCHS * BATCHES
    loaded = load_model(trained.path)
    np.testing.assert_array_equal(loaded.parameters, model.parameters)
    assert (loaded.config, loaded.features.blocks) == (model.config, STATES)
    assert loaded.config.expected_time == "travel"
    cnpgen.save_model(tmp_path / "again.h5", loaded)
    assert (tmp_path / "again.h5").read_bytes() == trained.path.read_bytes()
    b = open_training_data(tiny("airhockey-hit")).checked(3).boundary
    plans = cnpgen.Planner(trained.path).plan(b.start_q, b.goal_q, goal_dq=b.goal_dq)
    q, dq, _ = plans.states_at(plans.duration)
    np.testing.assert_allclose(q, b.goal_q, atol=1e-10)
    np.testing.assert_allclose(dq, b.goal_dq, atol=1e-8)


@pytest.mark.slow
def test_options_override_the_preset_and_are_in_the_command(
    tiny, tmp_path, monkeypatch
):
    monkeypatch.setattr("cnpgen.training.log.plot_curve", lambda *_: None)
    out = tmp_path / "p.h5"
    words = [
        "--preset",
        "paper",
        "--hidden",
        "8",
        "--layers",
        "2",
        "--steps",
        "2",
        "--projection-steps",
        "1",
    ]
    words += [
        "--path-scale",
        "0.5",
        "--features",
        "states",
        "--metric",
        "ramped",
        "--path-control-points",
        "12",
    ]
    words += [
        "--rate-control-points",
        "10",
        "--check",
        "2",
        "--workers",
        "1",
        "--quiet",
    ]
    assert main(["train", str(tiny("airhockey-hit")), "-o", str(out), *words]) == 0
    model = load_model(out)
    settings = model.training["settings"]
    assert (settings["learning_rate"], settings["batch_size"], settings["hidden"]) == (
        5e-5,
        128,
        8,
    )
    assert (
        model.config.path_scale,
        model.config.projection_steps,
        model.config.line_projection_steps,
    ) == (0.5, 1, 0)
    assert (settings["metric"]["kind"], settings["features"]) == ("ramped", "states")
    assert model.problem.trajectory.path_control_points == 12
    assert model.architecture.rate_outputs == 10
    assert model.training["command"].startswith(
        "cnpgen train airhockey-hit -o p.h5 --preset paper --steps 2 --hidden 8"
    )
    b = open_training_data(tiny("airhockey-hit")).checked(2).boundary
    assert cnpgen.Planner(out).plan(
        b.start_q, b.goal_q, goal_dq=b.goal_dq
    ).path_control_points.shape == (2, 12, 6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"features": "sines"},
            "features must be one of full, no-scene, states, paper, got 'sines'",
        ),
        ({"keep": "first"}, "keep must be one of best, last, got 'first'"),
        (
            {"constraint_terms": "some"},
            "constraint_terms must be one of all, budgeted, got 'some'",
        ),
        ({"loss_form": "plain"}, "loss_form must be one of signed, paper, got 'plain'"),
        ({"path_control_points": 0}, "path_control_points must be"),
        ({"validations": 0}, "validations must be"),
    ],
)
def test_invalid_settings_raise_errors(changes, message):
    with pytest.raises(UsageError, match=message):
        TrainingSettings(**changes)


def test_too_few_control_points_for_the_degree_are_refused():
    record = loaded_problem_of("airhockey").record
    assert with_control_points(record, 15, None) is record
    with is_refused(UsageError, argument="path_control_points"):
        with_control_points(record, 7, None)


def _airhockey():
    return interpreted(loaded_problem_of("airhockey"))


def _one(tiny):
    return open_training_data(tiny("airhockey-hit")).checked(1).boundary


def _clipping():
    from cnpgen.training.adam import Clipping

    return Clipping()
