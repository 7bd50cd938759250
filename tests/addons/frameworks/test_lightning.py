"""The recipe of docs/how-to/loading.md for Lightning, interrupted within an epoch; in the extended run only."""

import re
import warnings
from pathlib import Path
from typing import Any

import pytest

from tests.examples.loader import ids, make

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # warnings of its imports
    lightning = pytest.importorskip("lightning")
    import torch

from cnpgen.loader.load import load_dataset

pytestmark = [
    pytest.mark.extended,
    pytest.mark.filterwarnings("ignore"),
]  # warnings of Lightning

LOADING = Path(__file__).parents[3] / "docs" / "how-to" / "loading.md"
EPOCHS, BATCHES = 3, 6  # of 8 rows out of 50


class Interruption(Exception):
    """An exception that stops a run inside a step."""


class Recorder(lightning.LightningModule):
    """A linear model that records its training rows and may stop before a batch is used."""

    def __init__(self, stop_before: int | None = None) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.layer, self.stop_before = torch.nn.Linear(3, 2), stop_before
        self.seen: list[list[int]] = []

    def training_step(self, batch: Any, _: int) -> Any:
        if self.global_step == self.stop_before:
            raise Interruption
        self.seen.append(batch["sample_id"].tolist())
        loss = (self.layer(batch["start_q"]) - batch["goal_p"]).square().mean()
        self.log(
            "loss", loss, on_epoch=True
        )  # Lightning reads the number of rows from the batch
        return loss

    def validation_step(self, batch: Any, _: int) -> None:
        self.log(
            "validation",
            (self.layer(batch["start_q"]) - batch["goal_p"]).square().mean(),
        )

    def configure_optimizers(self) -> Any:
        return torch.optim.Adam(self.parameters(), 0.1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("loader") / "set", shard_size=8)


@pytest.fixture(scope="module")
def block() -> str:
    """Return the code of the documentation."""
    (found,) = [
        text
        for text in re.findall(r"```python\n(.*?)```", LOADING.read_text(), re.S)
        if "DataModule" in text
    ]
    return str(found)


@pytest.fixture(scope="module")
def recipe(block: str) -> Any:
    """Return the DataModule of the documentation."""
    module: dict[str, Any] = {}
    exec(block.partition("\n\n\n# ")[0], module)
    return module["Rows"]


def fit(
    model: Recorder, data: Any, folder: Path, checkpoint: Path | None = None
) -> Recorder:
    """Train, with a checkpoint after every step."""
    save = lightning.pytorch.callbacks.ModelCheckpoint(
        folder, "{step}", every_n_train_steps=1, save_top_k=-1
    )
    trainer = lightning.Trainer(
        accelerator="cpu", max_epochs=EPOCHS, callbacks=[save], logger=False, enable_progress_bar=False,
        enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(model, data, ckpt_path=checkpoint)
    return model


def with_ids(recipe: Any, folder: Path) -> Any:
    """Return the recipe with sample numbers in its batches."""
    return recipe(folder, 8, fields=["start_q", "goal_p", "sample_id"])


@pytest.mark.parametrize("step", [2, BATCHES, 2 * BATCHES - 1, 2 * BATCHES + 1])
def test_training_resumes_after_the_step_of_the_checkpoint(
    recipe: Any, folder: Path, tmp_path: Path, step: int
) -> None:
    whole = fit(Recorder(), with_ids(recipe, folder), tmp_path / "whole")
    expected = [
        load_dataset(folder).batches(8, fields=["sample_id"], epoch=epoch)
        for epoch in range(EPOCHS)
    ]
    assert whole.seen == [rows for batches in expected for rows in ids(batches)]

    with pytest.raises(Interruption):
        fit(Recorder(stop_before=step + 1), with_ids(recipe, folder), tmp_path / "part")
    resumed = fit(
        Recorder(),
        with_ids(recipe, folder),
        tmp_path / "rest",
        tmp_path / "part" / f"step={step}.ckpt",
    )
    assert resumed.seen == whole.seen[step:]
    assert torch.equal(resumed.layer.weight, whole.layer.weight)


def test_the_first_validation_has_all_rows_after_the_sanity_check(
    recipe: Any, folder: Path
) -> None:
    data = with_ids(recipe, folder)
    found = [
        sum(len(batch["start_q"]) for batch in data.val_dataloader()) for _ in range(2)
    ]
    assert found == [10, 10]


def test_the_code_of_the_documentation_runs_as_it_is_shown(
    block: str, tiny: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hits").symlink_to(tiny("airhockey-hit"))
    exec(block, {})
    assert (tmp_path / "partial.ckpt").exists()
