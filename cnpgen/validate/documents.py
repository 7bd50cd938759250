"""What the documents of a dataset say together: the recipe in its plan, and whether they agree beyond checksums."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cnpgen.errors import DatasetError
from cnpgen.make.load import restore_dataset_recipe
from cnpgen.make.recipe import DatasetRecipe, resolved_digest
from cnpgen.store.blueprint import DatasetPlan
from cnpgen.store.check import REPLACE, Finding
from cnpgen.store.files.documents import load_document, plain
from cnpgen.store.layout import PLAN, STATS
from cnpgen.store.summary import STATS_FORMAT, STATS_FORMAT_VERSION, stats_document, summarise


def check_recipe(plan: DatasetPlan) -> list[Finding]:
    """Check that the digest of the recipe in a plan is that of the recipe in it."""
    try:
        found = resolved_digest(plan.recipe["pipeline"], str(plan.robot["urdf"]).encode())
    except (KeyError, TypeError, AttributeError):
        return [Finding(PLAN, "has no recipe that can be read", advice=REPLACE)]
    if found == plan.recipe_sha256:
        return []
    return [Finding(PLAN, f"its recipe has the sha256 {found}, not the recorded {plan.recipe_sha256}", advice=REPLACE)]


def check_statistics(folder: Path, plan: DatasetPlan) -> list[Finding]:
    """Check that ``stats.json`` sums up the records of the shards, all of which must be there."""
    try:
        document = load_document(folder / STATS, STATS_FORMAT, version=STATS_FORMAT_VERSION)
        expected = plain(stats_document(summarise(folder, plan)))
    except DatasetError:  # missing or damaged: found already
        return []
    wrong = [key for key in expected if document.get(key) != expected[key]]
    if not wrong:
        return []
    advice = f"delete {STATS} and run the same make-dataset command again: it writes the file anew"
    return [Finding(STATS, f"does not sum up the shards' records: {', '.join(wrong)} differ", advice=advice)]


@contextmanager
def restored(plan: DatasetPlan) -> Iterator[DatasetRecipe]:
    """Rebuild the recipe from a plan, its URDF in a temporary folder that is gone when the block ends.

    Raises:
        RecipeError: It does not fit this version of cnpgen.
        PluginError: It needs packages that are not installed.
    """
    with tempfile.TemporaryDirectory(prefix="cnpgen-") as folder:
        yield restore_dataset_recipe(dict(plan.recipe), str(plan.robot["urdf"]), Path(folder))
