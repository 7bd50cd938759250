"""Contract of the documents that describe a finished dataset beside its samples, such as its card."""

from abc import ABC, abstractmethod
from typing import ClassVar

from cnpgen.store.dataset_summary import DatasetSummary


class DatasetDocument(ABC):
    """A document in the folder of a dataset; packages register them in the group ``cnpgen.documents``.

    Attributes:
        file: Name of the file, one of ``cnpgen.store.layout.DESCRIPTIONS``.
    """

    file: ClassVar[str]

    @abstractmethod
    def render(
        self, summary: DatasetSummary, *, created: str, folder: str, notes: str
    ) -> str:
        """Return the text of the document.

        It depends on the arguments only, so that the same samples give the same bytes.

        Args:
            summary: The samples and their statistics.
            created: Time of creation in ISO 8601.
            folder: Name of the folder of the dataset.
            notes: Markdown of the author of the recipe.
        """

    def notes(self, text: str) -> str:  # noqa: ARG002 - used by documents that contain notes
        """Return the notes in the text of a document; empty if it has none."""
        return ""
