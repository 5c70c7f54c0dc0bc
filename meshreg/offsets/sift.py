"""III-B: match SIFT features of the two mosaics; the offset that most matches share.

Paper: each feature's nearest neighbour in descriptor space (kd-tree) is a match, each match a
pair of world coordinates, and RANSAC draws n = 10 pairs, takes their mean offset and counts the
inliers within 0.20 m, ``k = log(1 - p) / log(1 - w^n)`` times (4,714 for p = 0.99, w = 0.5).
A translation needs only one match, so the robust preset lets every match vote instead: exact,
repeatable, and tested against what unrelated matches would show by chance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshreg.offsets import correlate
from meshreg.offsets.channels import grey, local_normalised
from meshreg.offsets.error_bars import BLOCK, FLOOR, MOST, Blocks, error_bar, ground_of
from meshreg.records import Bool, Float64, SurveyRaster, UInt8
from meshreg.settings import Settings, SiftSettings

MARGIN = 96  # px: how far outside a tile's core features may still look


@dataclass(frozen=True)
class Consensus:
    """The offset that most matches share.

    Attributes
    ----------
    east, north : float
        Mean offset of the inliers [m].
    inliers : (M,) bool
    second : int
        Inliers of the best rival further than two radii away.
    false_alarms : float
        Expected number of equally good clusters among unrelated matches.
    """

    east: float
    north: float
    inliers: Bool
    second: int
    false_alarms: float


def match(
    reference: SurveyRaster, moving: SurveyRaster, settings: Settings, radius: float
) -> tuple[Consensus | None, Mapping[str, Any]]:
    """Find features in both mosaics, match them and find the consensus within `radius` metres."""
    options = settings.sift
    robust = options.exhaustive_vote
    with ThreadPoolExecutor(correlate.WORKERS) as both:
        found = both.map(lambda raster: features(raster, options, robust), (reference, moving))
        (points1, descriptors1), (points2, descriptors2) = found
    pairs = nearest(descriptors2, descriptors1, options.ratio, settings.seed)
    a, b = points1[pairs[:, 1]], points2[pairs[:, 0]]
    offsets = a - b
    if robust:
        near = (np.abs(offsets) <= radius).all(axis=1)
        a, b, offsets = a[near], b[near], offsets[near]
        consensus = vote(offsets, options.inlier_radius, radius)
    else:
        rng = np.random.default_rng(settings.seed)
        consensus = ransac(offsets, options, rng)
    inliers = consensus.inliers if consensus else np.zeros(len(a), bool)
    evidence = {
        "reference_points": a,
        "moving_points": b,
        "inliers": inliers,
        "features": (len(points1), len(points2)),
    }
    return consensus, evidence


def features(raster: SurveyRaster, options: SiftSettings, equalise: bool) -> tuple[Float64, Any]:
    """SIFT keypoints as absolute (east, north) [m], and their (M, 128) float32 descriptors."""
    import cv2

    mask = raster.color_valid
    if not mask.any():
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    image = _eight_bit(grey(raster), mask, equalise)
    inside = cv2.erode(mask.astype(np.uint8), np.ones((9, 9), np.uint8), borderValue=0)
    share = options.max_features * options.tile**2 / max(int(mask.sum()), options.tile**2)
    sift = cv2.SIFT_create(  # type: ignore[attr-defined]
        nfeatures=max(int(share), 500)
    )
    rows_cols, descriptors, strength = [], [], []
    height, width = image.shape
    for top in range(0, height, options.tile):
        for left in range(0, width, options.tile):
            y0, x0 = max(top - MARGIN, 0), max(left - MARGIN, 0)
            y1, x1 = (
                min(top + options.tile + MARGIN, height),
                min(left + options.tile + MARGIN, width),
            )
            core = np.zeros((y1 - y0, x1 - x0), np.uint8)
            core[top - y0 : top - y0 + options.tile, left - x0 : left - x0 + options.tile] = 1
            core &= inside[y0:y1, x0:x1]
            if not core.any():
                continue
            keys, found = sift.detectAndCompute(image[y0:y1, x0:x1], core)
            if found is None:
                continue
            rows_cols.append(np.array([(k.pt[1] + y0, k.pt[0] + x0) for k in keys]))
            strength.append(np.array([k.response for k in keys]))
            descriptors.append(found)
    if not rows_cols:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    place, described = np.concatenate(rows_cols), np.concatenate(descriptors)
    order = np.argsort(-np.concatenate(strength), kind="stable")[: options.max_features]
    east, north = raster.grid.east_north(place[order, 0], place[order, 1])
    return np.stack([east, north], axis=1), described[order]


def _eight_bit(image: Float64, mask: Bool, equalise: bool) -> UInt8:
    if equalise:
        image = 127.5 + 40 * local_normalised(image.astype(np.float32), mask, 16.0)
    fill = float(np.median(image[mask]))
    return np.clip(np.rint(np.where(mask, image, fill)), 0, 255).astype(np.uint8)


def nearest(query: Any, train: Any, ratio: float, seed: int) -> Any:
    """(M, 2) int: each query's nearest neighbour, by FLANN's kd-tree, seeded for repeatability.

    With `ratio` under 1, a match must be that much nearer than the second best (Lowe 2004, 7.1).
    """
    import cv2

    if len(query) < 2 or len(train) < 2:
        return np.zeros((0, 2), np.int64)
    cv2.setRNGSeed(seed)
    index = cv2.flann.Index(train, {"algorithm": 1, "trees": 4})

    def found(part: Any) -> Any:
        return index.knnSearch(part, 2, params={"checks": 64})

    with ThreadPoolExecutor(correlate.WORKERS) as both:
        halves = list(both.map(found, np.array_split(query, 2)))
    neighbour, squared = (np.concatenate(parts) for parts in zip(*halves, strict=True))
    kept = np.flatnonzero((squared[:, 0] < ratio**2 * squared[:, 1]) | (ratio >= 1))
    return np.stack([kept, neighbour[kept, 0]], axis=1).astype(np.int64)


def draws(options: SiftSettings) -> int:
    """RANSAC's number of draws, ``k = log(1 - p) / log(1 - w^n)``, rounded up (III-B)."""
    clean = options.inlier_share**options.sample
    return math.ceil(math.log(1 - options.confidence) / math.log(1 - clean))


