"""A valid call of every public function, class and method: the starting point of calls with invalid arguments."""

import inspect
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

import cnpgen
from cnpgen import benchmark, losses, recipes, results, scenes, trajectories
from cnpgen.problems.problem_record import record_problem
from tests.examples.models import boundary_of_columns, untrained_model
from tests.examples.plans import load as stored_plan
from tests.faults.good_files import tiny_recipe_of

EXCLUDED = {  # public callables without a valid call, and the reason
    "CnpgenError": "exceptions are raised, not called",
    "BenchmarkPlanner": "abstract contract of plug-ins",
    "LossValue": "made by PlanLoss",
    "Executed": "made by simulate_plans",
    "Simulation": "made by simulate_plans",
    "Benchmark": "made by run_benchmark",
    "RunRecord": "made by run_benchmark",
    "Model": "made by load_model and train_model",
    "Dataset": "made by load_dataset",
    "SceneError": "exceptions are raised, not called",
    "SceneFamily": "abstract contract of families",
    "SolvedScenes": "made by solve_scenes",
    "make_scenes": "needs a robot with link geometry, and none is in the package",
    "plan_scenes": "needs a model for scenes; its arguments are those of scene_plans",
    "solve_scenes": "compiles kernels for minutes; its arguments are those of scene_plans and solve_plans",
    "ConditionDecision": "made by evaluate_trajectories",
    "SampleErrors": "made by evaluate_trajectories",
    "Statement": "an enum",
    "Decision": "an enum",
    "TrajectoryEvaluation": "made by evaluate_trajectories",
    "TrajectoryVerdict": "made by evaluate_trajectories",
    "ImportedTrajectories": "made by import_trajectories",
    "ChunkJoin": "made by ChunkExecutor.step",
    "ChunkSetPoint": "made by ChunkExecutor.set_point",
    "LoadedTrajectories": "made by load_trajectories",
}


@dataclass(frozen=True)
class ValidCall:
    """A valid call.

    Attributes:
        name: Name of the function, class or method.
        function: The callable, bound to an object if it is a method.
        arguments: Name -> value; the other parameters are at their defaults.
        unchanged: Parameters that are not replaced: large values are valid, but take long.
    """

    name: str
    function: Callable[..., Any]
    arguments: dict[str, Any] = field(default_factory=dict)
    unchanged: frozenset[str] = frozenset()

    @property
    def parameters(self) -> list[inspect.Parameter]:
        """Parameters of the callable."""
        return [
            p
            for p in inspect.signature(self.function).parameters.values()
            if p.kind != p.VAR_KEYWORD
        ]

    @property
    def names(self) -> list[str]:
        """Names of all parameters and of the keywords of the call."""
        return list(
            dict.fromkeys([*(p.name for p in self.parameters), *self.arguments])
        )

    def __call__(self, **changes: Any) -> Any:
        """Call with some arguments replaced."""
        arguments = {**self.arguments, **changes}
        kinds = {p.name: p.kind for p in self.parameters}
        positional = [
            arguments.pop(name)
            for name, kind in kinds.items()
            if name in arguments
            and kind
            in {inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.VAR_POSITIONAL}
        ]
        return self.function(*positional, **arguments)


def valid_calls(folder: Path) -> list[ValidCall]:
    """Return a valid call of every public callable; files are made in a folder."""
    made = cnpgen.make_dataset(
        tiny_recipe_of("airhockey-hit"), folder / "set", workers=1, shard_size=24
    )
    dataset = cnpgen.load_dataset(made.folder)
    plan = stored_plan("hit")
    problem, control = (
        plan.problem,
        {
            f"{name}_control_points": getattr(plan.motion, name)
            for name in ("path", "rate")
        },
    )
    plan = cnpgen.make_plans(problem, plan.boundary, **control)
    plans = plan[[0, 0]]
    cnpgen.save_plans(folder / "plans.h5", plans)
    model = untrained_model(
        "airhockey", boundary_of_columns(dataset.arrays("train"), 20)
    )
    cnpgen.save_model(folder / "model.h5", model)
    groups = (
        _of_datasets(folder, dataset),
        _of_problems(problem, plans),
        _of_trajectories(plans),
        _of_plans(folder, plans),
        _of_planners(folder, model, dataset, plans),
        _of_losses(problem, plans),
        _of_benchmark(folder, problem, plans),
        _of_recipes(problem),
        _of_scenes(folder),
        _of_sampled(folder, problem, plans),
        _of_runtime(),
    )
    return [call for group in groups for call in group]


