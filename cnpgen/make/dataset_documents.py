"""The documents that installed add-ons write into the folder of a finished dataset."""

from cnpgen.schema import registry
from cnpgen.store.dataset_document import DatasetDocument


def dataset_documents() -> list[DatasetDocument]:
    """Return the documents of all installed add-ons and packages."""
    names = registry.names(registry.DOCUMENTS)
    return [registry.load(registry.DOCUMENTS, name)() for name in names]
