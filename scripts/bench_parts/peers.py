"""Peers on the benchmark's pairs: who finds an offset of up to 5 m, 12 hours to 24 months later.

Every tool gets the same pairs: DEMs of 0.10 m and orthomosaics of 0.05 m, as delivered, or the
points that the DEMs' cells mean. (meshreg's features see the mosaic of 0.025 m too.) Each is used
as its own documentation or examples say, with lengths in proportion to the cell, and is not told
the search range. Success is an error below 0.25 m at the overlap's centroid.
"""

from __future__ import annotations

import pickle
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import measure
import numpy as np

PAIRS = 30  # two of each ground and interval, six of them flat sand
SUCCESS = 0.25  # m
THREADS = 2
KISS_VOXEL, FPFH_VOXEL = 0.2, 0.3  # m; of 0.1 to 0.4 what each did best with on nine of the pairs


@dataclass(frozen=True)
class Pair:
    """Rasters as delivered, and the true offset (2,) [m] at a place (2,) of the moving survey."""

    name: str
    flat: bool
    rasters: dict[str, tuple[Any, Any]]  # "dem", "ortho", "sift" to (reference, moving)
    settings: Any
    centroid: np.ndarray
    offset: np.ndarray


# ---- what the tools get -------------------------------------------------------------------------


def origin_of(pair: Pair) -> np.ndarray:
    """A point near both surveys [m], so that 32-bit tools lose nothing."""
    dem = pair.rasters["dem"][0]
    return np.array([np.floor(dem.grid.west), np.floor(dem.grid.north), dem.datum])


