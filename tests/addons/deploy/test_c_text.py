"""Names of model files cannot leave comments, strings or identifiers of a C file."""

import re
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.addons.deploy.c_source import Names, header_text, source_text
from cnpgen.addons.deploy.c_text import comment_text, identifier, string_literal, table
from cnpgen.addons.deploy.input_ranges import input_ranges
from cnpgen.addons.deploy.planner_parts import PlannerParts, planner_parts
from cnpgen.addons.deploy.readme import readme_text
from cnpgen.planner.inference_pipeline import loaded_problem
from cnpgen.planner.model_file import load_model
from tests.addons.deploy.compiled_planner import COMPILER, WARNINGS, needs_compiler

HOSTILE = (
    "*/ int main(void) { return 1; } /*",
    "end\\",
    "two\nlines\r#error",
    "</script><b>",
    '"quoted" ??/ ??)',
    "nul\0 tab\t é 日本",
)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("airhockey-hit", "airhockey_hit"),
        ("Mine 2", "mine_2"),
        ("2nd", "planner_2nd"),
        ("math", "planner_math"),
        ("日本", "planner"),
        ("", "planner"),
        ("__x__", "x"),
        ("*/", "planner"),
        ("a" * 100, "a" * 40),
    ],
)
def test_identifiers_have_letters_digits_and_underscores(text, name):
    assert identifier(text) == name


@pytest.mark.parametrize("text", HOSTILE)
def test_identifiers_of_hostile_names_are_valid(text):
    assert re.fullmatch(r"[a-z][a-z0-9_]{0,39}", identifier(text))


@pytest.mark.parametrize("text", HOSTILE)
def test_comments_contain_no_special_character(text):
    assert re.fullmatch(r"[A-Za-z0-9 _.,:;()+=<>%@#|~^-]*", comment_text(text))
    assert "*/" not in comment_text(text)


@needs_compiler
def test_strings_are_read_back_by_the_compiler(tmp_path: Path):
    texts = [*HOSTILE[:-1], "tab\t é 日本", "%s%n", "\x01\x7f1"]
    lines = "\n".join(f"puts({string_literal(text)});" for text in texts)
    source = f"#include <stdio.h>\nint main(void) {{\n{lines}\nreturn 0;\n}}\n"
    (tmp_path / "s.c").write_text(source, encoding="ascii")
    command = [str(COMPILER), *WARNINGS, "s.c", "-o", "s"]
    subprocess.run(command, cwd=tmp_path, check=True)
    out = subprocess.run(["./s"], cwd=tmp_path, capture_output=True, check=True)
    assert out.stdout == "".join(f"{text}\n" for text in texts).encode()


def test_numbers_read_back_exactly():
    values = np.array([0.1, -1e-300, 5e-324, np.inf, -np.inf, 0.0, 3.0, 1e22])
    body = table("double", "x", values).split("{")[1].split("}")[0]
    read = [float(t.replace("INFINITY", "inf")) for t in body.split(",")]
    np.testing.assert_array_equal(read, values)
    single = values[[0, 5, 6]].astype(np.float32)
    body = table("float", "x", single).split("{")[1].split("}")[0]
    read = [np.float32(t.strip().removesuffix("f")) for t in body.split(",")]
    np.testing.assert_array_equal(read, single)


@pytest.fixture(scope="module")
def parts() -> PlannerParts:
    model = load_model("airhockey-hit")
    with loaded_problem(model.problem, "numpy") as loaded:
        return planner_parts(model, loaded, input_ranges(model, loaded))


@needs_compiler
def test_hostile_names_of_joints_problems_and_models_compile(
    parts: PlannerParts, tmp_path: Path
):
    robot = replace(parts.robot, joint_names=HOSTILE)
    hostile = replace(
        parts, robot=robot, problem=replace(parts.problem, name=HOSTILE[0])
    )
    names = Names("mine", HOSTILE[2], "0" * 64)
    (tmp_path / "mine.h").write_text(header_text(hostile, names), encoding="ascii")
    (tmp_path / "mine.c").write_text(source_text(hostile, names), encoding="ascii")
    command = [str(COMPILER), *WARNINGS, "-fsyntax-only", "mine.c"]
    subprocess.run(command, cwd=tmp_path, check=True)
    page = readme_text(hostile, names)
    assert "script" in page
    assert "</script>" not in page


@needs_compiler
@pytest.mark.parametrize(
    "name", ["check", "path", "time", "plan", "int", "input", "rate", "max", "min"]
)
def test_prefixes_collide_with_no_name_of_the_source(
    parts: PlannerParts, tmp_path: Path, name: str
):
    names = Names(name, "model", "0" * 64)
    (tmp_path / f"{name}.h").write_text(header_text(parts, names))
    (tmp_path / f"{name}.c").write_text(source_text(parts, names))
    command = [str(COMPILER), *WARNINGS, "-fsyntax-only", f"{name}.c"]
    subprocess.run(command, cwd=tmp_path, check=True)
