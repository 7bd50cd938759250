"""The bridge to torch, against torch itself."""

# ruff: noqa: E402 - without the framework nothing else is imported
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.loader.batch_options import BatchOptions
from tests.examples.loader import ALL, columns, ids, make
from tests.examples.plans_of_networks import at_ends, boundary_for_layer, outputs

torch = pytest.importorskip("torch")

from torch.utils.data import DataLoader

from cnpgen.errors import UsageError
from cnpgen.interop.torch import (
    BatchDataset,
    RowDataset,
    control_points,
    plan_loss,
    to_torch,
)
from cnpgen.loader import windows
from cnpgen.loader.dataset import Dataset
from cnpgen.loader.load import load_dataset
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.planner.boundary_layer import BoundaryLayer
from cnpgen.problems.problem_file import load_problem

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings(
        "ignore:.*multi-threaded, use of fork:DeprecationWarning"
    ),
    pytest.mark.filterwarnings(
        "ignore:This DataLoader will create:UserWarning"
    ),  # than the machine has cores
]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return load_dataset(make(tmp_path_factory.mktemp("loader") / "set", shard_size=8))


def rows(loader: Any) -> list[list[int]]:
    return [batch["sample_id"].tolist() for batch in loader]


def test_tensors_have_the_values_of_the_batch_in_its_memory(dataset: Dataset) -> None:
    batch = next(iter(dataset.batches(8, fields=ALL)))
    tensors = to_torch(batch)
    assert list(tensors) == list(ALL)
    for name, values in batch.items():
        assert np.array_equal(tensors[name].numpy(), values)
        assert tensors[name].shape == values.shape
        assert np.shares_memory(tensors[name].numpy(), values)
    assert tensors["start_q"].dtype == torch.float32
    assert tensors["sample_id"].dtype == torch.int64


def test_a_batch_is_copied_to_a_device_as_one_table_with_views(
    dataset: Dataset,
) -> None:
    batch = next(iter(dataset.batches(8, fields=ALL)))
    tensors = to_torch(batch)
    assert np.shares_memory(tensors.table.numpy(), batch.table)
    there = tensors.to("meta")  # a device without data
    assert there.table.is_meta
    assert all(
        there[name].is_meta and there[name].shape == tensors[name].shape for name in ALL
    )
    assert all(there[name]._base is there.table for name in ALL if name != "sample_id")
    assert tensors.columns == batch.columns


@pytest.mark.parametrize("workers", [0, 2])
def test_the_table_comes_through_a_data_loader(dataset: Dataset, workers: int) -> None:
    loader = DataLoader(
        BatchDataset(dataset.batches(8, fields=ALL)),
        batch_size=None,
        num_workers=workers,
    )
    for found, batch in zip(loader, dataset.batches(8, fields=ALL), strict=True):
        assert np.array_equal(found.table.numpy(), batch.table)
        assert np.array_equal(found.to("cpu")["goal_p"].numpy(), batch["goal_p"])


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize("batch_size", [1, 2])
def test_batches_of_batches_are_refused(
    dataset: Dataset, workers: int, batch_size: int
) -> None:
    loader = DataLoader(
        BatchDataset(dataset.batches(8)), batch_size=batch_size, num_workers=workers
    )
    with pytest.raises(UsageError, match="its DataLoader needs batch_size=None"):
        next(iter(loader))


def test_tensors_are_normalized_and_denormalized_like_arrays(dataset: Dataset) -> None:
    batch, normalization = (
        next(iter(dataset.batches(8, fields=ALL))),
        dataset.normalization,
    )
    assert normalization is not None
    expected, found = (
        normalization.denormalize(batch),
        normalization.denormalize(to_torch(batch)),
    )
    for name, values in found.items():
        assert isinstance(values, torch.Tensor)
        np.testing.assert_allclose(values, expected[name], rtol=1e-6, atol=1e-6)
        assert values.numpy().dtype == batch[name].dtype
    again = normalization.normalize(found)
    assert all(np.allclose(again[name], batch[name], atol=1e-5) for name in batch)


def test_gradients_pass_through_denormalization(dataset: Dataset) -> None:
    normalization = dataset.normalization
    assert normalization is not None
    values = torch.zeros((4, 3), dtype=torch.float64, requires_grad=True)
    normalization.denormalize({"start_q": values})["start_q"].sum().backward()
    np.testing.assert_allclose(
        values.grad, np.tile(normalization.std["start_q"], (4, 1))
    )


