"""A folder of results is replaced only where it holds nothing but what meshreg wrote."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FrameType

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from meshreg.errors import UsageError
from meshreg.io.files import atomic
from meshreg.io.result import folders, manifest
from meshreg.io.result.folders import atomic_folder
from meshreg.io.result.manifest import require_apart, require_only_ours, require_ours, write_into


def tree(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def make(
    path: Path, overwrite: bool = False, text: str = "1", beside: Callable[[], None] = lambda: None
) -> None:
    with atomic_folder(path, overwrite, command="register") as folder:
        beside()
        (folder / "registration.json").write_text(text)
        (folder / "reference_dem.tif").write_text("dem")
        (folder / "figures" / "deep").mkdir(parents=True)
        (folder / "figures" / "deep" / "a.png").write_text("a")


@pytest.fixture
def out(tmp_path: Path) -> Path:
    make(tmp_path / "OUT")
    return tmp_path / "OUT"


def test_the_manifest_names_every_file_with_its_size_and_checksum(out: Path) -> None:
    document = json.loads((out / "manifest.json").read_text())
    assert (document["schema"], document["command"]) == ("meshreg.manifest/1", "register")
    assert document["files"] == {
        name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        for name, data in tree(out).items()
        if name != "manifest.json"
    }


def test_a_result_is_replaced_whole(out: Path) -> None:
    (out / "reference_dem.tif.aux.xml").write_text("<PAMDataset/>")  # as QGIS leaves it
    (out / "figures" / "deep" / ".a.0123456789ab.tmp.png").write_text("")  # as a kill leaves it
    make(out, overwrite=True, text="2")
    assert (out / "registration.json").read_text() == "2"
    assert sorted(tree(out)) == [
        "figures/deep/a.png", "manifest.json", "reference_dem.tif", "registration.json",
    ]  # fmt: skip
    assert os.listdir(out.parent) == ["OUT"]


def test_empty_folders_of_ours_go_too(out: Path) -> None:
    """One that was made empty, and one that somebody has emptied."""
    (out / "figures" / "deep" / "a.png").unlink()
    with atomic_folder(out, overwrite=True, command="register") as folder:
        (folder / "registration.json").write_text("2")
        (folder / "figures").mkdir()
    make(out, overwrite=True, text="3")
    assert (out / "registration.json").read_text() == "3"


FOREIGN = {
    "a file": lambda out: (out / "notes.txt").write_text("mine"),
    "a hidden file": lambda out: (out / ".notes").write_text("mine"),
    "in a folder of ours": lambda out: (out / "figures" / "deep" / "b.png").write_text("mine"),
    "in a folder of its own": lambda out: (
        (out / "a" / "b").mkdir(parents=True),
        (out / "a" / "b" / "c").write_text("mine"),
    ),
    "an empty folder": lambda out: (out / "later").mkdir(),
    "a link": lambda out: (out / "link").symlink_to(out / "registration.json"),
    "a link to a folder": lambda out: (out / "link").symlink_to(out.parent),
    "a dangling link": lambda out: (out / "link").symlink_to("nowhere"),
    "a pipe": lambda out: os.mkfifo(out / "pipe"),
    "aux.xml of a foreign map": lambda out: (out / "mine.tif.aux.xml").write_text("<x/>"),
    "a half of a foreign file": lambda out: (out / ".b.0123456789ab.tmp.txt").write_text("mine"),
    "aux.xml of nothing": lambda out: (out / ".aux.xml").write_text("<x/>"),
    "a file of ours, changed": lambda out: (out / "figures" / "deep" / "a.png").write_text("A"),
    "a file of ours, made a link": lambda out: (
        (out / "reference_dem.tif").rename(out.parent / "dem.tif"),
        (out / "reference_dem.tif").symlink_to(out.parent / "dem.tif"),
    ),
    "a file of ours, made a folder": lambda out: (
        (out / "reference_dem.tif").unlink(),
        (out / "reference_dem.tif").mkdir(),
    ),
    "a name that is not UTF-8": lambda out: Path(os.fsdecode(bytes(out) + b"/\xff")).write_text(""),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_anything_else_is_never_removed(out: Path, kind: str) -> None:
    FOREIGN[kind](out)
    before = {path: os.lstat(path) for path in out.rglob("*")}
    with pytest.raises(UsageError, match="1 files that meshreg did not write") as caught:
        make(out, overwrite=True)
    assert caught.value.exit_code == 2
    after = {path: os.lstat(path) for path in out.rglob("*")}
    assert {p: (s.st_ino, s.st_mtime_ns) for p, s in before.items()} == {
        p: (s.st_ino, s.st_mtime_ns) for p, s in after.items()
    }


def test_the_first_five_are_named(out: Path) -> None:
    for number in range(8):
        (out / f"mine_{number}.txt").write_text("")
    said = r"holds 8 files .*: mine_0.txt, mine_1.txt, .* mine_4.txt and 3 more\. Nothing is"
    with pytest.raises(UsageError, match=said):
        make(out, overwrite=True)


@pytest.mark.parametrize("when", ["meanwhile", "at the last moment"])
def test_what_appears_during_the_run_is_kept(
    out: Path, when: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the exchange it is refused; after the last look it is moved to a folder beside."""

    def late(path: Path) -> None:
        (path / "late.txt").write_text("mine")

    if when == "meanwhile":
        with pytest.raises(UsageError, match=r"late\.txt"):
            make(out, overwrite=True, text="2", beside=lambda: late(out))
        assert (out / "registration.json").read_text() == "1"
        assert (out / "late.txt").read_text() == "mine"
        return
    swap = folders._swap_in

    def swap_late(temporary: Path, path: Path, old: Path) -> Path:
        late(path)
        return swap(temporary, path, old)

    monkeypatch.setattr(folders, "_swap_in", swap_late)
    make(out, overwrite=True, text="2")
    assert (out / "registration.json").read_text() == "2"
    assert tree(out.parent / "OUT.kept") == {"late.txt": b"mine"}
    assert sorted(os.listdir(out.parent)) == ["OUT", "OUT.kept"]


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.EINVAL])
def test_where_paths_cannot_change_places_they_are_renamed(
    out: Path, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    import ctypes

    def cannot(*_: object) -> int:
        ctypes.set_errno(number)
        return -1

    class Library:
        renameat2 = staticmethod(cannot)

    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: Library)
    make(out, overwrite=True, text="2")
    assert (out / "registration.json").read_text() == "2"
    assert os.listdir(out.parent) == ["OUT"]


