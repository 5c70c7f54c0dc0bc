"""What a run says: every rate, Table I, and which expectations do not hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from meshreg.benchmark import tables
from meshreg.benchmark.plan import FLAT

Record = Mapping[str, Any]
# What the numbers must be on all ground but flat sand: least share of the pairs.
TARGETS = {
    "fused success": 0.995,
    "mutual_information success": 0.95,
    "terrain success": 0.98,
    "accepted": 0.95,
}


def summarise(records: Sequence[Record]) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the summary of a run and the rows of its table.

    Parameters
    ----------
    records : sequence of mapping
        As `jobs.run_job` returns them.
    """
    rows = tables.flat_rows(records)
    robust = [row for row in rows if row["preset"] == "robust"]
    crossing = [row for row in robust if row["kind"] == "crossing"]
    known = [row for row in robust if row.get("success") is not None]
    apart = [row for row in tables.fused(robust) if row["kind"] == "elsewhere"]
    broken = [record for record in records if record.get("error")]
    summary: dict[str, Any] = {
        "pairs": {
            "crossing": len(tables.fused(crossing)),
            "crossing_not_flat": len(tables.fused(tables.not_flat(robust))),
            "true": len(tables.fused(known)),
            "elsewhere": len(apart),
            "failed_jobs": len(broken),
        },
        "success": _success(rows),
        "verdicts": _verdicts(crossing, known, apart),
        "coverage": {
            name: {
                method: tables.coverage(tables.select(some, method=method))
                for method in tables.ANSWERS
            }
            | {"up": tables.coverage(tables.select(some, method="fused"), "covered_up")}
            for name, some in (("crossing", crossing), ("not_flat", tables.not_flat(robust)))
        },
        "errors": {
            method: tables.error_summary(tables.select(tables.not_flat(robust), method=method))
            for method in tables.ANSWERS
        },
        "table_one": tables.table_one(records),
        "sift_inliers": tables.inlier_shares(rows),
        "stages": tables.stages(records),
        "null_gaps": _null_gaps(apart),
    }
    summary["expectations"] = expectations(summary, records)
    summary["unmet"] = [line["what"] for line in summary["expectations"] if not line["holds"]]
    return summary, rows


def _success(rows: Sequence[tables.Row]) -> list[dict[str, Any]]:
    """Rates of success, by preset and method: all but flat sand, flat sand, and each scenario."""
    groups: dict[str, list[tables.Row]] = {
        "all but flat sand": tables.not_flat(rows),
        "flat sand": tables.select(rows, kind="crossing", ground=FLAT),
    }
    for row in rows:
        if row["kind"] in ("crossing", "ladder", "scenario") and row.get("success") is not None:
            groups.setdefault(row["scenario"], []).append(row)
    lines = []
    for name, some in groups.items():
        rates = tables.successes(some, lambda row: (row["preset"], row["method"]))
        for (preset, method), found in sorted(rates.items()):
            lines.append({"where": name, "preset": preset, "method": method, **found})
    return lines


def _verdicts(
    crossing: Sequence[tables.Row], known: Sequence[tables.Row], apart: Sequence[tables.Row]
) -> dict[str, Any]:
    flat = [row for row in crossing if row["ground"] == FLAT]
    return {
        "all but flat sand": tables.verdicts(tables.fused(tables.not_flat(crossing))),
        "flat sand": tables.verdicts(tables.fused(flat)),
        "severity ladder": tables.verdicts(tables.fused(tables.select(known, kind="ladder"))),
        "all true pairs": tables.verdicts(tables.fused(known)),
        "different places": tables.verdicts(apart),
    }


def _null_gaps(apart: Sequence[tables.Row]) -> dict[str, Any]:
    """Gaps that different places reach, and the least chance that was stated for them."""
    found: dict[str, Any] = {}
    for channel in ("terrain_gap", "image_gap"):
        gaps = sorted(row[channel] for row in apart if row.get(channel) is not None)
        if gaps:
            found[channel] = {"median": gaps[len(gaps) // 2], "largest": gaps[-1]}
    alarms = [row["false_alarm"] for row in apart if row.get("false_alarm") is not None]
    if alarms:
        found["least_false_alarm"] = min(alarms)
    return found


def expectations(summary: Mapping[str, Any], records: Sequence[Record]) -> list[dict[str, Any]]:
    """Return every expectation, what was found, and whether it holds."""
    lines = _targets(summary)
    for record in records:
        job = record["job"]
        if record.get("error"):
            what = f"{job['name']} runs"
            lines.append({"what": what, "found": record["error"], "holds": False})
            continue
        holds = tables.expected(record)
        if holds is None:
            continue
        row = next(r for r in tables.fused(record["rows"]) if r["preset"] == "robust")
        error = row.get("error")
        said = "no error known" if error is None else f"error {error:.3f} m"
        allowed = " or ".join(record["expect"]["verdicts"])
        limit = record["expect"]["max_error"]
        lines.append(
            {
                "what": f"{job['name']}: {allowed}, within {limit:g} m",
                "found": f"{row['verdict']}, {said}: {row['reason']}",
                "holds": holds,
            }
        )
    return lines


def _targets(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    lines = []
    rates = {
        f"{line['method']} success": line
        for line in summary["success"]
        if line["where"] == "all but flat sand" and line["preset"] == "robust"
    }
    rates["accepted"] = summary["verdicts"]["all but flat sand"]["accepted"]
    for name, least in TARGETS.items():
        found = rates.get(name)
        if found and found["total"]:
            what = f"{name} on all but flat sand at least {least:.1%}"
            lines.append({"what": what, "found": said(found), "holds": found["rate"] >= least})
    none = {
        "different places accepted": summary["verdicts"]["different places"]["accepted"],
        "true pairs accepted but wrong": summary["verdicts"]["all true pairs"][
            "accepted_but_wrong"
        ],
        "flat sand rejected": summary["verdicts"]["flat sand"]["rejected"],
    }
    for name, found in none.items():
        if found["total"]:
            lines.append(
                {"what": f"{name}: none", "found": said(found), "holds": found["count"] == 0}
            )
    return lines


def said(found: Mapping[str, Any]) -> str:
    """Return a rate in words: count, share and bounds."""
    if not found["total"]:
        return "no pairs"
    return (
        f"{found['count']} of {found['total']} = {found['rate']:.1%} "
        f"(95 % bounds {found['low']:.1%} to {found['high']:.1%})"
    )
