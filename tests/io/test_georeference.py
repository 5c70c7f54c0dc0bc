"""A place on Earth in a file or beside it, as each program writes it: read, refused or named."""

from __future__ import annotations

import json
import struct
from xml.etree import ElementTree

import numpy as np
import pyproj
import pytest
import trimesh

from meshreg.errors import InputError
from meshreg.io import read_survey, rewrite_survey
from meshreg.records import Transform

SHIFT = (731_000.0, 5_705_000.0, 12.5)
CRS = "EPSG:32754"
CORNERS = np.array([[0, 0, 0], [30, 0, 1], [30, 20, 2], [0, 20, 0.5]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3]])
MOVE = Transform(offset=np.array([1.5, -0.75, 0.25]))


def obj(path, points=CORNERS, comments=()):
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"# {text}" for text in comments]
    lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    path.write_text("\n".join([*lines, "f 1 2 3", "f 1 3 4"]) + "\n")
    return path


def absolute(survey):
    return np.asarray(survey.geometry.points) + survey.origin


def metadata(srs, origin, more=""):
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n<ModelMetadata version="1">\n'
        f"\t<!--Spatial Reference System-->\n\t<SRS>{srs}</SRS>\n"
        f"\t<!--Origin in Spatial Reference System-->\n\t<SRSOrigin>{origin}</SRSOrigin>\n"
        f"\t<Texture>\n\t\t<ColorSource>Visible</ColorSource>\n\t</Texture>\n{more}</ModelMetadata>"
    )


# --- metadata.xml: ContextCapture, DJI Terra


@pytest.mark.parametrize(
    ("file", "place", "srs"),
    [
        ("reef.obj", "metadata.xml", "32754"),
        ("P/Data/Tile_+000_+001/Tile_+000_+001.obj", "P/metadata.xml", CRS),
        ("terra/BlockA/BlockA.obj", "terra/metadata.xml", "wkt"),
        ("P/Data/Model.obj", "P/metadata.xml", CRS),
    ],
)
def test_metadata_xml(tmp_path, file, place, srs):
    text = pyproj.CRS(CRS).to_wkt("WKT1_GDAL") if srs == "wkt" else srs
    path = obj(tmp_path / file)
    (tmp_path / place).write_text(metadata(text.replace('"', "&quot;"), "731000,5705000,12.5"))
    survey = read_survey(path)
    assert absolute(survey) == pytest.approx(CORNERS + SHIFT, abs=1e-9)
    assert survey.crs == CRS
    assert any("metadata.xml" in note for note in survey.notes)


def test_a_production_of_tiles_is_read_and_written_with_its_place(tmp_path):
    for number in range(2):
        name = f"Tile_+00{number}_+000"
        obj(tmp_path / f"P/Data/{name}/{name}.obj", np.add(CORNERS, (30.0 * number, 0, 0)))
    (tmp_path / "P/metadata.xml").write_text(metadata(CRS, "731000,5705000,12.5"))
    survey = read_survey(tmp_path / "P")
    assert survey.bounds[1, :2] == pytest.approx([731060, 5705020])
    files = rewrite_survey(survey, MOVE, tmp_path / "out")
    again = read_survey([path for path in files if path.suffix == ".obj"])
    assert again.bounds == pytest.approx(survey.bounds + MOVE.offset, abs=1e-6)
    assert again.crs == CRS


