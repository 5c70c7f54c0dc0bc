"""evidence.npz is held to what the page shows: whatever is replaced, bad input is said to be so."""

from __future__ import annotations

import contextlib
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshreg.errors import InputError
from meshreg.io.result.evidence import NAME, read_evidence, write_evidence

PICTURE = np.frombuffer(b"\x89PNG\r\n\x1a\n", np.uint8)
BOUNDS = [0.0, 0.0, 1.0, 1.0]
META: dict[str, Any] = {
    "schema": "meshreg.evidence/1",
    "ortho": {"bounds": BOUNDS, "cell": 0.1},
    "dem": {"bounds": BOUNDS, "cell": 0.1, "full_cell": 0.1},
    "height": {"bounds": BOUNDS, "cell": 0.1, "step": 0.001, "middle": -5.0},
    "difference": {"bounds": BOUNDS, "cell": 0.1},
    "answer": {"offset": [1.0, 2.0], "sigma": [[1.0, 0.0], [0.0, 1.0]]},
    "turned": {"yaw_degrees": 1.0, "scale": 1.0},
    "matches": {"inliers": 1, "total": 2},
    "surfaces": {"terrain": {"bounds": BOUNDS, "lower_is_better": True, "low": 0.0, "high": 1.0,
                             "best": [0.0, 0.0], "second": None}},
}  # fmt: skip
ARRAYS = {
    "ortho_reference": PICTURE,
    "small_reference": PICTURE,
    "small_before": PICTURE,
    "surface_terrain": PICTURE,
    "difference": PICTURE,
    "difference_counts": np.arange(81),
    "difference_edges": np.linspace(-1, 1, 82),
    "height_reference": np.zeros((3, 4), "<i2"),
    "matches": np.zeros((2, 5)),
    "residuals": np.zeros((2, 7)),
    "residual_ups": np.zeros((2, 4)),
}


def save(folder: Path, arrays: dict[str, Any], meta: Any) -> None:
    text = np.frombuffer(json.dumps(meta).encode(), np.uint8)
    write_evidence({**arrays, "meta": text}, folder)


def places(value: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    inner = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    return [here, *(place for key, item in inner for place in places(item, (*here, key)))]


def test_what_was_written_is_read(tmp_path: Path) -> None:
    save(tmp_path, ARRAYS, META)
    found = read_evidence(tmp_path)
    assert found.pop("meta") == META
    assert set(found) == set(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(found[name], array)


@pytest.mark.parametrize("place", places(META)[1:], ids=str)
def test_no_value_of_the_text_may_be_text_or_too_large(tmp_path: Path, place: Any) -> None:
    for wrong in ({"a": {}}, [[]], "x", 1e16):
        meta = json.loads(json.dumps(META))
        inner = meta
        for key in place[:-1]:
            inner = inner[key]
        inner[place[-1]] = wrong
        save(tmp_path, ARRAYS, meta)
        with pytest.raises(InputError) as caught:
            read_evidence(tmp_path)
        assert caught.value.exit_code == 3
        assert str(place[-1]) in str(caught.value)


@pytest.mark.parametrize("name", ARRAYS)
def test_no_array_may_be_of_another_kind(tmp_path: Path, name: str) -> None:
    wrongs = [
        np.zeros(0),
        np.zeros((1, 1, 1)),
        np.array(["x"]),
        np.array(1),
        np.full((2, 9), 1e300),
    ]
    for wrong in (*wrongs, np.zeros((2, 5), complex), np.zeros(3, bool)):
        save(tmp_path, {**ARRAYS, name: wrong}, META)
        with pytest.raises(InputError, match=name):
            read_evidence(tmp_path)


@pytest.mark.parametrize("name", ["small_before", "difference_edges", "surface_terrain"])
def test_what_the_page_needs_must_be_there(tmp_path: Path, name: str) -> None:
    save(tmp_path, {key: array for key, array in ARRAYS.items() if key != name}, META)
    with pytest.raises(InputError, match=f"lacks '{name}'"):
        read_evidence(tmp_path)


def test_damaged_files_are_bad_input(tmp_path: Path) -> None:
    """Cut off anywhere, with any byte changed, with objects, or with a shape that lies."""
    save(tmp_path, ARRAYS, META)
    whole = (tmp_path / NAME).read_bytes()
    rng = np.random.default_rng(0)
    for number in range(150):
        data = bytearray(whole)
        if number % 3 == 0:
            data = data[: rng.integers(len(data))]
        else:
            data[rng.integers(len(data))] ^= int(rng.integers(1, 256))
        (tmp_path / NAME).write_bytes(data)
        with contextlib.suppress(InputError):  # nothing else may come
            read_evidence(tmp_path)
    for array in (np.array([{}], object), np.zeros((2, 5))):
        stream = io.BytesIO()
        np.save(stream, array, allow_pickle=True)
        lying = stream.getvalue().replace(b"(2, 5)", b"(9999999999, 5)"[:6] + b"")
        with zipfile.ZipFile(tmp_path / NAME, "w") as archive:
            archive.writestr("matches.npy", lying)
        with pytest.raises(InputError):
            read_evidence(tmp_path)


def test_a_link_out_of_the_folder_is_not_opened(tmp_path: Path) -> None:
    folder = tmp_path / "OUT"
    folder.mkdir()
    save(tmp_path, ARRAYS, META)
    (folder / NAME).symlink_to(tmp_path / NAME)
    with pytest.raises(InputError, match="link that leaves"):
        read_evidence(folder)
