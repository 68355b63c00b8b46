"""Writes the metadata of a published set in the format Croissant 1.0 of MLCommons (JSON-LD).

Every shard is listed with its size and SHA-256. Sets in Parquet also have a record set, which mlcroissant reads; the
other formats are not known to it.
"""

from __future__ import annotations

from collections.abc import Mapping

from qsim.publishing import data_card, parquet_shards
from qsim.publishing.record import MODULES, SetInfo
from qsim.publishing.statistics import Statistics

ENCODINGS = {
    "webdataset": "application/x-tar",
    "parquet": "application/x-parquet",
    "hdf5": "application/x-hdf5",
    "zarr": "application/zip",
}
CONTEXT: dict[str, object] = {
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
    "equivalentProperty": "cr:equivalentProperty",
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
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}


def metadata(info: SetInfo, totals: Mapping[str, Statistics]) -> dict[str, object]:
    """Return the metadata of a set, plain values for JSON."""
    shards = [shard for listed in info.shards.values() for shard in listed]
    clips = sum(shard.clips for shard in shards)
    whole = sum(totals.values(), Statistics())
    counts = ", ".join(f"{found.clips} {split}" for split, found in totals.items())
    files: list[dict[str, object]] = [
        {
            "@type": "cr:FileObject",
            "@id": shard.file,
            "name": shard.file,
            "contentUrl": shard.file,
            "contentSize": f"{shard.size} B",
            "encodingFormat": ENCODINGS[info.to],
            "sha256": shard.sha256,
        }
        for shard in shards
    ]
    found: dict[str, object] = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": info.name,
        "description": (
            f"{clips} clips ({counts}) of moving scenes at {data_card.rates(whole)} frames per second with ground truth"
            + (f", and their few-bit codes by {', '.join(_sensors(totals))}" if info.streams else "")
            + "; made by qsim."
        ),
        "keywords": ["quanta image sensor", "SPAD", "video restoration", "optical flow"],
        "version": "1.0.0",
        "distribution": files,
    }
    if info.licence:
        found["license"] = info.licence
    if info.to == "parquet":
        files.append(_shards_as_one(info))
        found["recordSet"] = [_records(info)]
    return found


def _sensors(totals: Mapping[str, Statistics]) -> list[str]:
    """Return the sensors of a set."""
    return list(dict.fromkeys(sensor for found in totals.values() for sensor in found.sensors.values()))


def _shards_as_one(info: SetInfo) -> dict[str, object]:
    """Return the set of all Parquet files."""
    return {
        "@type": "cr:FileSet",
        "@id": "shards",
        "name": "shards",
        "encodingFormat": ENCODINGS[info.to],
        "includes": f"shards/*.{MODULES[info.to].SUFFIX}",
    }


def _records(info: SetInfo) -> dict[str, object]:
    """Return the columns of a set in Parquet."""
    texts = dict.fromkeys(parquet_shards.TEXTS, "sc:Text")
    types = texts | dict.fromkeys(info.columns, "sc:Text")
    return {
        "@type": "cr:RecordSet",
        "@id": "clips",
        "name": "clips",
        "description": "One record for each clip; arrays are the bytes of .npy files, which numpy.load reads.",
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"clips/{name}",
                "name": f"clips/{name}",
                "dataType": kind,
                "source": {"fileSet": {"@id": "shards"}, "extract": {"column": name}},
            }
            for name, kind in types.items()
        ],
    }
