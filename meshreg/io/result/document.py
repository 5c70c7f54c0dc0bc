"""`registration.json`: the result as a document, written and read.

The document's schema is `registration.schema.json` beside this module. Numbers carry 17 digits,
so that reading gives back the same float64; what is not a number is null.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError, UsageError
from meshreg.io.files.checked_json import parse_json, require_schema
from meshreg.io.files.safe import open_regular
from meshreg.records import Finding, OffsetEstimate, Registration, Transform, Warp
from meshreg.settings.checked import shown

SCHEMA = "meshreg.registration/2"
READ = ("meshreg.registration/1", SCHEMA)
MAX_BYTES = 64_000_000  # a real record has some 20 kB
_NUMBERS = ("overlap", "height_median", "height_nmad", "height_rmse", "image_similarity")


def registration_document(registration: Registration) -> dict[str, Any]:
    """Return the registration as plain dictionaries, lists, strings, numbers and None.

    Its `transform.reference_from_moving` are the rows of the 4×4 matrix on absolute coordinates;
    `offset` is what that matrix does to the pivot, the centre of the moving survey's bounding
    box. Both are None when the registration is rejected.
    """
    transform = registration.transform
    matrix = pivot = offset = scale = yaw = None
    if transform is not None:
        matrix, pivot = transform.matrix.tolist(), transform.pivot.tolist()
        offset = dict(zip(("east", "north", "up"), transform.offset.tolist(), strict=True))
        scale = transform.scale
        yaw = math.degrees(transform.yaw)
    covariance = registration.covariance
    document = {
        "schema": registration.schema,
        "verdict": registration.verdict,
        "reason": registration.reason,
        "transform": {
            "reference_from_moving": matrix,
            "pivot": pivot,
            "scale": scale,
            "yaw_degrees": yaw,
        },
        "offset": offset,
        "covariance": None if covariance is None else covariance.tolist(),
        "registration_error": registration.registration_error,
        "false_alarm": registration.false_alarm,
        "findings": [
            {"code": f.code, "severity": f.severity, "text": f.text, "values": dict(f.values)}
            for f in registration.findings
        ],
        "heights_gain": registration.heights_gain,
        "internal": registration.internal,
        "warp": None if registration.warp is None else _warp_document(registration.warp),
        "methods": {e.method: _estimate_document(e) for e in registration.estimates},
        "hypotheses": [dict(hypothesis) for hypothesis in registration.hypotheses],
        "before": dict(registration.before),
        "after": dict(registration.after),
        "reference": dict(registration.reference),
        "moving": dict(registration.moving),
        "settings": dict(registration.settings),
        "versions": dict(registration.versions),
        "seconds": dict(registration.seconds),
        "notes": list(registration.notes),
    }
    plain: dict[str, Any] = _plain(document, "registration")
    return plain


def _warp_document(warp: Warp) -> dict[str, Any]:
    return {
        "horizontal": warp.horizontal,
        "vertical": warp.vertical,
        "low": warp.low.tolist(),
        "high": warp.high.tolist(),
        "coefficients": warp.coefficients.tolist(),
    }


def _warp(values: Mapping[str, Any] | None) -> Warp | None:
    return None if values is None else Warp(**values)


def _estimate_document(estimate: OffsetEstimate) -> dict[str, Any]:
    found = math.isfinite(estimate.east) and math.isfinite(estimate.north)
    sigma = None if estimate.sigma is None else np.sqrt(np.diag(estimate.sigma)).tolist()
    return {
        **({"manual": True} if estimate.manual else {}),
        "status": estimate.status,
        "offset": [estimate.east, estimate.north] if found else None,
        "sigma": sigma,
        "covariance": None if estimate.sigma is None else estimate.sigma.tolist(),
        "score": estimate.score,
        "gap": estimate.gap,
        "overlap": estimate.overlap,
        "reason": estimate.reason,
        "seconds": estimate.seconds,
    }


def _plain(value: Any, place: str) -> Any:
    """Reduce NumPy values, mappings and tuples to what JSON has; NaN and infinity to None."""
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{place}.{key}") for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist(), place)
    if isinstance(value, int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Sequence):
        return [_plain(item, place) for item in value]
    raise UsageError(f"{place} holds a {type(value).__name__}, which JSON cannot say.")


def to_json(value: Any) -> str:
    """Return plain values as strict JSON text: floats with 17 digits, short lists on one line.

    Raises
    ------
    UsageError
        For NaN, infinity or anything else that JSON cannot say.
    """
    return _encode(value, "") + "\n"


def _encode(value: Any, indent: str) -> str:
    if isinstance(value, float):
        if not math.isfinite(value):
            raise UsageError(f"{value} cannot be said in JSON.")
        text = format(value, ".17g")
        return text if re.search(r"[.e]", text) else text + ".0"  # a float stays a float
    if isinstance(value, str):
        return _quoted(value)
    if value is None or isinstance(value, bool | int):
        return json.dumps(value)
    inner = indent + "  "
    if isinstance(value, dict):
        items = [f"{_quoted(str(key))}: {_encode(item, inner)}" for key, item in value.items()]
        brackets = "{}"
    elif isinstance(value, list | tuple):
        items = [_encode(item, inner) for item in value]
        brackets = "[]"
        if not any(isinstance(item, dict | list | tuple | str) for item in value):
            return f"[{', '.join(items)}]"
    else:
        raise UsageError(f"A {type(value).__name__} cannot be said in JSON.")
    if not items:
        return brackets
    body = f",\n{inner}".join(items)
    return f"{brackets[0]}\n{inner}{body}\n{indent}{brackets[1]}"


def _quoted(text: str) -> str:
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:  # a file name that is no UTF-8
        return json.dumps(text)
    return json.dumps(text, ensure_ascii=False)


def read_registration(path: str | Path) -> Registration:
    """Read `registration.json`, or the one in a folder that `meshreg register` wrote.

    Parameters
    ----------
    path : path
        The file, or the folder that holds it.

    Returns
    -------
    Registration
        Without evidence (the rasters and score surfaces live in memory only).

    Raises
    ------
    InputError
        If it is no registration, contradicts itself, or was written by a newer meshreg.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "registration.json"
    with open_regular(path) as file:
        text = file.read(MAX_BYTES + 1)
    if len(text) > MAX_BYTES:
        raise InputError(
            f"is larger than {MAX_BYTES} bytes; that is not a registration.", file=path
        )
    return _registration(_parse(text, path), path)


