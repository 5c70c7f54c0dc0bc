"""One self-contained page: figures and tables of a run; nothing in it is fetched or executed."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from meshreg.benchmark import tables
from meshreg.benchmark.plan import PAPER_SITES
from meshreg.benchmark.summary import said

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 75rem; margin: 2rem auto;
  padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
table { border-collapse: collapse; margin: .8rem 0; font-size: .85rem; }
th, td { text-align: left; padding: .2rem .7rem; border-bottom: 1px solid #ddd;
  vertical-align: top; }
th { border-bottom: 1px solid #888; }
td.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
tr.no td { background: #fbe9e0; }
img { max-width: 100%; height: auto; }
figure { margin: 1rem 0; } figcaption { color: #555; font-size: .85rem; }
p.note { color: #555; }
"""
# Table I as printed: offset and mean residual of the hand-selected pairs [m].
PRINTED = {
    "tasmania_12h": (5.2113, 0.2258),
    "abrolhos_12mo": (0.7708, 0.0725),
    "scott_24mo": (2.4851, 0.2095),
}
CAPTIONS = {
    "fig2_errors": "Figure 2, against exact truth.",
    "fig2_errors_hand": "Figure 2 as in the paper: against hand-selected pairs, here simulated.",
    "severity": "Success on the ladder from no change to everything at once.",
    "error_cdf": "Share of pairs with an error below x.",
    "verdicts": "What was accepted, sent to review, rejected.",
    "reliability": "Left: the stated chance of a false alarm. Right: the stated regions.",
    "runtime": "Seconds of each stage; each worker has its share of the cores.",
}


def write_page(summary: Mapping[str, Any], folder: Path) -> str:
    """Return the page as HTML text, with the figures in `folder`/figures inside it."""
    pictures = {path.stem: path for path in sorted((folder / "figures").glob("*.png"))}
    drawn = {name: _picture(path, CAPTIONS.get(name, "")) for name, path in pictures.items()}
    parts = [
        _intro(summary),
        _expectations(summary["expectations"]),
        _section("Figure 2: error at the paper's sites", _figures(drawn, "fig2_")),
        _section("Table I", _table_one(summary["table_one"])),
        _section("SIFT's inliers", _inliers(summary["sift_inliers"])),
        *(
            _section(f"Figure {n}: {title}", _figures(drawn, f"fig{n}_"))
            for n, title in ((3, "matches"), (4, "relief and section"), (5, "scores"))
        ),
        _section("Success", _figures(drawn, "severity", "error_cdf"), _success(summary["success"])),
        _section("Verdicts", _figures(drawn, "verdicts", "reliability"), _trust(summary)),
        _section("Time", _figures(drawn, "runtime"), _stages(summary["stages"])),
    ]
    digest = base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'"
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width">\n'
        f"<title>meshreg benchmark</title><style>{_STYLE}</style></head><body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def _intro(summary: Mapping[str, Any]) -> str:
    pairs, options = summary["pairs"], summary["options"]
    versions = ", ".join(f"{k} {v}" for k, v in summary["versions"].items())
    return (
        "<h1>meshreg benchmark</h1>\n<p>"
        f"{pairs['true']} pairs with known truth and {pairs['elsewhere']} pairs of different "
        f"places, {escape(str(options['size']))} m patches, seed {escape(str(options['seed']))}. "
        "Offsets are uniform within ±5 m and drawn anew for every pair, yaw ±0.5°, internal warp "
        "0.04 to 0.25 m, unless a recipe says otherwise. Errors are horizontal, at the centroid "
        "of the ground that both surveys show, against the best rigid fit of the exact "
        "distortion; success is an error under 0.25 m. Rates come with their Clopper-Pearson "
        f'95 % bounds.</p>\n<p class="note">{escape(versions)}</p>'
    )


def _section(title: str, *parts: str) -> str:
    inside = "\n".join(part for part in parts if part)
    return f"<h2>{escape(title)}</h2>\n{inside}" if inside else ""


