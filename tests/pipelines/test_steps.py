"""Stages of a pipeline: a later stage may write a field again, but not redefine it."""

import re
from dataclasses import dataclass, replace

import pytest

from cnpgen import plugins
from cnpgen.errors import RecipeError
from cnpgen.pipelines.pipeline import load_pipeline
from cnpgen.pipelines.stages.draw import DrawParameters
from cnpgen.store.field import Field
from tests.conftest import Prepare
from tests.refusals import is_refused


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
    with is_refused(RecipeError):
        prepare(with_stage(overwriting(**{key: value}), monkeypatch))


def test_a_stage_may_change_limits_and_description_of_a_field(
    prepare: Prepare, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = overwriting(valid_min=(-1.0,) * 6, valid_max=(1.0,) * 6, long_name="again")
    prepared = prepare(with_stage(kind, monkeypatch))
    (field,) = (field for field in prepared.fields if field.name == "start_q")
    assert (field.valid_max, field.long_name) == ((1.0,) * 6, "again")


@pytest.mark.parametrize("kind", ["DrawPositions", "StartIK", "AtRest"])
def test_a_stage_whose_columns_are_replaced_is_refused(
    prepare: Prepare, kind: str
) -> None:
    pipeline = load_pipeline("airhockey-hit")
    twice = [
        copy
        for stage in pipeline.stage
        for copy in [stage] * (2 if type(stage).__name__ == kind else 1)
    ]
    with pytest.raises(RecipeError) as caught:
        prepare(replace(pipeline, stage=tuple(twice)))
    (error,) = caught.value.errors
    text = r"stage (\d) \((.*)\): has no effect: stage \d \(\2\) writes all of its columns again"
    assert re.search(text, error)


def test_a_pipeline_draws_the_parameters_of_its_problem(prepare: Prepare) -> None:
    pipeline = load_pipeline("airhockey-tables")
    kept = [each for each in pipeline.stage if not isinstance(each, DrawParameters)]
    assert len(kept) == len(pipeline.stage) - 1
    with is_refused(RecipeError):
        prepare(replace(pipeline, stage=tuple(kept)))