def test_the_old_result_is_there_until_the_new_one_is_whole(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At no system call is OUT missing: it is looked for before each one that renames."""
    seen = []
    real = folders._exchange

    def watched(one: Path, other: Path) -> bool:
        seen.append((other / "registration.json").read_text())
        done = real(one, other)
        seen.append((other / "registration.json").read_text())
        return done

    monkeypatch.setattr(folders, "_exchange", watched)
    monkeypatch.setattr(folders.os, "replace", lambda *_: pytest.fail("OUT would be missing"))
    with atomic_folder(out, overwrite=True) as folder:
        (folder / "registration.json").write_text("2")
    assert seen == ["1", "2"]
    assert os.listdir(out.parent) == ["OUT"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is damaged"),
        ("[" * 100_000, "is damaged"),
        ("{}", "is damaged"),
        ('{"schema": "meshreg.manifest/2", "files": {}}', "another version of meshreg"),
        ('{"schema": "meshreg.manifest/1", "files": {"a": 1}}', "another version|is damaged"),
        ('{"schema": "meshreg.manifest/1", "files": []}', "another version|is damaged"),
        ('{"schema": "meshreg.manifest/1", "files": {"a": {"bytes": 1e400}}}', "version|damaged"),
    ],
)
def test_a_damaged_manifest_protects_everything(out: Path, text: str, words: str) -> None:
    (out / "manifest.json").write_text(text)
    before = tree(out)
    with pytest.raises(UsageError, match=words):
        make(out, overwrite=True)
    assert tree(out) == before


def test_a_manifest_cannot_speak_of_files_elsewhere(out: Path) -> None:
    precious = out.parent / "precious.txt"
    precious.write_text("mine")
    entry = {"bytes": 4, "sha256": hashlib.sha256(b"mine").hexdigest()}
    document = json.loads((out / "manifest.json").read_text())
    document["files"] |= {"../precious.txt": entry, str(precious): entry}
    (out / "manifest.json").write_text(json.dumps(document))
    make(out, overwrite=True, text="2")
    assert precious.read_text() == "mine"


# --- folders from before there were manifests


RECORD = '{"moving": {"path": ["/data/2019/new.obj", "b.copc.laz"]}}'
README_TABLE = [
    "settings.toml", "log.txt", "report.html", "evidence.npz", "validation.html",
    "validation.json", "transform.txt", "transform_inverse.txt", "transform_global.txt",
    "transform_inverse_b.txt", "reference_dem.tif", "moving_dem.tif", "reference_ortho.tif",
    "moving_ortho.tif", "figures/residuals.png", "new_registered.obj", "new_registered_offset.xyz",
    "new_registered.survey.toml", "b_registered.laz", "new_registered/images.bin",
    "moving_dem.tif.aux.xml",
]  # fmt: skip


def former(folder: Path, names: list[str]) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("x")
    (folder / "registration.json").write_text(RECORD)
    return folder


def test_a_former_result_is_known_by_the_names_in_the_readme(tmp_path: Path) -> None:
    out = former(tmp_path / "OUT", README_TABLE)
    make(out, overwrite=True)
    assert "settings.toml" not in tree(out)


@pytest.mark.parametrize(
    "name",
    [
        "ties.csv", "old.obj", "new.obj", "new_registered.obj.bak", "new_registered", "page.jpg",
        "other_registered.obj", "figures/mine.pdf", "figures/deep/a.png", "mask.tif", "nav.csv",
        "reference_dem.tif.ovr", "notes.txt", "new_registered/mine.txt", "transform/a.txt",
    ],
)  # fmt: skip
def test_no_other_name_of_a_former_result_is_ours(tmp_path: Path, name: str) -> None:
    names = [n for n in README_TABLE if not name.startswith("new_registered") or n == "log.txt"]
    out = former(tmp_path / "OUT", [*names, name])
    before = tree(out)
    with pytest.raises(UsageError, match=f"{name}. Nothing is deleted"):
        make(out, overwrite=True)
    assert tree(out) == before


# --- the folder itself


def test_a_folder_that_cannot_be_replaced_is_refused_before_the_work(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(out)
    with pytest.raises(UsageError, match="is the current folder"):
        make(Path("."), overwrite=True)
    monkeypatch.chdir(out / "figures")
    with pytest.raises(UsageError, match="is the current folder, or holds it"):
        make(Path(".."), overwrite=True)
    monkeypatch.chdir(out.parent)
    monkeypatch.setenv("HOME", str(out))
    with pytest.raises(UsageError, match="is your home"):
        make(out, overwrite=True)
    monkeypatch.setenv("HOME", str(out.parent.parent))
    (out.parent / "link").symlink_to(out)
    with pytest.raises(UsageError, match="not a folder"):
        make(out.parent / "link", overwrite=True)
    with pytest.raises(UsageError, match="is a mount point"):
        make(Path("/proc"), overwrite=True)
    assert (out / "registration.json").read_text() == "1"


def test_an_input_within_is_refused_whatever_way_it_is_named(out: Path) -> None:
    (out.parent / "link.obj").symlink_to(out / "registration.json")
    (out.parent / "folder").symlink_to(out)
    for name in (
        "OUT/registration.json",
        "OUT/none.obj",
        "OUT",
        "link.obj",
        "folder/x",
        "OUT/../OUT/x",
    ):
        with pytest.raises(UsageError, match=r"holds files that are read: .*Nothing is deleted"):
            require_apart(out, [out.parent / "fine.obj", out.parent / name])
    require_apart(out, [out.parent / "OUT2" / "x", out.parent, "elsewhere.obj"])
    require_apart(out.parent / "absent", [out.parent / "absent" / "x"])


# --- files that are written later


def test_later_files_are_entered_and_foreign_ones_not_written_over(out: Path) -> None:
    page = out / "validation.html"
    require_ours(out, ["validation.html", "registration.json"])
    write_into(out, {"validation.html": b"ours", "figures/validation.png": b"png"})
    assert page.read_bytes() == b"ours"
    require_ours(out, ["validation.html", "figures/validation.png"])
    assert set(require_only_ours(out, ("registration.json",))) == set(tree(out))
    page.write_text("a remark of mine")
    with pytest.raises(UsageError, match=r"validation\.html: is not as meshreg wrote it"):
        require_ours(out, ["validation.html"])
    (out / "manifest.json").unlink()
    require_ours(out, ["validation.html"])
    write_into(out, {"validation.html": b"ours"})
    assert page.read_bytes() == b"ours"
    assert not (out / "manifest.json").exists()


def test_a_run_killed_at_any_file_leaves_only_files_that_are_ours(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which the next run writes over, and --overwrite replaces; before it the old or the new."""
    names = ("validation.html", "validation.json")
    for files in (dict.fromkeys(names, b"first"), dict.fromkeys(names, b"second")):
        for at in range(4):  # the manifest, two files, the manifest
            replaced = []

            def replace(source: Path, to: Path, at: int = at, seen: list = replaced) -> None:
                if len(seen) == at:
                    raise KeyboardInterrupt
                seen.append(to)
                os.rename(source, to)

            with monkeypatch.context() as patch:
                patch.setattr("meshreg.io.result.folders.os.replace", replace)
                with pytest.raises(KeyboardInterrupt):
                    write_into(out, {name: data + bytes([at]) for name, data in files.items()})
            assert len(replaced) == at
            require_ours(out, names)
            assert set(require_only_ours(out, ("registration.json",))) == set(tree(out))
        write_into(out, files)
        assert {(out / name).read_bytes() for name in names} == set(files.values())
        require_ours(out, names)
    (out / names[0]).write_text("a remark of mine")
    with pytest.raises(UsageError, match="is not as meshreg wrote it"):
        require_ours(out, names)


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    ours=st.sets(st.sampled_from(["a", "b/c", "b/d", "e/f/g", "h.tif"]), min_size=1),
    foreign=st.dictionaries(
        st.sampled_from(["x", "b/y", "e/f/z", "h.tif.aux.xml", "q/"]), st.just(b"")
    ),
    changed=st.booleans(),
)
def test_whatever_is_there_either_all_goes_or_all_stays(tmp_path_factory, ours, foreign, changed):
    """Over any mixture of our files and others: replaced where all is ours, else untouched."""
    out = tmp_path_factory.mktemp("any") / "OUT"
    with atomic_folder(out, command="register") as folder:
        for name in (*ours, "registration.json"):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text("old")
    for name in foreign:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).mkdir() if name.endswith("/") else (out / name).write_text("mine")
    if changed:
        (out / min(ours)).write_text("OLD")
    free = changed or any(n != "h.tif.aux.xml" or "h.tif" not in ours for n in foreign)
    before = tree(out)
    try:
        make(out, overwrite=True)
    except UsageError:
        assert free
        assert tree(out) == before
    else:
        assert not free
        assert "reference_dem.tif" in tree(out)
        assert not ours & set(tree(out))
    assert os.listdir(out.parent) == ["OUT"]


