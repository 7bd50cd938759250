"""The documents of this add-on in the folder of a dataset: its card and its Croissant description."""

from dataclasses import dataclass

from cnpgen.addons.hub.card import card_notes, card_text
from cnpgen.addons.hub.croissant import croissant_document
from cnpgen.store.dataset_document import DatasetDocument
from cnpgen.store.dataset_summary import DatasetSummary
from cnpgen.store.files.documents import plain, render
from cnpgen.store.layout import CARD, CROISSANT


@dataclass(frozen=True)
class Card(DatasetDocument):
    """Document: the card in Markdown, for users and the Hugging Face Hub."""

    file = CARD

    def render(
        self, summary: DatasetSummary, *, created: str, folder: str, notes: str
    ) -> str:
        """Return the card."""
        return card_text(summary, created=created, folder=folder, notes=notes)

    def notes(self, text: str) -> str:
        """Return the notes in a card."""
        return card_notes(text)


@dataclass(frozen=True)
class Croissant(DatasetDocument):
    """Document: the description in the format Croissant."""

    file = CROISSANT

    def render(
        self, summary: DatasetSummary, *, created: str, folder: str, notes: str
    ) -> str:
        """Return the description; it does not depend on the folder."""
        return render(plain(croissant_document(summary, created=created))) + "\n"