@pytest.mark.parametrize("workers", [0, 1, 2, 3])
@pytest.mark.parametrize("drop_last", [True, False])
def test_a_data_loader_yields_the_same_batches_with_any_number_of_workers(
    dataset: Dataset, workers: int, drop_last: bool
) -> None:
    wanted = BatchDataset(
        dataset.batches(7, fields=ALL, options=BatchOptions(drop_last=drop_last))
    )
    loader = DataLoader(wanted, batch_size=None, num_workers=workers)
    expected = list(
        dataset.batches(7, fields=ALL, options=BatchOptions(drop_last=drop_last))
    )
    assert len(loader) == len(expected)
    for found, batch in zip(loader, expected, strict=True):
        assert list(found) == list(batch)
        assert all(np.array_equal(found[name].numpy(), batch[name]) for name in batch)


def test_workers_may_be_spawned(dataset: Dataset) -> None:
    loader = DataLoader(
        BatchDataset(dataset.batches(7, fields=ALL)),
        batch_size=None,
        num_workers=1,
        multiprocessing_context="spawn",
    )
    assert rows(loader) == ids(dataset.batches(7, fields=ALL))


def test_without_workers_every_loop_is_the_next_epoch(dataset: Dataset) -> None:
    loader = DataLoader(BatchDataset(dataset.batches(10, fields=ALL)), batch_size=None)
    assert [rows(loader) for _ in range(3)] == [
        ids(dataset.batches(10, fields=ALL, epoch=e)) for e in range(3)
    ]


@pytest.mark.parametrize("persistent", [True, False])
def test_with_workers_every_loop_is_the_next_epoch_too(
    dataset: Dataset, persistent: bool
) -> None:
    wanted = BatchDataset(dataset.batches(10, fields=ALL, epoch=1))
    loader = DataLoader(
        wanted, batch_size=None, num_workers=2, persistent_workers=persistent
    )
    expected = {
        epoch: ids(dataset.batches(10, fields=ALL, epoch=epoch)) for epoch in range(6)
    }
    assert [rows(loader) for _ in range(2)] == [expected[1], expected[2]]
    next(iter(loader))  # leaves epoch 3 early
    assert rows(loader) == expected[4]
    wanted.set_epoch(0)
    assert [rows(loader) for _ in range(2)] == [expected[0], expected[1]]


def test_a_state_loaded_between_two_loops_applies_to_workers_too(
    dataset: Dataset,
) -> None:
    batches = dataset.batches(10, fields=ALL)
    loader = DataLoader(BatchDataset(batches), batch_size=None, num_workers=2)
    state, expected = batches.state(batch=2), ids(dataset.batches(10, fields=ALL))
    for _ in range(2):
        assert rows(loader) == expected
        batches.load_state(state)
        assert rows(loader) == expected[2:]
        batches.epoch = 0


@pytest.mark.parametrize("persistent", [True, False])
def test_set_epoch_reaches_workers(dataset: Dataset, persistent: bool) -> None:
    wanted = BatchDataset(dataset.batches(10, fields=ALL))
    loader = DataLoader(
        wanted, batch_size=None, num_workers=2, persistent_workers=persistent
    )
    for epoch in (0, 1, 2, 0):
        wanted.set_epoch(epoch)
        assert rows(loader) == ids(dataset.batches(10, fields=ALL, epoch=epoch))


@pytest.mark.parametrize("workers", [0, 2])
def test_training_resumes_after_any_number_of_used_batches(
    dataset: Dataset, workers: int
) -> None:
    expected = ids(dataset.batches(6, fields=ALL, epoch=1))
    for used in range(len(expected)):
        batches = dataset.batches(6, fields=ALL)
        wanted = BatchDataset(batches)
        batches.load_state(dataset.batches(6).state(epoch=1, batch=used))
        if used % 2:
            wanted.set_epoch(1)  # changes nothing
        assert (
            rows(DataLoader(wanted, batch_size=None, num_workers=workers))
            == expected[used:]
        )