def ransac(offsets: Float64, options: SiftSettings, rng: np.random.Generator) -> Consensus | None:
    """III-B as published: means of ten random matches, the one with most inliers wins."""
    n_matches = len(offsets)
    if n_matches < options.sample:
        return None
    best, best_inliers = -1, np.zeros(n_matches, bool)
    for _ in range(draws(options)):
        drawn = rng.choice(n_matches, options.sample, replace=False)
        centre = offsets[drawn].mean(axis=0)
        inliers = ((offsets - centre) ** 2).sum(axis=1) <= options.inlier_radius**2
        if inliers.sum() > best:
            best, best_inliers = int(inliers.sum()), inliers
    if best < 1:
        return None
    return _consensus(
        offsets, best_inliers, options.inlier_radius, np.ptp(offsets, axis=0).max() / 2
    )


def vote(offsets: Float64, inlier_radius: float, search_radius: float) -> Consensus | None:
    """Every match's offset is a candidate; the one with most matches within the radius wins."""
    from scipy.spatial import cKDTree

    if len(offsets) < 3:
        return None
    tree = cKDTree(offsets)
    votes = tree.query_ball_point(offsets, inlier_radius, return_length=True)
    centre = offsets[int(np.argmax(votes))]
    inliers = np.zeros(len(offsets), bool)
    for _ in range(10):  # mean shift, to the cluster's own centre
        inliers = ((offsets - centre) ** 2).sum(axis=1) <= inlier_radius**2
        moved = offsets[inliers].mean(axis=0)
        if np.allclose(moved, centre, atol=1e-9):
            break
        centre = moved
    return _consensus(offsets, inliers, inlier_radius, search_radius)


def _consensus(
    offsets: Float64, inliers: Bool, inlier_radius: float, search_radius: float
) -> Consensus:
    """A-contrario test: how many such clusters would unrelated matches make (Moisan, Stival 2004).

    ``NFA = M P(Bin(M - 1, p0) >= k - 1)`` with p0 the chance of one unrelated match falling within
    the radius. Keypoints stand in lattices, so p0 is at least what the matches outside the
    cluster show among themselves.
    """
    from scipy.spatial import cKDTree
    from scipy.special import bdtrc  # the binomial's tail; all of scipy.stats takes long to import

    count, total = int(inliers.sum()), len(offsets)
    centre = offsets[inliers].mean(axis=0)
    outside = offsets[((offsets - centre) ** 2).sum(axis=1) > (2 * inlier_radius) ** 2]
    uniform = math.pi * inlier_radius**2 / (4 * max(search_radius, inlier_radius) ** 2)
    p0, second = min(uniform, 1.0), 0
    if len(outside) > 2:
        votes = cKDTree(outside).query_ball_point(outside, inlier_radius, return_length=True)
        second = int(votes.max())
        p0 = max(p0, float(np.mean(votes - 1)) / max(len(outside) - 1, 1))
    false_alarms = total * float(bdtrc(count - 2, total - 1, min(p0, 1.0)))
    return Consensus(float(centre[0]), float(centre[1]), inliers, second, false_alarms)


def spread(
    reference: SurveyRaster,
    moving: SurveyRaster,
    consensus: Consensus,
    evidence: Mapping[str, Any],
    inlier_radius: float,
) -> Float64:
    """(2, 2) mean square error [m²] of the consensus, as its blocks tell it (`error_bars`).

    A block's own offset is the median of its matches within 2.5 inlier radii of the consensus:
    the inliers alone would not tell how far a block lies beyond their radius.
    """
    at = (consensus.east, consensus.north)
    least = max(0.001, FLOOR * moving.grid.cell)  # m: a survey matched to itself
    places = evidence["moving_points"]
    offsets = evidence["reference_points"] - places
    near = consensus.inliers | (np.hypot(*(offsets - at).T) <= 2.5 * inlier_radius)
    extent = max(float(np.ptp(places[near], axis=0).max()), 0.1)
    side = float(np.clip(BLOCK, extent / MOST, extent / 4))
    _, block = np.unique(np.floor(places / side).astype(int), axis=0, return_inverse=True)
    block = block.reshape(-1)
    centres, own, slopes = [], [], []
    for number in np.unique(block[near]):
        mine = near & (block == number)
        agreed = offsets[mine & consensus.inliers]
        centres.append(places[mine].mean(axis=0))
        own.append(np.median(offsets[mine], axis=0))
        slopes.append((agreed - at).sum(axis=0))
    count = int(consensus.inliers.sum())
    blocks = Blocks(np.array(centres), np.array(own), np.array(slopes), -count * np.eye(2))
    masks, grids = (reference.color_valid, moving.color_valid), (reference.grid, moving.grid)
    ground = ground_of(masks, grids, at)
    sigma = None if ground is None else error_bar(at, blocks, ground, least)
    return np.eye(2) * inlier_radius**2 if sigma is None else sigma
