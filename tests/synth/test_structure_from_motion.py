"""Real structure from motion on rendered photographs, placed by noisy navigation alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from data_synth.make import write_pair
from data_synth.recipe import load
from meshreg.io import read_survey
from meshreg.io.options import ReadOptions
from meshreg.pipeline import register_pair

pycolmap = pytest.importorskip("pycolmap")


def reconstruct(photographs: Path, work: Path) -> Path:
    """Reconstruct one epoch on the CPU; return the folder of its only model."""
    work.mkdir()
    camera = pycolmap.ImageReaderOptions(camera_model="SIMPLE_PINHOLE", camera_params="690,400,300")
    features = pycolmap.FeatureExtractionOptions()
    features.use_gpu, features.num_threads = False, 2
    features.sift.max_num_features, features.sift.peak_threshold = 4000, 0.003
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu, matching.num_threads = False, 2
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads, mapping.ba_refine_focal_length = 2, False
    database = work / "database.db"
    pycolmap.extract_features(
        database,
        photographs,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=camera,
        extraction_options=features,
        device=pycolmap.Device.cpu,
    )
    pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
    models = pycolmap.incremental_mapping(database, photographs, work / "sparse", mapping)
    assert len(models) == 1
    assert models[0].num_reg_images() == len(list(photographs.glob("*.jpg")))
    return work / "sparse" / "0"


def test_reconstructed_photographs_register(tmp_path):
    """20 images an epoch; the clouds are sparse, so review will do, a wrong answer will not."""
    recipe = load("severity_03", {"sfm.follows_offset": 0.0})
    write_pair(recipe, tmp_path / "pair", 1, 6.0, "images")
    truth = json.loads((tmp_path / "pair" / "truth.json").read_text())
    surveys = []
    for name in ("reference", "moving"):
        photographs = tmp_path / "pair" / name
        model = reconstruct(photographs, tmp_path / name)
        positions = ReadOptions(positions=photographs / "positions.csv")
        surveys.append(read_survey(model, positions))
        assert len(surveys[-1].geometry.points) > 2000
    registration = register_pair(*surveys)
    assert registration.verdict in ("accepted", "review"), registration.reason
    centroid = np.array([*truth["centroid"], 1.0])
    want = np.array(truth["reference_from_moving"]) @ centroid
    error = registration.transform.matrix @ centroid - want
    cell = registration.settings["raster"]["dem_cell"]
    assert np.hypot(*error[:2]) < 2.0 * cell, registration.reason
    assert abs(error[2]) < 0.3