def _fields(instance: Any) -> dict[str, Any]:
    """Return the arguments of the constructor of a dataclass instance."""
    return {
        entry.name: getattr(instance, entry.name)
        for entry in fields(instance)
        if entry.init
    }


def _of_datasets(folder: Path, dataset: Any) -> list[ValidCall]:
    shutil.copytree(folder / "set", folder / "part")
    recipe = tiny_recipe_of("airhockey-hit")
    return [
        ValidCall("load_dataset", cnpgen.load_dataset, {"folder": folder / "set"}),
        ValidCall(
            "inspect_dataset", cnpgen.inspect_dataset, {"folder": folder / "set"}
        ),
        ValidCall(
            "validate_dataset",
            cnpgen.validate_dataset,
            {"folder": folder / "set", "workers": 1},
        ),
        ValidCall(
            "make_dataset",
            cnpgen.make_dataset,
            {"recipe": recipe, "out": folder / "made", "workers": 1},
        ),
        ValidCall(
            "extend_dataset",
            cnpgen.extend_dataset,
            {"folder": folder / "part", "n": 40, "workers": 1},
        ),
        ValidCall(
            "merge_datasets",
            cnpgen.merge_datasets,
            {"parts": [folder / "set"], "out": folder / "merged"},
        ),
        ValidCall("Dataset.__getitem__", dataset.__getitem__, {"split": "train"}),
        ValidCall("Dataset.arrays", dataset.arrays),
        ValidCall("Dataset.batches", dataset.batches, {"batch_size": 4}),
        ValidCall("Dataset.frame", dataset.frame),
        ValidCall("Dataset.rows", dataset.rows, {"split": "train", "indices": [1, 2]}),
        ValidCall("check_machine", cnpgen.check_machine),
    ]


def _of_problems(problem: Any, plans: Any) -> list[ValidCall]:
    robot, q = cnpgen.RobotModel(problem), plans.boundary.start_q
    place = {
        "start_xyz": plans.columns["start_xyz"],
        "goal_xyz": plans.columns["goal_xyz"],
    }
    scene = robot.scene(**place)
    base = robot.home
    goal = plans.columns["goal_xyz"][0]
    return [
        ValidCall("load_problem", cnpgen.load_problem, {"name_or_path": "airhockey"}),
        ValidCall(
            "draw_boundary_problems",
            cnpgen.draw_boundary_problems,
            {"recipe": "airhockey-hit", "n": 2},
        ),
        ValidCall(
            "complete",
            cnpgen.complete,
            {
                "recipe": "airhockey-hit",
                "start_q": base,
                "goal_xyz": goal,
                "hit_angle": 0.1,
                "hit_speed_share": 0.5,
            },
        ),
        ValidCall("Problem", cnpgen.Problem, _fields(problem)),
        ValidCall("Problem.validate", problem.validate),
        ValidCall(
            "Problem.first", problem.first, {"kind": type(problem.constraint[0])}
        ),
        ValidCall("RobotModel", cnpgen.RobotModel, {"problem": problem}),
        ValidCall("RobotModel.constraint_values", robot.constraint_values, {"q": q}),
        ValidCall("RobotModel.forward_kinematics", robot.forward_kinematics, {"q": q}),
        ValidCall("RobotModel.inverse_dynamics", robot.inverse_dynamics, {"q": q}),
        ValidCall("RobotModel.is_collision_free", robot.is_collision_free, {"q": q}),
        ValidCall("RobotModel.jacobian", robot.jacobian, {"q": q}),
        ValidCall(
            "RobotModel.min_distance", robot.min_distance, {"q": q, "scene": scene}
        ),
        ValidCall("RobotModel.scene", robot.scene, place),
        ValidCall(
            "Scene", cnpgen.Scene, {"obstacles": scene.obstacles, "poses": scene.poses}
        ),
        ValidCall("Scene.__getitem__", scene.__getitem__, {"index": 0}),
        ValidCall("Scene.bodies", scene.bodies, {"sample": 0}),
    ]


