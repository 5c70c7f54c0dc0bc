#!/usr/bin/env python3
"""Are the error bars true on real surveys? Many dates of one place, registered all with all.

    scripts/closures.py FOLDER [FOLDER ...] [--json FILE] [--pairs 3] [--shifts 6] [--seed 0]

    scripts/closures.py ../shared/data/beach ../shared/data/beach_dates

A date is NAME_dsm.tif (or _dem.tif) with NAME_ortho.tif beside it, or a point cloud or mesh NAME.*
where NAME has no such map. All dates must lie in one CRS, each pair within the search radius.

What is registered from A to B, from B to C and from C to A must close, whatever the truth. All
pairs are adjusted as one network by weighted least squares (one position for each date), with the
covariances that the registrations state: the sum of the weighted squares of what is left, over the
degrees of freedom (observations less unknowns), is 1 where these are true. It must lie under the
upper 95 % bound of chi-square, and not under 0.3; so for east and north together, and for up. Each
pair has another known shift put into its moving survey. Some pairs are then registered with shifts
of parts of a cell and whole cells: their scatter about their mean must not exceed what is stated
(chi-square over its degrees of freedom at most 1.2). East and north are compared at the middle of
all overlaps; up too where a tilt was applied, else at the middle of the pair's own overlap.

What all pairs of a date err by alike closes, and is not seen.

Exit code 0 where all bounds hold, 1 where one does not, 2 where there are too few dates.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

MAP_ENDS = ("_dsm", "_dem")
OTHERS = (".laz", ".las", ".ply", ".obj", ".glb", ".xyz")
LEAST, REPEATED = 0.3, 1.2  # chi-square over its degrees of freedom
CLOSURE = 0.10  # cells, median over all triples
# Cells, east and north: parts of one, whole ones, both
SHIFTS = ((0.0, 0.0), (0.5, 0.5), (0.25, -0.35), (-0.7, 0.15), (2.0, -1.0), (-3.4, 2.6), (0.9, 0.1))


def dates_in(folders: list[Path]) -> dict[str, str]:
    """What to read of each date, by its name, in the order of the names."""
    found: dict[str, str] = {}
    for folder in folders:
        for end in MAP_ENDS:
            for dem in sorted(folder.glob(f"*{end}.tif")):
                name = dem.stem.removesuffix(end)
                ortho = dem.with_name(f"{name}_ortho.tif")
                found.setdefault(name, f"{dem},{ortho}" if ortho.exists() else str(dem))
        for file in sorted(folder.iterdir()):
            known = any(file.stem.startswith(name) for name in found)
            if file.suffix.lower() in OTHERS and not known:
                found[file.stem] = str(file)
    return dict(sorted(found.items()))


def shifted(survey: Any, shift: Any) -> Any:
    """Move a survey by (east, north, 0) [m]."""
    import numpy as np

    from meshreg.apply import apply_transform
    from meshreg.records import Maps, Transform

    geometry = survey.geometry
    if not isinstance(geometry, Maps):
        return apply_transform(survey, Transform(np.eye(3), 1.0, shift, survey.centre))

    def there(grid: Any) -> Any:
        west, north = grid.west + float(shift[0]), grid.north + float(shift[1])
        return replace(grid, west=west, north=north)

    colors = None if geometry.color_grid is None else there(geometry.color_grid)
    moved = replace(geometry, height_grid=there(geometry.height_grid), color_grid=colors)
    return replace(survey, geometry=moved)


def registered(reference: Any, moving: Any, shift: Any) -> dict[str, Any]:
    """Register with a shift [m] put into the moving survey; the answer is without it."""
    import numpy as np

    from meshreg import register_pair

    shift = np.append(shift, 0.0)
    result = register_pair(reference, shifted(moving, shift))
    return {"result": result, "shift": shift, "cell": result.settings["raster"]["dem_cell"]}


def offset_at(found: dict[str, Any], place: Any) -> tuple[Any, Any]:
    """Offset (3,) [m] at a place of the reference, and its covariance (3, 3)."""
    import numpy as np

    from meshreg.statistics import lever

    result, up = found["result"], np.array(found["result"].registration_error["at"])
    transform, covariance = result.transform, result.covariance
    home = transform.pivot + transform.offset
    offset = place - transform.inverse().apply(place) + found["shift"]
    carry = lever(place - home)
    stated = (carry @ covariance @ carry.T)[:3, :3]
    if transform.rotation[2, 2] == 1.0:
        carry = lever(up - home)
        variance = (carry @ covariance @ carry.T)[2, 2]
        stated[2, :2] = stated[:2, 2] = 0.0
        stated[2, 2] = variance
    return offset, stated


def adjusted(pairs: dict[tuple[int, int], tuple[Any, Any]], axes: list[int]) -> dict[str, float]:
    """Weighted least squares of one position for each date: chi-square and degrees of freedom."""
    import numpy as np
    from scipy.stats import chi2

    dates = 1 + max(max(pair) for pair in pairs)
    size = len(axes)
    rows, values = [], []
    for (first, second), (offset, covariance) in pairs.items():
        design = np.zeros((size, dates, size))
        design[:, first] -= np.eye(size)
        design[:, second] += np.eye(size)
        root = np.linalg.inv(np.linalg.cholesky(covariance[np.ix_(axes, axes)]))
        rows.append(root @ design.reshape(size, -1))
        values.append(root @ offset[axes])
    design, value = np.concatenate(rows), np.concatenate(values)
    position, _, rank, _ = np.linalg.lstsq(design, value, rcond=None)
    freedom = len(value) - int(rank)
    total = float(((value - design @ position) ** 2).sum())
    upper = float(chi2.ppf(0.95, freedom)) / freedom if freedom else float("nan")
    ratio = total / freedom if freedom else float("nan")
    return {"ratio": ratio, "freedom": freedom, "lower": LEAST, "upper": upper}


def scattered(answers: list[tuple[Any, Any]]) -> tuple[float, int]:
    """Chi-square of one pair's answers, east and north, about their mean, and its freedom."""
    import numpy as np

    values = np.array([offset[:2] for offset, _ in answers])
    away = values - values.mean(axis=0)
    total = sum(
        float(d @ np.linalg.solve(c[:2, :2], d)) for d, (_, c) in zip(away, answers, strict=True)
    )
    return total, 2 * (len(values) - 1)