def test_a_metadata_xml_comes_with_the_registered_survey(tmp_path):
    """Of programs that know no other side file; its origin is that of the file as it is written."""
    path, home = obj(tmp_path / "in/reef.obj"), obj(tmp_path / "home/first.obj")
    (tmp_path / "in/metadata.xml").write_text(metadata(CRS, "731000,5705000,12.5"))
    (tmp_path / "home/first.survey.toml").write_text(f'shift = [730000, 5704000, 0]\ncrs = "{CRS}"')
    survey = read_survey(path)
    for reference, shift in ((None, SHIFT), (read_survey(home), (730_000, 5_704_000, 0))):
        out = tmp_path / f"out{reference is None}"
        files = rewrite_survey(survey, MOVE, out, reference)
        assert out / "metadata.xml" in files
        text = (out / "metadata.xml").read_text()
        said = {word.tag: word.text for word in ElementTree.fromstring(text)}
        assert [float(value) for value in said["SRSOrigin"].split(",")] == pytest.approx(shift)
        assert pyproj.CRS(said["SRS"]) == pyproj.CRS(CRS)
        for beside in (*out.glob("*.toml"), *out.glob("*_offset.xyz")):
            beside.unlink()
        again = read_survey(next(file for file in files if file.suffix == ".obj"))
        assert absolute(again) == pytest.approx(absolute(survey) + MOVE.offset, abs=1e-6)
        assert again.crs == CRS
    plain = rewrite_survey(read_survey(home), MOVE, tmp_path / "plain")
    assert not any(file.name == "metadata.xml" for file in plain)


def test_tiles_of_a_tileset_are_named_with_what_to_do(tmp_path):
    (tmp_path / "tileset.json").write_text('{"geometricError": 1, "root": {}}')
    (tmp_path / "a.b3dm").write_bytes(b"b3dm")
    for given in (tmp_path, tmp_path / "tileset.json", tmp_path / "a.b3dm"):
        with pytest.raises(InputError, match="3D Tiles, which are not read") as raised:
            read_survey(given)
        assert "Export the model as .obj or .glb" in raised.value.remedy


def test_a_metadata_xml_of_another_layout_is_named_only(tmp_path):
    path = obj(tmp_path / "mine" / "reef.obj")
    (tmp_path / "metadata.xml").write_text(metadata(CRS, "731000,5705000,0"))
    survey = read_survey(path)
    assert absolute(survey) == pytest.approx(CORNERS)
    assert any("731000, 5705000" in note and "not applied" in note for note in survey.notes)


@pytest.mark.parametrize("text", ["<metadata><Esri/></metadata>", "<gmd:MD_Metadata/>", ""])
def test_other_files_of_that_name_are_no_matter(tmp_path, text):
    path = obj(tmp_path / "reef.obj")
    (tmp_path / "metadata.xml").write_text(text)
    survey = read_survey(path)
    assert absolute(survey) == pytest.approx(CORNERS)
    assert not survey.notes


def test_a_local_system_of_context_capture_is_placed(tmp_path):
    """Against the topocentric formulas of EPSG guidance note 7-2, section 4.1.2, by geocentric."""
    points = np.add(CORNERS, (200.0, -150.0, -9.0))
    path = obj(tmp_path / "reef.obj", points)
    (tmp_path / "metadata.xml").write_text(metadata("ENU:-38.75,143.66", "10,20,5"))
    utm = obj(tmp_path / "other" / "utm.obj", points + SHIFT)
    (tmp_path / "other" / "utm.prj").write_text(CRS)
    from meshreg.io.frames.place import common_crs

    moving, _ = common_crs(read_survey(utm), read_survey(path))
    lat, lon = np.radians([-38.75, 143.66])
    east = [-np.sin(lon), np.cos(lon), 0]
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    origin = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(
        143.66, -38.75, 0
    )
    earth = np.array(origin) + np.add(points, (10, 20, 5)) @ np.array([east, north, up])
    wanted = np.transpose(
        pyproj.Transformer.from_crs("EPSG:4978", CRS, always_xy=True).transform(*earth.T)
    )
    assert absolute(moving)[:, :2] == pytest.approx(wanted[:, :2], abs=1e-3)
    assert absolute(moving)[:, 2] == pytest.approx(wanted[:, 2], abs=0.006)  # of the ellipsoid
    assert moving.crs == CRS


@pytest.mark.parametrize("srs", ["ENU:1", "ENU:95,10", "ENU:a,b"])
def test_a_broken_local_system_is_refused(tmp_path, srs):
    path = obj(tmp_path / "reef.obj")
    (tmp_path / "metadata.xml").write_text(metadata(srs, "0,0,0"))
    with pytest.raises(InputError, match="ENU:latitude,longitude"):
        read_survey(path)