def _of_trajectories(plans: Any) -> list[ValidCall]:
    boundary, motion = plans.boundary, plans.motion
    t = np.linspace(0, 1, 60)
    q = np.sin(t)[:, None] * plans.boundary.goal_q[:1]
    return [
        ValidCall("Boundary", cnpgen.Boundary, vars(boundary)),
        ValidCall("Boundary.__getitem__", boundary.__getitem__, {"index": slice(0, 1)}),
        ValidCall("Boundary.conditions", boundary.conditions),
        ValidCall(
            "Boundary.from_batch",
            cnpgen.Boundary.from_batch,
            {"batch": vars(boundary), "normalization": None},
        ),
        ValidCall(
            "Boundary.min_control_points", boundary.min_control_points, {"degree": 7}
        ),
        ValidCall("Motion", cnpgen.Motion, {"path": motion.path, "rate": motion.rate}),
        ValidCall("Motion.__getitem__", motion.__getitem__, {"index": 0}),
        ValidCall("Motion.at", motion.at, {"s": np.array([0.0, 0.5])}),
        ValidCall(
            "Motion.at_times",
            motion.at_times,
            {"t": np.array([[0.0, 0.1], [0.0, 0.1]])},
        ),
        ValidCall("Motion.duration", motion.duration),
        ValidCall(
            "Motion.phase_at",
            motion.phase_at,
            {"t": np.array([[0.0, 0.1], [0.0, 0.1]])},
        ),
        ValidCall("Motion.runs_forward", motion.runs_forward),
        ValidCall("Motion.time_at", motion.time_at, {"s": np.array([0.0, 0.5])}),
        ValidCall("Motion.time_scaled", motion.time_scaled, {"factor": 2.0}),
        ValidCall(
            "evaluate_trajectories",
            cnpgen.evaluate_trajectories,
            {
                "problem": "airhockey",
                "trajectories": [cnpgen.trajectories.Trajectory(t, q)],
                "noise": 1e-3,
            },
        ),
        ValidCall(
            "fit_motion",
            cnpgen.trajectories.fit_motion,
            {"t": t, "q": q, "spec": recipes.TrajectorySpec()},
        ),
    ]


def _of_plans(folder: Path, plans: Any) -> list[ValidCall]:
    control = {
        "path_control_points": plans.path_control_points,
        "rate_control_points": plans.rate_control_points,
    }
    options = cnpgen.RefineOptions(max_iterations=0)
    small = frozenset({"rate"})  # of 10^9 samples a second
    return [
        ValidCall("load_plans", cnpgen.load_plans, {"path": folder / "plans.h5"}),
        ValidCall(
            "load_boundary_problems",
            cnpgen.load_boundary_problems,
            {"path": folder / "set", "n": 2},
        ),
        ValidCall(
            "save_plans",
            cnpgen.save_plans,
            {"path": folder / "saved.h5", "plans": plans},
        ),
        ValidCall(
            "make_plans",
            cnpgen.make_plans,
            {"problem": "airhockey", "boundary": plans.boundary, **control},
        ),
        ValidCall("Plans", cnpgen.Plans, _fields(plans)),
        ValidCall("Plans.__getitem__", plans.__getitem__, {"which": 0}),
        ValidCall("Plans.states_at", plans.states_at, {"time": 0.1}),
        ValidCall(
            "join_plans",
            cnpgen.join_plans,
            {"first": plans, "following": plans, "at": np.zeros(len(plans))},
        ),
        ValidCall(
            "evaluate_plans", cnpgen.evaluate_plans, {"plans": plans[:1], "workers": 1}
        ),
        ValidCall(
            "export_plans",
            cnpgen.export_plans,
            {"plans": plans[:1], "out": folder / "plan.csv", "to": "csv"},
            small,
        ),
        ValidCall("explain_plans", cnpgen.explain_plans, {"plans": plans[:1]}),
        ValidCall(
            "refine_plans",
            cnpgen.refine_plans,
            {"plans": plans[:1], "options": options, "workers": 1},
        ),
        ValidCall(
            "solve_plans",
            cnpgen.solve_plans,
            {"problems": plans[:0], "options": options, "workers": 1},
        ),
        ValidCall("RefineOptions", cnpgen.RefineOptions),
        ValidCall("GenerationOptions", cnpgen.GenerationOptions),
        ValidCall("BatchOptions", cnpgen.BatchOptions),
        ValidCall("TrainingOptions", cnpgen.TrainingOptions),
        ValidCall("BenchmarkOptions", benchmark.BenchmarkOptions),
        ValidCall("RefineOptions.document", options.document),
    ]