def test_a_killed_run_that_had_changed_places_is_cleared_away(out: Path) -> None:
    """OUT is the new result, and the hidden folder holds the former one with its manifest."""
    make(out.parent / "B")
    with atomic_folder(out, overwrite=True) as folder:
        hidden = folder
        (folder / "registration.json").write_text("2")
    (out.parent / "B").rename(hidden)
    (hidden / "mine.txt").write_text("mine")
    with pytest.raises(UsageError, match="exists already"), atomic_folder(out):
        pass
    with atomic_folder(out, overwrite=True) as folder:
        (folder / "registration.json").write_text("3")
    assert sorted(os.listdir(out.parent)) == ["OUT", "OUT.kept"]
    assert tree(out.parent / "OUT.kept") == {"mine.txt": b"mine"}
    assert manifest.NAME not in tree(out)


class StopAt:
    """A trace function that raises KeyboardInterrupt at the k-th line of the code that swaps."""

    def __init__(self, at: int) -> None:
        self.left = at

    def __call__(self, frame: FrameType, event: str, arg: object) -> StopAt | None:
        code = frame.f_code
        if (
            code.co_filename not in (atomic.__file__, folders.__file__, manifest.__file__)
            or code.co_name == "_locked"
        ):
            return None  # the lock ends with the process, which the test does not
        if event == "line":
            self.left -= 1
            if self.left == 0:
                sys.settrace(None)
                raise KeyboardInterrupt
        return self


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # files left open
@pytest.mark.parametrize("exchange", [True, False])
def test_a_signal_at_any_line_leaves_one_whole_result_and_every_file_that_is_not_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exchange: bool
) -> None:
    """Somebody puts a file into OUT at the last moment, after it was looked at for such."""
    swap, before = folders._swap_in, sys.gettrace()
    if not exchange:
        monkeypatch.setattr(folders, "_exchange", lambda one, other: False)

    def late(temporary: Path, path: Path, old: Path) -> None:
        (path / "mine.txt").write_text("mine")
        swap(temporary, path, old)

    at, stopped = 0, True
    while stopped:
        at += 7  # of some 1,500
        out = tmp_path / str(at) / "OUT"
        out.parent.mkdir()
        make(out)
        with monkeypatch.context() as patch:
            patch.setattr(folders, "_swap_in", late)
            try:
                with atomic_folder(out, overwrite=True, command="register") as folder:
                    (folder / "registration.json").write_text("2")
                    sys.settrace(StopAt(at))
                stopped = False
            except KeyboardInterrupt:
                pass
            finally:
                sys.settrace(before)
        put = [path.read_text() for path in out.parent.rglob("mine.txt")]
        with suppress(UsageError):  # where "mine.txt" is in OUT still
            make(out, overwrite=True, text="3")
        assert (out / "registration.json").read_text() in ("1", "3"), at
        assert set(os.listdir(out.parent)) <= {"OUT", "OUT.kept"}, at
        kept = [path.read_text() for path in out.parent.rglob("mine.txt")]
        assert kept == put, at
    assert put == ["mine"]
    assert at > 100