@pytest.mark.parametrize("used", range(1, 13))
def test_a_state_dict_continues_with_the_next_batch_and_the_following_epochs(
    dataset: Dataset, used: int
) -> None:
    whole = [
        rows
        for epoch in range(3)
        for rows in ids(dataset.batches(8, fields=ALL, epoch=epoch))
    ]
    assert len(whole) == 18
    interrupted, seen = BatchDataset(dataset.batches(8, fields=ALL)), []
    while len(seen) < used:
        for batch in interrupted:
            seen.append(batch["sample_id"].tolist())
            if len(seen) == used:
                break
    resumed = BatchDataset(dataset.batches(8, fields=ALL, seed=5))
    resumed.load_state_dict(json.loads(json.dumps(interrupted.state_dict())))
    rest: list[list[int]] = []
    while len(rest) < 18 - used:
        rest += rows(resumed)
    assert seen + rest == whole


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_a_position_known_only_to_workers_is_refused_until_it_is_set_again(
    dataset: Dataset, context: str
) -> None:
    batches = dataset.batches(10, fields=ALL)
    wanted = BatchDataset(batches)
    loader = DataLoader(
        wanted, batch_size=None, num_workers=1, multiprocessing_context=context
    )
    assert wanted.state_dict() == batches.state(batch=0)
    next(iter(loader))
    for ask in (wanted.state_dict, batches.state):
        with pytest.raises(
            UsageError,
            match=r"workers .* read batches ahead.* state\(epoch=\.\.\., batch=\.\.\.\)",
        ):
            ask()
    state = batches.state(epoch=2, batch=3)
    wanted.load_state_dict(state)
    assert batches.state() == wanted.state_dict() == state
    assert rows(loader) == ids(dataset.batches(10, fields=ALL, epoch=2))[3:]
    with pytest.raises(UsageError, match="workers"):
        batches.state()
    wanted.set_epoch(4)
    assert batches.state() == batches.state(epoch=4)


def test_all_data_sets_of_the_same_batches_detect_use_by_workers(
    dataset: Dataset,
) -> None:
    batches = dataset.batches(10, fields=ALL)
    for epoch in range(3):
        assert rows(
            DataLoader(BatchDataset(batches), batch_size=None, num_workers=1)
        ) == ids(dataset.batches(10, fields=ALL, epoch=epoch))
        with pytest.raises(UsageError, match="workers"):
            batches.state()


class AskedInWorker(BatchDataset):
    """A dataset that requests the position inside a worker."""

    def __iter__(self) -> Any:
        self.state_dict()
        return super().__iter__()


def test_a_worker_refuses_to_return_the_position(dataset: Dataset) -> None:
    loader = DataLoader(
        AskedInWorker(dataset.batches(10)), batch_size=None, num_workers=1
    )
    with pytest.raises(
        UsageError,
        match="worker of a DataLoader has no state of the batches that were used",
    ):
        next(iter(loader))


