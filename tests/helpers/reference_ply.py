"""Slow, readable twins: a PLY encoder and decoder by `struct`, face keys, ear cutting."""

from __future__ import annotations

import itertools
import struct

CODES = {
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I",
    "float": "f", "double": "d", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "float32": "f", "float64": "d", "int64": "q", "uint64": "Q",
}  # fmt: skip
FORMATS = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}


def header(elements, order, comments=(), newline="\n", counts=None):
    """Header of [(name, [(property, type or (count type, type)), ...], rows), ...]."""
    lines = ["ply", f"format {FORMATS[order]} 1.0", *(f"comment {text}" for text in comments)]
    for name, properties, rows in elements:
        lines.append(f"element {name} {(counts or {}).get(name, len(rows))}")
        for item, kind in properties:
            words = kind if isinstance(kind, str) else f"list {kind[0]} {kind[1]}"
            lines.append(f"property {words} {item}")
    return "".join(line + newline for line in [*lines, "end_header"]).encode("utf-8")


def body(elements, order, newline="\n"):
    out = []
    for _, properties, rows in elements:
        for row in rows:
            words = []
            for (_, kind), value in zip(properties, row, strict=True):
                if isinstance(kind, str):
                    words.append((kind, value))
                else:
                    words.append((kind[0], len(value)))
                    words += [(kind[1], item) for item in value]
            if order:
                out += [struct.pack(order + CODES[kind], value) for kind, value in words]
            else:
                out.append((" ".join(repr(value) for _, value in words) + newline).encode())
    return b"".join(out)


def encode(elements, order="<", comments=(), newline="\n", counts=None):
    return header(elements, order, comments, newline, counts) + body(elements, order, newline)


def decode(data):
    """Read any well-formed PLY: {element: ([property names], [row, ...])}."""
    head, _, rest = data.partition(b"end_header\n")
    order, elements = "", []
    for line in head.decode().splitlines():
        words = line.split()
        if words[0] == "format":
            order = next(key for key, name in FORMATS.items() if name == words[1])
        elif words[0] == "element":
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property":
            kind = words[1] if len(words) == 3 else (words[2], words[3])
            elements[-1][2].append((words[-1], kind))
    text = iter(rest.split())
    place = 0

    def take(kind):
        nonlocal place
        if not order:
            word = next(text)
            return float(word) if kind in ("float", "double", "float32", "float64") else int(word)
        value = struct.unpack_from(order + CODES[kind], rest, place)[0]
        place += struct.calcsize(CODES[kind])
        return value

    tables = {}
    for name, count, properties in elements:
        rows = []
        for _ in range(count):
            row = []
            for _, kind in properties:
                if isinstance(kind, str):
                    row.append(take(kind))
                else:
                    row.append([take(kind[1]) for _ in range(take(kind[0]))])
            rows.append(row)
        tables[name] = ([item for item, _ in properties], rows)
    assert place == len(rest) or not order
    return tables


def kept_faces(points, faces):
    """Rows of faces that have area, are finite and come first among those of equal vertices."""
    seen, keep = set(), []
    for row, face in enumerate(faces):
        corners = [points[v] for v in face]
        if not all(abs(value) < float("inf") for corner in corners for value in corner):
            continue
        a, b, c = corners
        p, q = [b[k] - a[k] for k in range(3)], [c[k] - a[k] for k in range(3)]
        cross = [p[i - 2] * q[i - 1] - p[i - 1] * q[i - 2] for i in range(3)]
        key = tuple(sorted(face))
        if len(set(key)) < 3 or cross == [0, 0, 0] or key in seen:
            continue
        seen.add(key)
        keep.append(row)
    return keep


def area(polygon):
    """Signed area of a plane polygon (shoelace)."""
    pairs = zip(polygon, itertools.islice(itertools.cycle(polygon), 1, None))  # noqa: B905
    return sum(a[0] * b[1] - a[1] * b[0] for a, b in pairs) / 2
