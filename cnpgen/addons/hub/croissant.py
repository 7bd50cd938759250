"""The Croissant description of a dataset: metadata, files and measured variables with units.

Files of HDF5 have no record sets, because no Croissant reader opens them
(mlcommons/croissant issue 697); Parquet tables have. Fields of Croissant have no unit.
They are therefore also listed as ``variableMeasured`` of schema.org, which Croissant
documents may contain.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from cnpgen.store.dataset_summary import DatasetSummary
from cnpgen.store.field import Field
from cnpgen.store.scene_table import SCENE_ARRAYS


def _terms(names: str) -> dict[str, str]:
    """Return the terms of a vocabulary that Croissant defines under their own names."""
    return {name: f"cr:{name}" for name in names.split()}


_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    **_terms("arrayShape citeAs column"),
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **_terms(
        "extract field fileProperty fileObject fileSet format includes isArray isLiveDataset jsonPath key md5"
    ),
    **_terms("parentField path recordSet references regex repeated replace"),
    "sc": "https://schema.org/",
    **_terms("separator source subField transform"),
}


@dataclass(frozen=True)
class ParquetFile:
    """A Parquet table of a split: its path in the repository, size [B] and sha256."""

    path: str
    bytes: int
    sha256: str


def croissant_document(summary: DatasetSummary, *, created: str) -> dict[str, Any]:
    """Return the content of ``croissant.json`` of a dataset, created at an ISO 8601 time."""
    files = [
        _file(item.file, item.bytes, item.sha256, "x-hdf5")
        for _, item in summary.records
    ]
    return _document(summary, created) | {"distribution": files}


def croissant_of_tables(
    summary: DatasetSummary,
    tables: Mapping[str, Iterable[ParquetFile]],
    *,
    created: str,
    url: str,
) -> dict[str, Any]:
    """Return the content of ``croissant.json`` of a repository of Parquet tables, with a record set for each split."""
    distribution, records = [], []
    for split, files in tables.items():
        objects = [
            _file(item.path, item.bytes, item.sha256, "x-parquet") for item in files
        ]
        name = f"{split}-tables"
        chosen = {
            "containedIn": [{"@id": item["@id"]} for item in objects],
            "includes": f"*/{split}/*.parquet",
        }
        kind = {
            "@type": "cr:FileSet",
            "@id": name,
            "name": name,
            "encodingFormat": "application/x-parquet",
        }
        distribution += [*objects, kind | chosen]
        fields = [_field(field, split, name) for field in summary.spec.fields]
        records.append(
            {"@type": "cr:RecordSet", "@id": split, "name": split, "field": fields}
        )
    return _document(summary, created) | {
        "url": url,
        "distribution": distribution,
        "recordSet": records,
    }


def _field(field: Field, split: str, files: str) -> dict[str, Any]:
    """Describe a column of a split's tables."""
    source = {"fileSet": {"@id": files}, "extract": {"column": field.name}}
    shape = {"isArray": True, "arrayShape": str(field.width)} if field.width else {}
    return {
        "@type": "cr:Field",
        "@id": f"{split}/{field.name}",
        "name": field.name,
        "description": f"{field.long_name} [{field.unit}]",
        "dataType": "sc:Integer" if field.dtype == "int64" else "sc:Float",
        "source": source,
        **shape,
    }


def _document(summary: DatasetSummary, created: str) -> dict[str, Any]:
    """Return the metadata and the variables of a dataset."""
    spec = summary.spec
    document: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.1",
        "name": spec.name,
        "description": _description(summary),
        "version": spec.version,
        "datePublished": created,
    }
    if spec.license:
        document["license"] = f"https://spdx.org/licenses/{spec.license}"
    return document | {"variableMeasured": [_variable(field) for field in spec.fields]}


def _variable(field: Field) -> dict[str, Any]:
    """Describe a field; the limits cover all columns."""
    columns = f" ({', '.join(field.names)})" if field.names else ""
    described = {
        "name": field.name,
        "description": f"{field.long_name}{columns}",
        "unitText": field.unit,
    }
    lower = {} if field.valid_min is None else {"minValue": min(field.valid_min)}
    upper = {} if field.valid_max is None else {"maxValue": max(field.valid_max)}
    return {"@type": "sc:PropertyValue", **described, **lower, **upper}


def _description(summary: DatasetSummary) -> str:
    """Describe splits and fields in prose, in place of record sets."""
    spec = summary.spec
    rows = ", ".join(f"{count} {split}" for split, count in spec.splits.items())
    fields = "; ".join(
        f"{item.name} ({item.long_name}) [{item.unit}]" for item in spec.fields
    )
    title = spec.title.rstrip(".") or spec.name
    text = f"{title}. Rows: {rows}. Every HDF5 file holds one dataset per field, one entry per row: {fields}."
    if not spec.scene_obstacles:
        return text
    arrays = "; ".join(
        f"{item.name} ({item.long_name}) [{item.unit}]" for item in SCENE_ARRAYS
    )
    return f"{text} One entry per scene: {arrays}."


def _file(name: str, size: int, sha256: str, encoding: str) -> dict[str, str]:
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "contentSize": f"{size} B",
        "encodingFormat": f"application/{encoding}",
        "sha256": sha256,
    }