def main() -> int:
    asked = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    asked.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    asked.add_argument("--json", type=Path, help="write what was found there too")
    asked.add_argument("--pairs", type=int, default=3, help="registered with several shifts")
    asked.add_argument("--shifts", type=int, default=6, help=f"of each, up to {len(SHIFTS)}")
    asked.add_argument("--seed", type=int, default=0, help="of the shifts of all pairs")
    said = asked.parse_args()

    import numpy as np

    from meshreg import read_survey

    dates = dates_in(said.folders)
    if len(dates) < 3:
        print(f"{len(dates)} dates in {', '.join(map(str, said.folders))}: three are needed")
        return 2
    names = list(dates)
    surveys = [read_survey(path) for path in dates.values()]
    pairs = list(itertools.combinations(range(len(names)), 2))
    draw = np.random.default_rng(said.seed)
    found = {}
    for first, second in pairs:
        shift = np.round(draw.uniform(-3, 3, 2), 2)
        one = registered(surveys[first], surveys[second], shift)
        verdict = one["result"].verdict
        print(f"{names[first]} {names[second]}: {verdict}", file=sys.stderr, flush=True)
        if verdict == "accepted" and one["result"].registration_error is not None:
            found[first, second] = one
    if not found:
        print("no pair was accepted")
        return 1
    place = np.mean([one["result"].registration_error["at"] for one in found.values()], axis=0)
    cell = float(np.median([one["cell"] for one in found.values()]))
    stated = {pair: offset_at(one, place) for pair, one in found.items()}
    record: dict[str, Any] = {"dates": names, "accepted": len(found), "cell": cell, "pairs": []}
    print("| pair | east | north | up | sigma east | sigma north | sigma up |")
    print("|---|---|---|---|---|---|---|")
    for (first, second), (offset, covariance) in stated.items():
        sigma = np.sqrt(np.diag(covariance))
        name = f"{names[first]} {names[second]}"
        print(f"| {name} | {' | '.join(f'{v:.3f}' for v in [*offset, *sigma])} |")
        row = {"pair": name, "offset": offset.tolist(), "covariance": covariance.tolist()}
        record["pairs"].append(row)
    triples = [
        stated[a, b][0] + stated[b, c][0] - stated[a, c][0]
        for a, b, c in itertools.combinations(range(len(names)), 3)
        if {(a, b), (b, c), (a, c)} <= stated.keys()
    ]
    print()
    print(f"{len(names)} dates, {len(pairs)} pairs, {len(found)} accepted; cells of {cell:g} m")
    held = []
    if triples:
        median = float(np.median(np.hypot(*np.array(triples)[:, :2].T)))
        record["closure"] = {"triples": len(triples), "median": median}
        held.append(median <= CLOSURE * cell)
        print(f"{len(triples)} triples close within {median:.3f} m (median; {CLOSURE * cell:g} m)")
    for name, axes in (("horizontal", [0, 1]), ("up", [2])):
        network = adjusted(stated, axes)
        record[name] = network
        held.append(network["lower"] <= network["ratio"] <= network["upper"])
        print(
            f"{name}: chi-square {network['ratio']:.2f} per degree of freedom, {network['freedom']}"
            f" of them; bounds {network['lower']:g} and {network['upper']:.2f}"
        )
    total, freedom = 0.0, 0
    for first, second in list(found)[:: max(1, len(found) // max(said.pairs, 1))][: said.pairs]:
        answers = []
        for shift in SHIFTS[: said.shifts]:
            one = registered(surveys[first], surveys[second], cell * np.array(shift))
            if one["result"].registration_error is not None:
                answers.append(offset_at(one, place))
        chi, more = scattered(answers)
        spread = np.std([offset[:2] for offset, _ in answers], axis=0)
        print(
            f"{names[first]} {names[second]}, {len(answers)} shifts: scatter {spread[0]:.3f} and "
            f"{spread[1]:.3f} m, chi-square {chi / max(more, 1):.2f} per degree of freedom"
        )
        total, freedom = total + chi, freedom + more
    if freedom:
        ratio = total / freedom
        record["shifts"] = {"ratio": ratio, "freedom": freedom, "upper": REPEATED}
        held.append(ratio <= REPEATED)
        print(f"other shifts: chi-square {ratio:.2f} of {freedom}; at most {REPEATED:g}")
    record["held"] = bool(all(held))
    if said.json is not None:
        said.json.write_text(json.dumps(record, indent=1) + "\n")
    print("all bounds hold" if record["held"] else "a bound does not hold")
    return 0 if record["held"] else 1


if __name__ == "__main__":
    sys.exit(main())
