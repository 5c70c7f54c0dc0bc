"""Who may import whom (CONTRIBUTING.md), read from the syntax trees; and what starts lazily."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
BASE = {"errors", "types", "settings", "checked"}
# Room -> rooms it may import, itself apart. A new room needs a line here and in CONTRIBUTING.md.
RULES: dict[str, set[str]] = {
    "errors": set(),
    "checked": {"errors"},
    "types": BASE,
    "settings": BASE,
    "jit": set(),
    "io": BASE | {"jit"},
    "raster": BASE | {"jit"},
    "tile_kernels": {"jit"},
    "tiles": BASE | {"offsets", "tile_kernels"},
    "kriging": BASE,
    "sandwich": BASE,
    "refine": BASE | {"kriging", "offsets", "sandwich", "tiles"},
    "tile_surfaces": BASE | {"offsets", "raster"},
    "voting_kernels": {"jit"},
    "voting": BASE | {"offsets", "tile_surfaces", "voting_kernels"},
    "heading": BASE | {"judge", "refine", "tiles", "voting"},
    "ground": BASE,
    "dem_pair": BASE | {"ground"},
    "ground_plane": BASE | {"dem_pair", "ground", "sandwich"},
    "heights": BASE | {"dem_pair", "gain", "ground", "ground_plane", "tears"},
    "open3d_loading": set(),
    "surfaces": BASE | {"open3d_loading", "sandwich"},
    "posture": BASE,
    "apply": BASE,
    "report": BASE,
    "held_out": BASE,
    "ladder": BASE | {"held_out"},
    "warp_rasters": BASE,
    "warp": BASE | {"ladder", "tiles", "warp_rasters"},
    "statistics": BASE | {"raster", "offsets"},
    "offsets": BASE | {"jit", "kriging", "raster", "sandwich"},
    "layers": BASE,
    "gain": BASE | {"dem_pair"},
    "tears": BASE | {"held_out", "tiles"},
    "verdict": BASE | {"gain", "judge", "tears"},
    "judge": BASE | {"raster", "offsets"},
    "levels": BASE | {"offsets", "raster", "statistics"},
    "narrowing": BASE | {"judge", "offsets", "raster", "tile_surfaces", "voting"},
    "far_pose": BASE | {"judge", "offsets", "raster", "settings", "tile_surfaces"},
    "search_cost": BASE | {"io", "narrowing", "offsets"},
    "decision": BASE
    | {"heading", "heights", "held_out", "judge", "kriging", "narrowing", "offsets", "refine"}
    | {"statistics", "tears", "tile_surfaces", "tiles", "verdict", "voting"},
    "pipeline": BASE
    | {
        "decision",
        "far_pose",
        "gain",
        "heading",
        "heights",
        "judge",
        "layers",
        "levels",
        "offsets",
        "posture",
    }
    | {"raster", "refine", "search_cost", "statistics", "surfaces", "voting", "verdict", "warp"}
    | {"warp_rasters"},
    "ties": BASE | {"io", "raster", "offsets", "statistics", "report"},
    "doctor": set(),
}
FRONT = {"cli", "cli_parts", "benchmark", "selftest", "__init__", "__main__"}  # may import anything
ESTIMATORS = {"sift", "terrain", "mutual_information"}
HEAVY = {
    "numba",
    "open3d",
    "small_gicp",
    "cv2",
    "rasterio",
    "trimesh",
    "pycolmap",
    "pyvista",
    "matplotlib",
    "laspy",
    "pye57",
}
LAZY = [*sorted(HEAVY), "scipy"]


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def name_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts)


def room_of(module: str) -> str:
    """Return the part of a dotted name that follows "meshreg."."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


def imported(path: Path, *, top_only: bool = False) -> Iterator[tuple[str, int]]:
    """Give every module that a file imports, with the line; relative ones made absolute."""
    tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
    for node in tree.body if top_only else ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node.lineno
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = name_of(path).split(".")[: -node.level]
                base = ".".join([*package, base] if base else package)
            for alias in node.names:
                if (base, alias.name) == ("meshreg", "__version__"):
                    continue  # a string that everybody may know
                # `from meshreg import statistics` imports the module meshreg.statistics
                full = f"{base}.{alias.name}"
                is_module = (ROOT / full.replace(".", "/")).with_suffix(".py").exists()
                is_package = (ROOT / full.replace(".", "/") / "__init__.py").exists()
                yield (full if is_module or is_package else base), node.lineno


