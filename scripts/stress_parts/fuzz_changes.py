"""What the fuzzer does to a file: changes of bytes, of words and numbers, and of structure."""

from __future__ import annotations

import io
import json
import random
import re
import struct
import zlib
from collections.abc import Callable
from typing import Any

NUMBERS = (
    "0", "-1", "1", "1e10", "-1e10", "1e20", "1e229", "1e308", "1e400", "nan", "inf", "-inf", "0,5",
    "255", "256", "65536", "2147483647", "2147483648", "4294967295", "4294967296", "1e-320", "0x10",
    "99999999999999999999", "1_0", "½", "-1.#IND", "--1", "1.5.2", "3/4", "-0", "000", "1000000",
)  # fmt: skip
WORDS = (
    "",
    "null",
    "true",
    "ü",
    "\0",
    "..",
    "/etc/passwd",
    "\\",
    '"',
    "<",
    "#",
    " " * 9,
    "a" * 3000,
)
WHOLE = (0, 1, 2, 3, 7, 127, 128, 255, 256, 32767, 32768, 65535, 65536, 1 << 20, 1 << 24)
LARGE = (2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**53, 2**63 - 1, 2**63, 2**64 - 1)
REALS = (
    0.0,
    -0.0,
    1e-320,
    1e-30,
    1e10,
    1e20,
    1e38,
    1e229,
    1e308,
    float("inf"),
    float("nan"),
    -1e20,
)
JSONS = (
    None, True, False, 0, -1, 1, 1.5, 1e10, 1e20, 1e300, -1e300, 2**31, 2**53, 2**70, "", "a", "ü",
    "nan", [], {}, [1], [[]], {"a": 1}, "x" * 5000, [0] * 20, float("nan"), float("inf"),
)  # fmt: skip
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[^\s,;<>=\"]+")


def change(name: str, data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """Return a file changed in one to four places."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = rng.choice(_ways(name, data))(data, rng, others)
    return data


_Way = Callable[[bytes, random.Random, list[bytes]], bytes]


def _ways(name: str, data: bytes) -> list[_Way]:
    """Return the ways that fit a file; those that keep its form stand twice or more."""
    end = name.rsplit(".", 1)[-1].lower()
    ways: list[_Way] = [bits, some, number, cut, cut, splice, blank]
    if end in ("json", "gltf", "geojson"):
        return [tree] * 8 + [text_number, word, bits, cut]
    if end == "glb":
        return [glb_tree] * 5 + ways
    if end == "npz":
        return [arrays] * 5 + ways
    if end == "png":
        return [png] * 4 + ways
    if end == "e57":
        return [e57] * 8 + ways
    if end in ("tif", "tiff"):
        return [ifd] * 7 + ways
    if end in ("las", "laz"):
        return [las] * 4 + [blank] * 2 + ways
    if b"\0" not in data[:4000]:
        return [text_number] * 4 + [word] * 2 + [line] * 2 + [bits, some, cut, splice]
    if data.startswith((b"ply", b"OFF")):
        return [head] * 5 + ways
    return ways


def bits(data: bytes, rng: random.Random, _: list[bytes]) -> bytes:
    """Turn one to eight bits."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8)) if out else 0):
        at = rng.randrange(len(out))
        out[at] ^= 1 << rng.randrange(8)
    return bytes(out)


def some(data: bytes, rng: random.Random, _: list[bytes]) -> bytes:
    """Take out, repeat or put in a stretch."""
    at, size = rng.randrange(len(data) + 1), rng.choice((1, 2, 4, 16, 200))
    what = rng.randrange(3)
    if what == 0:
        return data[:at] + data[at + size :]
    if what == 1:
        return data[: at + size] + data[at:]
    return data[:at] + rng.randbytes(size) + data[at:]


def number(data: bytes, rng: random.Random, _: list[bytes]) -> bytes:
    """Write a number that is somebody's limit, half of the time near the start."""
    form = rng.choice(("<B", "<H", "<I", "<Q", ">I", ">H", "<f", "<d"))
    size = struct.calcsize(form)
    if len(data) < size:
        return data
    at = rng.randrange(len(data) - size + 1)
    if rng.random() < 0.5:
        at = min(at, rng.randrange(512))
    try:
        real = form[1] in "fd"
        value = rng.choice(REALS) if real else rng.choice(WHOLE + LARGE) % 256**size
        return data[:at] + struct.pack(form, value) + data[at + size :]
    except OverflowError:
        return data


def cut(data: bytes, rng: random.Random, _: list[bytes]) -> bytes:
    """Cut the end off."""
    return data[: rng.randrange(len(data) + 1)]


def splice(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """Go on with another file."""
    other = rng.choice(others)
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other) + 1) :]


