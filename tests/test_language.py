"""Rules of language: vocabulary, docstring starts, one value per constant, one class per name, sentence length."""

import ast
import json
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
REPLACEMENTS: dict[str, str] = json.loads(
    (ROOT / "tests" / "data" / "vocabulary.json").read_text(encoding="utf-8")
)
PREFIXES = {
    "MOST_": "MAX_",
    "ENOUGH": "MIN_",
    "ALONE": "MAX_ or MIN_",
    "SPARE": "MARGIN_",
    "DEEP": "DEPTH_",
}
EXCLUDED = {
    "CHANGELOG.md",
    "glossary.md",
    "references.md",
    "test_language.py",
}  # old names, synonyms, titles, examples
EXTERNAL_NAMES = re.compile(r"warm_start_slack_\w+")  # options of Ipopt
TEXT = ("*.py", "*.pyi", "*.c", "*.h", "*.html", "*.md", "*.toml")
MAX_WORDS = 25
MAX_MEAN_WORDS = 18.0
MAX_LONG_SHARE = 0.05
FOLDERS = ("cnpgen", "tests", "benchmarks", "docs", "problems", "pipelines", "datasets")


def texts() -> Iterator[Path]:
    """Yield every text file of the project."""
    paths = [
        *ROOT.glob("*.md"),
        *(
            path
            for folder in FOLDERS
            for kind in TEXT
            for path in (ROOT / folder).rglob(kind)
        ),
    ]
    yield from (
        path
        for path in sorted(paths)
        if path.name not in EXCLUDED and "_recipes" not in path.parts
    )


def sources() -> Iterator[tuple[str, ast.Module]]:
    """Yield the path and the syntax tree of every module of the package."""
    for path in sorted((ROOT / "cnpgen").rglob("*.py*")):
        if path.suffix in {".py", ".pyi"}:
            yield (
                path.relative_to(ROOT).as_posix(),
                ast.parse(path.read_text(encoding="utf-8")),
            )


def words_in(text: str) -> list[str]:
    """Split names and prose into lower-case words: ``SamplingStatistics`` has two."""
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", text)]


def private_words(text: str) -> Iterator[tuple[int, str, str]]:
    """Yield line, word and replacement of every private word."""
    for number, line in enumerate(EXTERNAL_NAMES.sub("", text).splitlines(), 1):
        for word in words_in(line):
            if word in REPLACEMENTS:
                yield number, word, REPLACEMENTS[word]
        for name in re.findall(r"\b[A-Z][A-Z_]+\b", line):
            for prefix, replacement in PREFIXES.items():
                if name.startswith(prefix):
                    yield number, name, replacement


def test_private_words_occur_nowhere() -> None:
    findings = [
        f"{path.relative_to(ROOT)}:{line}: {word!r}, use: {replacement}"
        for path in texts()
        for line, word, replacement in private_words(path.read_text(encoding="utf-8"))
    ]
    assert not findings, "\n".join(findings)


def test_private_words_are_recognized_in_names_and_prose() -> None:
    found = list(
        private_words("def settle_it(MOST_ROWS):\n    return FatesTable  # likewise")
    )
    assert [word for _, word, _ in found] == [
        "settle",
        "MOST_ROWS",
        "fates",
        "likewise",
    ]
    assert found[0] == (1, "settle", "decide")


def docstrings() -> Iterator[tuple[str, ast.AST, str]]:
    for path, tree in sources():
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and (
                text := ast.get_docstring(node)
            ):
                yield f"{path}:{getattr(node, 'lineno', 1)}", node, text


def is_boolean_property(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.FunctionDef)
        and node.returns is not None
        and "bool" in ast.unparse(node.returns)
    )


def test_docstrings_begin_with_a_verb_or_a_noun() -> None:
    findings = [
        f"{place}: {text.splitlines()[0]!r}, begin with a verb in the imperative or a noun"
        for place, node, text in docstrings()
        if re.match(r"(What|How|Where|Likewise)\b", text)
        or (text.startswith("Whether") and not is_boolean_property(node))
    ]
    assert not findings, "\n".join(findings)