def test_an_origin_in_degrees_is_named_not_guessed(tmp_path):
    path = obj(tmp_path / "reef.obj")
    (tmp_path / "metadata.xml").write_text(metadata("EPSG:4326", "143.66,-38.75,0"))
    survey = read_survey(path)
    assert absolute(survey) == pytest.approx(CORNERS)
    assert any("degrees or metres" in note for note in survey.notes)


def test_two_files_that_contradict_are_refused_unless_the_user_says(tmp_path):
    path = obj(tmp_path / "reef.obj")
    (tmp_path / "metadata.xml").write_text(metadata(CRS, "731000,5705000,0"))
    (tmp_path / "offset.xyz").write_text("731003 5705000 0")
    with pytest.raises(InputError, match=r"says shift.*offset\.xyz says shift"):
        read_survey(path)
    survey = read_survey(path, shift=(731_001, 5_705_000, 0))
    assert absolute(survey)[0].tolist() == [731_001, 5_705_000, 0]


# --- Pix4D, OpenDroneMap, Skycatch


@pytest.mark.parametrize("moved", [False, True])
def test_pix4d_names_its_offset_after_the_project(tmp_path, moved):
    path = obj(tmp_path / "p/2_densification/3d_mesh/site_4_simplified_3d_mesh.obj")
    params = tmp_path / "p/1_initial/params"
    params.mkdir(parents=True)
    beside = path.parent if moved else params
    (beside / "site_4_offset.xyz").write_text("731000.000 5705000.000 12.500\n")
    (beside / "site_4_wkt.prj").write_text(pyproj.CRS(CRS).to_wkt("WKT1_ESRI"))
    (beside / "site_offset.xyz").write_text("1 2 3\n") if moved else None
    survey = read_survey(path)
    assert absolute(survey) == pytest.approx(CORNERS + SHIFT)
    assert survey.crs == CRS


def test_a_cloud_is_not_a_projects_offset(tmp_path):
    """site_offset.xyz is a survey where it lists points, and no sidecar of site_2.obj."""
    path = obj(tmp_path / "site_2.obj")
    rows = "\n".join(" ".join(map(str, row)) for row in CORNERS.tolist())
    (tmp_path / "site_offset.xyz").write_text(rows + "\n")
    assert absolute(read_survey(path)) == pytest.approx(CORNERS)


@pytest.mark.parametrize("name", ["coords.txt", "odm_georeferencing_model_geo.txt"])
def test_odm(tmp_path, name):
    path = obj(tmp_path / "odm_texturing" / "odm_textured_model_geo.obj")
    (tmp_path / "odm_georeferencing").mkdir()
    (tmp_path / "odm_georeferencing" / name).write_text("WGS84 UTM 54S\n731000 5705000\n")
    survey = read_survey(path)
    assert absolute(survey) == pytest.approx(np.add(CORNERS, (731_000, 5_705_000, 0)))
    assert survey.crs == CRS


def test_offset_txt(tmp_path):
    path = obj(tmp_path / "reef.obj")
    (tmp_path / "offset.txt").write_text("731000.0\n5705000.0\n12.5\n")
    assert absolute(read_survey(path)) == pytest.approx(CORNERS + SHIFT)
    (tmp_path / "offset.txt").write_text("notes of the day\n")
    assert any("offset.txt" in note for note in read_survey(path).notes)


# --- what is named only


@pytest.mark.parametrize("name", ["reef.rcInfo", "reef.obj.rsInfo", "reef.obj.rcinfo"])
def test_realityscan(tmp_path, name):
    path = obj(tmp_path / "reef.obj")
    (tmp_path / name).write_text(
        '<Model globalCoordinateSystem="+proj=utm +zone=54 +south"\n'
        '   globalCoordinateSystemName="epsg:32754 - WGS 84 / UTM zone 54S" '
        'exportCoordinateSystemType="2">\n'
        "  <transformToModel>0 0 1 731000 1 0 0 5705000 0 1 0 -12 0 0 0 1</transformToModel>\n"
        '  <Header magic="5786959" version="1"/>\n</Model>\n'
    )
    survey = read_survey(path)
    assert absolute(survey) == pytest.approx(CORNERS)
    (note,) = survey.notes
    assert "epsg:32754" in note
    assert "731000, 5705000, -12" in note