def blank(data: bytes, rng: random.Random, _: list[bytes]) -> bytes:
    """Fill a stretch with one byte."""
    at, size = rng.randrange(len(data) + 1), rng.choice((4, 10, 60, 500))
    size = min(size, len(data) - at)
    return (
        data[:at]
        + bytes([rng.choice((0, 255, 255, rng.randrange(256)))]) * size
        + data[at + size :]
    )


def _replaced(pattern: re.Pattern[bytes], data: bytes, rng: random.Random, new: bytes) -> bytes:
    found = list(pattern.finditer(data))
    if not found:
        return data
    match = rng.choice(found[:40] if rng.random() < 0.4 else found)
    return data[: match.start()] + new + data[match.end() :]


def text_number(data: bytes, rng: random.Random, _: list[bytes]) -> bytes:
    """Write another number for one in a text."""
    return _replaced(_NUMBER, data, rng, rng.choice(NUMBERS).encode())


def word(data: bytes, rng: random.Random, _: list[bytes]) -> bytes:
    """Write another word for one in a text: one of its own, or a strange one."""
    own = _WORD.findall(data[:20_000])
    new = rng.choice(own) if own and rng.random() < 0.5 else rng.choice(WORDS).encode()
    if rng.random() < 0.2:
        new = new.decode("utf-8", "replace").encode("latin-1", "replace")
    return _replaced(_WORD, data, rng, new)


def line(data: bytes, rng: random.Random, _: list[bytes]) -> bytes:
    """Take out, move or repeat lines."""
    lines = data.split(b"\n")
    at, to = rng.randrange(len(lines)), rng.randrange(len(lines))
    what = rng.randrange(3)
    if what == 0:
        del lines[at]
    elif what == 1:
        lines[at], lines[to] = lines[to], lines[at]
    else:
        lines[at:at] = [lines[at]] * rng.choice((1, 2, 50))
    return b"\n".join(lines)


