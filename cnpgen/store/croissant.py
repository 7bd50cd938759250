"""The Croissant description of a dataset: metadata, files and measured variables with units.

It has no record sets, because no Croissant reader opens HDF5 (mlcommons/croissant issue 697). Fields of Croissant are
parts of record sets and have no unit. The fields are therefore listed as ``variableMeasured`` of schema.org, which
Croissant documents may contain.
"""

from typing import Any

from cnpgen.store.dataset_summary import DatasetSummary
from cnpgen.store.field import Field
from cnpgen.store.scene_table import SCENE_ARRAYS

_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}


def croissant_document(summary: DatasetSummary, *, created: str) -> dict[str, Any]:
    """Return the content of ``croissant.json``.

    Args:
        summary: The finished shards.
        created: Creation time of the dataset, ISO 8601.
    """
    spec = summary.spec
    document: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": spec.name,
        "description": _description(summary),
        "version": spec.version,
        "datePublished": created,
    }
    if spec.license:
        document["license"] = f"https://spdx.org/licenses/{spec.license}"
    return document | {
        "variableMeasured": [_variable(field) for field in spec.fields],
        "distribution": [_file(item.file, item.bytes, item.sha256) for _, item in summary.records],
    }


def _variable(field: Field) -> dict[str, Any]:
    """Describe a field; the limits cover all columns."""
    columns = f" ({', '.join(field.names)})" if field.names else ""
    described = {"name": field.name, "description": f"{field.long_name}{columns}", "unitText": field.unit}
    lower = {} if field.valid_min is None else {"minValue": min(field.valid_min)}
    upper = {} if field.valid_max is None else {"maxValue": max(field.valid_max)}
    return {"@type": "sc:PropertyValue", **described, **lower, **upper}


def _description(summary: DatasetSummary) -> str:
    """Describe splits and fields in prose, in place of record sets."""
    spec = summary.spec
    rows = ", ".join(f"{count} {split}" for split, count in spec.splits.items())
    fields = "; ".join(f"{item.name} ({item.long_name}) [{item.unit}]" for item in spec.fields)
    title = spec.title.rstrip(".") or spec.name
    text = f"{title}. Rows: {rows}. Every HDF5 file holds one dataset per field, one entry per row: {fields}."
    if not spec.scene_obstacles:
        return text
    arrays = "; ".join(f"{item.name} ({item.long_name}) [{item.unit}]" for item in SCENE_ARRAYS)
    return f"{text} One entry per scene: {arrays}."


def _file(name: str, size: int, sha256: str) -> dict[str, str]:
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "contentSize": f"{size} B",
        "encodingFormat": "application/x-hdf5",
        "sha256": sha256,
    }
