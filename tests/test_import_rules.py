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
LISTED = re.compile(r"^([a-z_]+)(?:/|\.py) {2,}\S", re.MULTILINE)


def listed_rooms() -> list[str]:
    """Return the rooms as CONTRIBUTING.md lists them: each may use those before it."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    return LISTED.findall(text.split("## Rooms")[1].split("```")[1])


ROOMS = listed_rooms()
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


def _is_typing(test: ast.expr) -> bool:
    return isinstance(test, ast.Name) and test.id == "TYPE_CHECKING"


def imported(path: Path, *, top_only: bool = False) -> Iterator[tuple[str, int]]:
    """Give every module that a file imports, with the line; relative ones made absolute."""
    tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
    if path.name == "__init__.py":  # names for the type checker alone: a front door is lazy
        tree.body = [n for n in tree.body if not (isinstance(n, ast.If) and _is_typing(n.test))]
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


def home_of(module: str) -> str:
    """Return the room of a module of meshreg or of the synthetic data, "" for what is neither."""
    top = module.split(".", maxsplit=1)[0]
    return {"meshreg": room_of(module), "data_synth": "data_synth"}.get(top, "")


def test_every_room_is_listed_once_and_there_are_few() -> None:
    there = {path.stem for path in (ROOT / "meshreg").glob("*.py")}
    there |= {path.parent.name for path in (ROOT / "meshreg").glob("*/__init__.py")}
    there -= {"__init__", "__main__"}
    assert sorted(ROOMS) == sorted(there | {"data_synth"})
    assert len(there) <= 22


@pytest.mark.parametrize("path", modules("meshreg") + modules("data_synth"), ids=name_of)
def test_rooms_import_only_those_listed_before_them(path: Path) -> None:
    room = home_of(name_of(path))
    if room in ("__init__", "__main__"):
        return
    before = set(ROOMS[: ROOMS.index(room) + 1])
    for module, line in imported(path):
        other = home_of(module)
        assert not other or other in before, (
            f"{path.relative_to(ROOT)}:{line}: {room} comes before {module} in CONTRIBUTING.md"
        )


def test_no_module_imports_itself_by_way_of_others() -> None:
    files = {name_of(path).removesuffix(".__init__"): path for path in modules("meshreg")}
    files |= {name_of(path).removesuffix(".__init__"): path for path in modules("data_synth")}
    del files["meshreg"]  # the front door, lazy
    ways = {name: {m for m, _ in imported(path)} & files.keys() for name, path in files.items()}
    done: set[str] = set()

    def follow(name: str, before: tuple[str, ...]) -> None:
        assert name not in before, " -> ".join((*before[before.index(name) :], name))
        if name not in done:
            for other in sorted(ways[name]):
                follow(other, (*before, name))
            done.add(name)

    for name in sorted(files):
        follow(name, ())


def test_estimators_do_not_know_one_another() -> None:
    for name in ESTIMATORS:
        path = ROOT / "meshreg" / "offsets" / f"{name}.py"
        others = {f"meshreg.offsets.{other}" for other in ESTIMATORS - {name}}
        for module, line in imported(path):
            assert module not in others, f"{name}, line {line}, imports {module}"


def test_data_synth_knows_no_method_under_test() -> None:
    allowed = {"errors", "settings", "jit", "records", "io"}
    for path in modules("data_synth"):
        for module, line in imported(path):
            if module.split(".")[0] == "meshreg":
                assert room_of(module) in allowed, (
                    f"{path.relative_to(ROOT)}:{line}: data_synth may not import {module}"
                )


def test_only_the_benchmark_and_the_command_line_use_the_synthetic_data() -> None:
    for path in modules("meshreg"):
        if room_of(name_of(path)) in ("benchmark", "cli"):
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
    only = ROOT / "meshreg" / "refine" / "open3d_loading.py"
    # In text, not in syntax trees: code that a child process gets is a string.
    importing = re.compile(
        r"\b(import|from)\s+open3d\b|(import_module|__import__|importorskip)\(.open3d\b"
    )
    folders = ("meshreg", "data_synth", "tests", "scripts")
    found = [path for folder in folders for path in modules(folder)]
    assert {
        "meshreg/refine/surfaces.py",
        "scripts/bench_parts/peers.py",
        "tests/refine/test_surfaces.py",
    } <= {str(path.relative_to(ROOT)) for path in found}
    importers = [path for path in found if importing.search(path.read_text(encoding="utf-8"))]
    assert importers == [only], "take meshreg.refine.open3d_loading.load_open3d() instead"


@pytest.mark.parametrize(
    "code",
    [
        "import meshreg",
        "import meshreg.cli.app",
        "from meshreg.cli.app import run; assert run(['--help']) == 0",
        "from meshreg.cli.app import run; assert run(['register', '--help']) == 0",
        "from meshreg.cli.app import run; assert run(['--version']) == 0",
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