@pytest.mark.parametrize(
    "comment",
    [
        "offset 731000 5705000 12.5",
        "Global shift: (731000.0, 5705000.0, 0)",
        "origin = 731000, 5705000, 0",
        "Translation x:731000 y:5705000 z:0",
    ],
)
@pytest.mark.parametrize("kind", ["obj", "ply", "xyz"])
def test_a_shift_in_a_comment_is_named(tmp_path, comment, kind):
    if kind == "obj":
        path = obj(tmp_path / "reef.obj", comments=["made by hand", comment])
    elif kind == "ply":
        path = tmp_path / "reef.ply"
        head = f"ply\nformat ascii 1.0\ncomment {comment}\nelement vertex 4\n"
        head += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
        path.write_text(head + "".join("{} {} {}\n".format(*row) for row in CORNERS.tolist()))
    else:
        path = tmp_path / "reef.xyz"
        rows = "".join("{} {} {}\n".format(*row) for row in CORNERS.tolist())
        path.write_text(f"# {comment}\n" + rows)
    survey = read_survey(path)
    assert absolute(survey) == pytest.approx(CORNERS)
    assert any(comment in note and "not applied" in note for note in survey.notes)
    stated = read_survey(path, shift=(1, 2, 3))
    assert not any(comment in note for note in stated.notes)


@pytest.mark.parametrize(
    "comment", ["made 12 3 2019", "offset of nothing", "origin 0 0 0", "1 2 3"]
)
def test_other_comments_are_not(tmp_path, comment):
    assert not read_survey(obj(tmp_path / "reef.obj", comments=[comment])).notes


def test_geocentric_coordinates_are_named_and_read_when_said(tmp_path):
    way = pyproj.Transformer.from_crs(CRS, "EPSG:4978", always_xy=True)
    flat = np.add(CORNERS, (731_000, 5_705_000, 0))
    path = obj(tmp_path / "reef.obj", np.transpose(way.transform(*flat.T)))
    assert any("EPSG:4978" in note for note in read_survey(path).notes)
    survey = read_survey(path, crs="EPSG:4978")
    assert absolute(survey)[:, :2] == pytest.approx(flat[:, :2], abs=1e-6)
    assert not any("look geocentric" in note for note in survey.notes)


# --- CESIUM_RTC


def glb(path, points, center=None, tree=None, faces=FACES):
    """Write a GLB by its specification alone: points (N, 3) float32 as they stand in the file."""
    points = np.asarray(points, np.float32)
    blob = points.astype("<f4").tobytes() + np.asarray(faces, "<u4").tobytes()
    whole = {
        "asset": {"version": "2.0", "generator": "test"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(blob)}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": points.nbytes},
            {"buffer": 0, "byteOffset": points.nbytes, "byteLength": 4 * np.size(faces)},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(points), "type": "VEC3"}
            | {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()},
            {"bufferView": 1, "componentType": 5125, "count": int(np.size(faces))}
            | {"type": "SCALAR"},
        ],
    }
    if center is not None:
        whole["extensionsUsed"] = whole["extensionsRequired"] = ["CESIUM_RTC"]
        whole["extensions"] = {"CESIUM_RTC": {"center": [float(value) for value in center]}}
    text = json.dumps(whole | (tree or {})).encode()
    text += b" " * (-len(text) % 4)
    blob += bytes(-len(blob) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(blob), 0x004E4942) + blob
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


def as_cesium_does(path):
    """Where CesiumJS puts a GLB's points: node matrices (by trimesh), y up to z up, then centre."""
    data = path.read_bytes()
    size = struct.unpack("<I", data[12:16])[0]
    tree = json.loads(data[20 : 20 + size])
    center = tree.get("extensions", {}).get("CESIUM_RTC", {}).get("center", [0, 0, 0])
    assert ("CESIUM_RTC" in tree.get("extensionsUsed", [])) == any(center)
    points = np.asarray(trimesh.load(path, process=False, force="mesh").vertices, float)
    return points @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], float) + center


