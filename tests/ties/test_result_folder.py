"""What a result's own folder gives to pick and to validate: pictures of the registered survey."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from made_registration import made_registration

from meshreg.cli import app as cli
from meshreg.cli.common import SurveyRequest
from meshreg.cli.console import Terminal
from meshreg.cli.picking import PickRequest, _desk
from meshreg.io.options import ReadOptions
from meshreg.io.result.record import write_registration
from meshreg.ties.placing import read_placing


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("result") / "OUT"
    write_registration(made_registration("accepted"), folder)
    return folder


def desk_of(out: Path, folder: Path):
    request = PickRequest(SurveyRequest(str(out), ReadOptions()), None, folder / "ties.csv")
    return _desk(request, folder, Terminal(as_json=True))


def test_a_result_is_picked_on_as_it_was_laid_down(out, tmp_path):
    desk = desk_of(out, tmp_path)
    registration = made_registration("accepted")
    assert desk.registered
    assert desk.session.crs == registration.reference["crs"]
    assert desk.reference.grid.bounds == desk.moving.grid.bounds
    link = desk.state()["links"]["registration"]
    assert link["angle"] == 0  # the picture lies right already
    assert link["shown"] == pytest.approx(link["reference"], abs=1e-6)
    shown = np.array([[link["shown"][0] + 3, link["shown"][1] - 2]])
    height = registration.transform.pivot[2] + registration.transform.offset[2]
    back = registration.transform.inverse().apply([*shown[0], height])
    assert np.allclose(desk.to_moving(shown), back[:2], rtol=0, atol=1e-9)
    desk.reference.close()
    desk.moving.close()


def test_a_result_without_color_shows_its_relief(out, tmp_path):
    bare = tmp_path / "OUT"
    bare.mkdir()
    for name in ("registration.json", "reference_dem.tif", "moving_dem.tif"):
        (bare / name).write_bytes((out / name).read_bytes())
    desk = desk_of(bare, tmp_path)
    assert desk.reference.path.parent == tmp_path
    assert desk.reference.mask()[0].any()
    desk.reference.close()
    desk.moving.close()


def test_taglab_pixels_of_the_results_own_mosaics_go_back_to_the_survey(out, tmp_path, capsys):
    """Pixels of the registered mosaic name places of the survey as it was delivered."""
    registration = made_registration("accepted")
    west, north, cell = _corner(out / "moving_ortho.tif")
    rng = np.random.default_rng(1)
    delivered = registration.transform.pivot[:2] + rng.uniform(-7, 7, (12, 2))
    level = np.full((12, 1), registration.transform.pivot[2])
    true = registration.transform.apply(np.column_stack([delivered, level]))[:, :2]
    meant = true + np.array([0.06, -0.03])  # the reference shows each thing that far from there
    lines = ["Image name,TagLab Id,TagLab Genet Id,TagLab Centroid x,TagLab Centroid y,TagLab Note"]
    for image, places in (("old", meant), ("new", true)):
        for k, (east, up) in enumerate(places, 1):
            lines.append(f"{image},{k},{k},{(east - west) / cell:.6f},{(north - up) / cell:.6f},")
    table = tmp_path / "taglab.csv"
    table.write_text("\n".join(lines) + "\n")
    assert cli.run(["validate", str(out), str(table), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [pair["name"] for pair in document["pairs"]][:2] == ["genet 1", "genet 2"]
    found = np.array([pair["moving"] for pair in document["pairs"]])
    assert np.allclose(found, delivered, rtol=0, atol=1e-6)
    assert document["fused"]["difference"] == pytest.approx([-0.06, 0.03], abs=2e-3)
    assert document["fused"]["residual"] == pytest.approx(np.hypot(0.06, 0.03), abs=1e-6)
    # the maps tell where pairs are missing
    assert sum(part["share"] for part in document["sectors"]) == pytest.approx(1)
    assert sum(part["pairs"] for part in document["sectors"]) == 12


def _corner(path: Path) -> tuple[float, float, float]:
    import rasterio

    with rasterio.open(path) as dataset:
        return dataset.transform.c, dataset.transform.f, dataset.transform.a


def test_a_placing_needs_a_transform(tmp_path):
    folder = tmp_path / "OUT"
    write_registration(made_registration("rejected"), folder)
    with pytest.raises(Exception, match="rejected"):
        read_placing(folder)
