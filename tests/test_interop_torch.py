"""The bridge to torch, against torch itself."""

# ruff: noqa: E402 - without the framework nothing else is imported
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loader_example import ALL, columns, ids, make

torch = pytest.importorskip("torch")

from torch.utils.data import DataLoader

from cnpgen.interop.torch import BatchDataset, RowDataset, plan_loss, to_torch
from cnpgen.library import load_problem
from cnpgen.loader import order
from cnpgen.loader.dataset import Dataset
from cnpgen.loader.load import load_dataset
from cnpgen.losses.plan_loss import PlanLoss

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning"),  # than the machine has cores
]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return load_dataset(make(tmp_path_factory.mktemp("loader") / "set", shard_size=8))


def rows(loader: Any) -> list[list[int]]:
    return [batch["sample_id"].tolist() for batch in loader]


def test_tensors_have_the_batch_s_numbers_in_the_batch_s_memory(dataset: Dataset) -> None:
    batch = next(iter(dataset.batches(8, fields=ALL)))
    tensors = to_torch(batch)
    assert list(tensors) == list(ALL)
    for name, values in batch.items():
        assert np.array_equal(tensors[name].numpy(), values)
        assert tensors[name].shape == values.shape
        assert np.shares_memory(tensors[name].numpy(), values)
    assert tensors["start_q"].dtype == torch.float32
    assert tensors["sample_id"].dtype == torch.int64


@pytest.mark.parametrize("workers", [0, 1, 2, 3])
@pytest.mark.parametrize("drop_last", [True, False])
def test_a_data_loader_gives_the_same_batches_with_any_number_of_workers(
    dataset: Dataset, workers: int, drop_last: bool
) -> None:
    wanted = BatchDataset(dataset.batches(7, fields=ALL, drop_last=drop_last))
    loader = DataLoader(wanted, batch_size=None, num_workers=workers)
    expected = list(dataset.batches(7, fields=ALL, drop_last=drop_last))
    assert len(loader) == len(expected)
    for found, batch in zip(loader, expected, strict=True):
        assert list(found) == list(batch)
        assert all(np.array_equal(found[name].numpy(), batch[name]) for name in batch)


def test_workers_may_be_spawned(dataset: Dataset) -> None:
    loader = DataLoader(
        BatchDataset(dataset.batches(7, fields=ALL)), batch_size=None, num_workers=1, multiprocessing_context="spawn"
    )
    assert rows(loader) == ids(dataset.batches(7, fields=ALL))


def test_without_workers_every_loop_is_the_next_epoch(dataset: Dataset) -> None:
    loader = DataLoader(BatchDataset(dataset.batches(10, fields=ALL)), batch_size=None)
    assert [rows(loader) for _ in range(3)] == [ids(dataset.batches(10, fields=ALL, epoch=e)) for e in range(3)]


@pytest.mark.parametrize("persistent", [True, False])
def test_workers_are_told_the_epoch(dataset: Dataset, persistent: bool) -> None:
    wanted = BatchDataset(dataset.batches(10, fields=ALL))
    loader = DataLoader(wanted, batch_size=None, num_workers=2, persistent_workers=persistent)
    for epoch in (0, 1, 2, 0):
        wanted.set_epoch(epoch)
        assert rows(loader) == ids(dataset.batches(10, fields=ALL, epoch=epoch))


@pytest.mark.parametrize("workers", [0, 2])
def test_training_resumes_after_any_number_of_used_batches(dataset: Dataset, workers: int) -> None:
    expected = ids(dataset.batches(6, fields=ALL, epoch=1))
    for used in range(len(expected)):
        batches = dataset.batches(6, fields=ALL)
        wanted = BatchDataset(batches)
        batches.load_state(dataset.batches(6).state(epoch=1, batch=used))
        if used % 2:
            wanted.set_epoch(1)  # changes nothing
        assert rows(DataLoader(wanted, batch_size=None, num_workers=workers)) == expected[used:]


