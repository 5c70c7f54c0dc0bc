"""What the page says in sentences: what to do next, and how it was done, ready to paste."""

from __future__ import annotations

import math
from typing import Any

from meshreg.records import Registration
from meshreg.report import style
from meshreg.report.markup import number

PAPER = (
    "M. Bryson, M. Johnson-Roberson, O. Pizarro and S. B. Williams, Automated registration for "
    "multi-year robotic surveys of marine benthic habitats, IROS 2013"
)
_LOOK = (
    "Compare both surveys in report.html with swipe and flicker; if they do not lie on each "
    "other, do not use the registered survey."
)
# What the reason says, and what helps. `{wider}` is twice the search radius.
_UP_UNKNOWN = 0.14  # m; two depths of 5 cm each, as where nothing tells what sand did
_ALIGN = (
    "The heading of one survey is off by more than this registration corrects. Align the "
    "model to north again in the software that made it, or check its camera positions."
)
_LENGTHS = (
    "The lengths of the surveys differ. Check the scale bars or camera positions of the "
    "model that is wrong, and make it again; growth does not stretch the ground."
)
_SHIFTS = (
    "Shifts (--reference-shift, --moving-shift) are east, north, up in metres that are "
    "added to a file's coordinates. Check each file's coordinate system too."
)
_COMMON = (
    _LOOK,
    "More common ground, finer textures, or a mask over what changed (--mask not:FILE) "
    "give the answer more weight; so does a smaller --search-radius where the offset is "
    "known to be small.",
)
# What to do, by the code of a finding (`meshreg.judge.CODES`).
ADVICE: dict[str, tuple[str, ...]] = {
    "degrees": (
        "Longitude and latitude are projected to metres once their CRS is known: write it into "
        "NAME.survey.toml beside the file, or export in a projected CRS (UTM).",
    ),
    "apart": ("The coordinates of the surveys do not meet: report.html shows where they lie.",),
    "nothing": (
        "There is too little in common to compare. Check that both files are whole, and their "
        "shifts, axes and units (`meshreg info FILE`).",
    ),
    "turned": (_ALIGN,),
    "resized": (_LENGTHS,),
    "axes": (
        "Axes are stated by --up and --axes for both files, or for one by NAME.survey.toml "
        "beside it. `meshreg info FILE` then shows its bounds and whether it lies level.",
    ),
    "mirrored": (
        "One of the files has its axes exchanged or mirrored. Check --axes (enu or ned) and "
        "--up (y or z), or write them into a NAME.survey.toml beside the file that differs.",
        "`meshreg info FILE` says which axes a file seems to have.",
    ),
    "upright": (
        "Seen from above a steep wall shows nothing. Turn both models by the same known "
        "rotation, so that the wall lies level, and register those.",
    ),
    "lean": (
        "Align both models to the vertical in the software that made them, or check --up and "
        "--axes of each file.",
    ),
    "layers": (
        "Parts of the model do not lie on each other, as after an alignment of images or scans "
        "in two groups. Align all of them in one block, or leave one group out, and export "
        "again.",
    ),
    "tear": (
        "Look along that part's border in report.html. If a model is torn there, align its "
        "images again with more ties between both parts; if the ground has slid, mask the part "
        "that did (--mask not:FILE).",
    ),
    "upside_down": (
        "Export the survey whose heights are depths with up counted upwards, or state its axes "
        "in a NAME.survey.toml beside it.",
    ),
    "heights": (
        "Export both models with heights and plan in the same unit (--unit m, ft, ...; "
        'unit = "ft" in a NAME.survey.toml beside the file that differs), without vertical '
        "exaggeration. A GeoTIFF's heights may be in feet though its plan is in metres.",
    ),
    "scale": (_LENGTHS,),
    "tilt": (
        "One model leans by more than this registration corrects. Align it to the vertical in "
        "the software that made it (camera positions, depth, level markers), or check --up.",
    ),
    "heading": (_ALIGN,),
    "pieces": (
        "Pieces of the survey ask for another offset than the whole: the model may be bent, "
        "scaled, or its ground may have moved. Look at the residual field in report.html.",
        _LOOK,
    ),
    "light": (
        "Light from another side moves the shadows, and with them what the image says. " + _LOOK,
        "Relief would settle it: a finer DEM, or a survey that reaches rougher ground.",
    ),
    "surfaces": (
        "The 3-D surfaces ask for another place than the maps. Look at the height differences in "
        "report.html, or register without refine.surfaces.",
    ),
    "up": ("Check the height's unit and datum of both files. " + _LOOK,),
    "ties": (
        "Look at the points with the largest residuals in `meshreg validate OUT ties.csv`: "
        "either they are not of the same feature, or the answer is wrong. " + _LOOK,
    ),
    "contradiction": (
        "Relief and image put the survey at different places; one of them is deceived, for "
        "example by ripples, by a changed bottom, or by moving plants.",
        _LOOK,
        "Mask what moves or what repeats itself (--mask not:FILE), and register again.",
    ),
    "chance": (
        "Make sure that both surveys show the same ground: compare them in report.html.",
        "If their coordinates may be off by more than {radius:g} m, search further "
        "(--search-radius {wider:g}), or give the shift that is known (--moving-shift).",
        "Mask what moved or grew (--mask not:FILE). Check units (--unit) and axes (--axes).",
    ),
    "overlap": (
        "So narrow a common strip may fit by luck. " + _LOOK,
        "A larger survey, or one that lies further over the other, would settle it.",
    ),
    "flat": (
        "Flat ground has nothing that the relief could be known by. " + _LOOK,
        "Color may know it: export the models with textures or vertex colors. So may a larger "
        "survey, one that reaches rougher ground.",
    ),
    "border": (
        "The true offset may lie further out: register again with --search-radius {wider:g}.",
    ),
    "weak": _COMMON,
    "alone": _COMMON,
}
_FALLBACK = {
    "review": (
        _LOOK,
        "More overlap, a mask over what moves (--mask not:FILE), or a known shift "
        "(--moving-shift) may settle it.",
    ),
    "rejected": (
        "Check that both surveys show the same ground, their shifts (--reference-shift, "
        "--moving-shift), axes (--axes, --up) and units (--unit); a larger --search-radius costs "
        "only time.",
    ),
}