def test_the_import_does_not_change_torch() -> None:
    code = (
        "from torch.utils.data._utils import collate; before = dict(collate.default_collate_fn_map);"
        "import cnpgen.interop.torch; assert collate.default_collate_fn_map == before"
    )
    subprocess.run(
        [sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[3]
    )


def test_fields_of_a_batch_may_be_replaced_by_others_of_their_shape(
    dataset: Dataset,
) -> None:
    batch = to_torch(next(iter(dataset.batches(8, fields=ALL))))
    batch.update({"start_q": 2 * batch["start_q"]}, extra=torch.zeros(1))
    assert batch["extra"].shape == (1,)
    with pytest.raises(
        UsageError,
        match=r"field 'start_q' of a batch must keep its shape \(8, 3\), got \(1, 8, 3\)",
    ):
        batch.update(start_q=batch["start_q"][None])


def test_a_batch_of_tensors_is_printed_in_a_line(dataset: Dataset) -> None:
    batch = to_torch(next(iter(dataset.batches(8, fields=ALL))))
    expected = "<batch of 8 rows, torch.float32 on cpu: start_q[3], goal_p[2], clearance, sample_id>"
    assert repr(batch) == expected


def test_a_worker_that_starts_within_a_window_gets_its_part(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(windows, "WINDOW_ROWS", 16)
    loader = DataLoader(
        BatchDataset(dataset.batches(3, fields=ALL)), batch_size=None, num_workers=2
    )
    assert rows(loader) == ids(dataset.batches(3, fields=ALL))


@pytest.mark.parametrize("workers", [0, 2])
def test_rows_are_read_batch_by_batch_in_the_order_of_torch(
    dataset: Dataset, workers: int
) -> None:
    wanted = RowDataset(dataset, fields=ALL, normalize=False, dtype="float64")
    generator = torch.Generator().manual_seed(3)
    loader = DataLoader(
        wanted,
        batch_size=16,
        shuffle=True,
        generator=generator,
        collate_fn=wanted.collate,
        num_workers=workers,
    )
    assert len(wanted) == 50
    found = list(loader)
    assert [len(batch["start_q"]) for batch in found] == [16, 16, 16, 2]
    seen = np.concatenate([batch["sample_id"] for batch in found])
    assert sorted(seen.tolist()) == list(range(50)) != seen.tolist()
    for name, values in columns(shard_size=8).items():
        assert np.array_equal(
            np.concatenate([batch[name] for batch in found]), values[seen]
        )


@pytest.mark.parametrize("workers", [0, 2])
def test_rows_need_no_collate_fn_and_may_be_split_at_random(
    dataset: Dataset, workers: int
) -> None:
    wanted = RowDataset(dataset, fields=ALL)
    one, other = torch.utils.data.random_split(wanted, [30, 20])
    expected = dataset.rows(
        "train", range(50), fields=ALL, normalize=True, dtype="float32"
    )
    for part, options in (
        (wanted, {}),
        (wanted, {"batch_sampler": [[3, 1], [49]]}),
        (one, {}),
        (other, {"shuffle": 1}),
    ):
        for collate in (None, wanted.collate):
            kind = {"batch_size": 16} if "batch_sampler" not in options else {}
            loader = DataLoader(
                part, **options, **kind, collate_fn=collate, num_workers=workers
            )
            found = list(loader)
            assert sum(len(batch["start_q"]) for batch in found) == (
                3 if "batch_sampler" in options else len(part)
            )
            for batch in found:
                for name, values in batch.items():
                    assert np.array_equal(
                        values.numpy(), expected[name][batch["sample_id"].numpy()]
                    )


def test_a_concatenation_of_row_datasets_can_be_collated(dataset: Dataset) -> None:
    wanted = RowDataset(dataset, fields=ALL)
    loader = DataLoader(wanted + wanted, batch_size=60, collate_fn=wanted.collate)
    assert rows(loader) == [[*range(50), *range(10)], [*range(10, 50)]]


def test_single_rows_are_read_too(dataset: Dataset) -> None:
    wanted = RowDataset(dataset)
    assert list(wanted[4]) == ["start_q", "goal_p"]
    assert wanted[4]["start_q"].dtype == torch.float32
    expected = dataset.rows("train", [4], normalize=True, dtype="float32")
    assert np.array_equal(wanted[4]["goal_p"].numpy(), expected["goal_p"][0])


# The loss.


@pytest.fixture(scope="module")
def loss(cache_folder: Path, fastest: Any) -> Callable[..., PlanLoss]:
    return lambda problem, dtype="float64": PlanLoss(
        load_problem(problem),
        dtype=dtype,
        nodes=12,
        backend=fastest,
        cache_folder=cache_folder,
    )


def plans(problem: str, count: int, dtype: Any = torch.float64) -> dict[str, Any]:
    """Draw plans, weights and obstacle poses."""
    found, random = load_problem(problem), np.random.default_rng(1)
    base, spec = np.array(found.robot.base), found.trajectory
    path = base + 0.3 * random.standard_normal(
        (count, spec.path_control_points, len(base))
    )
    tensors = {
        "path": path,
        "rate": random.uniform(1.0, 2.0, (count, spec.rate_control_points)),
        "weights": random.uniform(0.5, 2.0, len(found.constraint)),
    }
    heights, puck = (
        random.uniform(0.2, 0.4, (count, 2)),
        np.tile([1.0, 0.0, 1.07, 0.0], (count, 1)),
    )
    tensors["obstacle_poses"] = heights if problem == "heavy-object" else puck
    return {name: torch.tensor(values, dtype=dtype) for name, values in tensors.items()}


@pytest.mark.parametrize("problem", ["airhockey", "heavy-object"])
def test_the_gradients_of_the_loss_agree_with_gradcheck(
    loss: Any, problem: str
) -> None:
    of, given = loss(problem), plans(problem, 2)
    variables = [
        given.pop(name).requires_grad_() for name in ("path", "rate", "weights")
    ]

    def total(path: Any, rate: Any, weights: Any) -> Any:
        return plan_loss(of, path, rate, weights=weights, **given)[0]

    assert torch.autograd.gradcheck(total, variables, eps=1e-6, rtol=1e-5, atol=1e-5)


def test_the_loss_agrees_with_numpy_and_is_the_sum_of_its_terms(loss: Any) -> None:
    of, given = loss("airhockey"), plans("airhockey", 5)
    total, terms = plan_loss(of, **given)
    expected = of(**{name: values.numpy() for name, values in given.items()})
    assert np.array_equal(total.numpy(), expected.total)
    assert np.array_equal(terms.numpy(), expected.terms)
    assert not terms.requires_grad


def test_gradients_reach_the_network_that_made_the_plans(loss: Any) -> None:
    """Check that two gradient steps in float32, through other operations, decrease the loss."""
    of, given = loss("airhockey", "float32"), plans("airhockey", 4, torch.float32)
    log_rate = given["rate"].log().requires_grad_()
    values = []
    for _ in range(3):
        total, _ = plan_loss(of, **given | {"rate": log_rate.exp()}, shift=0.5)
        assert total.dtype == torch.float32
        values.append(float(total.mean().detach()))
        (by_rate,) = torch.autograd.grad(total.mean(), [log_rate])
        log_rate = (
            (log_rate - 1e-2 * by_rate / by_rate.norm()).detach().requires_grad_()
        )
    assert values[0] > values[1] > values[2]


def test_a_second_derivative_is_refused(loss: Any) -> None:
    of, given = loss("airhockey"), plans("airhockey", 2)
    path = given.pop("path").requires_grad_()
    given["obstacle_poses"] = given["obstacle_poses"].numpy()
    (by_path,) = torch.autograd.grad(
        (plan_loss(of, path, **given)[0] ** 2).sum(), [path], create_graph=True
    )
    with pytest.raises(UsageError, match="gradients of gradients of the loss"):
        by_path.sum().backward()
    first = torch.func.grad(lambda path: (plan_loss(of, path, **given)[0] ** 2).sum())
    with pytest.raises(UsageError, match="gradients of gradients of the loss"):
        torch.func.grad(lambda path: first(path).sum())(path.detach())


def test_a_gradient_of_the_weights_alone_is_the_terms(loss: Any) -> None:
    of, given = loss("airhockey"), plans("airhockey", 3)
    total, terms = plan_loss(
        of, **given | {"weights": given["weights"].requires_grad_()}
    )
    total.sum().backward()
    torch.testing.assert_close(given["weights"].grad, terms[:, 1:].sum(0))


def test_an_invalid_plan_does_not_affect_others_through_autograd(loss: Any) -> None:
    """Check a network with four plans, one with a negative rate: its weights get the gradient of the other three."""
    of, given = loss("airhockey", "float32"), plans("airhockey", 4, torch.float32)
    weights = given["weights"].requires_grad_()
    network, inputs = torch.nn.Linear(3, 90), torch.eye(4, 3)
    reductions = {
        "mean": lambda total: total.mean(),
        "finite": lambda total: total[total.isfinite()].sum() / len(total),
        "nan_to_num": lambda total: total.nan_to_num().mean(),
        "where": lambda total: torch.where(total.isfinite(), total, 0).mean(),
        "log": lambda total: total.log().mean(),
    }

    def gradients(reduction: str, rate: Any) -> list[Any]:
        path = given["path"] + 0.01 * network(inputs).reshape(4, 15, 6)
        poses = given["obstacle_poses"][: len(rate)]
        total, _ = plan_loss(
            of, path[: len(rate)], rate, weights=weights, obstacle_poses=poses
        )
        scale = len(rate) / 4  # means over three and over four
        return list(
            torch.autograd.grad(
                reductions[reduction](total) * scale, [*network.parameters(), weights]
            )
        )

    for garbage in (-1.0, float("nan"), 1e-35):
        rate = given["rate"].clone()
        rate[3, 4] = garbage
        if garbage > 0:
            rate[3] = garbage  # the loss overflows
        for reduction in reductions:
            expected = gradients(
                "mean" if reduction != "log" else reduction, given["rate"][:3]
            )
            for found, want in zip(gradients(reduction, rate), expected, strict=True):
                torch.testing.assert_close(found, want, rtol=1e-4, atol=1e-6)


def test_weights_and_poses_may_be_arrays_and_any_float_type_is_accepted(
    loss: Any,
) -> None:
    of, given = loss("heavy-object", "float32"), plans("heavy-object", 3, torch.float32)
    expected = plan_loss(of, **given)[0]
    arrays = given | {
        name: given[name].numpy() for name in ("weights", "obstacle_poses")
    }
    by_name = dict(zip(of.terms[1:], given["weights"].tolist(), strict=True))
    for changed in (
        arrays,
        given | {"weights": given["weights"].tolist()},
        given | {"weights": by_name},
    ):
        torch.testing.assert_close(plan_loss(of, **changed)[0], expected)
    for dtype in (torch.bfloat16, torch.float16, torch.float64):
        path = given["path"].to(dtype).requires_grad_()
        total, terms = plan_loss(of, **given | {"path": path})
        assert total.dtype == terms.dtype == torch.float32
        total.sum().backward()
        assert path.grad.dtype == dtype


def test_it_works_under_autocast(loss: Any) -> None:
    of, given = loss("airhockey", "float32"), plans("airhockey", 4, torch.float32)
    network = torch.nn.Linear(3, 20)
    with torch.autocast("cpu", torch.bfloat16):
        log_rate = network(torch.ones(4, 3))
        assert log_rate.dtype == torch.bfloat16
        given["weights"].requires_grad_()
        total, _ = plan_loss(of, **given | {"rate": log_rate.exp()})
        total.mean().backward()
    assert network.weight.grad.abs().sum() > 0
    assert given["weights"].grad.dtype == torch.float32


def test_functional_gradients_are_the_same(loss: Any) -> None:
    of, given = loss("airhockey"), plans("airhockey", 3)
    path = given.pop("path")
    given["obstacle_poses"] = given["obstacle_poses"].numpy()
    (expected,) = torch.autograd.grad(
        plan_loss(of, path.requires_grad_(), **given)[0].sum(), [path]
    )
    found = torch.func.grad(lambda path: plan_loss(of, path, **given)[0].sum())(
        path.detach()
    )
    torch.testing.assert_close(found, expected)


def test_without_gradients_only_terms_are_computed(
    loss: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    of, given = loss("airhockey"), plans("airhockey", 2)
    monkeypatch.delitem(of.__dict__, "_gradient", raising=False)
    with torch.no_grad():
        plan_loss(of, **given | {"path": given["path"].requires_grad_()})
    assert "_gradient" not in of.__dict__


MISTAKES = {
    "rate must have shape (2, 20), got (1, 20)": {"rate": torch.ones(1, 20)},
    "weights must have shape (6,) for joint-position": {"weights": np.ones(3)},
    "weights must be an array of numbers, got str": {"weights": "abc"},
    "there is no constraint 'tabel' (did you mean 'table'?)": {
        "weights": {"tabel": 1.0}
    },
    "path must be real numbers, got torch.complex64": {
        "path": torch.ones(2, 15, 6, dtype=torch.complex64)
    },
    "start_tip must have shape (2, 3), got (3,)": {"start_tip": torch.zeros(3)},
    "shift must be a finite number, got None": {"shift": None},
}


@pytest.mark.parametrize("message", MISTAKES)
def test_invalid_arguments_are_refused(loss: Any, message: str) -> None:
    with pytest.raises(UsageError) as error:
        plan_loss(loss("airhockey"), **plans("airhockey", 2) | MISTAKES[message])
    assert str(error.value).startswith(message)


# Control points.


@pytest.fixture(
    scope="module",
    params=[("airhockey", "free"), ("airhockey", "given"), ("heavy-object", "free")],
    ids=" ".join,
)
def layer(
    request: pytest.FixtureRequest, cache_folder: Path, fastest: Any
) -> BoundaryLayer:
    problem, acceleration = request.param
    return BoundaryLayer(
        problem,
        goal_acceleration=acceleration,
        backend=fastest,
        cache_folder=cache_folder,
    )


def test_control_points_meet_the_boundary_conditions_and_have_gradients(
    layer: BoundaryLayer,
) -> None:
    given = boundary_for_layer(layer, 2)
    tasks = layer.tasks(given)
    values = [torch.tensor(part).requires_grad_() for part in outputs(layer, 2)]
    path, rate = (part.detach() for part in control_points(layer, tasks, *values))
    wanted = given.conditions().values()
    for found, expected, exact in zip(
        at_ends(path, rate), wanted, (1e-12, 1e-10, 1e-8) * 2, strict=False
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=exact)
    assert torch.autograd.gradcheck(
        lambda phi, log_rate: control_points(layer, tasks, phi, log_rate), values, eps=1e-6, rtol=1e-4, atol=1e-6,
        fast_mode=True,
    )  # fmt: skip


def test_boundary_conditions_may_be_tensors(layer: BoundaryLayer) -> None:
    given = boundary_for_layer(layer, 2)
    tensors = type(given)(
        *(None if part is None else torch.tensor(part) for part in vars(given).values())
    )
    np.testing.assert_array_equal(
        layer.tasks(tensors).expected_time, layer.tasks(given).expected_time
    )
    tensors.goal_q.requires_grad_()
    with pytest.raises(
        UsageError,
        match=r"goal_q must be an array of numbers, got Tensor: .*requires grad",
    ):
        layer.tasks(tensors)


@pytest.mark.parametrize(
    ("dtype", "expected"),
    [("bfloat16", "float32"), ("float32", "float32"), ("float64", "float64")],
)
def test_control_points_have_at_least_single_precision(
    layer: BoundaryLayer, dtype: str, expected: str
) -> None:
    tasks = layer.tasks(boundary_for_layer(layer, 2))
    values = [
        torch.tensor(part, dtype=getattr(torch, dtype)).requires_grad_()
        for part in outputs(layer, 2)
    ]
    path, rate = control_points(layer, tasks, *values)
    assert path.dtype == rate.dtype == getattr(torch, expected)
    path.sum().backward()
    assert all(
        part.grad.dtype == part.dtype and part.grad.abs().sum() > 0 for part in values
    )


def test_functional_gradients_of_control_points_are_the_same_and_second_ones_are_refused(
    layer: BoundaryLayer,
) -> None:
    tasks, (phi, log_rate) = (
        layer.tasks(boundary_for_layer(layer, 2)),
        map(torch.tensor, outputs(layer, 2)),
    )

    def scalar(phi: Any) -> Any:
        return (control_points(layer, tasks, phi, log_rate)[0] ** 2).sum()

    (expected,) = torch.autograd.grad(scalar(phi.requires_grad_()), [phi])
    torch.testing.assert_close(torch.func.grad(scalar)(phi.detach()), expected)
    with pytest.raises(UsageError, match="gradients of gradients"):
        torch.func.grad(lambda phi: torch.func.grad(scalar)(phi).sum())(phi.detach())


def test_a_network_learns_through_control_points_and_loss_despite_an_overflow(
    layer: BoundaryLayer, loss: Any
) -> None:
    of, tasks = (
        loss(layer.problem.name, "float32"),
        layer.tasks(boundary_for_layer(layer, 4)),
    )
    torch.manual_seed(0)
    network = torch.nn.Linear(4, layer.path_outputs + layer.rate_outputs)
    torch.nn.init.normal_(network.weight, std=1e-2)
    optimizer, values, overflow = (
        torch.optim.Adam(network.parameters(), 1e-3),
        [],
        torch.zeros(4, layer.rate_outputs),
    )
    overflow[3] = 1000.0
    for _ in range(5):
        phi, log_rate = network(torch.eye(4)).split(
            [layer.path_outputs, layer.rate_outputs], dim=1
        )
        path, rate = control_points(layer, tasks, phi.tanh(), log_rate + overflow)
        total, _ = plan_loss(
            of,
            path,
            rate,
            weights=of.weights0,
            obstacle_poses=tasks.scene.poses,
            start_tip=tasks.start_xyz,
        )
        assert total.isfinite().tolist() == [True, True, True, False]
        optimizer.zero_grad()
        total.mean().backward()
        optimizer.step()
        values.append(float(total[:3].mean().detach()))
    assert values[-1] < values[0]
    assert all(part.isfinite().all() for part in network.parameters())