def test_a_worker_in_the_middle_of_windows_gets_its_share(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(order, "WINDOW_ROWS", 16)
    loader = DataLoader(BatchDataset(dataset.batches(3, fields=ALL)), batch_size=None, num_workers=2)
    assert rows(loader) == ids(dataset.batches(3, fields=ALL))


@pytest.mark.parametrize("workers", [0, 2])
def test_rows_are_read_batch_by_batch_in_torch_s_own_order(dataset: Dataset, workers: int) -> None:
    wanted = RowDataset(dataset, fields=ALL, normalize=False, dtype="float64")
    generator = torch.Generator().manual_seed(3)
    loader = DataLoader(
        wanted, batch_size=16, shuffle=True, generator=generator, collate_fn=wanted.collate, num_workers=workers
    )
    assert len(wanted) == 50
    found = list(loader)
    assert [len(batch["start_q"]) for batch in found] == [16, 16, 16, 2]
    seen = np.concatenate([batch["sample_id"] for batch in found])
    assert sorted(seen.tolist()) == list(range(50)) != seen.tolist()
    for name, values in columns(shard_size=8).items():
        assert np.array_equal(np.concatenate([batch[name] for batch in found]), values[seen])


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
        load_problem(problem), dtype=dtype, nodes=12, backend=fastest, cache_folder=cache_folder
    )


def plans(problem: str, count: int, dtype: Any = torch.float64) -> dict[str, Any]:
    """Draw plans, weights and, where there are obstacles, their heights."""
    found, random = load_problem(problem), np.random.default_rng(1)
    base, spec = np.array(found.robot.base), found.trajectory
    path = base + 0.3 * random.standard_normal((count, spec.path_control_points, len(base)))
    tensors = {
        "path": path,
        "rate": random.uniform(1.0, 2.0, (count, spec.rate_control_points)),
        "weights": random.uniform(0.5, 2.0, len(found.constraint)),
    }
    if problem == "heavy-object":
        tensors["tops"] = random.uniform(0.2, 0.4, (count, 2))
    return {name: torch.tensor(values, dtype=dtype) for name, values in tensors.items()}


@pytest.mark.parametrize("problem", ["airhockey", "heavy-object"])
def test_the_loss_s_gradients_are_those_that_torch_finds_by_differences(loss: Any, problem: str) -> None:
    of, given = loss(problem), plans(problem, 2)
    variables = [given.pop(name).requires_grad_() for name in ("path", "rate", "weights")]

    def total(path: Any, rate: Any, weights: Any) -> Any:
        return plan_loss(of, path, rate, weights=weights, **given)[0]

    assert torch.autograd.gradcheck(total, variables, eps=1e-6, rtol=1e-5, atol=1e-5)


def test_the_loss_is_that_of_numpy_and_a_sum_of_its_terms(loss: Any) -> None:
    of, given = loss("airhockey"), plans("airhockey", 5)
    total, terms = plan_loss(of, **given)
    expected = of(**{name: values.numpy() for name, values in given.items()})
    assert np.array_equal(total.numpy(), expected.total)
    assert np.array_equal(terms.numpy(), expected.terms)
    assert not terms.requires_grad


def test_gradients_reach_the_network_that_made_the_plans(loss: Any) -> None:
    """Two steps down a plan's own gradient, in float32 and through other operations, lower the loss."""
    of, given = loss("airhockey", "float32"), plans("airhockey", 4, torch.float32)
    log_rate = given["rate"].log().requires_grad_()
    values = []
    for _ in range(3):
        total, _ = plan_loss(of, given["path"], log_rate.exp(), weights=given["weights"], shift=0.5)
        assert total.dtype == torch.float32
        values.append(float(total.mean().detach()))
        (by_rate,) = torch.autograd.grad(total.mean(), [log_rate])
        log_rate = (log_rate - 1e-2 * by_rate / by_rate.norm()).detach().requires_grad_()
    assert values[0] > values[1] > values[2]


def test_a_second_derivative_is_refused(loss: Any) -> None:
    of, given = loss("airhockey"), plans("airhockey", 2)
    path = given.pop("path").requires_grad_()
    (by_path,) = torch.autograd.grad((plan_loss(of, path, **given)[0] ** 2).sum(), [path], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        by_path.sum().backward()