def clouds(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    """One point for each cell of the DEMs, from `origin_of` (N, 3) [m]."""
    found = []
    for dem in pair.rasters["dem"]:
        east, north = dem.grid.east_north(*np.nonzero(dem.valid))
        points = np.column_stack([east, north, dem.height[dem.valid].astype(float) + dem.datum])
        found.append(points - origin_of(pair))
    return found[0], found[1]


def on_one_lattice(
    pair: Pair, name: str
) -> tuple[list[np.ndarray], list[np.ndarray], tuple[float, float, float]]:
    """Both images and masks on the lattice that holds both; (west, north, cell) of it.

    The grids differ by whole cells, so nothing is interpolated. Heights where `name` is "dem",
    else grey values; cells without a value hold the median.
    """
    both = pair.rasters[name]
    cell = both[0].grid.cell
    west = min(r.grid.west for r in both)
    north = max(r.grid.north for r in both)
    places = [
        (round((north - r.grid.north) / cell), round((r.grid.west - west) / cell)) for r in both
    ]
    shape = tuple(
        max(place[k] + r.grid.shape[k] for place, r in zip(places, both, strict=True))
        for k in (0, 1)
    )
    images, masks = [], []
    for (row, col), raster in zip(places, both, strict=True):
        valid = raster.valid if name == "dem" else raster.color_valid
        if name == "dem":
            values = raster.height.astype(float) + (raster.datum - both[0].datum)
        else:
            values = grey(raster)
        image, mask = np.full(shape, np.median(values[valid])), np.zeros(shape, bool)
        part = slice(row, row + valid.shape[0]), slice(col, col + valid.shape[1])
        image[part], mask[part] = np.where(valid, values, np.median(values[valid])), valid
        images.append(image)
        masks.append(mask)
    return images, masks, (west, north, cell)


def grey(raster: Any) -> np.ndarray:
    found: np.ndarray = raster.color @ np.array([0.299, 0.587, 0.114])
    return found


def shifted(east: float, north: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:2, 3] = east, north
    return matrix


def absolute(matrix: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """A matrix between coordinates from `origin`, as one between absolute ones."""
    there, back = np.eye(4), np.eye(4)
    there[:3, 3], back[:3, 3] = origin, -origin
    return there @ matrix @ back


# ---- the tools: a pair to `reference_from_moving` (4, 4) ----------------------------------------


def meshreg_robust(pair: Pair) -> tuple[np.ndarray | None, str]:
    """The fused answer at the overlap's centroid, with its verdict."""
    from meshreg.benchmark.measure import of_decision, register_rasters

    decision = register_rasters(pair.rasters, pair.settings)
    truth = {"centroid": [*pair.centroid, 0.0], "offset": [*pair.offset, 0.0]}
    fused = of_decision(decision, "robust", truth, None)[-1]
    if "east" not in fused:
        return None, fused["verdict"]
    return shifted(fused["east"], fused["north"]), fused["verdict"]


def masked_correlation(name: str) -> Callable[[Pair], np.ndarray]:
    """scikit-image, "Masked normalized cross-correlation": both masks given, overlap as it is."""

    def run(pair: Pair) -> np.ndarray:
        from skimage.registration import phase_cross_correlation

        images, masks, (_, _, cell) = on_one_lattice(pair, name)
        shift, _, _ = phase_cross_correlation(
            *images, reference_mask=masks[0], moving_mask=masks[1]
        )
        return shifted(shift[1] * cell, -shift[0] * cell)

    return run


def kiss_matcher(pair: Pair) -> np.ndarray:
    """As its Python example: one resolution, everything else follows from it."""
    import kiss_matcher as kiss

    reference, moving = (cloud.astype(np.float32) for cloud in clouds(pair))
    matcher = kiss.KISSMatcher(kiss.KISSMatcherConfig(KISS_VOXEL))
    found = matcher.estimate(moving, reference)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.array(found.rotation), np.array(found.translation).ravel()
    return absolute(matrix, origin_of(pair))


def open3d_global(pair: Pair) -> np.ndarray:
    """Its "Global registration" tutorial, radii and thresholds in the same ratio to the voxel."""
    from meshreg.refine.open3d_loading import load_open3d

    open3d = load_open3d()
    registration = open3d.pipelines.registration
    near = open3d.geometry.KDTreeSearchParamHybrid
    open3d.utility.random.seed(0)
    whole, sparse, features = [], [], []
    for points in clouds(pair):
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        cloud.estimate_normals(near(radius=2 * FPFH_VOXEL, max_nn=30))
        down = cloud.voxel_down_sample(FPFH_VOXEL)
        down.estimate_normals(near(radius=2 * FPFH_VOXEL, max_nn=30))
        for one in (cloud, down):  # a seafloor's normals point up
            one.orient_normals_to_align_with_direction([0.0, 0.0, 1.0])
        whole.append(cloud)
        sparse.append(down)
        features.append(
            registration.compute_fpfh_feature(down, near(radius=5 * FPFH_VOXEL, max_nn=100))
        )
    coarse = registration.registration_ransac_based_on_feature_matching(
        sparse[1],
        sparse[0],
        features[1],
        features[0],
        True,
        1.5 * FPFH_VOXEL,
        registration.TransformationEstimationPointToPoint(False),
        3,
        [
            registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            registration.CorrespondenceCheckerBasedOnDistance(1.5 * FPFH_VOXEL),
        ],
        registration.RANSACConvergenceCriteria(100_000, 0.999),
    )
    fine = registration.registration_icp(
        whole[1],
        whole[0],
        0.4 * FPFH_VOXEL,
        coarse.transformation,
        registration.TransformationEstimationPointToPlane(),
    )
    return absolute(np.array(fine.transformation), origin_of(pair))


def simple_itk(pair: Pair) -> np.ndarray:
    """Its examples' Mattes mutual information in three resolutions, from its own initializer.

    Lengths in cells: its step lengths are meant for spacings of about one.
    """
    import SimpleITK as sitk  # noqa: N813

    both, images, masks = pair.rasters["ortho"], [], []
    for raster in both:
        for stack, array in (
            (images, grey(raster).astype(np.float32)),
            (masks, raster.color_valid),
        ):
            rows_to_north = array[::-1].astype(np.uint8 if array.dtype == bool else np.float32)
            stack.append(sitk.GetImageFromArray(rows_to_north))
    rigid = sitk.CenteredTransformInitializer(
        *images, sitk.Euler2DTransform(), sitk.CenteredTransformInitializerFilter.GEOMETRY
    )
    method = sitk.ImageRegistrationMethod()
    method.SetGlobalDefaultNumberOfThreads(THREADS)
    method.SetMetricAsMattesMutualInformation(50)
    method.SetMetricFixedMask(masks[0])
    method.SetMetricMovingMask(masks[1])
    method.SetInterpolator(sitk.sitkLinear)
    method.SetOptimizerAsRegularStepGradientDescent(4.0, 0.001, 200)
    method.SetOptimizerScalesFromPhysicalShift()
    method.SetShrinkFactorsPerLevel([4, 2, 1])
    method.SetSmoothingSigmasPerLevel([2, 1, 0])
    method.SetInitialTransform(rigid)
    rigid = method.Execute(*images)  # takes the reference's points to the moving survey's
    columns = [rigid.TransformPoint(p) for p in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))]
    moving_from_reference = np.eye(4)
    moving_from_reference[:2, 3] = columns[0]
    moving_from_reference[:2, :2] = np.subtract(columns[1:], columns[0]).T
    to_cells = [cells_of(raster) for raster in both]
    return np.linalg.inv(to_cells[0]) @ np.linalg.inv(moving_from_reference) @ to_cells[1]


