"""Stages of a pipeline: a later stage may write a field again, but not redefine it."""

import re
from dataclasses import dataclass, replace

import pytest

from cnpgen import plugins
from cnpgen.errors import RecipeError
from cnpgen.pipelines.pipeline import load_pipeline
from cnpgen.store.field import Field
from tests.conftest import Prepare


def overwriting(**changes: object) -> type[plugins.Stage]:
    """Create a plug-in stage that writes ``start_q`` with a different declaration."""

    @dataclass(frozen=True, kw_only=True)
    class Again(plugins.Stage):
        inputs = ("start_q",)

        def describe(self) -> str:
            return "write the start configuration again"

        def outputs(self, context: plugins.Context) -> tuple[Field, ...]:
            return (replace(context.joint_field("start_q", "rad", "start"), **changes),)

        def prepare(self, context: plugins.Context):
            def work(candidates: plugins.CandidateBatch, random: object) -> None:
                candidates["start_q"] = candidates["start_q"].copy()

            return work

    return Again


def with_stage(kind: type[plugins.Stage], monkeypatch: pytest.MonkeyPatch):
    """Return a shipped pipeline with a plug-in stage at its end."""
    from cnpgen.schema import registry

    known = registry.name_of
    monkeypatch.setattr(
        registry,
        "name_of",
        lambda group, cls: "again" if cls is kind else known(group, cls),
    )
    pipeline = load_pipeline("airhockey-hit")
    return replace(pipeline, stage=(*pipeline.stage, kind()))


def test_a_stage_that_changes_unit_and_width_of_a_field_raises_an_error(
    prepare: Prepare, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = overwriting(
        unit="furlong", width=2, names=("a", "b"), valid_min=None, valid_max=None
    )
    pipeline = with_stage(kind, monkeypatch)
    with pytest.raises(RecipeError) as caught:
        prepare(pipeline)
    (error,) = caught.value.errors
    assert error.startswith(
        f"{pipeline.path}: stage {len(pipeline.stage)} (again): declares start_q as unit 'furlong', "
    )
    text = r"width 2, names \('a', 'b'\), but stage \d \(.*\) before it as unit 'rad', width 6, names \('joint_1', "
    assert re.search(text, error)


@pytest.mark.parametrize(
    ("key", "value"),
    [("dtype", "int64"), ("frame", "table"), ("names", tuple("abcdef"))],
)
def test_a_stage_may_not_redefine_a_field(
    prepare: Prepare, monkeypatch: pytest.MonkeyPatch, key: str, value: object
) -> None:
    with pytest.raises(
        RecipeError,
        match=rf"\(again\): declares start_q as {key} .*, but stage \d+ \(.*\) before it",
    ):
        prepare(with_stage(overwriting(**{key: value}), monkeypatch))


def test_a_stage_may_change_limits_and_description_of_a_field(
    prepare: Prepare, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = overwriting(valid_min=(-1.0,) * 6, valid_max=(1.0,) * 6, long_name="again")
    prepared = prepare(with_stage(kind, monkeypatch))
    (field,) = (field for field in prepared.fields if field.name == "start_q")
    assert (field.valid_max, field.long_name) == ((1.0,) * 6, "again")
