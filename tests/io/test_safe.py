"""The resolver of references, the checks before reading, and the writers of whole files."""

from __future__ import annotations

import errno
import hashlib
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from meshreg.errors import InputError, OutputError, UnsafeReferenceError, UsageError
from meshreg.io.files import atomic
from meshreg.io.files.atomic import atomic_file, copy_file
from meshreg.io.files.safe import (
    MissingReferenceError,
    decode_name,
    file_bytes,
    fingerprint,
    open_regular,
    require,
    resolve_reference,
    sha256,
)
from meshreg.io.result.folders import atomic_folder


@pytest.fixture
def survey(tmp_path):
    """A survey's folder with a secret beside it."""
    (tmp_path / "secret.txt").write_text("secret")
    folder = tmp_path / "survey"
    (folder / "Tex tures").mkdir(parents=True)
    (folder / "page.jpg").write_bytes(b"page")
    (folder / "Tex tures" / "Page 1.PNG").write_bytes(b"one")
    return folder


def found(folder, name):
    return resolve_reference(folder, name, root=folder)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("page.jpg", "page.jpg"),
        (b"page.jpg", "page.jpg"),
        ("  page.jpg ", "page.jpg"),
        ("./page.jpg", "page.jpg"),
        (".\\page.jpg", "page.jpg"),
        ("PAGE.JPG", "page.jpg"),
        ("Tex tures/Page 1.PNG", "Tex tures/Page 1.PNG"),
        ("Tex tures\\Page 1.PNG", "Tex tures/Page 1.PNG"),
        (b"tex TURES//page 1.png", "Tex tures/Page 1.PNG"),
    ],
)
def test_a_reference_is_found_however_it_is_spelt(survey, name, expected):
    assert found(survey, name) == survey / expected


@pytest.mark.parametrize("on_disk", ["Höhle.jpg".encode(), "Höhle.jpg".encode("latin-1")])
@pytest.mark.parametrize("written", ["Höhle.jpg".encode(), "Höhle.jpg".encode("latin-1")])
def test_names_of_other_bytes_are_found(survey, on_disk, written):
    if not sys.platform.startswith("linux"):
        pytest.skip("file names are text on this system")
    Path(os.fsdecode(bytes(survey) + b"/" + on_disk)).write_bytes(b"cave")
    if on_disk != written and on_disk == "Höhle.jpg".encode("latin-1"):
        # UTF-8 in the file and Latin-1 on the disk: nothing says that they belong together.
        with pytest.raises(MissingReferenceError):
            found(survey, written)
    else:
        assert found(survey, written).read_bytes() == b"cave"


def test_unicode_forms_do_not_matter(survey):
    (survey / "reéf.jpg").write_bytes(b"composed")
    assert found(survey, "reéf.jpg").read_bytes() == b"composed"


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("../secret.txt", "climbs out"),
        ("a/../../secret.txt", "climbs out"),
        ("..\\secret.txt", "climbs out"),
        ("page.jpg/..", "climbs out"),
        ("/etc/hostname", "absolute"),
        ("\\\\server\\share\\x.jpg", "absolute"),
        ("//server/x.jpg", "absolute"),
        ("C:\\x.jpg", "drive"),
        ("c:x.jpg", "drive"),
        ("http://example.org/x.jpg", "scheme"),
        ("file:///etc/hostname", "scheme"),
        ("data:image/png;base64,AAAA", "scheme"),
        ("page.jpg\0.png", "NUL"),
        ("", "names no file"),
        (" ./ ", "names no file"),
        ("Tex tures", "not a regular file"),
    ],
)
def test_unsafe_references_are_refused(survey, name, why):
    for spelling in (name, name.encode()):
        with pytest.raises(UnsafeReferenceError, match=why):
            found(survey, spelling)


def test_links_may_not_leave_the_folder(survey):
    (survey / "out.jpg").symlink_to(survey.parent / "secret.txt")
    (survey / "folder").symlink_to(survey.parent)
    (survey / "in.jpg").symlink_to(survey / "page.jpg")
    (survey / "nowhere.jpg").symlink_to(survey / "gone.jpg")
    assert found(survey, "in.jpg").read_bytes() == b"page"
    for name in ("out.jpg", "OUT.jpg", "folder/secret.txt"):
        with pytest.raises(UnsafeReferenceError, match="link that leaves"):
            found(survey, name)
    with pytest.raises(UnsafeReferenceError, match="not a regular file"):
        found(survey, "nowhere.jpg")


def test_a_linked_survey_folder_is_its_own_root(survey, tmp_path):
    link = tmp_path / "link"
    link.symlink_to(survey)
    assert found(link, "page.jpg").read_bytes() == b"page"


