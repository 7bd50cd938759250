"""The Croissant description of a dataset: metadata, files and measured variables with units.

Every split has a record set, of HDF5 files or of Parquet tables. No Croissant reader
opens HDF5 files yet (mlcommons/croissant issue 697); their record sets describe the
columns. Fields of Croissant have no unit and no limits. Their components are therefore
also listed as ``variableMeasured`` of schema.org, which Croissant documents may contain.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from cnpgen.documents import JsonObject
from cnpgen.store.dataset_summary import DatasetSummary
from cnpgen.store.field import Field
from cnpgen.store.scene_table import SCENE_ARRAYS


def _terms(names: str) -> dict[str, str]:
    """Return the terms of a vocabulary that Croissant defines under their own names."""
    return {name: f"cr:{name}" for name in names.split()}


_CONTEXT: JsonObject = {
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
class SplitFile:
    """A file of a split: its path in the repository, size [B] and sha256."""

    path: str
    bytes: int
    sha256: str


def croissant_document(summary: DatasetSummary, *, created: str) -> JsonObject:
    """Return the content of ``croissant.json`` of a dataset, created at an ISO 8601 time."""
    splits = {
        split: [
            SplitFile(item.file, item.bytes, item.sha256)
            for _, item in summary.of_split(split)
        ]
        for split in summary.spec.splits
    }
    pattern = "{}/*.h5"
    return _document(summary, created) | _records(summary, splits, "x-hdf5", pattern)


def croissant_of_tables(
    summary: DatasetSummary,
    tables: Mapping[str, Sequence[SplitFile]],
    *,
    created: str,
    url: str,
) -> JsonObject:
    """Return the content of ``croissant.json`` of a repository of Parquet tables."""
    records = _records(summary, tables, "x-parquet", "*/{}/*.parquet")
    return _document(summary, created) | {"url": url, **records}


def _records(
    summary: DatasetSummary,
    splits: Mapping[str, Sequence[SplitFile]],
    encoding: str,
    pattern: str,
) -> JsonObject:
    """Describe the files of all splits, with a record set for each split; "{}" in the pattern of paths is the split."""
    distribution = []
    records = []
    for split, files in splits.items():
        if not files:
            continue
        objects = [_file(item, encoding) for item in files]
        # Record sets refer to the set of all files of their split.
        name = f"{split}-files"
        distribution += [
            *objects,
            {
                "@type": "cr:FileSet",
                "@id": name,
                "name": name,
                "encodingFormat": f"application/{encoding}",
                "containedIn": [{"@id": item["@id"]} for item in objects],
                "includes": pattern.format(split),
            },
        ]
        fields = [_field(field, split, name) for field in summary.spec.fields]
        records.append(
            {"@type": "cr:RecordSet", "@id": split, "name": split, "field": fields}
        )
    return {"distribution": distribution, "recordSet": records}


def _field(field: Field, split: str, files: str) -> JsonObject:
    """Describe a column of a split's files."""
    source = {"fileSet": {"@id": files}, "extract": {"column": field.name}}
    # A width of 0 is a column of single numbers.
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


def _document(summary: DatasetSummary, created: str) -> JsonObject:
    """Return the metadata and the variables of a dataset."""
    spec = summary.spec
    document: JsonObject = {
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
    if creator := str(spec.recipe.get("creator", "")).strip():
        document["creator"] = {"@type": "sc:Organization", "name": creator}
    if citation := str(spec.recipe.get("citation", "")).strip():
        document["citeAs"] = citation
    variables = [item for field in spec.fields for item in _variables(field)]
    return document | {"variableMeasured": variables}


def _variables(field: Field) -> Iterator[JsonObject]:
    """Describe the components of a field, each with its unit and limits."""
    for index, (name, unit) in enumerate(zip(field.columns, field.units, strict=True)):
        limits = {"minValue": field.valid_min, "maxValue": field.valid_max}
        # The limits of a field have one number for each component.
        yield {
            "@type": "sc:PropertyValue",
            "name": name,
            "description": field.long_name,
            "unitText": unit,
            **{key: limit[index] for key, limit in limits.items() if limit is not None},
        }


def _description(summary: DatasetSummary) -> str:
    """Describe splits and fields in prose."""
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


def _file(file: SplitFile, encoding: str) -> dict[str, str]:
    return {
        "@type": "cr:FileObject",
        "@id": file.path,
        "name": file.path,
        "contentUrl": file.path,
        "contentSize": f"{file.bytes} B",
        "encodingFormat": f"application/{encoding}",
        "sha256": file.sha256,
    }