def cells_of(raster: Any) -> np.ndarray:
    """Absolute coordinates to those of an image whose first pixel is the south-west cell."""
    grid = raster.grid
    west, south = grid.east_north(np.array([grid.shape[0] - 1]), np.array([0]))
    matrix = np.diag([1 / grid.cell, 1 / grid.cell, 1.0, 1.0])
    matrix[:2, 3] = -west[0] / grid.cell, -south[0] / grid.cell
    return matrix


def nuth_kaab(pair: Pair) -> np.ndarray:
    """xdem's, as it comes, from where the navigation puts the moving DEM."""
    import rasterio.transform
    import xdem

    dems = []
    for raster in pair.rasters["dem"]:
        grid = raster.grid
        place = rasterio.transform.from_origin(grid.west, grid.north, grid.cell, grid.cell)
        values = raster.height + np.float32(raster.datum - pair.rasters["dem"][0].datum)
        dems.append(xdem.DEM.from_array(values, place, crs=32755, nodata=-9999))
    method = xdem.coreg.NuthKaab()
    method.fit(*dems, random_state=0)
    east, north, _ = method.to_translations()
    return shifted(float(east), float(north))


def small_gicp(pair: Pair) -> np.ndarray:
    """Its GICP from where the navigation puts the moving cloud, downsampled to the cell."""
    import small_gicp as gicp

    reference, moving = clouds(pair)
    cell = pair.rasters["dem"][0].grid.cell
    found = gicp.align(reference, moving, downsampling_resolution=cell, num_threads=THREADS)
    return absolute(np.array(found.T_target_source), origin_of(pair))


TOOLS: dict[str, tuple[str, Callable[[Pair], Any]]] = {
    "meshreg, robust, fused": ("DEM, mosaic", meshreg_robust),
    "scikit-image masked correlation, DEM": ("DEM", masked_correlation("dem")),
    "scikit-image masked correlation, mosaic": ("mosaic", masked_correlation("ortho")),
    "KISS-Matcher": ("points", kiss_matcher),
    "Open3D FPFH + RANSAC + ICP": ("points", open3d_global),
    "SimpleITK mutual information": ("mosaic", simple_itk),
    "xdem Nuth-Kääb": ("DEM", nuth_kaab),
    "small_gicp": ("points", small_gicp),
}
PACKAGES = {
    "scikit-image masked correlation, DEM": "skimage",
    "scikit-image masked correlation, mosaic": "skimage",
    "KISS-Matcher": "kiss_matcher",
    "SimpleITK mutual information": "SimpleITK",
    "xdem Nuth-Kääb": "xdem",
    "small_gicp": "small_gicp",
}


# ---- the runs, each in a process of its own -----------------------------------------------------


