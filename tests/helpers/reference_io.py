"""Slow, readable twins of what meshreg.io computes fast, and truth made without PROJ."""

from __future__ import annotations

import math

# GRS 80 (GDA94, GDA2020, NAD83, ETRS89). WGS 84 differs by 0.1 mm in the polar radius.
SEMI_MAJOR, FLATTENING = 6_378_137.0, 1 / 298.257222101


def utm(lon: float, lat: float, zone: int) -> tuple[float, float]:
    """Transverse Mercator by the series of L. Krüger (1912) to the third power of n."""
    south = lat < 0
    n = FLATTENING / (2 - FLATTENING)
    radius = SEMI_MAJOR / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    alpha = (
        n / 2 - 2 / 3 * n**2 + 5 / 16 * n**3,
        13 / 48 * n**2 - 3 / 5 * n**3,
        61 / 240 * n**3,
    )
    phi = math.radians(lat)
    lam = math.radians(lon - (6 * zone - 183))
    c = 2 * math.sqrt(n) / (1 + n)
    t = math.sinh(math.atanh(math.sin(phi)) - c * math.atanh(c * math.sin(phi)))
    xi = math.atan2(t, math.cos(lam))
    eta = math.asinh(math.sin(lam) / math.hypot(t, math.cos(lam)))
    x = eta + sum(a * math.cos(2 * j * xi) * math.sinh(2 * j * eta) for j, a in enumerate(alpha, 1))
    y = xi + sum(a * math.sin(2 * j * xi) * math.cosh(2 * j * eta) for j, a in enumerate(alpha, 1))
    return 500_000 + 0.9996 * radius * x, (10_000_000 if south else 0) + 0.9996 * radius * y


def scale_and_convergence(lon: float, lat: float, zone: int) -> tuple[float, float]:
    """Grid scale and the angle [rad] from true to grid north, clockwise, by a step northward."""
    step = 1e-4
    east0, north0 = utm(lon, lat - step, zone)
    east1, north1 = utm(lon, lat + step, zone)
    e2 = FLATTENING * (2 - FLATTENING)
    meridian = SEMI_MAJOR * (1 - e2) / (1 - e2 * math.sin(math.radians(lat)) ** 2) ** 1.5
    length = meridian * math.radians(2 * step)
    scale = math.hypot(east1 - east0, north1 - north0) / length
    # True north points to (east1 - east0, north1 - north0) on the grid; grid north is +y.
    return scale, -math.atan2(east1 - east0, north1 - north0)


def rows_of(text: bytes, delimiter: str, columns: list[int]) -> list[list[float]]:
    """Numbers of some columns of each row of data; nan where a field is empty or "nan"."""
    rows = []
    for line in text.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n"):
        words = fields_of(line, delimiter)
        if words is not None:
            rows.append([float(words[column] or b"nan") for column in columns])
    return rows


def fields_of(line: bytes, delimiter: str) -> list[bytes] | None:
    """Fields of a line, None for an empty line or a comment."""
    bare = line.strip(b" \t")
    if not bare or bare.startswith((b"#", b"//")):
        return None
    if delimiter == " ":
        return bare.split()
    return [word.strip(b" \t") for word in line.split(delimiter.encode())]


def spliced(line: bytes, delimiter: str, words: dict[int, bytes]) -> bytes:
    """Return the line with some fields replaced, all else as it was."""
    out, at = b"", 0
    for number, field in enumerate(fields_of(line, delimiter) or []):
        start = line.index(field, at)
        out += line[at:start] + words.get(number, field)
        at = start + len(field)
        mark = -1 if delimiter == " " else line.find(delimiter.encode(), at)
        if mark >= 0:
            out += line[at : mark + 1]
            at = mark + 1
    return out + line[at:]