def _of_planners(folder: Path, model: Any, dataset: Any, plans: Any) -> list[ValidCall]:
    planner = cnpgen.Planner(model, backend="numpy")
    hits, moving = cnpgen.Planner("airhockey-hit"), cnpgen.Planner("airhockey-replan")
    layer = cnpgen.BoundaryLayer("airhockey")
    tasks = layer.tasks(plans.boundary)
    outputs = {
        "tasks": tasks,
        "phi": np.zeros((len(tasks), layer.path_outputs)),
        "log_rate": np.zeros((len(tasks), layer.rate_outputs)),
    }
    gradients = {
        "path_gradient": np.zeros_like(plans.path_control_points),
        "rate_gradient": np.zeros_like(plans.rate_control_points),
    }
    base = hits.robot.home
    rest = planner.plan(base, base + 0.1)
    state = (base, np.zeros(6), np.zeros(6))
    long_runs = frozenset({"steps", "epochs", "cpu_seconds", "check_rows"})
    settings = cnpgen.TrainingSettings(hidden=8, layers=1, batch_size=8, nodes=16)
    return [
        ValidCall(
            "load_model", cnpgen.load_model, {"name_or_path": folder / "model.h5"}
        ),
        ValidCall(
            "save_model",
            cnpgen.save_model,
            {"path": folder / "saved_model.h5", "model": model},
        ),
        ValidCall("Model.outputs", model.outputs, {"tasks": tasks}),
        ValidCall("Planner", cnpgen.Planner, {"model": model, "backend": "numpy"}),
        ValidCall(
            "Planner.plan", planner.plan, {"start_q": base, "goal_q": base + 0.1}
        ),
        ValidCall(
            "Planner.plan_batch", planner.plan_batch, {"boundary": rest.boundary}
        ),
        ValidCall(
            "Planner.replan",
            planner.replan,
            {"plans": rest, "time": 0.0, "goal_q": base + 0.2},
        ),
        ValidCall(
            "plan_hits",
            cnpgen.plan_hits,
            {
                "planner": hits,
                "state": state,
                "puck": [1.0, 0.1],
                "target": [2.4, 0.0],
                "options": results.HitOptions(speed_share=0.5),
            },
        ),
        ValidCall(
            "plan_hits",
            cnpgen.plan_hits,
            {
                "planner": moving,
                "state": state,
                "puck": np.array([1.0, 0.1]),
                "target": np.array([2.4, 0.0]),
            }
            | {
                "puck_velocity": np.array([-0.3, 0.1]),
                "meeting_time": 0.9,
                "options": results.HitOptions(puck_model=results.PuckModel()),
                "home": base,
            },
        ),
        ValidCall("PuckModel", results.PuckModel),
        ValidCall("BoundaryLayer", cnpgen.BoundaryLayer, {"problem": "airhockey"}),
        ValidCall("BoundaryLayer.__call__", layer.__call__, outputs),
        ValidCall(
            "BoundaryLayer.check_shapes",
            layer.check_shapes,
            {
                "tasks": tasks,
                "phi": outputs["phi"].shape,
                "log_rate": outputs["log_rate"].shape,
            },
        ),
        ValidCall("BoundaryLayer.plans", layer.plans, outputs),
        ValidCall("BoundaryLayer.tasks", layer.tasks, {"boundary": plans.boundary}),
        ValidCall("BoundaryLayer.vjp", layer.vjp, {**outputs, **gradients}),
        ValidCall("TrainingSettings", cnpgen.TrainingSettings),
        ValidCall(
            "train_model",
            cnpgen.train_model,
            {
                "folder": folder / "set",
                "out": folder / "trained.h5",
                "settings": settings,
                "steps": 1,
                "workers": 1,
            },
            long_runs,
        ),
    ]