def next_steps(registration: Registration) -> tuple[str, ...]:
    """Sentences that say what to do about a verdict that is not "accepted"."""
    if registration.verdict == "accepted":
        return ()
    radius = _of(registration.settings, "search", "radius") or 10.0
    codes = [finding.code for finding in registration.findings]
    steps = [
        step.format(radius=radius, wider=2 * radius)
        for code in codes
        for step in ADVICE.get(code, ())
    ]
    if "apart" in codes and "axes" not in codes:
        steps.append(_SHIFTS)
    return tuple(dict.fromkeys(steps or _FALLBACK[registration.verdict]))


def _of(settings: Any, *keys: str) -> Any:
    for name in keys:
        settings = settings.get(name) if hasattr(settings, "get") else None
    return settings


def methods_paragraph(registration: Registration) -> str:
    """Return how it was done, in prose for a paper: parameters, versions, checksums."""
    r, settings = registration, registration.settings
    versions = dict(r.versions)
    meshreg = versions.pop("meshreg", "")
    versions.pop("platform", None)
    raster = settings.get("raster", {})
    names = [style.method_name(name) for name in settings.get("methods", ())]
    cells = [
        f"{what} cells of {raster[name]:g} m"
        for what, name in (("elevation", "dem_cell"), ("orthomosaic", "ortho_cell"))
        if raster.get(name)
    ]
    radius = _of(settings, "search", "radius")
    done = {
        "accepted": "was registered to",
        "review": "was compared, for a registration that is not accepted, with",
        "rejected": "could not be registered to",
    }[r.verdict]
    refined = ", and the best was refined on tiles" if r.transform is not None else ""
    parts = [
        f"The survey {_name(r.moving, 'moving')} ({_files(r.moving)}) {done} the "
        f"survey {_name(r.reference, 'reference')} ({_files(r.reference)}) with meshreg {meshreg} "
        f"(preset {settings.get('preset', 'robust')}, seed {settings.get('seed', 0)}), which "
        f"follows {PAPER}.",
        f"Both were rasterized from above to {' and '.join(cells)}"
        f"{_crs(r.reference.get('crs'))}." if cells else "",
        f"Horizontal offsets within ±{radius:g} m were searched by {_listed(names)}; the proposals "
        f"were weighed against relief and image of the whole overlap{refined}."
        if radius and names else "",
        _outcome(r),
        _agreement(r),
        "Software: "
        + ", ".join(
            f"{name.capitalize() if name == 'python' else name} {version}"
            for name, version in versions.items()
        )
        + ".",
    ]  # fmt: skip
    return " ".join(part for part in parts if part)


def _name(entry: Any, default: str) -> str:
    return str(entry.get("name") or default)


def _files(entry: Any) -> str:
    """Return the files' names and checksums; a long list is cut."""
    paths, sums = entry.get("path") or [], entry.get("sha256") or []
    pairs = [
        f"{path}, SHA-256 {digest}" if digest else str(path)
        for path, digest in zip(paths, [*sums, *[""] * len(paths)], strict=False)
    ]
    if len(pairs) > 3:
        pairs = [*pairs[:3], f"and {len(pairs) - 3} more files"]
    return "; ".join(pairs) or "made in memory"