def y_up(points):
    return np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1)


@pytest.mark.parametrize("order", ["z up", "y up"])
def test_a_projected_centre_is_a_shift(tmp_path, order):
    center = SHIFT if order == "z up" else (SHIFT[0], SHIFT[2], -SHIFT[1])
    path = glb(tmp_path / "reef.glb", y_up(CORNERS), center)
    survey = read_survey(path)
    assert absolute(survey) == pytest.approx(CORNERS + SHIFT)
    assert any("CESIUM_RTC" in note for note in survey.notes)
    # moved, another reader finds it where it should be; so do we, without and with the sidecar
    for reference in (None, read_survey(obj(tmp_path / "near.obj", CORNERS + 5))):
        folder = tmp_path / ("own" if reference is None else "near")
        files = rewrite_survey(survey, MOVE, folder, reference)
        assert absolute(read_survey(files[0])) == pytest.approx(
            CORNERS + SHIFT + MOVE.offset, abs=2e-3
        )
        if order == "z up":
            wanted = CORNERS + SHIFT + MOVE.offset
            assert as_cesium_does(files[0]) == pytest.approx(wanted, abs=2e-3)
            for side in files[1:]:
                side.unlink()
            assert absolute(read_survey(files[0])) == pytest.approx(wanted, abs=2e-3)


def geocentric(points):
    """From absolute UTM to geocentric coordinates."""
    way = pyproj.Transformer.from_crs(CRS, "EPSG:4978", always_xy=True)
    return np.transpose(way.transform(*np.asarray(points).T))


@pytest.mark.parametrize("axes", ["geocentric", "local"])
@pytest.mark.parametrize("lon", [143.66, -90.0, 0.0])
def test_a_geocentric_centre(tmp_path, axes, lon):
    lat = -38.75 if lon > 100 else 5.0
    to_earth = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    center = np.array(to_earth.transform(lon, lat, -20.0))
    phi, lam = np.radians([lat, lon])
    east = np.array([-np.sin(lam), np.cos(lam), 0])
    up = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    local = np.array([east, np.cross(up, east), up])
    earth = center + CORNERS @ local  # where the points truly are
    stored = y_up(CORNERS if axes == "local" else CORNERS @ local)
    path = glb(tmp_path / "reef.glb", stored, center)
    survey = read_survey(path)
    zone = pyproj.CRS(survey.crs)
    assert zone.is_projected
    to_zone = pyproj.Transformer.from_crs("EPSG:4978", zone.to_3d(), always_xy=True)
    wanted = np.transpose(to_zone.transform(*earth.T))
    assert absolute(survey) == pytest.approx(wanted, abs=1e-3)
    assert any("geocentric centre" in note for note in survey.notes)
    # moved by 1.5 m: stays geocentric, and another reader finds the same place on Earth
    files = rewrite_survey(survey, MOVE, tmp_path / "out")
    assert absolute(read_survey(files[0])) == pytest.approx(wanted + MOVE.offset, abs=2e-3)
    if axes == "geocentric":
        found = np.transpose(to_zone.transform(*as_cesium_does(files[0]).T))
        assert found == pytest.approx(wanted + MOVE.offset, abs=2e-3)


def test_a_file_beside_and_a_centre_that_differ_are_refused(tmp_path):
    path = glb(tmp_path / "reef.glb", y_up(CORNERS), SHIFT)
    (tmp_path / "reef_offset.xyz").write_text("731003 5705000 12.5")
    with pytest.raises(InputError, match=r"offset\.xyz: says shift.*reef\.glb says shift"):
        read_survey(path)
    (tmp_path / "reef_offset.xyz").write_text("731000 5705000 12.5")
    assert absolute(read_survey(path)) == pytest.approx(CORNERS + SHIFT)
    stated = read_survey(path, shift=(0, 0, 0))
    assert absolute(stated) == pytest.approx(CORNERS)