def _of_losses(problem: Any, plans: Any) -> list[ValidCall]:
    loss = cnpgen.PlanLoss(problem)
    weights = loss.weights0
    control = {"path": plans.path_control_points, "rate": plans.rate_control_points}
    poses = plans.scene.poses
    budgets = np.ones_like(weights)
    metric = losses.Metric(weights, budgets)
    margins = losses.suggested_margins(problem)
    return [
        ValidCall("PlanLoss", cnpgen.PlanLoss, {"problem": problem}),
        ValidCall(
            "PlanLoss.__call__",
            loss.__call__,
            {**control, "weights": weights, "obstacle_poses": poses},
        ),
        ValidCall(
            "PlanLoss.checked_weights", loss.checked_weights, {"weights": weights}
        ),
        ValidCall(
            "PlanLoss.check_shapes",
            loss.check_shapes,
            {
                name: values.shape
                for name, values in {
                    **control,
                    "obstacle_poses": poses,
                    "weights": weights,
                }.items()
            },
        ),
        ValidCall("PlanLoss.load_kernels", loss.load_kernels),
        ValidCall(
            "PlanLoss.ordered_weights", loss.ordered_weights, {"weights": weights}
        ),
        ValidCall("Margins", losses.Margins),
        ValidCall("Margins.tightening", margins.tightening, {"terms": loss.terms[1:]}),
        ValidCall("suggested_margins", losses.suggested_margins, {"problem": problem}),
        ValidCall("Metric", losses.Metric, {"weights": weights, "budgets": budgets}),
        ValidCall("Metric.end_epoch", metric.end_epoch, {"progress": 0.5}),
        ValidCall("Metric.load_state", metric.load_state, {"state": metric.state()}),
        ValidCall(
            "Metric.observe",
            metric.observe,
            {"terms": np.ones((3, len(weights))), "progress": 0.5},
        ),
        ValidCall("Metric.state", metric.state),
        ValidCall("Metric.weights", metric.weights, {"progress": 0.5}),
        ValidCall("MetricSettings", losses.MetricSettings),
        ValidCall(
            "MetricSettings.grown", losses.MetricSettings().grown, {"progress": 0.5}
        ),
        ValidCall(
            "suggested_weights",
            losses.suggested_weights,
            {"problem": problem, "weights0": weights},
        ),
        ValidCall("rotating_shift", losses.rotating_shift, {"step": 3}),
    ]


def _of_benchmark(folder: Path, problem: Any, plans: Any) -> list[ValidCall]:
    suite = benchmark.load_suite("hits-81")
    ran = benchmark.run_benchmark("hits-81", folder / "ran", planners=["cnpgen"], n=1)
    at = np.linspace(0, 1, 50)
    path = benchmark.Trajectory(at, np.sin(at)[:, None] * np.ones(6))
    scenario = benchmark.load_suite("replan").replanning
    prefix = benchmark.ExecutedPrefix(plans.motion, plans.duration / 2)
    return [
        ValidCall(
            "ReplanningScenario", benchmark.ReplanningScenario, _fields(scenario)
        ),
        ValidCall("ReplanningScenario.validate", scenario.validate),
        ValidCall("load_suite", benchmark.load_suite, {"name_or_path": "hits-81"}),
        ValidCall("Suite", benchmark.Suite, _fields(suite)),
        ValidCall("Suite.validate", suite.validate),
        ValidCall("Suite.problems", suite.problems, {"n": 1}),
        ValidCall(
            "SampledProblems", benchmark.SampledProblems, {"recipe": "airhockey-hit"}
        ),
        ValidCall(
            "SceneFileProblems",
            benchmark.SceneFileProblems,
            {"file": "scenes.h5", "robot": "panda"},
        ),
        ValidCall("Pucks", benchmark.Pucks, _fields(suite.pucks)),
        ValidCall("Pucks.validate", suite.pucks.validate),
        ValidCall("Pucks.positions", suite.pucks.positions),
        ValidCall("Plant", benchmark.Plant, {"name": "mine", "title": "mine"}),
        ValidCall("Setting", benchmark.Setting, {"problem": plans.problem}),
        ValidCall(
            "Setting.random",
            benchmark.Setting(plans.problem).random,
            {"problem": plans},
        ),
        ValidCall(
            "run_benchmark",
            benchmark.run_benchmark,
            {
                "suite": "hits-81",
                "folder": folder / "ran",
                "planners": ["cnpgen"],
                "n": 1,
                "workers": 1,
            },
            frozenset({"n"}),  # large ones are valid and run the whole suite
        ),
        ValidCall("Benchmark.summary", ran.summary),
        ValidCall(
            "save_benchmark_report",
            benchmark.save_benchmark_report,
            {"benchmark": ran, "path": folder / "report.html"},
            frozenset({"video"}),
        ),
        ValidCall(
            "save_benchmark_tables",
            benchmark.save_benchmark_tables,
            {"benchmark": ran, "folder": folder / "ran"},
        ),
        ValidCall(
            "save_benchmark_figures",
            benchmark.save_benchmark_figures,
            {"benchmark": ran, "folder": folder / "ran"},
        ),
        ValidCall(
            "simulate_plans",
            benchmark.simulate_plans,
            {"plans": plans[:0], "workers": 1},
        ),
        ValidCall("Trajectory", benchmark.Trajectory, {"t": path.t, "q": path.q}),
        ValidCall("Trajectory.states", path.states, {"t": np.array([0.1, 0.5])}),
        ValidCall("Trajectory.jerks", path.jerks, {"t": np.array([0.1, 0.5])}),
        ValidCall(
            "ExecutedPrefix",
            benchmark.ExecutedPrefix,
            {"motion": prefix.motion, "until": prefix.until},
        ),
        ValidCall("ExecutedPrefix.__getitem__", prefix.__getitem__, {"index": 0}),
    ]


