"""Rates with their Clopper-Pearson bounds, out of the records of a run."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.benchmark.plan import CROSSING, FLAT, PAPER_SITES
from meshreg.io.files.atomic import atomic_file
from meshreg.settings import METHODS

Row = Mapping[str, Any]
COLUMNS = (
    "kind", "scenario", "ground", "interval", "severity", "index", "seed", "format", "preset",
    "method", "status", "east", "north", "true_east", "true_north", "yaw", "error", "error_hand",
    "error_up", "sigma_up", "covered_up", "success", "covered", "sigma", "distance2", "gap",
    "terrain_gap", "image_gap", "score", "matches", "inliers", "inlier_share", "seconds", "verdict",
    "false_alarm", "expected", "overlap", "warp_residual", "hand_residual", "reason", "places",
)  # fmt: skip
ANSWERS = (*METHODS, "fused")


def bounds(count: int, total: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return Clopper and Pearson's exact interval of a share (Biometrika 26, 1934).

    Parameters
    ----------
    count, total : int
        Successes, trials.
    confidence : float
    """
    from scipy.stats import beta

    if total == 0:
        return 0.0, 1.0
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if count == 0 else float(beta.ppf(tail, count, total - count + 1))
    high = 1.0 if count == total else float(beta.ppf(1.0 - tail, count + 1, total - count))
    return low, high


def rate(flags: Iterable[bool]) -> dict[str, Any]:
    """Return count, total, share and the 95 % bounds of the share."""
    values = [bool(flag) for flag in flags]
    count, total = sum(values), len(values)
    low, high = bounds(count, total)
    share = count / total if total else None
    return {"count": count, "total": total, "rate": share, "low": low, "high": high}


