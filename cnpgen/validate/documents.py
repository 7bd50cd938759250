"""What the documents of a dataset say together: the recipe in its blueprint, and whether the statistics add up."""

from pathlib import Path

from cnpgen.errors import DatasetError
from cnpgen.make.recipe import resolved_digest
from cnpgen.store.blueprint import Blueprint
from cnpgen.store.check import REPLACE, Finding
from cnpgen.store.files.documents import load_document, plain
from cnpgen.store.intact import AGAIN
from cnpgen.store.layout import PLAN, STATS
from cnpgen.store.summary import STATS_FORM, STATS_FORMAT, STATS_FORMAT_VERSION, stats_document, summarise


def check_recipe(blueprint: Blueprint) -> list[Finding]:
    """Check that the digest of the recipe in a blueprint is that of the recipe in it."""
    try:
        found = resolved_digest(blueprint.recipe["pipeline"], str(blueprint.robot["urdf"]).encode())
    except (KeyError, TypeError, AttributeError):
        return [Finding(PLAN, "has no recipe that can be read", advice=REPLACE)]
    if found == blueprint.recipe_sha256:
        return []
    return [
        Finding(PLAN, f"its recipe has the sha256 {found}, not the recorded {blueprint.recipe_sha256}", advice=REPLACE)
    ]


def check_statistics(folder: Path, blueprint: Blueprint) -> list[Finding]:
    """Check that ``stats.json`` sums up the records of the shards, all of which must be there."""
    try:
        document = load_document(folder / STATS, STATS_FORMAT, version=STATS_FORMAT_VERSION, form=STATS_FORM)
        expected = plain(stats_document(summarise(folder, blueprint)))
    except DatasetError:  # missing or damaged: found already
        return []
    wrong = [key for key in expected if document.get(key) != expected[key]]
    if not wrong:
        return []
    advice = f"delete {STATS} and {AGAIN}: it writes the file anew"
    return [Finding(STATS, f"does not sum up the shards' records: {', '.join(wrong)} differ", advice=advice)]