def _of_recipes(problem: Any) -> list[ValidCall]:
    recipe = recipes.load_dataset_recipe("airhockey-hit")
    stored = record_problem(problem)
    return [
        ValidCall("list_recipes", recipes.list_recipes, {"kind": "dataset"}),
        ValidCall(
            "load_dataset_recipe",
            recipes.load_dataset_recipe,
            {"name_or_path": "airhockey-hit"},
        ),
        ValidCall(
            "load_pipeline", recipes.load_pipeline, {"name_or_path": "airhockey-hit"}
        ),
        ValidCall("DatasetRecipe", recipes.DatasetRecipe, _fields(recipe)),
        ValidCall("Pipeline", recipes.Pipeline, _fields(recipe.pipeline)),
        ValidCall("Pipeline.validate", recipe.pipeline.validate),
        ValidCall(
            "ProblemRecord",
            recipes.ProblemRecord,
            {"recipe": stored.recipe, "urdf": stored.urdf},
        ),
        ValidCall("ProblemRecord.differences", stored.differences, {"other": stored}),
        ValidCall("ProblemRecord.restored", stored.restored),
        ValidCall(
            "ProblemRecord.tip_positions", stored.tip_positions, {"q": np.zeros((2, 6))}
        ),
    ]


def _of_scenes(folder: Path) -> list[ValidCall]:
    problem = cnpgen.load_problem("heavy-object")
    start = np.array([-0.6, 0.0, 0.0, -1.5, 0.0, 1.2, 0.8])
    goal = start + np.array([0.4, *np.zeros(6)])
    post = recipes.Obstacle(
        name="post", kind="cylinder", position=(0.0, 0.9, 0.3), radius=0.05, length=0.6
    )
    scene = scenes.SceneProblem(
        name="post", obstacles=(post,), start_q=start, goal_q=goal[None]
    )
    scenes.save_scenes(folder / "scenes.h5", [scene])
    grasp = scenes.Grasp(np.array([0.5, 0.2, 0.3]), np.array([0.0, 0.0, -1.0]))
    return [
        ValidCall("load_scenes", scenes.load_scenes, {"path": folder / "scenes.h5"}),
        ValidCall(
            "save_scenes",
            scenes.save_scenes,
            {"path": folder / "saved_scenes.h5", "scenes": [scene]},
        ),
        ValidCall(
            "scene_plans", scenes.scene_plans, {"problem": problem, "scenes": [scene]}
        ),
        ValidCall("load_family", scenes.load_family, {"name": "tabletop"}),
        ValidCall("observe", scenes.observe, {"scenes": [scene], "kind": "tokens"}),
        ValidCall("scene_bodies", scenes.scene_bodies, {"scenes": [scene]}),
        ValidCall(
            "BatchObserver",
            scenes.BatchObserver,
            {"kind": "tokens", "scenes": lambda _: [scene]},
        ),
        ValidCall(
            "obstacles_of_points",
            scenes.obstacles_of_points,
            {"points": np.eye(3), "radius": 0.01},
        ),
        ValidCall(
            "make_mesh", scenes.make_mesh, {"name": "rock", "points": np.eye(4, 3)}
        ),
        ValidCall(
            "GoalPose",
            scenes.GoalPose,
            {"frame": "", "position": start[:3], "rotation": np.eye(3)},
        ),
        ValidCall("Grasp", scenes.Grasp, _fields(grasp)),
        ValidCall("SceneOptions", scenes.SceneOptions, {"payload": 1.0}),
        ValidCall("Layout", scenes.Layout, {"obstacles": (post,), "grasps": (grasp,)}),
        ValidCall("SceneProblem", scenes.SceneProblem, _fields(scene)),
    ]


