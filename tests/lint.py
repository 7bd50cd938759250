"""Check names and headings: ``python -m tests.lint`` prints each finding as ``path:line: text`` and ends with 1.

Every file is parsed once. A name is a class, function, argument, variable or module. Prose and ordinary words are free:
``tests/data/vocabulary.json`` lists only words that once had a private meaning here, each with the term of the field.
"""

import ast
import json
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
VOCABULARY = Path(__file__).parent / "data" / "vocabulary.json"
FOLDERS = ("cnpgen", "tests", "benchmarks", "docs")
PACKAGE = "cnpgen"
PAGES_OF_OTHER_NAMES = {"CHANGELOG.md", "glossary.md", "references.md"}
MAX_REPEATED_STEMS = 7
CONSTANT_PREFIXES = {
    "MOST_": "MAX_",
    "ENOUGH": "MIN_",
    "ALONE": "MAX_ or MIN_",
    "SPARE": "MARGIN_",
    "DEEP": "DEPTH_",
}


@dataclass(frozen=True)
class Source:
    """A module: its path below the root, and its syntax tree."""

    path: str
    tree: ast.Module


@dataclass(frozen=True)
class Page:
    """A page: its path below the root, and its headings with their lines."""

    path: str
    headings: tuple[tuple[int, str], ...]


Finding = tuple[str, int, str]  # path, line, text


def parse_sources(root: Path) -> list[Source]:
    """Parse every module of the project once."""
    paths = (
        path
        for folder in FOLDERS
        for path in (root / folder).rglob("*.py*")
        if path.suffix in {".py", ".pyi"} and "_recipes" not in path.parts
    )
    return [
        Source(
            path.relative_to(root).as_posix(),
            ast.parse(path.read_text(encoding="utf-8")),
        )
        for path in sorted(paths)
    ]


def read_pages(root: Path) -> list[Page]:
    """Read the headings of every page, without those in code blocks."""
    pages = []
    for path in sorted([*root.glob("*.md"), *(root / "docs").rglob("*.md")]):
        text = path.read_text(encoding="utf-8")
        blank = re.sub(
            r"^```[\s\S]*?^```",
            lambda block: "\n" * block[0].count("\n"),
            text,
            flags=re.M,
        )
        headings = tuple(
            (number, line.lstrip("# "))
            for number, line in enumerate(blank.splitlines(), 1)
            if re.match(r"#+ ", line)
        )
        pages.append(Page(path.relative_to(root).as_posix(), headings))
    return pages


def defined_names(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the line and the name of everything that a module defines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(
            node.ctx, ast.Store
        ):
            name = node.id if isinstance(node, ast.Name) else node.attr
            yield node.lineno, name


def words_in(text: str) -> list[str]:
    """Split a name or a heading into lower-case words: ``SamplingStatistics`` has two."""
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", text)]


def check_words(
    sources: Iterable[Source], pages: Iterable[Page], vocabulary: dict[str, str]
) -> Iterator[Finding]:
    """Find private words in names and headings."""
    places = [
        (source.path, line, name)
        for source in sources
        for line, name in [(1, Path(source.path).stem), *defined_names(source.tree)]
    ]
    places += [
        (page.path, line, heading)
        for page in pages
        if Path(page.path).name not in PAGES_OF_OTHER_NAMES
        for line, heading in page.headings
    ]
    for path, line, text in places:
        for word in words_in(text):
            if word in vocabulary:
                yield path, line, f"{word!r} in {text!r}, use: {vocabulary[word]}"


def check_constants(sources: Iterable[Source]) -> Iterator[Finding]:
    """Find constants with a forbidden prefix, with two values, or assigned twice."""
    values: dict[str, dict[str, tuple[str, int]]] = defaultdict(dict)
    for source in sources:
        first: dict[str, int] = {}
        for line, name, value in constants(source.tree):
            for prefix, term in CONSTANT_PREFIXES.items():
                if name.startswith(prefix):
                    yield source.path, line, f"{name}: begin with {term}"
            used = {part.id for part in ast.walk(value) if isinstance(part, ast.Name)}
            if name in first and name not in used:
                yield source.path, line, f"{name} hides its value of line {first[name]}"
            first[name] = line
            if is_number(value) and source.path.startswith(f"{PACKAGE}/"):
                values[name].setdefault(ast.unparse(value), (source.path, line))
    for name, places in values.items():
        for value, (path, line) in list(places.items())[1:]:
            other = next(iter(places.values()))
            yield path, line, f"{name} = {value} has another value in {other[0]}"


def constants(tree: ast.Module) -> Iterator[tuple[int, str, ast.expr]]:
    """Yield line, name and value of the assignments of constants at module level."""
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for target in targets:
                if isinstance(target, ast.Name) and target.id.isupper():
                    yield node.lineno, target.id, node.value


def is_number(node: ast.expr) -> bool:
    """Return whether an expression is a number or arithmetic with numbers."""
    allowed = ast.BinOp | ast.UnaryOp | ast.operator | ast.unaryop | ast.Constant
    parts = list(ast.walk(node))
    numbers = [part for part in parts if isinstance(part, ast.Constant)]
    return all(isinstance(part, allowed) for part in parts) and all(
        isinstance(part.value, int | float) for part in numbers
    )


def check_classes_and_modules(sources: Iterable[Source]) -> Iterator[Finding]:
    """Find classes of one name, and names of modules that occur in several packages."""
    classes: dict[str, str] = {}
    stems: Counter[str] = Counter()
    for source in sources:
        path = Path(source.path)
        if path.parts[0] != PACKAGE:
            continue
        stems[path.stem] += path.suffix == ".py" and not path.stem.startswith("__")
        for node in ast.walk(source.tree):
            if isinstance(node, ast.ClassDef):
                other = classes.setdefault(node.name, f"{path}:{node.lineno}")
                if other != f"{path}:{node.lineno}":
                    yield source.path, node.lineno, f"class {node.name}, as in {other}"
    repeated = sorted(stem for stem, count in stems.items() if count > 1)
    if len(repeated) > MAX_REPEATED_STEMS:
        text = f"{len(repeated)} names of modules occur twice: {', '.join(repeated)}"
        yield PACKAGE, 1, text


def check_headings(pages: Iterable[Page]) -> Iterator[Finding]:
    """Find headings that end like a sentence or that a link to the page cannot name."""
    for page in pages:
        if page.path == "CHANGELOG.md":
            continue  # its sections repeat per version
        seen: dict[str, int] = {}
        for line, heading in page.headings:
            if heading.endswith((".", ":")):
                yield page.path, line, f"heading {heading!r}: leave out its last sign"
            if heading in seen:
                yield (
                    page.path,
                    line,
                    f"heading {heading!r}, as in line {seen[heading]}",
                )
            seen.setdefault(heading, line)


def find_all(root: Path = ROOT) -> list[Finding]:
    """Run every check on the project."""
    sources, pages = parse_sources(root), read_pages(root)
    vocabulary = json.loads(VOCABULARY.read_text(encoding="utf-8"))
    return [
        *check_words(sources, pages, vocabulary),
        *check_constants(sources),
        *check_classes_and_modules(sources),
        *check_headings(pages),
    ]


def main() -> int:
    """Print the findings; return the exit code."""
    findings = sorted(find_all())
    for path, line, text in findings:
        print(f"{path}:{line}: {text}")
    return int(bool(findings))


if __name__ == "__main__":
    sys.exit(main())