def test_a_file_below_may_refer_within_the_root_only(survey):
    below = survey / "Tex tures"
    assert resolve_reference(below, "Page 1.PNG", root=survey) == below / "Page 1.PNG"
    with pytest.raises(UnsafeReferenceError, match="climbs out"):
        resolve_reference(below, "../page.jpg", root=survey)


def test_a_pipe_is_refused_without_waiting(survey):
    os.mkfifo(survey / "pipe.jpg")
    with pytest.raises(UnsafeReferenceError, match="not a regular file"):
        found(survey, "pipe.jpg")
    with pytest.raises(InputError, match="a pipe, socket or device"):
        open_regular(survey / "pipe.jpg")


def test_two_files_that_differ_in_case_are_named(survey):
    (survey / "Rock.jpg").write_bytes(b"a")
    (survey / "rock.JPG").write_bytes(b"b")
    assert found(survey, "Rock.jpg").read_bytes() == b"a"
    with pytest.raises(MissingReferenceError, match=r"several files: Rock\.jpg, rock\.JPG"):
        found(survey, "ROCK.jpg")


def test_a_missing_file_is_named_with_its_folder(survey):
    with pytest.raises(MissingReferenceError) as caught:
        found(survey, b"none/gone.jpg")
    assert "'none/gone.jpg'" in str(caught.value)
    assert str(survey) in str(caught.value)


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.one_of(
        st.binary(max_size=30),
        st.lists(
            st.sampled_from(["..", ".", "", "link", "page.jpg", "~", "\\", "/", "C:"]), max_size=6
        ).map("/".join),
    )
)
def test_whatever_is_written_no_reference_leaves_the_root(survey, name):
    if not (survey / "link").is_symlink():
        (survey / "link").symlink_to(survey.parent)
    try:
        path = found(survey, name)
    except InputError:
        return
    assert path.resolve().is_relative_to(survey.resolve())
    assert path.is_file()


def test_decode_name():
    assert decode_name("Höhle".encode()) == "Höhle"
    assert decode_name("Höhle".encode("latin-1")) == "Höhle"
    assert decode_name("Höhle") == "Höhle"


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda path: None, "No such file"),
        (lambda path: path.mkdir(), "a folder"),
        (lambda path: path.symlink_to("/dev/zero"), "a pipe, socket or device"),
        (lambda path: path.symlink_to(path.name), "cannot be opened"),
    ],
)
def test_only_regular_files_are_opened(tmp_path, make, why):
    path = tmp_path / "x.obj"
    make(path)
    for opener in (open_regular, file_bytes, sha256, fingerprint):
        with pytest.raises(InputError, match=why) as caught:
            opener(path)
        assert caught.value.file == str(path)


def test_a_path_with_a_nul_byte_is_bad_input():
    with pytest.raises(InputError, match="cannot be opened"):
        open_regular(Path("a\0b"))


def test_file_bytes_are_read_only(tmp_path):
    path = tmp_path / "x.bin"
    path.write_bytes(bytes(range(200)))
    data = file_bytes(path)
    np.testing.assert_array_equal(data, np.arange(200))
    assert type(data) is np.ndarray
    with pytest.raises(ValueError, match="read-only"):
        data[0] = 1
    path.write_bytes(b"")
    with pytest.raises(InputError, match="is empty"):
        file_bytes(path)


@pytest.mark.parametrize("count", [-1, 101, 2**70])
def test_require_refuses_what_cannot_fit(count):
    with pytest.raises(InputError) as caught:
        require(count, 12, 1200, Path("a.ply"), "line 3", "vertices")
    assert str(caught.value).startswith(f"a.ply, line 3: declares {count} vertices")
    assert "1200 bytes" in str(caught.value)


def test_require_takes_what_just_fits():
    require(100, 12, 1200, Path("a.ply"), "line 3", "vertices")
    require(0, 12, 0, Path("a.ply"), "line 3", "vertices")