def _of_sampled(folder: Path, problem: Any, plans: Any) -> list[ValidCall]:
    cnpgen.export_plans(plans[:1], folder / "exported", to="csv", rate=100)
    loaded = trajectories.load_trajectories(folder / "exported", problem)
    sampled = loaded.trajectories[0]
    fitted = plans.motion[[0]]
    return [
        ValidCall(
            "LoadOptions", trajectories.LoadOptions, {"unit": "deg", "rate": 100.0}
        ),
        ValidCall(
            "load_trajectories",
            trajectories.load_trajectories,
            {"path": folder / "exported", "problem": problem},
        ),
        ValidCall(
            "import_trajectories",
            trajectories.import_trajectories,
            {"problem": problem, "trajectories": [sampled]},
        ),
        ValidCall(
            "largest_error",
            trajectories.largest_error,
            {"motion": fitted, "t": sampled.t, "q": sampled.q},
        ),
    ]


def _of_runtime() -> list[ValidCall]:
    planner = cnpgen.Planner("airhockey-replan")
    base = planner.robot.home
    runtime = results.PlanRuntime(planner, base)
    plan = planner.plan(base, base)

    def resume(measured_q: Any, at: Any = None) -> None:
        stopped = results.PlanRuntime(planner, base)
        stopped.stop(0.0)
        stopped.resume(measured_q, at=at)

    def close(timeout: Any) -> bool:
        return results.PlanRuntime(planner, base).close(timeout=timeout)

    options = {
        "rate": 30.0,
        "length": 20,
        "join": 0.05,
        "max_distance": 0.1,
        "tracking_error": 0.03,
        "stale_after": 0.5,
    }
    problem, still = planner.model.problem, np.zeros(len(base))
    executor = results.ChunkExecutor(problem, **options)
    executor.reset((base, still))

    def reset(measured: Any) -> None:
        results.ChunkExecutor(problem, **options).reset(measured)

    return [
        ValidCall(
            "ChunkExecutor",
            results.ChunkExecutor,
            {"problem": problem, **options},
            frozenset({"length", "rate"}),
        ),
        ValidCall("ChunkExecutor.reset", reset, {"measured": (base, still)}),
        ValidCall("ChunkExecutor.stop", executor.stop),
        ValidCall("ChunkOptions", results.ChunkOptions, {"noise": 1e-3}),
        ValidCall("ChunkExecutor.set_point", executor.set_point, {"time": 0.0}),
        ValidCall("ChunkExecutor.state_at", executor.state_at, {"time": 0.0}),
        ValidCall(
            "ChunkExecutor.step",
            executor.step,
            {
                "time": 0.0,
                "chunk": np.tile(base, (20, 1)),
                "observed_at": 0.0,
                "measured": (base, still),
            },
        ),
        ValidCall("PlanRuntime.plan_at", runtime.plan_at, {"time": 0.0}),
        ValidCall("PlanRuntime", results.PlanRuntime, {"planner": planner, "q": base}),
        ValidCall("PlanRuntime.state_at", runtime.state_at, {"time": 0.0}),
        ValidCall(
            "PlanRuntime.set_point",
            results.PlanRuntime(planner, base).set_point,
            {"time": 0.0},
        ),
        ValidCall("PlanRuntime.switch", runtime.switch, {"plan": plan, "at": 0.0}),
        ValidCall("PlanRuntime.stop", runtime.stop, {"at": 0.0}),
        ValidCall(
            "PlanRuntime.replan",
            runtime.replan,
            {"make_plan": lambda *_: plan, "at": 0.0},
        ),
        ValidCall("PlanRuntime.resume", resume, {"measured_q": base, "at": 1.0}),
        ValidCall("PlanRuntime.close", close, {"timeout": 1.0}),
    ]
