"""Real structure from motion on rendered photographs, placed by noisy navigation alone.

Twenty images an epoch are reconstructed by pycolmap on the CPU, which takes about half a minute an
epoch on two cores. All seeds are set, so that a run on the same machine repeats itself.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from data_synth.make import write_pair
from data_synth.recipe import load
from meshreg.io import read_survey
from meshreg.io.options import ReadOptions
from meshreg.pipeline.register import register_pair
from meshreg.records import PointCloud, Survey


def reconstruct(photographs: Path, work: Path) -> Path:
    """Reconstruct one epoch; return the folder of its only model."""
    work.mkdir()
    camera = pycolmap.ImageReaderOptions(camera_model="SIMPLE_PINHOLE", camera_params="690,400,300")
    features = pycolmap.FeatureExtractionOptions()
    features.use_gpu, features.num_threads = False, 2
    features.sift.max_num_features, features.sift.peak_threshold = 4000, 0.003
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu, matching.num_threads = False, 2
    checking = pycolmap.TwoViewGeometryOptions()
    checking.ransac.random_seed = 0
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads, mapping.ba_refine_focal_length = 2, False
    mapping.random_seed = mapping.mapper.random_seed = mapping.triangulation.random_seed = 0
    database = work / "database.db"
    pycolmap.extract_features(
        database,
        photographs,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=camera,
        extraction_options=features,
        device=pycolmap.Device.cpu,
    )
    pycolmap.match_exhaustive(
        database,
        matching_options=matching,
        verification_options=checking,
        device=pycolmap.Device.cpu,
    )
    models = pycolmap.incremental_mapping(database, photographs, work / "sparse", mapping)
    assert len(models) == 1
    assert models[0].num_reg_images() == len(list(photographs.glob("*.jpg"))) == 20
    return work / "sparse" / "0"


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Survey, Survey, dict[str, Any]]:
    """Both epochs as meshreg reads them, and the truth: metres apart, a third of all change."""
    folder = tmp_path_factory.mktemp("sfm")
    recipe = load("severity_03", {"sfm.follows_offset": 0.0})
    write_pair(recipe, folder / "pair", 1, 6.0, "images")
    truth = json.loads((folder / "pair" / "truth.json").read_text())
    surveys = []
    for name in ("reference", "moving"):
        photographs = folder / "pair" / name
        model = reconstruct(photographs, folder / name)
        positions = ReadOptions(positions=photographs / "positions.csv")
        surveys.append(read_survey(model, positions))
        assert len(surveys[-1].geometry.points) > 2000
    return surveys[0], surveys[1], truth


def errors(registration: Any, reference_from_moving: np.ndarray, place: np.ndarray) -> np.ndarray:
    """East, north, up [m] at an absolute place of the moving survey."""
    error: np.ndarray = (registration.transform.matrix - reference_from_moving) @ [*place, 1.0]
    return error[:3]


def test_reconstructed_photographs_register_both_ways(
    pair: tuple[Survey, Survey, dict[str, Any]],
) -> None:
    """The clouds are sparse, so review will do; a wrong answer will not."""
    reference, moving, truth = pair
    there = np.array(truth["reference_from_moving"])
    centroid = np.array(truth["centroid"])
    assert np.hypot(*truth["offset"][:2]) > 2.0  # metres, and there is something to find
    for first, second, true, place in (
        (reference, moving, there, centroid),
        (moving, reference, np.linalg.inv(there), centroid + truth["offset"]),
    ):
        registration = register_pair(first, second)
        assert registration.verdict in ("accepted", "review"), registration.reason
        east, north, up = errors(registration, true, place)
        cell = registration.settings["raster"]["dem_cell"]
        assert cell <= 0.5
        assert np.hypot(east, north) < 2.0 * cell, registration.reason
        assert abs(up) < 0.1


def test_half_a_turn_is_not_accepted(pair: tuple[Survey, Survey, dict[str, Any]]) -> None:
    """The same ground turned by 180 degrees is no ground that a shift could lay down."""
    reference, moving, _ = pair
    cloud = moving.geometry
    assert isinstance(cloud, PointCloud)
    middle = np.median(cloud.points, axis=0)
    turned = PointCloud(middle + (cloud.points - middle) * [-1, -1, 1], cloud.colors)
    registration = register_pair(reference, dataclasses.replace(moving, geometry=turned))
    assert registration.verdict != "accepted", registration.reason