def is_number(node: ast.expr | None) -> bool:
    parts = (
        []
        if node is None
        else [
            part
            for part in ast.walk(node)
            if not isinstance(part, ast.operator | ast.unaryop)
        ]
    )
    numbers = [
        part
        for part in parts
        if isinstance(part, ast.Constant) and isinstance(part.value, int | float)
    ]
    return bool(numbers) and all(
        isinstance(part, ast.BinOp | ast.UnaryOp) or part in numbers for part in parts
    )


def test_no_numeric_constant_has_two_values() -> None:
    values: dict[str, dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    for path, tree in sources():
        for node in tree.body:
            targets = (
                node.targets
                if isinstance(node, ast.Assign)
                else [node.target]
                if isinstance(node, ast.AnnAssign)
                else []
            )
            for target in targets:
                if (
                    isinstance(target, ast.Name)
                    and target.id.isupper()
                    and is_number(getattr(node, "value", None))
                ):
                    values[target.id][ast.unparse(node.value)].append(
                        f"{path}:{node.lineno}"
                    )
    findings = [
        f"{name} = {dict(places)}: give each a name of its own"
        for name, places in values.items()
        if len(places) > 1
    ]
    assert not findings, "\n".join(findings)


def test_no_constant_is_assigned_twice_without_use_of_its_first_value() -> None:
    findings = []
    for path in (
        path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))
    ):
        lines: dict[str, int] = {}
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            for target in node.targets if isinstance(node, ast.Assign) else []:
                if not isinstance(target, ast.Name) or not target.id.isupper():
                    continue
                used = {
                    part.id
                    for part in ast.walk(node.value)
                    if isinstance(part, ast.Name)
                }
                if target.id in lines and target.id not in used:
                    findings.append(
                        f"{path.relative_to(ROOT)}:{node.lineno}: {target.id}, see line {lines[target.id]}"
                    )
                lines[target.id] = node.lineno
    assert not findings, "\n".join(findings)


def test_no_two_classes_have_the_same_name() -> None:
    classes: dict[str, list[str]] = defaultdict(list)
    for path, tree in sources():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                classes[node.name].append(f"{path}:{node.lineno}")
    findings = [
        f"{name}: {', '.join(places)}"
        for name, places in classes.items()
        if len(places) > 1
    ]
    assert not findings, "\n".join(findings)


def test_few_file_names_occur_in_several_packages() -> None:
    places: dict[str, list[str]] = defaultdict(list)
    for path, _ in sources():
        stem = Path(path).stem
        if stem not in {"__init__", "__main__"} and not path.endswith(
            ".pyi"
        ):  # stubs have the names of their modules
            places[stem].append(path)
    repeated = {stem: paths for stem, paths in places.items() if len(paths) > 1}
    assert len(repeated) < 8, repeated


def sentences(text: str) -> list[str]:
    """Split a page into sentences of more than three words, without code, tables, comments and pictures."""
    prose = re.sub(
        r"```[\s\S]*?```|<!--[\s\S]*?-->|!\[[^\]]*\]\([^)]*\)|^[|#].*$",
        "",
        text,
        flags=re.MULTILINE,
    )
    paragraphs = re.split(r"\n\s*\n|^\s*(?:[-*]|\d+\.)\s", prose, flags=re.MULTILINE)
    parts = [
        part
        for paragraph in paragraphs
        for part in re.split(r"(?<=[.!?])\s+(?=[A-Z`])", paragraph)
    ]
    return [part for part in parts if len(part.split()) > 3]


PAGES = [*sorted((ROOT / "docs").rglob("*.md")), *sorted(ROOT.glob("*.md"))]
BIBLIOGRAPHY = "references.md"  # titles of articles are not sentences


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page.name != BIBLIOGRAPHY],
    ids=lambda page: page.relative_to(ROOT).as_posix(),
)
def test_sentences_of_a_page_are_short(page: Path) -> None:
    lengths = {
        " ".join(text.split()): len(text.split())
        for text in sentences(page.read_text(encoding="utf-8"))
    }
    long = [
        f"{words} words: {text}" for text, words in lengths.items() if words > MAX_WORDS
    ]
    assert len(long) <= MAX_LONG_SHARE * max(len(lengths), 1), "\n".join(long)


def test_the_mean_length_of_all_sentences_is_small() -> None:
    lengths = [
        len(text.split())
        for page in PAGES
        for text in sentences(page.read_text(encoding="utf-8"))
    ]
    assert sum(lengths) / len(lengths) <= MAX_MEAN_WORDS