def make_pairs(path: str, count: int) -> dict[str, Any]:
    """Draw pairs as the benchmark does (its first ones), and keep them for the tools."""
    from meshreg.benchmark import plan, rasters

    repeats = -(-count // len(plan.CROSSING))
    jobs, _ = plan.jobs(plan.Options(repeats=repeats, elsewhere=0))
    pairs = []
    for job in [job for job in jobs if job.kind == "crossing"][:count]:
        made, about = rasters.make(job)
        made = {  # a dict of its own, which can be pickled
            name: tuple(replace(raster, masked={}) for raster in both)
            for name, both in made.items()
        }
        truth, settings = about.truth, plan.settings_of(job, "robust")
        place, offset = (np.array(truth[name][:2]) for name in ("centroid", "offset"))
        flat = plan.CROSSING[job.scenario][0] == plan.FLAT
        pairs.append(Pair(job.name, flat, made, settings, place, offset))
    Path(path).write_bytes(pickle.dumps(pairs))
    return {"pairs": len(pairs)}


def run_tool(path: str, tool: str) -> dict[str, Any]:
    """Every pair through one tool; the first one once more before, to import and compile."""
    import importlib
    import warnings

    from meshreg.refine.open3d_loading import load_open3d

    warnings.simplefilter("ignore")
    if tool in PACKAGES:
        importlib.import_module(PACKAGES[tool])  # raises here, where it is not an answer
    elif tool.startswith("Open3D"):
        load_open3d()
    pairs: list[Pair] = pickle.loads(Path(path).read_bytes())
    call = TOOLS[tool][1]
    one_by_one = [answer(call, pairs[0]), *(answer(call, pair) for pair in pairs)][1:]
    return {"answers": one_by_one}


def answer(call: Callable[[Pair], Any], pair: Pair) -> dict[str, Any]:
    began = time.perf_counter()
    verdict, raised, matrix = "", "", None
    try:
        found = call(pair)
        matrix, verdict = found if isinstance(found, tuple) else (found, "")
    except Exception as error:
        raised = f"{type(error).__name__}: {error}".splitlines()[0]
    seconds = time.perf_counter() - began
    error = None
    if matrix is not None and np.isfinite(matrix).all():
        place = np.array([*pair.centroid, 0.0, 1.0])
        error = float(np.hypot(*((matrix @ place - place)[:2] - pair.offset)))
    return {
        "name": pair.name,
        "flat": pair.flat,
        "error": error,
        "verdict": verdict,
        "raised": raised,
        "seconds": seconds,
    }


def row_of(tool: str, found: dict[str, Any]) -> dict[str, Any]:
    row: dict[str, Any] = {"tool": tool, "looks at": TOOLS[tool][0]}
    if "failed" in found:
        return row | {"failed": found["failed"]}
    answers = found["answers"]
    right = [a["error"] is not None and a["error"] < SUCCESS for a in answers]
    uneven = [ok for ok, a in zip(right, answers, strict=True) if not a["flat"]]
    errors = [np.inf if a["error"] is None else a["error"] for a in answers]
    row |= {
        "success": f"{sum(right)} of {len(right)}",
        "but flat sand": f"{sum(uneven)} of {len(uneven)}",
        "median error [m]": float(np.median(errors)),
        "seconds": float(np.median([a["seconds"] for a in answers])),
    }
    notes = []
    verdicts = [a["verdict"] for a in answers]
    if any(verdicts):
        wrong = sum(v == "accepted" and not ok for v, ok in zip(verdicts, right, strict=True))
        notes += [f"accepted {verdicts.count('accepted')}, of these wrong {wrong}"]
    raised = [a["raised"] for a in answers if a["raised"]]
    if len(raised) == len(answers):
        row["failed"] = "on every pair"
    if raised:
        notes += [f"raised {len(raised)} times: {raised[0]}"]
    return row | {"note": "; ".join(notes)}


def bench(count: int = PAIRS) -> list[dict[str, Any]]:
    """Return a row for each tool; one that is not installed, or dies, has "failed" in its row."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder, "pairs.pickle"))
        measure.apart("peers", "make_pairs", path, count)
        for tool in TOOLS:
            try:
                found = measure.apart("peers", "run_tool", path, tool)
            except RuntimeError as error:
                found = {"failed": str(error).strip().splitlines()[-1]}
            rows.append(row_of(tool, found))
    columns = (
        "tool",
        "looks at",
        "success",
        "but flat sand",
        "median error [m]",
        "seconds",
        "note",
    )
    return [{name: row.get(name) for name in columns} | row for row in rows]


if __name__ == "__main__":
    import sys

    for line in bench(int(sys.argv[1]) if len(sys.argv) > 1 else PAIRS):
        print(*line.values(), sep=" | ")
