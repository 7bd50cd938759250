"""The stages of a pipeline together: a later one may write a field again, but not as something else."""

import re
from dataclasses import dataclass, replace

import pytest

from cnpgen import plugins
from cnpgen.errors import RecipeError
from cnpgen.pipelines.load import load_pipeline
from cnpgen.store.field import Field
from tests.conftest import Prepare


def overwriting(**changes: object) -> type[plugins.Stage]:
    """Make a stage of a plug-in that writes ``start_q`` again, declared otherwise."""

    @dataclass(frozen=True, kw_only=True)
    class Again(plugins.Stage):
        needs = ("start_q",)

        def describe(self) -> str:
            return "write the start configuration again"

        def provides(self, context: plugins.Context) -> tuple[Field, ...]:
            return (replace(context.joint_field("start_q", "rad", "start"), **changes),)

        def prepare(self, context: plugins.Context):
            def work(draws: plugins.Round, random: object) -> None:
                draws["start_q"] = draws["start_q"].copy()

            return work

    return Again


def with_stage(kind: type[plugins.Stage], monkeypatch: pytest.MonkeyPatch):
    """Return a shipped pipeline with the stage of a plug-in at its end."""
    from cnpgen.schema import registry

    known = registry.name_of
    monkeypatch.setattr(registry, "name_of", lambda group, cls: "again" if cls is kind else known(group, cls))
    pipeline = load_pipeline("airhockey-hit")
    return replace(pipeline, stage=(*pipeline.stage, kind()))


def test_a_stage_that_writes_a_field_in_furlongs_of_width_2_is_refused(
    prepare: Prepare, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = overwriting(unit="furlong", width=2, names=("a", "b"), valid_min=None, valid_max=None)
    pipeline = with_stage(kind, monkeypatch)
    with pytest.raises(RecipeError) as caught:
        prepare(pipeline)
    (mistake,) = caught.value.mistakes
    assert mistake.startswith(
        f"{pipeline.path}: stage {len(pipeline.stage)} (again): provides start_q as unit 'furlong', "
    )
    text = r"width 2, names \('a', 'b'\), but stage \d \(.*\) before it as unit 'rad', width 6, names \('joint_1', "
    assert re.search(text, mistake)


@pytest.mark.parametrize(("key", "value"), [("dtype", "int64"), ("frame", "table"), ("names", tuple("abcdef"))])
def test_whatever_says_what_the_numbers_are_must_stay(
    prepare: Prepare, monkeypatch: pytest.MonkeyPatch, key: str, value: object
) -> None:
    with pytest.raises(RecipeError, match=rf"\(again\): provides start_q as {key} .*, but stage \d+ \(.*\) before it"):
        prepare(with_stage(overwriting(**{key: value}), monkeypatch))


def test_a_field_written_again_may_have_other_limits_and_another_description(
    prepare: Prepare, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = overwriting(valid_min=(-1.0,) * 6, valid_max=(1.0,) * 6, long_name="again")
    prepared = prepare(with_stage(kind, monkeypatch))
    (field,) = (field for field in prepared.fields if field.name == "start_q")
    assert (field.valid_max, field.long_name) == ((1.0,) * 6, "again")
