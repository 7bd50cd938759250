"""The Croissant description of a dataset: metadata, files and what is measured in which unit.

No record set is promised: no reader of Croissant opens HDF5 (mlcommons/croissant issue 697). Croissant's own fields are
parts of record sets and have no unit; so the fields are listed as schema.org's ``variableMeasured``, which a Croissant
document may have as any ``sc:Dataset`` may.
"""

from typing import Any

from cnpgen.store.field import Field
from cnpgen.store.summary import Summary

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


def croissant_document(summary: Summary, *, created: str) -> dict[str, Any]:
    """Return the content of ``croissant.json``.

    Args:
        summary: The finished shards.
        created: When the dataset was finished, ISO 8601.
    """
    blueprint = summary.blueprint
    document: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": blueprint.name,
        "description": _description(summary),
        "version": blueprint.version,
        "datePublished": created,
    }
    if blueprint.license:
        document["license"] = f"https://spdx.org/licenses/{blueprint.license}"
    return document | {
        "variableMeasured": [_variable(field) for field in blueprint.fields],
        "distribution": [_file(item.file, item.bytes, item.sha256) for _, item in summary.records],
    }


def _variable(field: Field) -> dict[str, Any]:
    """Describe a field; limits are those of all columns together."""
    columns = f" ({', '.join(field.names)})" if field.names else ""
    described = {"name": field.name, "description": f"{field.long_name}{columns}", "unitText": field.unit}
    least = {} if field.valid_min is None else {"minValue": min(field.valid_min)}
    most = {} if field.valid_max is None else {"maxValue": max(field.valid_max)}
    return {"@type": "sc:PropertyValue", **described, **least, **most}


def _description(summary: Summary) -> str:
    """Say in prose what the record sets would have said."""
    blueprint = summary.blueprint
    rows = ", ".join(f"{count} {split}" for split, count in blueprint.splits.items())
    fields = "; ".join(f"{item.name} ({item.long_name}) [{item.unit}]" for item in blueprint.fields)
    title = blueprint.title.rstrip(".") or blueprint.name
    return f"{title}. Rows: {rows}. Every HDF5 file holds one dataset per field, one entry per row: {fields}."


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
