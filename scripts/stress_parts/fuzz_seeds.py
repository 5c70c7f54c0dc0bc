"""Small surveys, side files and records that the fuzzer starts from; all made here."""

from __future__ import annotations

import io
import json
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

# What is done with a case; {main} is the survey, {here} its folder, {out} a new folder.
READ = (("info", "{main}"), ("rasterize", "{main}", "-o", "{out}"), ("@rewrite", "{main}"))


@dataclass(frozen=True)
class Seed:
    """Files by name, the one that is named to the commands, and those commands."""

    files: dict[str, bytes]
    main: str
    commands: tuple[tuple[str, ...], ...] = READ
    weights: dict[str, float] = field(default_factory=dict)


def ground(n: int = 8, cell: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n², 3) of a bumpy square and its triangles."""
    row, col = np.mgrid[:n, :n]
    z = 0.3 * np.sin(1.7 * col) * np.cos(1.3 * row) + 0.05 * col
    points = np.column_stack([col.ravel() * cell, row.ravel() * cell, np.round(z.ravel(), 3)])
    at = (row[:-1, :-1] * n + col[:-1, :-1]).ravel()
    faces = np.concatenate(
        [np.column_stack([at, at + 1, at + n]), np.column_stack([at + 1, at + n + 1, at + n])]
    )
    return points, faces


def picture(kind: str, size: int = 32, mode: str = "RGB") -> bytes:
    """Return an encoded picture of random speckle."""
    from PIL import Image

    rng = np.random.default_rng(3)
    pixels = rng.integers(0, 255, (size, size, 3), np.uint8)
    out = io.BytesIO()
    Image.fromarray(pixels).convert(mode).save(out, kind)
    return out.getvalue()


def obj(kind: str) -> dict[str, bytes]:
    """Return an OBJ with its material file and page."""
    points, faces = ground()
    page = f"t.{kind.lower()}"
    text = "mtllib a.mtl\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in points)
    text += "".join(f"vt {x / 4} {y / 4}\n" for x, y, _ in points) + "vn 0 0 1\nusemtl m\n"
    text += "".join("f " + " ".join(f"{k + 1}/{k + 1}/1" for k in f) + "\n" for f in faces)
    return {
        "a.obj": text.encode(),
        "a.mtl": f"newmtl m\nKd 1 1 1\nmap_Kd {page}\n".encode(),
        page: picture(kind),
    }


def ply(binary: bool) -> dict[str, bytes]:
    """Return a PLY with colors, normals and a texture."""
    points, faces = ground()
    head = (
        f"ply\nformat {'binary_little_endian' if binary else 'ascii'} 1.0\n"
        f"comment TextureFile t.png\nelement vertex {len(points)}\n"
        + "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
        + "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
        + f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
        "property list uchar float texcoord\nend_header\n"
    ).encode()
    body = []
    for x, y, z in points:
        row = (x, y, z, 0, 0, 1, 90, 120, 80)
        body.append(
            struct.pack("<6f3B", *row)
            if binary
            else (" ".join(f"{v:g}" for v in row) + "\n").encode()
        )
    for face in faces:
        uv = [value / 4 for k in face for value in points[k, :2]]
        row = (3, *(int(k) for k in face), 6, *map(float, uv))
        if binary:
            body.append(struct.pack("<B3iB6f", *row))
        else:
            body.append((" ".join(map(str, row)) + "\n").encode())
    return {"a.ply": head + b"".join(body), "t.png": picture("PNG")}


def gltf(binary: bool) -> dict[str, bytes]:
    """Return a glTF, its buffer beside it or in the file."""
    points, faces = ground()
    xyz = points[:, [0, 2, 1]].astype("<f4") * [1, 1, -1]
    parts = [
        faces.astype("<u2").tobytes(),
        xyz.astype("<f4").tobytes(),
        (points[:, :2] / 4).astype("<f4").tobytes(),
        picture("PNG"),
    ]
    views, at = [], 0
    for part in parts:
        views.append({"buffer": 0, "byteOffset": at, "byteLength": len(part)})
        at += len(part) + -len(part) % 4
    blob = b"".join(part + b"\0" * (-len(part) % 4) for part in parts)
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [1, 0, 2], "rotation": [0, 0, 0, 1]}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 1, "TEXCOORD_0": 2}, "indices": 0, "material": 0}
                ]
            }
        ],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5123, "count": faces.size, "type": "SCALAR"},
            {
                "bufferView": 1, "componentType": 5126, "count": len(points), "type": "VEC3",
                "min": xyz.min(axis=0).tolist(), "max": xyz.max(axis=0).tolist(),
            },
            {"bufferView": 2, "componentType": 5126, "count": len(points), "type": "VEC2"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }  # fmt: skip
    if not binary:
        tree["buffers"][0]["uri"] = "a.bin"
        return {"a.gltf": json.dumps(tree).encode(), "a.bin": blob}
    return {"a.glb": glb(json.dumps(tree).encode(), blob)}


def glb(text: bytes, blob: bytes) -> bytes:
    """Return the two chunks as one file."""
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(blob)
    return (
        struct.pack("<4sII", b"glTF", 2, size)
        + struct.pack("<II", len(text), 0x4E4F534A)
        + text
        + struct.pack("<II", len(blob), 0x004E4942)
        + blob
    )


def stl(binary: bool) -> dict[str, bytes]:
    """Return an STL."""
    points, faces = ground(5)
    if binary:
        rows = [struct.pack("<12fH", 0, 0, 1, *points[face].ravel(), 0) for face in faces]
        return {"a.stl": b"made".ljust(80) + struct.pack("<I", len(faces)) + b"".join(rows)}
    text = "solid made\n"
    for face in faces:
        text += "facet normal 0 0 1\nouter loop\n"
        text += "".join(f"vertex {x} {y} {z}\n" for x, y, z in points[face])
        text += "endloop\nendfacet\n"
    return {"a.stl": (text + "endsolid made\n").encode()}


def off() -> dict[str, bytes]:
    """Return an OFF."""
    points, faces = ground(5)
    rows = [f"{x} {y} {z}" for x, y, z in points] + ["3 " + " ".join(map(str, f)) for f in faces]
    return {"a.off": f"OFF\n{len(points)} {len(faces)} 0\n".encode() + "\n".join(rows).encode()}


def las(name: str, minor: int, form: int) -> dict[str, bytes]:
    """Return a LAS or LAZ with a CRS and extra dimensions."""
    import laspy

    points, _ = ground(12)
    header = laspy.LasHeader(version=f"1.{minor}", point_format=form)
    header.scales, header.offsets = [0.001] * 3, [731_000, 5_705_000, 0]
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name, "float32") for name in ("NormalX", "NormalY", "NormalZ")]
    )
    header.add_crs(__import__("pyproj").CRS(32754))
    record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
    record.x, record.y, record.z = (points + np.array([731_000, 5_705_000, -9.0])).T
    record["NormalZ"] = np.ones(len(points), np.float32)
    for color in ("red", "green", "blue"):
        record[color] = np.arange(len(points), dtype=np.uint16) * 300
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, name)
        with laspy.open(path, "w", header=header) as writer:
            writer.write_points(record)
        return {name: path.read_bytes()}


def e57() -> dict[str, bytes]:
    """Return an E57 with colors and a pose."""
    from meshreg.io import write_survey
    from meshreg.records import PointCloud, Survey

    points, _ = ground()
    cloud = PointCloud(points - points.mean(axis=0), np.full((len(points), 3), 90, np.uint8))
    survey = Survey(name="a", geometry=cloud, origin=np.array([100.0, 200.0, 0.0]))
    with tempfile.TemporaryDirectory() as folder:
        write_survey(survey, Path(folder, "a.e57"))
        return {"a.e57": Path(folder, "a.e57").read_bytes()}


def xyz(name: str, header: str, comma: str) -> dict[str, bytes]:
    """Return a text cloud with colors and normals."""
    points, _ = ground()
    rows = [comma.join(map(str, (x, y, z, 90, 100, 80, 0, 0, 1))) for x, y, z in points]
    return {name: (header + "\n".join(rows) + "\n").encode()}


def tif(bands: int = 1, crs: int | None = 32754, shift: float = 0.0, n: int = 24) -> bytes:
    """Return a DEM (one band) or an orthomosaic as GeoTIFF."""
    import rasterio
    from rasterio import Affine

    row, col = np.mgrid[:n, :n]
    east, north = 731_000 + 0.5 * col - shift, 5_705_000 - 0.5 * row
    rng = np.random.default_rng(1)
    table = rng.normal(0, 0.2, (64, 64))
    bump = table[(np.floor(north / 0.5) % 64).astype(int), (np.floor(east / 0.5) % 64).astype(int)]
    options = {"driver": "GTiff", "width": n, "height": n, "count": bands, "compress": "deflate"}
    options["transform"] = Affine(0.5, 0, 731_000, 0, -0.5, 5_705_000)
    if crs is not None:
        options["crs"] = crs
    data = (bump - 9).astype("f4")[None]
    if bands > 1:
        data = np.clip(120 + 300 * np.stack([bump] * bands), 1, 255).astype("u1")
    else:
        options["nodata"] = -9999
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.tif")
        with rasterio.open(path, "w", dtype=data.dtype, **options) as dataset:
            dataset.write(data)
        return path.read_bytes()


def colmap(binary: bool) -> dict[str, bytes]:
    """Return a COLMAP model with its positions."""
    points, _ = ground(5)
    names = [f"IMG {k}.jpg" for k in range(6)]
    seen = [
        range(6),
        range(6),
        *[range(0)] * (len(points) - 2),
    ]  # points by the images that show them
    text = {
        "cameras": "1 PINHOLE 100 80 90 90 50 40\n",
        "images": "".join(
            f"{k + 1} 0 1 0 0 {-k * 0.4} {k * k * 0.1} 5 1 {name}\n10 10 1 20 20 2\n"
            for k, name in enumerate(names)
        ),
        "points3D": "".join(
            f"{k + 1} {x} {y} {z} 90 90 90 0.5 {' '.join(f'{m + 1} {k}' for m in seen[k])}\n"
            for k, (x, y, z) in enumerate(points)
        ),
    }
    files = {f"{name}.txt": value.encode() for name, value in text.items()}
    if binary:
        files = {
            "cameras.bin": struct.pack("<QiiQQ4d", 1, 1, 1, 100, 80, 90, 90, 50, 40),
            "images.bin": struct.pack("<Q", 6)
            + b"".join(
                struct.pack("<i7di", k + 1, 0, 1, 0, 0, -k * 0.4, k * k * 0.1, 5, 1)
                + name.encode()
                + b"\0"
                + struct.pack("<Qddqddq", 2, 10, 10, 1, 20, 20, 2)
                for k, name in enumerate(names)
            ),
            "points3D.bin": struct.pack("<Q", len(points))
            + b"".join(
                struct.pack("<Q3d3Bd", k + 1, *point, 90, 90, 90, 0.5)
                + struct.pack("<Q", len(seen[k]))
                + b"".join(struct.pack("<ii", m + 1, k) for m in seen[k])
                for k, point in enumerate(points)
            ),
        }
    files["positions.csv"] = ("image,east,north,up\n" + "".join(
        f"{name},{100 + k * 0.4},{200 - k * k * 0.1},{7 + 0.3 * (k % 2)}\n"
        for k, name in enumerate(names)
    )).encode()  # fmt: skip
    return files


def beside(files: dict[str, bytes], **more: str) -> dict[str, bytes]:
    """Add text files; two underscores in a name stand for a dot."""
    return files | {name.replace("__", "."): text.encode() for name, text in more.items()}


METADATA = (
    '<?xml version="1.0" encoding="utf-8"?>\n<ModelMetadata version="1">\n<SRS>EPSG:32754</SRS>\n'
    "<SRSOrigin>731000,5705000,0</SRSOrigin>\n</ModelMetadata>\n"
)
AUX = (
    '<PAMDataset>\n<PAMRasterBand band="1"><NoDataValue>-3</NoDataValue></PAMRasterBand>\n'
    "</PAMDataset>\n"
)
TOML = (
    'name = "a"\ndate = 2019-02-05\ncrs = "EPSG:32754"\nshift = [731000, 5705000, 0]\n'
    'axes = "enu"\nunit = "m"\n'
)
SQUARE = [
    [731001, 5704990],
    [731010, 5704990],
    [731010, 5704999],
    [731001, 5704999],
    [731001, 5704990],
]
GEOJSON = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature",
            "properties": {},
            "geometry": {"type": "Polygon", "coordinates": [SQUARE]},
        }
    ],
}  # fmt: skip


def shapefile() -> dict[str, bytes]:
    """Return a shapefile of a square."""
    import shapefile as pyshp

    parts = {suffix: io.BytesIO() for suffix in ("shp", "shx", "dbf")}
    with pyshp.Writer(**parts) as writer:
        writer.field("name", "C")
        writer.poly([SQUARE])
        writer.record("x")
    return {f"m.{suffix}": part.getvalue() for suffix, part in parts.items()}


def masked(name: str) -> tuple[tuple[str, ...], ...]:
    """Return the command that uses a mask."""
    return (("rasterize", "{main}", "-o", "{out}", "--mask", "{here}/" + name),)


def record() -> dict[str, bytes]:
    """Return the folder of a small registration, and what it was made from."""
    from meshreg.cli import app as cli

    files = {"ref.tif": tif(n=40), "mov.tif": tif(n=40, shift=1.0)}
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        for name, data in files.items():
            (here / name).write_bytes(data)
        arguments = ["register", here / "ref.tif", here / "mov.tif", "-o", here / "OUT"]
        arguments += ["--search-radius", "3"]
        code = cli.run([str(item) for item in arguments])
        assert (here / "OUT" / "registration.json").exists(), code
        for path in (here / "OUT").glob("*"):
            if path.suffix in (".json", ".npz"):
                files[f"OUT/{path.name}"] = path.read_bytes()
    rows = ["id,name,reference_east,reference_north,moving_east,moving_north,crs"]
    for k in range(8):
        x, y = 731_002 + 2 * (k % 4), 5_704_990 - 3 * (k // 4)
        rows.append(f"{k + 1},p{k},{x},{y},{x + 1.0},{y},EPSG:32754")
    files["ties.csv"] = ("\n".join(rows) + "\n").encode()
    return files


def seeds() -> dict[str, Callable[[], Seed]]:
    """Return every kind by name; each is made when it is asked for."""
    colmap_read = tuple(
        (*command, "--positions", "{here}/positions.csv") if command[0] != "@rewrite" else command
        for command in READ
    )
    records = (
        ("apply", "{here}/OUT/registration.json", "{here}/mov.tif", "-o", "{out}"),
        ("report", "{here}/OUT"),
        ("validate", "{here}/OUT", "{here}/ties.csv"),
    )
    dem = {"a.tif": tif()}
    return {
        "obj": lambda: Seed(obj("PNG"), "a.obj", weights={"a.obj": 3}),
        "obj-jpeg": lambda: Seed(obj("JPEG"), "a.obj", weights={"t.jpeg": 3}),
        "obj-webp": lambda: Seed(obj("WEBP"), "a.obj", weights={"t.webp": 3}),
        "obj-tiff": lambda: Seed(obj("TIFF"), "a.obj", weights={"t.tiff": 3}),
        "ply": lambda: Seed(ply(True), "a.ply", weights={"a.ply": 4}),
        "ply-text": lambda: Seed(ply(False), "a.ply", weights={"a.ply": 4}),
        "gltf": lambda: Seed(gltf(False), "a.gltf", weights={"a.gltf": 2}),
        "glb": lambda: Seed(gltf(True), "a.glb"),
        "stl": lambda: Seed(stl(True), "a.stl"),
        "stl-text": lambda: Seed(stl(False), "a.stl"),
        "off": lambda: Seed(off(), "a.off"),
        "las": lambda: Seed(las("a.las", 2, 3), "a.las"),
        "las14": lambda: Seed(las("a.las", 4, 7), "a.las"),
        "laz": lambda: Seed(las("a.laz", 2, 3), "a.laz"),
        "laz14": lambda: Seed(las("a.laz", 4, 7), "a.laz"),
        "e57": lambda: Seed(e57(), "a.e57"),
        "xyz": lambda: Seed(xyz("a.xyz", "", " "), "a.xyz"),
        "csv": lambda: Seed(xyz("a.csv", "x,y,z,r,g,b,nx,ny,nz\n", ","), "a.csv"),
        "pts": lambda: Seed(xyz("a.pts", "64\n", " "), "a.pts"),
        "colmap": lambda: Seed(colmap(True), ".", colmap_read),
        "colmap-text": lambda: Seed(colmap(False), ".", colmap_read),
        "tif": lambda: Seed(dem, "a.tif"),
        "tif-degrees": lambda: Seed({"a.tif": tif_degrees()}, "a.tif"),
        "tif-pair": lambda: Seed(
            {"a_dem.tif": tif(), "b_ortho.tif": tif(3)}, "a_dem.tif,{here}/b_ortho.tif"
        ),
        "tif-world": lambda: Seed(
            beside({"a.tif": tif(crs=None)}, a__tfw="0.5\n0\n0\n-0.5\n731000\n5705000\n",
                   a__prj=wkt(), a__tif__aux__xml=AUX, a__aux__xml=AUX),
            "a.tif", weights={"a.tif": 0.3},
        ),
        "sides": lambda: Seed(
            beside(xyz("a.xyz", "", " "), a_offset__xyz="731000 5705000 0\n", a__prj=wkt()),
            "a.xyz", weights={"a.xyz": 0.1},
        ),
        "sides-odm": lambda: Seed(
            beside(obj("PNG"), coords__txt="WGS84 UTM 54S\n731000 5705000\n0 0 0\n"),
            "a.obj", weights={"coords.txt": 20},
        ),
        "sides-shift": lambda: Seed(
            beside(ply(False), SHIFT__txt="731000 5705000 0\n"),
            "a.ply", weights={"SHIFT.txt": 20},
        ),
        "sides-metadata": lambda: Seed(
            beside(obj("PNG"), metadata__xml=METADATA), "a.obj", weights={"metadata.xml": 20}
        ),
        "sides-toml": lambda: Seed(
            beside(off(), a__survey__toml=TOML), "a.off", weights={"a.survey.toml": 20}
        ),
        "mask-geojson": lambda: Seed(
            dem | {"m.geojson": json.dumps(GEOJSON).encode()}, "a.tif", masked("m.geojson"),
            {"a.tif": 0.05},
        ),
        "mask-shp": lambda: Seed(dem | shapefile(), "a.tif", masked("m.shp"), {"a.tif": 0.05}),
        "mask-tif": lambda: Seed(
            dem | {"m.tif": tif(3)}, "a.tif", masked("m.tif"), {"a.tif": 0.05}
        ),
        "settings": lambda: Seed(
            dem | {"s.toml": all_settings()}, "a.tif",
            (("rasterize", "{main}", "-o", "{out}", "--config", "{here}/s.toml"),),
            {"a.tif": 0.01},
        ),
        "ties": lambda: Seed(record(), "OUT", records[2:], {"ties.csv": 1e6}),
        "record": lambda: Seed(record(), "OUT", records, {"OUT/registration.json": 1e6}),
        "evidence": lambda: Seed(record(), "OUT", records[1:2], {"OUT/evidence.npz": 1e6}),
    }  # fmt: skip


def all_settings() -> bytes:
    """Return all settings as a file."""
    from meshreg.settings import Settings, write_settings

    return write_settings(Settings()).encode()


def wkt() -> str:
    """Return a projected CRS as text."""
    import pyproj

    return str(pyproj.CRS(32754).to_wkt("WKT1_ESRI"))


def tif_degrees() -> bytes:
    """Return a DEM in degrees."""
    import rasterio
    from rasterio import Affine

    n = 16
    row, col = np.mgrid[:n, :n]
    data = (0.3 * np.sin(col) * np.cos(row) - 9).astype("f4")[None]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.tif")
        with rasterio.open(
            path, "w", driver="GTiff", width=n, height=n, count=1, dtype="float32", crs=4326,
            transform=Affine(5e-6, 0, 143.5, 0, -5e-6, -38.3),
        ) as dataset:  # fmt: skip
            dataset.write(data)
        return path.read_bytes()
