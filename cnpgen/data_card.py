"""The data card that a user keeps beside the recipe of a dataset."""

from cnpgen.errors import RecipeError
from cnpgen.recipe import DatasetRecipe


def load_notes(recipe: DatasetRecipe) -> str:
    """Read the text beside a recipe's file, of the same name with the ending ``.md``; empty where there is none.

    Raises:
        RecipeError: It cannot be read, or is not UTF-8.
    """
    if not recipe.path.name:  # built in Python, from no file
        return ""
    card = recipe.path.with_suffix(".md")
    try:
        return card.read_bytes().decode("utf-8-sig") if card.is_file() else ""
    except OSError as error:
        raise RecipeError([f"{card}: cannot be read: {error.strerror or error}"]) from error
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        wrong = f"line {line}: not UTF-8: byte 0x{error.object[error.start]:02x}"
        raise RecipeError([f"{card}: {wrong}; it becomes part of the dataset's card"]) from error