def _parse(text: bytes, path: Path) -> dict[str, Any]:
    document = parse_json(text, path)
    schema = document.get("schema") if isinstance(document, dict) else None
    found = re.fullmatch(r"meshreg\.registration/(\d{1,9})", str(schema))
    if found is None:
        raise InputError(
            f'has schema {shown(schema)}; a registration has "{SCHEMA}".',
            file=path,
            remedy="Give the registration.json that `meshreg register` wrote.",
        )
    if schema not in READ:
        raise InputError(
            f"has schema {schema}; this meshreg reads {SCHEMA}.",
            file=path,
            remedy="Use the version of meshreg that wrote it, or a newer one.",
        )
    assert isinstance(document, dict)
    require_schema(document, "registration.schema.json", path, "Run `meshreg register` again.")
    return document


def _registration(document: dict[str, Any], path: Path) -> Registration:
    try:
        transform = _transform(document, path)
        return Registration(
            verdict=document["verdict"],
            reason=str(document["reason"]),
            transform=transform,
            covariance=document["covariance"],
            estimates=tuple(_estimate(item) for item in document["methods"].items()),
            hypotheses=tuple(dict(item) for item in document["hypotheses"]),
            before=_statistics(document["before"]),
            after=_statistics(document["after"]),
            reference=dict(document["reference"]),
            moving=dict(document["moving"]),
            settings=dict(document["settings"]),
            versions=dict(document["versions"]),
            seconds=dict(document["seconds"]),
            notes=tuple(str(note) for note in document["notes"]),
            registration_error=document.get("registration_error"),
            internal=document.get("internal"),
            false_alarm=document.get("false_alarm"),
            findings=tuple(map(_finding, document.get("findings") or ())),
            heights_gain=document.get("heights_gain"),
            warp=_warp(document.get("warp")),
        )
    except UsageError as error:  # a record refused at birth; here the file is to blame
        raise InputError(f"contradicts itself: {error.message}", file=path) from error


def _finding(item: Mapping[str, Any]) -> Finding:
    """Return a finding; those of version 1 had a code and a text that was called `said`."""
    if "said" in item:
        return Finding(str(item["code"]), str(item["said"]))
    values = {str(name): float(value) for name, value in item["values"].items()}
    return Finding(str(item["code"]), str(item["text"]), item["severity"], values)


def _transform(document: dict[str, Any], path: Path) -> Transform | None:
    rows, pivot = document["transform"]["reference_from_moving"], document["transform"]["pivot"]
    if rows is None:
        return None
    matrix, pivot = np.array(rows, float), np.array(pivot, float)
    offset = np.array([document["offset"][key] for key in ("east", "north", "up")], float)
    read = Transform.from_matrix(matrix, pivot)
    # The offset is stated apart because the matrix carries it only to the digits that a
    # translation at UTM size leaves.
    transform = Transform(read.rotation, read.scale, offset, pivot)
    tolerance = 1e-6 + 1e-12 * float(np.abs(matrix).max())
    if not np.abs(read.offset - offset).max() <= tolerance:
        raise InputError(
            f"contradicts itself: its matrix moves the pivot by {read.offset.tolist()}, "
            f"its offset says {offset.tolist()}.",
            file=path,
        )
    return transform


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)


def _statistics(values: Mapping[str, Any]) -> dict[str, Any]:
    """Give back NaN where a statistic could not be computed."""
    return {key: _number(item) if key in _NUMBERS else item for key, item in values.items()}


def _estimate(item: tuple[str, Mapping[str, Any]]) -> OffsetEstimate:
    method, values = item
    east, north = values["offset"] or (None, None)
    return OffsetEstimate(
        method=method,
        status=values["status"],
        reason=str(values["reason"]),
        east=_number(east),
        north=_number(north),
        sigma=values["covariance"],
        score=_number(values["score"]),
        gap=_number(values["gap"]),
        overlap=_number(values["overlap"]),
        seconds=_number(values["seconds"]),
        manual=bool(values.get("manual", False)),
    )