def _crs(crs: Any) -> str:
    return f" in {crs}" if crs else " in a local frame"


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def sigmas(registration: Registration) -> tuple[float, float, float, float]:
    """One sigma of east, north, up [m] and yaw [degrees]; NaN where there is none."""
    covariance = registration.covariance
    if covariance is None:
        return (math.nan,) * 4
    east, north, up, yaw = (math.sqrt(max(float(covariance[k, k]), 0.0)) for k in (0, 1, 2, 5))
    return east, north, up, math.degrees(yaw)


def yaw_degrees(registration: Registration) -> float:
    """Rotation about the vertical, counted from east to north."""
    transform = registration.transform
    if transform is None:
        return math.nan
    return math.degrees(transform.yaw)


def tilt_degrees(registration: Registration) -> float:
    """Angle between the vertical before and after; zero where no tilt was estimated."""
    transform = registration.transform
    if transform is None:
        return math.nan
    return math.degrees(transform.tilt)


def _outcome(r: Registration) -> str:
    reason = r.reason.strip().rstrip(".")
    if r.transform is None:
        return f"No registration was accepted: {reason}."
    moves = [
        f"{number(value, '+.4f')}{_stated(sigma)} m {name}"
        for name, value, sigma in zip(
            ("east", "north", "up"), r.transform.offset.tolist(), sigmas(r)[:3], strict=True
        )
    ]
    tilt = tilt_degrees(r)
    tilted = f", tilts it by {tilt:.4f}°" if tilt > 0 else ""
    known = "(one sigma)" if r.covariance is not None else "(no error is stated)"
    where = f"about the centre of its bounding box {known}"
    turn = f"turns it by {number(yaw_degrees(r), '+.4f')}{_stated(sigmas(r)[3])}° {where}"
    if r.verdict == "review":
        return (
            f"The registration is held for review, not accepted: {reason}. The best hypothesis "
            f"would move the survey by {_listed(moves)}{tilted}; it {turn}."
        )
    said = f"The registration was accepted: {reason}. It moves the survey by {_listed(moves)}"
    return " ".join([f"{said}{tilted} and {turn}.", *undetermined(r), *_warped(r)])


def _stated(sigma: float) -> str:
    return f" ± {number(sigma, '.4f')}" if math.isfinite(sigma) else ""


def undetermined(r: Registration) -> list[str]:
    """Sentences that name what of an accepted answer the data did not tell."""
    if r.transform is None or r.covariance is None:
        return []
    said = []
    yaw, sigma = yaw_degrees(r), sigmas(r)
    if abs(yaw) < 1e-9 and math.isfinite(sigma[3]):
        said.append(
            f"The yaw was not determined: no turn stood out of its error of {sigma[3]:.4f}°."
        )
    nmad = [float(side.get("height_nmad") or math.nan) for side in (r.before, r.after)]
    worse = nmad[1] >= nmad[0]  # of what is not known nothing is said
    if sigma[2] > _UP_UNKNOWN or (worse and sigma[2] > 0.5 * nmad[1]):
        said.append(
            f"The height was not determined: up is known to ± {sigma[2]:.2g} m"
            + (" and the heights agree no better than before." if worse else " only.")
        )
    return said


def _warped(r: Registration) -> list[str]:
    """Say that a bend was applied after the rigid motion, and which."""
    if r.warp is None:
        return []
    parts = [f"{r.warp.horizontal} horizontally"] if r.warp.horizontal != "rigid" else []
    parts += [f"{r.warp.vertical} in height"] if r.warp.vertical != "rigid" else []
    return [
        f"The survey was then bent by a smooth warp ({' and '.join(parts)}) that predicts "
        "held-out tiles better than the rigid motion."
    ]


def _agreement(r: Registration) -> str:
    parts = [_compared(r)]
    error = r.registration_error
    if error:
        parts.append(
            "The registration error at the overlap's centroid is "
            f"{error['x']:.4f}, {error['y']:.4f} and {error['z']:.4f} m (east, north, up; one "
            f"sigma), at most {error['isotropic']:.4f} m in any direction."
        )
    if r.internal and r.internal.get("said"):
        said = str(r.internal["said"]).strip().rstrip(".")
        parts.append(f"Internal error: {said}.")
    return " ".join(part for part in parts if part)


def _compared(r: Registration) -> str:
    if r.verdict == "rejected":
        return ""
    overlap, after = r.after.get("overlap"), r.after.get("height_nmad")
    if overlap is None or after is None or not math.isfinite(after):
        return ""
    done = "registration and warp" if r.warp is not None else "registration"
    if r.verdict == "review":
        done = "the motion under review"
    before = r.before.get("height_nmad")
    earlier = f" ({before:.3f} m before)" if before is not None and math.isfinite(before) else ""
    return (
        f"After {done} {overlap:.0%} of the smaller survey overlap, and the NMAD of the "
        f"height differences there is {after:.3f} m{earlier}."
    )