def _picture(path: Path, caption: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    text = escape(caption or _title(path.stem))
    return (
        f'<figure><img alt="{text}" src="data:image/png;base64,{data}">'
        f"<figcaption>{text}</figcaption></figure>"
    )


def _title(stem: str) -> str:
    figure, *rest = stem.split("_")
    return f"Figure {figure[3:]}: {' '.join(rest)}"


def _figures(drawn: Mapping[str, str], *names: str) -> str:
    found = [text for stem, text in drawn.items() if stem.startswith(names)]
    if names[0].startswith("fig"):  # by site, in the paper's order
        order = {site: k for k, site in enumerate(PAPER_SITES)}
        stems = [stem for stem in drawn if stem.startswith(names)]
        stems.sort(key=lambda s: (next((order[x] for x in PAPER_SITES if x in s), -1), s))
        found = [drawn[stem] for stem in stems]
    return "\n".join(found)


def _table(head: Sequence[str], lines: Iterable[Sequence[Any]], bad: Any = None) -> str:
    """Return a table as HTML, numbers to the right, rows for which `bad` holds tinted."""
    rows = []
    for line in lines:
        cells = "".join(f"<td{_side(cell)}>{escape(str(cell))}</td>" for cell in line)
        rows.append(f'<tr class="no">{cells}</tr>' if bad and bad(line) else f"<tr>{cells}</tr>")
    if not rows:
        return ""
    names = "".join(f"<th>{escape(name)}</th>" for name in head)
    return f"<table><tr>{names}</tr>\n" + "\n".join(rows) + "</table>"


def _side(cell: Any) -> str:
    text = str(cell).strip("+−-")
    return ' class="n"' if text[:1].isdigit() and len(text) < 12 else ""


def _number(value: Any, digits: int = 3) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _place(pair: Sequence[Any]) -> str:
    if pair[0] is None:
        return "–"
    return f"({pair[0]:+.3f}, {pair[1]:+.3f})"


def _expectations(lines: Sequence[Mapping[str, Any]]) -> str:
    unmet = [line for line in lines if not line["holds"]]
    good = f"<p>{len(lines) - len(unmet)} of {len(lines)} expectations hold.</p>"
    table = _table(
        ("does not hold", "found"),
        [(line["what"], line["found"]) for line in unmet],
        lambda _: True,
    )
    rates = [x for x in lines if " on all " in x["what"] or x["what"].endswith(": none")]
    overall = _table(
        ("expected", "found", "holds"),
        [(x["what"], x["found"], "yes" if x["holds"] else "no") for x in rates],
        lambda line: line[2] == "no",
    )
    return _section("Expectations", good, overall, table)


def _table_one(lines: Sequence[Mapping[str, Any]]) -> str:
    head = (
        "site", "printed offset", "printed residual", "truth (east, north)", "length",
        "hand (east, north)", "hand's error", "hand's residual",
    )  # fmt: skip
    first = _table(
        head,
        [
            (
                line["site"],
                f"{PRINTED[line['site']][0]:.4f}",
                f"{PRINTED[line['site']][1]:.4f}",
                _place(line["truth"]),
                _number(line["truth_length"], 4),
                _place(line["hand"]),
                _number(line["hand_error"], 4),
                _number(line["hand_residual"], 4),
            )
            for line in lines
        ],
    )
    second = _table(
        ("site", "preset", "method", "offset (east, north)", "error, truth", "error, hand", "says"),
        [
            (
                line["site"],
                row["preset"],
                _method(row["method"]),
                _place((row.get("east"), row.get("north"))),
                _number(row.get("error")),
                _number(row.get("error_hand")),
                row.get("verdict") or row["status"],
            )
            for line in lines
            for row in line["answers"]
        ],
    )
    note = (
        '<p class="note">Metres. The hand clicks 25 points of the ground that both surveys show, '
        "2 cm off in each mosaic, one in twenty of them on the wrong thing, and goes through the "
        "RANSAC of III-B; its residual is the mean over all 25.</p>"
    )
    return first + note + second if first else ""


def _method(name: str) -> str:
    return "fused" if name == "fused" else tables_name(name)


def tables_name(method: str) -> str:
    """How a method is called in print."""
    from meshreg.report import style

    return style.method_name(method)


def _inliers(lines: Sequence[Mapping[str, Any]]) -> str:
    paper = {"tasmania_12h": "72 %", "abrolhos_12mo": "12 %", "scott_24mo": "fails"}
    cells = {"crossing": "2.5 cm", "table": "1 cm"}
    return _table(
        ("site", "mosaic", "preset", "pairs", "matches", "inliers: median", "from", "to",
         "in the paper", "success"),
        [
            (
                line["site"],
                cells[line["kind"]],
                line["preset"],
                line["pairs"],
                _number(line["matches"], 0),
                _share(line["median"]),
                _share(line["lowest"]),
                _share(line["highest"]),
                paper[line["site"]],
                said(line["success"]),
            )
            for line in lines
        ],
    )  # fmt: skip


def _share(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.1f} %"


def _success(lines: Sequence[Mapping[str, Any]]) -> str:
    groups: dict[tuple[str, str], dict[str, str]] = {}
    for line in lines:
        groups.setdefault((line["where"], line["preset"]), {})[line["method"]] = _rate(line)
    return _table(
        ("pairs", "preset", *(_method(m) for m in tables.ANSWERS)),
        [
            (where, preset, *(found.get(m, "–") for m in tables.ANSWERS))
            for (where, preset), found in groups.items()
        ],
    )


def _rate(found: Mapping[str, Any]) -> str:
    if not found["total"]:
        return "–"
    low, high = 100 * found["low"], 100 * found["high"]
    return f"{found['count']}/{found['total']}: {100 * found['rate']:.1f} % [{low:.1f}, {high:.1f}]"


def _trust(summary: Mapping[str, Any]) -> str:
    names = ("accepted", "review", "rejected", "accepted_but_wrong")
    verdicts = _table(
        ("pairs", *(name.replace("_", " ") for name in names)),
        [
            (where, *(_rate(found[name]) for name in names))
            for where, found in summary["verdicts"].items()
        ],
    )
    covered = _table(
        ("stated 95 % region covers the truth", *(_method(m) for m in tables.ANSWERS), "height"),
        [
            (where.replace("_", " "), *(_rate(found[m]) for m in (*tables.ANSWERS, "up")))
            for where, found in summary["coverage"].items()
        ],
    )
    return verdicts + covered


def _stages(lines: Sequence[Mapping[str, Any]]) -> str:
    return _table(
        ("through", "stage", "pairs", "median [s]", "95th percentile [s]"),
        [
            (x["through"], _method(x["stage"]), x["pairs"], _number(x["median"]), _number(x["p95"]))
            for x in lines
        ],
    )