def flat_rows(records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row a pair and method, as `pairs.csv` has them."""
    rows = []
    for record in records:
        job, truth = record["job"], record.get("truth") or {}
        ground, interval = CROSSING.get(job["scenario"], ("", ""))
        true = truth.get("offset") or [None, None]
        hand = record.get("hand") or {}
        for row in record["rows"]:
            rows.append(
                {
                    "kind": job["kind"],
                    "scenario": job["scenario"],
                    "ground": ground,
                    "interval": interval,
                    "severity": truth.get("severity"),
                    "index": job["index"],
                    "seed": job["seed"],
                    "format": job["format"],
                    "true_east": true[0],
                    "true_north": true[1],
                    "overlap": truth.get("overlap"),
                    "warp_residual": truth.get("residual"),
                    "hand_residual": hand.get("residual"),
                    "expected": expected(record) if row["method"] == "fused" else None,
                    "places": " ".join(record.get("places", ())),
                    **row,
                }
            )
    return rows


def expected(record: Mapping[str, Any]) -> bool | None:
    """Whether a pair's verdict and error are what its recipe's [expect] allows; None: not asked.

    The error is asked of accepted pairs alone: a pair in review promises nothing. Pairs of the
    crossing redraw what the recipe fixes, so that they are held to the rates, not one by one.
    """
    if "expect" not in record or record["job"]["kind"] == "crossing":
        return None
    row = next((r for r in fused(record["rows"]) if r["preset"] == "robust"), None)
    if row is None:
        return False
    if row["verdict"] not in record["expect"]["verdicts"]:
        return False
    if row["verdict"] != "accepted":
        return True
    error = row.get("error")
    return error is not None and bool(error <= record["expect"]["max_error"])


def fused(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of the fused answers."""
    return [row for row in rows if row["method"] == "fused"]


def select(rows: Iterable[Row], **wanted: Any) -> list[Row]:
    """Return the rows whose columns have these values, or one of a tuple's."""
    return [
        row
        for row in rows
        if all(
            row.get(key) in value if isinstance(value, tuple) else row.get(key) == value
            for key, value in wanted.items()
        )
    ]


def successes(rows: Iterable[Row], by: Callable[[Row], Any]) -> dict[Any, dict[str, Any]]:
    """Return the rate of success of each group of rows."""
    groups: dict[Any, list[bool]] = {}
    for row in rows:
        if row.get("success") is not None:
            groups.setdefault(by(row), []).append(bool(row["success"]))
    return {name: rate(flags) for name, flags in groups.items()}


def verdicts(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Return the rates of each verdict among fused rows, and of accepted but wrong ones."""
    result = {
        verdict: rate(row["verdict"] == verdict for row in rows)
        for verdict in ("accepted", "review", "rejected")
    }
    result["accepted_but_wrong"] = rate(
        row["verdict"] == "accepted" and not row.get("success") for row in rows
    )
    return result


def coverage(rows: Iterable[Row], column: str = "covered") -> dict[str, Any]:
    """Return how often the stated 95 % region covers the truth ("covered_up": in height)."""
    return rate(row[column] for row in rows if row.get(column) is not None)


def error_summary(rows: Sequence[Row], column: str = "error") -> dict[str, Any]:
    """Return median, 95th percentile and largest error [m] of the pairs that have an answer."""
    errors = np.array([row[column] for row in rows if row.get(column) is not None], float)
    if not errors.size:
        return {"answers": 0, "pairs": len(rows), "median": None, "p95": None, "largest": None}
    return {
        "answers": int(errors.size),
        "pairs": len(rows),
        "median": float(np.median(errors)),
        "p95": float(np.percentile(errors, 95)),
        "largest": float(errors.max()),
    }


def table_one(records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return Table I: for each of the paper's sites the offset of truth, hand and each method."""
    lines = []
    for record in records:
        if record["job"]["kind"] != "table" or record.get("error"):
            continue
        true, hand = record["truth"]["offset"], record["hand"] or {}
        lines.append(
            {
                "site": record["job"]["scenario"],
                "truth": true,
                "truth_length": float(np.hypot(true[0], true[1])),
                "hand": [hand.get("east"), hand.get("north")],
                "hand_error": _distance(hand, true),
                "hand_residual": hand.get("residual"),
                "hand_residual_inliers": hand.get("residual_inliers"),
                "hand_inliers": hand.get("inliers"),
                "answers": [dict(row) for row in record["rows"]],
            }
        )
    order = {site: k for k, site in enumerate(PAPER_SITES)}
    return sorted(lines, key=lambda line: order[line["site"]])


def _distance(hand: Mapping[str, Any], true: Sequence[float]) -> float | None:
    if not hand:
        return None
    return float(np.hypot(hand["east"] - true[0], hand["north"] - true[1]))


def inlier_shares(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return SIFT's share of inliers and its success at each of the paper's sites."""
    lines = []
    for kind in ("crossing", "table"):
        for site in PAPER_SITES:
            for preset in ("paper", "robust"):
                some = select(rows, kind=kind, scenario=site, preset=preset, method="sift")
                if not some:
                    continue
                shares = [row["inlier_share"] or 0.0 for row in some if "inlier_share" in row]
                lines.append(
                    {
                        "kind": kind,
                        "site": site,
                        "preset": preset,
                        "pairs": len(some),
                        "matches": float(np.median([row.get("matches") or 0 for row in some])),
                        "median": float(np.median(shares)) if shares else None,
                        "lowest": min(shares, default=None),
                        "highest": max(shares, default=None),
                        "success": rate(bool(row["success"]) for row in some),
                    }
                )
    return lines


def stages(records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return seconds of each stage, raster pairs and pairs through files apart."""
    lines = []
    for through, kinds in (("rasters", ("crossing", "ladder", "scenario")), ("files", ("files",))):
        times: dict[str, list[float]] = {}
        for record in records:
            if record["job"]["kind"] in kinds and not record.get("error"):
                for name, value in record["stages"].items():
                    times.setdefault(name, []).append(value)
        for name, values in times.items():
            lines.append(
                {
                    "through": through,
                    "stage": name,
                    "pairs": len(values),
                    "median": float(np.median(values)),
                    "p95": float(np.percentile(values, 95)),
                }
            )
    return lines


def not_flat(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of the crossing on ground other than flat sand."""
    return [row for row in rows if row["kind"] == "crossing" and row["ground"] != FLAT]


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """Write a line a row; what a spreadsheet would take for a formula is quoted."""
    with (
        atomic_file(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="") as stream,
    ):
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        for row in rows:
            writer.writerow([_cell(row.get(column)) for column in COLUMNS])


def _cell(value: Any) -> Any:
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, str) and value[:1] in "=+-@":
        return f"'{value}" if value else ""
    return value
