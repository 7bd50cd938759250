"""Notebooks show datasets, plans, verdicts and scenes as tables, with escaped texts."""

from html.parser import HTMLParser
from pathlib import Path

import numpy as np

from cnpgen.loader.load import load_dataset
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.schema.html_table import MAX_SHOWN_ROWS, html_table
from tests.examples.loader import make
from tests.examples.plan_files import plans_of
from tests.examples.plans import load


class _Cells(HTMLParser):
    """Collects the texts of the cells of each row, and checks that all tags are closed."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in {"td", "th"}:
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1] in {"td", "th"}:
            self.rows[-1][-1] += data


def rows_of(html: str) -> list[list[str]]:
    cells = _Cells()
    cells.feed(html)
    assert cells.open == []
    return cells.rows


def test_texts_are_escaped_and_long_tables_are_cut() -> None:
    html = html_table("<script>", ("a", "b"), ((i, "<b>") for i in range(50)))
    assert "<script>" not in html
    assert "<b>" not in html
    rows = rows_of(html)
    assert rows[0] == ["a", "b"]
    assert rows[1] == ["0", "<b>"]
    assert rows[-1] == [f"{50 - MAX_SHOWN_ROWS} more"]
    assert len(rows) == MAX_SHOWN_ROWS + 2


def test_a_dataset_shows_its_fields(tmp_path: Path) -> None:
    dataset = load_dataset(make(tmp_path / "data"))
    rows = rows_of(dataset._repr_html_())
    assert [row[0] for row in rows[1:]] == list(dataset.fields)
    assert rows[1][1] == "rad"


def test_plans_verdicts_and_scenes_show_their_values() -> None:
    plans = plans_of(load("transport"), load("transport"))
    rows = rows_of(plans._repr_html_())
    assert [row[0] for row in rows] == ["plan", "0", "1"]
    assert float(rows[1][3]) == float(f"{plans.duration[0]:.4g}")
    found = evaluate_plans(plans)
    assert [row[1] for row in rows_of(found._repr_html_())[1:]] == ["ok", "ok"]
    verdict = found.verdicts[0]
    shown = rows_of(verdict._repr_html_())
    assert [row[0] for row in shown[1:]] == list(verdict.margins)
    assert shown[1][1] == str(next(iter(verdict.margins.values())))
    scene = rows_of(plans.scene._repr_html_())
    assert [row[0] for row in scene[1:]] == [o.name for o in plans.scene.obstacles]
    center = np.array(scene[1][2].strip("[]").split(), float)
    np.testing.assert_allclose(center, plans.scene.bodies()[0].position, atol=1e-4)