def test_fingerprint_and_sha256(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(b"reef")
    before = fingerprint(path)
    assert before[0] == 4
    assert sha256(path) == hashlib.sha256(b"reef").hexdigest()
    os.utime(path, ns=(0, before[1] + 1))
    assert fingerprint(path) != before


# Whole files.


def names(folder):
    return sorted(os.listdir(folder))


def test_atomic_file_replaces_at_the_end_only(tmp_path):
    path = tmp_path / "out.json"
    path.write_text("old")
    with atomic_file(path) as temporary:
        assert temporary.suffix == ".json"
        assert temporary.parent == tmp_path
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert names(tmp_path) == ["out.json"]


def write_half_a_file(path, error):
    with atomic_file(path) as temporary:
        temporary.write_text("half")
        raise error


def make_half_a_folder(path, **options):
    with atomic_folder(path, **options) as temporary:
        (temporary / "half").write_text("")
        raise KeyError


def enter(manager):
    """Enter a context; for contexts that must refuse to be entered."""
    with manager:
        pytest.fail("the block must not run")


@pytest.mark.parametrize("error", [ValueError("x"), KeyboardInterrupt(), MemoryError()])
def test_atomic_file_leaves_the_old_file_on_any_error(tmp_path, error):
    path = tmp_path / "out.json"
    path.write_text("old")
    with pytest.raises(type(error)):
        write_half_a_file(path, error)
    assert path.read_text() == "old"
    assert names(tmp_path) == ["out.json"]


def test_atomic_file_keeps_the_usual_permissions(tmp_path):
    plain = tmp_path / "plain"
    plain.write_text("")
    with atomic_file(tmp_path / "ours") as temporary:
        temporary.write_text("")
    assert (tmp_path / "ours").stat().st_mode == plain.stat().st_mode


def test_os_errors_become_output_errors(tmp_path):
    with pytest.raises(OutputError, match="No such file") as caught:
        enter(atomic_file(tmp_path / "none" / "x"))
    assert caught.value.exit_code == 6
    with pytest.raises(OutputError, match="No space left"):
        write_half_a_file(tmp_path / "x", OSError(errno.ENOSPC, "No space left on device"))
    assert names(tmp_path) == []


def failing_after(monkeypatch, good):
    """Make the n-th system call of the atomic writers fail, counted over all kinds.

    What is returned holds the kind of call that failed, once it has.
    """
    calls, failed = iter(range(10**6)), []

    def wrapped(real, kind):
        def call(*args, **kwargs):
            if next(calls) == good:
                failed.append(kind)
                raise OSError(errno.EIO, f"broken {kind}")
            return real(*args, **kwargs)

        return call

    for kind in ("open", "fsync", "replace", "listdir", "write", "ftruncate"):
        monkeypatch.setattr(atomic.os, kind, wrapped(getattr(os, kind), kind))
    return failed


def test_a_signal_right_after_the_file_is_made_leaves_nothing(tmp_path, monkeypatch):
    """It may come before any name is bound to what was opened."""
    real = os.open

    def interrupted(path, flags, *mode):
        handle = real(path, flags, *mode)
        if flags & os.O_EXCL:
            os.close(handle)
            raise KeyboardInterrupt
        return handle

    monkeypatch.setattr(atomic.os, "open", interrupted)
    with pytest.raises(KeyboardInterrupt), atomic_file(tmp_path / "out.txt"):
        pytest.fail("the block is not reached")
    assert list(tmp_path.iterdir()) == []


def test_atomic_file_survives_a_fault_at_every_call(tmp_path):
    path = tmp_path / "out.txt"
    for good in range(100):
        path.write_text("old")
        with pytest.MonkeyPatch.context() as patch:
            failed = failing_after(patch, good)
            try:
                with atomic_file(path) as temporary:
                    Path(temporary).write_text("new")
                said = ""
            except OutputError as error:
                said = str(error)
        assert names(tmp_path) == ["out.txt"]
        # once the file is in place it is there, also where its folder cannot be synced
        assert path.read_text() == ("old" if said else "new")
        assert not said or f"broken {failed[0]}" in said
        if not failed:
            break
    assert 3 < good < 12


def test_atomic_file_clears_away_what_a_killed_process_left(tmp_path):
    """And nothing else: not what a living one writes, nor a file that only looks like it."""
    path = tmp_path / "out.json"
    code = (
        "import os, signal, sys\n"
        "from meshreg.io.files.atomic import atomic_file\n"
        "with atomic_file(sys.argv[1]) as temporary:\n"
        "    temporary.write_text('half')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, path], check=False)
    assert done.returncode == -signal.SIGKILL
    left = names(tmp_path)
    assert len(left) == 1
    assert left[0].startswith(".out.")
    others = [".out.2019.tmp.json", "out.0123456789ab.tmp.json", ".put.0123456789ab.tmp.json"]
    for name in others:
        (tmp_path / name).write_text("somebody's")
    with atomic_file(path) as first:
        first.write_text("first")
        assert left[0] not in names(tmp_path)
        with atomic_file(path) as second:
            second.write_text("second")
            assert first.read_text() == "first"
        assert path.read_text() == "second"
    assert path.read_text() == "first"
    assert names(tmp_path) == sorted([*others, "out.json"])


def test_atomic_folder_survives_a_fault_at_every_call(tmp_path):
    path = tmp_path / "OUT"
    for good in range(100):
        if not path.exists():
            path.mkdir()
        (path / "registration.json").write_text("old")
        with pytest.MonkeyPatch.context() as patch:
            failing_after(patch, good)
            try:
                with atomic_folder(path, overwrite=True) as temporary:
                    (temporary / "registration.json").write_text("new")
                    (temporary / "figures").mkdir()
                    (temporary / "figures" / "a.png").write_text("a")
                text, done = "broken", True
            except OutputError as error:
                text, done = str(error), False
        assert "broken" in text
        # Hidden leftovers may stay where removing them fails; the next run clears them away.
        assert [name for name in names(tmp_path) if name[0] != "."] == ["OUT"]
        text = (path / "registration.json").read_text()
        assert text in ("old", "new")
        if done:
            assert text == "new"
            assert names(path) == ["figures", "registration.json"]
        if done and names(tmp_path) == ["OUT"]:
            break
    assert 5 < good < 40


def test_atomic_folder_is_whole_or_absent(tmp_path):
    path = tmp_path / "OUT"
    with pytest.raises(KeyError):
        make_half_a_folder(path)
    assert names(tmp_path) == []
    with atomic_folder(path) as temporary:
        (temporary / "registration.json").write_text("1")
        assert not path.exists()
    assert names(tmp_path) == ["OUT"]
    assert names(path) == ["registration.json"]


def test_an_existing_folder_is_refused_before_any_work(tmp_path):
    path = tmp_path / "OUT"
    path.mkdir()
    with pytest.raises(UsageError, match="exists already") as caught:
        enter(atomic_folder(path))
    assert caught.value.exit_code == 2
    assert "--overwrite" in str(caught.value)


def test_only_a_former_result_is_overwritten(tmp_path):
    path = tmp_path / "Documents"
    path.mkdir()
    (path / "thesis.tex").write_text("years of work")
    with pytest.raises(UsageError, match=r"no registration\.json"):
        enter(atomic_folder(path, overwrite=True))
    assert (path / "thesis.tex").read_text() == "years of work"
    with pytest.raises(UsageError, match="not a folder"):
        enter(atomic_folder(path / "thesis.tex", overwrite=True))
    with pytest.raises(UsageError, match=r"did not write, .* thesis\.tex\. Nothing is deleted"):
        enter(atomic_folder(path, overwrite=True, markers=("thesis.tex",)))
    assert names(path) == ["thesis.tex"]
    with atomic_folder(tmp_path / "empty", overwrite=True):
        pass


def test_a_second_run_is_kept_out_while_the_first_lives(tmp_path):
    path = tmp_path / "OUT"
    with atomic_folder(path):
        with pytest.raises(OutputError, match=f"process {os.getpid()}") as caught:
            enter(atomic_folder(path))
        assert caught.value.exit_code == 6
    with atomic_folder(path, overwrite=True):
        pass


def run_until_killed(path, ready):
    with atomic_folder(path, overwrite=True) as temporary:
        (temporary / "half").write_text("")
        ready.set()
        time.sleep(60)


def test_a_killed_run_leaves_nothing_that_matters(tmp_path):
    path = tmp_path / "OUT"
    path.mkdir()
    (path / "registration.json").write_text("old")
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    process = context.Process(target=run_until_killed, args=(path, ready))
    process.start()
    assert ready.wait(60)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert (path / "registration.json").read_text() == "old"
    assert len(names(tmp_path)) == 3  # OUT, its lock, the half folder
    with atomic_folder(path, overwrite=True) as temporary:
        assert names(temporary) == []
        (temporary / "registration.json").write_text("new")
    assert names(tmp_path) == ["OUT"]
    assert (path / "registration.json").read_text() == "new"


def test_a_result_that_was_being_replaced_comes_back(tmp_path):
    path = tmp_path / "OUT"
    with atomic_folder(path) as temporary:
        old = temporary.with_suffix(".old")
    os.rename(path, old)  # killed between the two renames
    with pytest.raises(KeyError):
        make_half_a_folder(path, overwrite=True)
    assert names(tmp_path) == ["OUT"]


def test_copy_file(tmp_path):
    source = tmp_path / "page.jpg"
    source.write_bytes(b"page")
    target = tmp_path / "a" / "b" / "page.jpg"
    copy_file(source, target)
    assert target.read_bytes() == b"page"
    copy_file(source, target)
    target.write_bytes(b"other")
    with pytest.raises(OutputError, match="other content"):
        copy_file(source, target)
    assert target.read_bytes() == b"other"
    with pytest.raises(OutputError):
        copy_file(source, source / "x")