@pytest.mark.parametrize("center", [[1, 2], [1, 2, "3"], [1e300, 0, 0], [1e10, 0, 0], "here"])
def test_a_broken_centre_is_refused(tmp_path, center):
    path = glb(tmp_path / "reef.glb", y_up(CORNERS), SHIFT)
    path = glb(path, y_up(CORNERS), tree={"extensions": {"CESIUM_RTC": {"center": center}}})
    with pytest.raises(InputError, match=r"CESIUM_RTC|center"):
        read_survey(path)


@pytest.mark.parametrize(
    "tree",
    [
        {"extensions": {"CESIUM_geopose": {"longitude": 1, "latitude": 2, "height": 3}}},
        {"nodes": [{"mesh": 0, "extensions": {"EXT_geospatial": {}}}]},
        {"asset": {"version": "2.0", "extras": {"offset": [731000, 5705000, 0]}}},
        {"extras": {"epsg": 32754}},
    ],
)
def test_other_hints_in_a_gltf_are_named(tmp_path, tree):
    survey = read_survey(glb(tmp_path / "reef.glb", y_up(CORNERS), tree=tree))
    assert absolute(survey) == pytest.approx(CORNERS)
    assert any("not applied" in note for note in survey.notes)


def test_a_tileset_is_named(tmp_path):
    path = glb(tmp_path / "reef.glb", y_up(CORNERS))
    (tmp_path / "tileset.json").write_text(
        json.dumps({"geometricError": 1, "root": {"transform": [1] * 16, "content": {}}})
    )
    assert any("tileset.json" in note for note in read_survey(path).notes)


def test_a_geocentric_reference_makes_no_other_file_geocentric(tmp_path):
    flat = np.add(CORNERS, (731_000, 5_705_000, 0))
    earth = geocentric(flat)
    center = np.round(earth.mean(axis=0))
    reference = read_survey(glb(tmp_path / "reef.glb", y_up(earth - center), center))
    from meshreg.io.frames.place import common_crs

    path = obj(tmp_path / "b" / "reef.obj")
    (path.parent / "SHIFT.txt").write_text(f"{CRS} 731000 5705000 0")
    moving, _ = common_crs(reference, read_survey(path))
    files = rewrite_survey(moving, MOVE, tmp_path / "out", reference)
    again = read_survey(files[0])
    assert absolute(again) == pytest.approx(flat + MOVE.offset, abs=1e-5)
    z = [float(line.split()[3]) for line in files[0].read_text().splitlines() if line[:2] == "v "]
    assert np.ptp(z) == pytest.approx(2, abs=1e-6)  # as steep as it was: axes east, north, up


@pytest.mark.parametrize(("unit", "carried"), [("m", True), ("ft", False)])
def test_maps_made_of_a_survey_are_in_its_local_crs(tmp_path, unit, carried):
    """Maps are in metres, so that a system whose numbers were feet is not theirs."""
    import rasterio
    from made_registration import made_registration

    from meshreg.cli import app as cli
    from meshreg.io import ReadOptions
    from meshreg.io.result.record import write_record_files

    path = obj(tmp_path / "in/reef.obj")
    axes = 'AXIS["E",EAST],AXIS["N",NORTH]'
    wkt = f'LOCAL_CS["Site grid",LOCAL_DATUM["Site",0],UNIT["metre",1],{axes}]'
    path.with_suffix(".prj").write_text(wkt)
    words = ["rasterize", str(path), "-o", str(tmp_path / "maps"), "--unit", unit]
    assert cli.run(words) == 0
    survey = read_survey(path, ReadOptions(unit=unit))
    write_record_files(made_registration("accepted"), tmp_path, reference=survey)
    for name in ("maps/dem.tif", "reference_dem.tif", "moving_ortho.tif"):
        with rasterio.open(tmp_path / name) as raster:
            assert (raster.crs is not None and "Site grid" in raster.crs.to_wkt()) == carried