def head(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """Change the words of a header before binary data."""
    end = data.find(b"end_header")
    end = end if end > 0 else min(len(data), 200)
    way = rng.choice((text_number, word, line))
    return way(data[:end], rng, others) + data[end:]


def _tree_changed(root: Any, rng: random.Random) -> Any:
    """Put something else at a place of a JSON document, or take it out."""
    places: list[tuple[Any, Any]] = []

    def walk(item: Any) -> None:
        pairs: Any = ()
        if isinstance(item, dict):
            pairs = item.items()
        elif isinstance(item, list):
            pairs = enumerate(item)
        for key, value in pairs:
            places.append((item, key))
            walk(value)

    walk(root)
    if not places:
        return root
    owner, key = rng.choice(places)
    if rng.random() < 0.2:
        del owner[key]
    elif rng.random() < 0.2:
        other, at = rng.choice(places)
        owner[key] = json.loads(json.dumps(other[at]))
    else:
        owner[key] = rng.choice(JSONS)
    return root


def tree(data: bytes, rng: random.Random, _: list[bytes]) -> bytes:
    """Change the structure of a JSON document."""
    try:
        return json.dumps(_tree_changed(json.loads(data), rng)).encode()
    except (ValueError, KeyError, IndexError):
        return data


def glb_tree(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """Change the JSON of a GLB."""
    from fuzz_seeds import glb

    try:
        (size,) = struct.unpack_from("<I", data, 12)
        return glb(tree(data[20 : 20 + size], rng, others), data[28 + size :])
    except struct.error:
        return data


def arrays(data: bytes, rng: random.Random, _: list[bytes]) -> bytes:
    """Change one array of an NPZ: shape, type, values, or the JSON that it holds."""
    import numpy as np

    try:
        with np.load(io.BytesIO(data)) as file:
            kept = dict(file)
    except Exception:
        return data
    name = rng.choice(sorted(kept))
    item = kept[name]
    try:
        what = rng.randrange(7)
        if what == 0:
            del kept[name]
        elif what == 1:
            kept[name] = item.astype(rng.choice(("f4", "f8", "u1", "i4", "c8", "U5", "?")))
        elif what == 2:
            kept[name] = rng.choice((item[:1], item[..., None], item.ravel(), item[None], item.T))
        elif what == 3:
            kept[name] = np.zeros(rng.choice(((0,), (), (1, 1), (3, 0, 2), (7,))), item.dtype)
        elif what == 4 and item.size:
            flat = item.copy().ravel()
            with np.errstate(all="ignore"):
                flat[rng.randrange(flat.size)] = np.array(rng.choice(REALS)).astype(item.dtype)
            kept[name] = flat.reshape(item.shape)
        elif item.dtype == np.uint8 and item.ndim == 1 and item[:1].tobytes() in (b"{", b"["):
            kept[name] = np.frombuffer(tree(item.tobytes(), rng, []), np.uint8)
        else:
            other = rng.choice(sorted(kept))
            kept[name] = kept[other]
    except (IndexError, ValueError, TypeError):
        return data
    out = io.BytesIO()
    np.savez_compressed(out, **kept)
    return out.getvalue()


def png(data: bytes, rng: random.Random, _: list[bytes]) -> bytes:
    """Change a number of a PNG's header, with the right checksum."""
    if len(data) < 33:
        return data
    fields = bytearray(data[16:29])
    if rng.random() < 0.6:
        at = rng.choice((0, 4))
        fields[at : at + 4] = struct.pack(">I", rng.choice((0, 1, 31, 33, 8000, 30000, 2**31 - 1)))
    else:
        fields[rng.randrange(8, 13)] = rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
    check = struct.pack(">I", zlib.crc32(b"IHDR" + bytes(fields)))
    return data[:16] + bytes(fields) + check + data[33:]


def e57(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """Change the payload of an E57's pages or its XML, with the right checksums."""
    from meshreg.io.e57 import pages as e57_pages

    try:
        pages = [data[at : at + 1020] for at in range(0, len(data), 1024)]
        payload = b"".join(pages)
        start = struct.unpack_from("<Q", data, 24)[0]
        start = start // 1024 * 1020 + start % 1024
        xml = payload[start : start + struct.unpack_from("<Q", data, 32)[0]]
        if rng.random() < 0.7 and xml:
            new = rng.choice((text_number, text_number, word, bits))(xml, rng, others)
            before = payload[:start]
            page = start // 1020
            body = e57_pages.paged(before[page * 1020 :] + new)
            out = data[: page * 1024] + body
            first = e57_pages.header_page(
                out[:1020], len(out), e57_pages.to_physical(start), len(new)
            )
            return first + out[1024:]
        changed = rng.choice((bits, number, blank))(payload[:start], rng, others)
        return e57_pages.paged(changed + payload[start:])
    except (struct.error, IndexError):
        return data


def ifd(data: bytes, rng: random.Random, _: list[bytes]) -> bytes:
    """Change a field of a TIFF's first directory."""
    try:
        order = "<" if data[:2] == b"II" else ">"
        (start,) = struct.unpack_from(order + "I", data, 4)
        (count,) = struct.unpack_from(order + "H", data, start)
        at = start + 2 + 12 * rng.randrange(count)
        tag, kind, n, value = struct.unpack_from(order + "HHII", data, at)
        what = rng.randrange(5)
        if what == 0:
            tag = rng.choice(
                (256, 257, 258, 259, 262, 277, 317, 320, 322, 338, 339, 33550, 33922, 34735)
            )
        elif what == 1:
            kind = rng.choice((1, 2, 3, 4, 5, 11, 12, 16, 99))
        elif what == 2:
            n = rng.choice(WHOLE + LARGE) % 2**32
        else:
            value = rng.choice((*WHOLE, *LARGE, value + 1, value ^ 1, 9000, 20000)) % 2**32
        return data[:at] + struct.pack(order + "HHII", tag, kind, n, value) + data[at + 12 :]
    except (struct.error, ValueError):
        return data


_LAS = (
    (6, "H"), (24, "B"), (25, "B"), (94, "H"), (96, "I"), (100, "I"), (104, "B"), (105, "H"),
    (107, "I"), (131, "d"), (139, "d"), (147, "d"), (155, "d"), (163, "d"), (171, "d"), (227, "Q"),
    (235, "Q"), (243, "I"), (247, "Q"),
)  # fmt: skip


def las(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """Change a field of a LAS header, or something in its records."""
    try:
        if rng.random() < 0.4:
            length, start = struct.unpack_from("<HI", data, 94)
            way = rng.choice((bits, number, blank, text_number))
            return data[:length] + way(data[length:start], rng, others) + data[start:]
        at, form = rng.choice(_LAS)
        (old,) = struct.unpack_from("<" + form, data, at)
        size = struct.calcsize(form)
        if form == "d":
            new: float = rng.choice((*REALS, -old, old * 1e6))
        else:
            new = rng.choice((*WHOLE, *LARGE, old + 1, old - 1)) % 256**size
        return data[:at] + struct.pack("<" + form, new) + data[at + size :]
    except (struct.error, OverflowError):
        return data