@pytest.mark.parametrize("path", modules("meshreg"), ids=name_of)
def test_rooms_import_only_what_they_may(path: Path) -> None:
    room = room_of(name_of(path))
    if room in FRONT:
        return
    assert room in RULES, f"{room} is a new room: say in RULES and CONTRIBUTING.md what it may use"
    for module, line in imported(path):
        if module.split(".")[0] != "meshreg":
            continue
        other = room_of(module)
        allowed = other == room or other in RULES[room]
        assert allowed, f"{path.relative_to(ROOT)}:{line}: {room} may not import {module}"


def test_nobody_imports_pipeline_or_cli() -> None:
    for path in modules("meshreg"):
        if room_of(name_of(path)) in FRONT:
            continue
        for module, line in imported(path):
            assert module.split(".")[:2] not in (["meshreg", "pipeline"], ["meshreg", "cli"]), (
                f"{path.relative_to(ROOT)}:{line} imports {module}"
            )


def test_estimators_do_not_know_one_another() -> None:
    for name in ESTIMATORS:
        path = ROOT / "meshreg" / "offsets" / f"{name}.py"
        others = {f"meshreg.offsets.{other}" for other in ESTIMATORS - {name}}
        for module, line in imported(path):
            assert module not in others, f"{name}, line {line}, imports {module}"


def test_data_synth_knows_no_method_under_test() -> None:
    allowed = BASE | {"io", "jit"}
    for path in modules("data_synth"):
        for module, line in imported(path):
            if module.split(".")[0] == "meshreg":
                assert room_of(module) in allowed, (
                    f"{path.relative_to(ROOT)}:{line}: data_synth may not import {module}"
                )


def test_package_does_not_use_the_synthetic_data() -> None:
    for path in modules("meshreg"):
        if room_of(name_of(path)) in FRONT - {"__init__"}:
            continue
        for module, line in imported(path):
            assert module.split(".")[0] not in ("data_synth", "tests"), f"{path}:{line}: {module}"


@pytest.mark.parametrize("path", modules("meshreg"), ids=name_of)
def test_heavy_libraries_are_imported_inside_functions(path: Path) -> None:
    numba_home = path.name == "jit.py" or path.name.endswith("kernels.py")
    for module, line in imported(path, top_only=True):
        library = module.split(".")[0]
        if library == "numba" and numba_home:
            continue
        assert library not in HEAVY, f"{path.relative_to(ROOT)}:{line} imports {library} at its top"
        kernels = module.startswith("meshreg.") and module.endswith(("kernels", ".jit"))
        assert not kernels or numba_home, (
            f"{path.relative_to(ROOT)}:{line} imports {module} (numba) at its top"
        )


def test_open3d_is_imported_in_one_place() -> None:
    """Anywhere else it fails on a machine without libusb, which its own developers never see."""
    only = ROOT / "meshreg" / "open3d_loading.py"
    # In text, not in syntax trees: code that a child process gets is a string.
    importing = re.compile(
        r"\b(import|from)\s+open3d\b|(import_module|__import__|importorskip)\(.open3d\b"
    )
    folders = ("meshreg", "data_synth", "tests", "scripts")
    found = [path for folder in folders for path in modules(folder)]
    assert {"meshreg/surfaces.py", "scripts/bench_parts/peers.py", "tests/test_surfaces.py"} <= {
        str(path.relative_to(ROOT)) for path in found
    }
    importers = [path for path in found if importing.search(path.read_text(encoding="utf-8"))]
    assert importers == [only], "take meshreg.open3d_loading.load_open3d() instead"


@pytest.mark.parametrize(
    "code",
    [
        "import meshreg",
        "import meshreg.cli",
        "from meshreg.cli import run; assert run(['--help']) == 0",
        "from meshreg.cli import run; assert run(['register', '--help']) == 0",
        "from meshreg.cli import run; assert run(['--version']) == 0",
    ],
)
def test_start_up_loads_nothing_heavy(code: str) -> None:
    check = f"{code}\nimport sys\nprint('@', *sorted(set({LAZY!r}) & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", check], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].split() == ["@"]


def test_importing_does_not_touch_logging_or_warnings() -> None:
    check = (
        "import logging, warnings; before = list(warnings.filters), list(logging.root.handlers)\n"
        "import meshreg\n"
        "assert (list(warnings.filters), list(logging.root.handlers)) == before\n"
        "logger = logging.getLogger('meshreg')\n"
        "assert [type(h) for h in logger.handlers] == [logging.NullHandler]\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", check], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr


def test_every_public_name_exists() -> None:
    import meshreg

    for name in meshreg.__all__:
        assert getattr(meshreg, name) is not None
    with pytest.raises(AttributeError, match="no_such_name"):
        meshreg.no_such_name  # noqa: B018
