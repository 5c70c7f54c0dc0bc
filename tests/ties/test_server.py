"""The page's server without a browser: who gets in, what changes, what is in the file."""

from __future__ import annotations

import io
import json
import math
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from made_registration import made_registration
from PIL import Image
from starlette.testclient import TestClient

from meshreg.cli import app as cli
from meshreg.errors import InputError, OutputError, UsageError
from meshreg.io.maps.pair import write_raster
from meshreg.io.result.document import registration_document, to_json
from meshreg.records import Grid, SurveyRaster
from meshreg.ties import TiePair, TiePoints, read_ties, write_ties
from meshreg.ties.guard import Guard
from meshreg.ties.placing import Placing
from meshreg.ties.server import PickServer, make_app
from meshreg.ties.session import Session, StaleError, only_one
from meshreg.ties.state import Link, PickState
from meshreg.ties.tiles import SIDE, TileSource, overlap_points

PORT = 8123
HOME = f"http://127.0.0.1:{PORT}"


def picture(path: Path, shape=(700, 900), west=500.0, north=900.0, cell=0.01, seed=0) -> np.ndarray:
    """A GeoTIFF of noise with an empty corner, and its bands."""
    rng = np.random.default_rng(seed)
    color = rng.integers(0, 255, (*shape, 3), np.uint8)
    seen = np.ones(shape, bool)
    seen[:90, :130] = False
    color[~seen] = 0
    height = np.zeros(shape, np.float32)
    raster = SurveyRaster(
        Grid(west, north, cell, shape), height, color, seen, seen, np.ones(shape, np.uint16)
    )
    write_raster(raster, path, "color")
    return np.dstack([color, np.where(seen, 255, 0).astype(np.uint8)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures")
    picture(folder / "reference.tif")
    picture(folder / "moving.tif", west=498.0, north=899.0, seed=1)
    return folder


@pytest.fixture
def desk(folder, tmp_path):
    sources = [TileSource(folder / f"{name}.tif") for name in ("reference", "moving")]
    yield PickState(*sources, ("old", "new"), Session(tmp_path / "ties.csv"))
    for source in sources:
        source.close()


@pytest.fixture
def pool():
    with ThreadPoolExecutor(2) as found:
        yield found


@pytest.fixture
def guard(desk, pool):
    return Guard(make_app(desk, pool), PORT)


@pytest.fixture
def client(guard):
    with TestClient(guard, base_url=HOME) as found:
        assert found.get("/", params={"token": guard.token}).status_code == 200
        yield found


def change(client, revision, what, **values):
    return client.post("/api/change", json={"revision": revision, "what": what, **values})


# Who gets in


def test_the_token_works_once_and_buys_a_cookie(guard):
    with TestClient(guard, base_url=HOME) as client:
        assert client.get("/").status_code == 403
        assert client.get("/", params={"token": guard.token[:-1] + "!"}).status_code == 403
        assert client.get("/api/job", params={"token": guard.token}).status_code == 403
        answer = client.get("/", params={"token": guard.token})
        assert answer.status_code == 200
        cookie = answer.headers["set-cookie"].lower()
        assert "httponly" in cookie
        assert "samesite=strict" in cookie
        assert guard.token not in answer.text
        assert client.get("/api/job").status_code == 200
        client.cookies.clear()
        assert client.get("/", params={"token": guard.token}).status_code == 403


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", f"127.0.0.1.evil.example:{PORT}",
                                  f"localhost:{PORT + 1}", ""])  # fmt: skip
def test_another_host_name_is_refused(client, host):
    assert client.get("/api/state").status_code == 200
    assert client.get("/api/state", headers={"host": host}).status_code == 403
    assert client.get("/api/state", headers={"host": f"localhost:{PORT}"}).status_code == 200


@pytest.mark.parametrize("origin", ["https://evil.example", "null", f"https://127.0.0.1:{PORT}"])
def test_another_origin_changes_nothing(client, desk, origin):
    values = {"revision": 0, "what": "point", "side": "reference", "x": 501, "y": 895}
    answer = client.post("/api/change", json=values, headers={"origin": origin})
    assert answer.status_code == 403
    assert desk.session.revision == 0
    assert client.post("/api/change", json=values, headers={"origin": HOME}).status_code == 200


def test_every_answer_carries_the_policy(client):
    for path in ("/", "/api/job", "/assets/pick.js", "/assets/none.js", "/tiles/moving/0/0/0.png"):
        headers = client.get(path).headers
        assert headers["content-security-policy"].startswith("default-src 'self'")
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
    page = client.get("/").text
    assert "http" not in page  # nothing from elsewhere
    assert "<style" not in page
    for line in page.splitlines():
        assert "<script" not in line or "src=" in line


@pytest.mark.parametrize("name", ["OPENLAYERS-LICENSE.md", "../server.py", "..%2fserver.py"])
def test_only_assets_are_served(client, name):
    assert client.get(f"/assets/{name}").status_code == 404


# What changes


def test_a_pair_is_in_the_file_before_the_answer(client, desk):
    answer = change(client, 0, "point", side="moving", x=499.12345, y=895.0)
    assert answer.status_code == 200
    assert read_ties(desk.session.path).pairs == (TiePair(1, "", None, (499.1234, 895.0)),)
    state = change(client, 1, "point", side="reference", x=501.5, y=894.25).json()
    assert state["revision"] == 2
    assert state["hand"] is None
    assert read_ties(desk.session.path).complete[0].reference == (501.5, 894.25)
    assert client.get("/api/state?since=2").status_code == 204
    assert client.get("/api/state?since=1").json() == state


def test_the_hand_registration_follows_each_pair(client, desk):
    for k in range(4):
        for side, shift in (("reference", 0.0), ("moving", -1.5)):
            wrong = 0.8 if k == 3 and shift else 0.0
            at = {"x": 502 + k + shift + wrong, "y": 895.0 + 0.5 * k}
            state = change(client, 2 * k + (shift < 0), "point", side=side, **at).json()
    assert state["hand"]["east"] == pytest.approx(1.5)
    assert state["hand"]["north"] == pytest.approx(0.0)
    assert [pair["inlier"] for pair in state["pairs"]] == [True, True, True, False]
    assert state["pairs"][3]["residual"] == pytest.approx(0.8)
    link = Link(0.0, state["links"]["pairs"]["shown"], state["links"]["pairs"]["reference"])
    assert np.allclose(link.to_shown([[505.0, 895.0]]), [[503.5, 895.0]])
    assert "north-west" in state["weak"]
    assert "middle" not in state["weak"]


def test_a_survey_delivered_turned_is_laid_down_by_its_pairs(client, desk):
    rng = np.random.default_rng(4)
    moving = rng.uniform((502, 895), (507, 900), (8, 2))
    c, s = np.cos(0.2), np.sin(0.2)
    reference = (moving - [504, 897]) @ np.array([[c, s], [-s, c]]) + [504.3, 896.8]
    for k in range(8):
        for side, places in (("reference", reference), ("moving", moving)):
            x, y = places[k].tolist()
            change(client, desk.session.revision, "point", side=side, x=x, y=y)
    state = client.get("/api/state").json()
    assert state["turned"] == pytest.approx(np.rad2deg(0.2), abs=0.01)
    assert state["hand"]["inliers"] == 8
    assert state["hand"]["residual"] < 1e-3
    assert state["links"]["pairs"]["angle"] == pytest.approx(0.2, abs=2e-4)
    assert state["links"]["delivered"]["angle"] == 0


def test_a_stale_change_is_refused_with_the_present_state(client, desk):
    change(client, 0, "point", side="reference", x=501, y=895)
    answer = change(client, 0, "point", side="reference", x=777, y=777)
    assert answer.status_code == 409
    assert answer.json()["state"]["revision"] == 1
    assert "Another window" in answer.json()["error"]
    assert read_ties(desk.session.path).pairs[0].reference == (501.0, 895.0)


@pytest.mark.parametrize(
    "body",
    [
        "nothing", "[]", "{}", '{"revision": 0}', "{" * 5000, '{"revision": 0, "what": "explode"}',
        '{"revision": 0, "what": "point", "side": "left", "x": 1, "y": 2}',
        '{"revision": 0, "what": "point", "side": "reference", "x": "1", "y": 2}',
        '{"revision": 0, "what": "point", "side": "reference", "x": NaN, "y": 2}',
        '{"revision": 0, "what": "point", "side": "reference", "x": 1e300, "y": 2}',
        '{"revision": 0, "what": "point", "side": "reference", "x": true, "y": 2}',
        '{"revision": 0, "what": "point", "side": "reference", "x": 1' + "0" * 400 + ', "y": 2}',
        '{"revision": 0, "what": "name", "id": 5, "name": "x"}',
        '{"revision": 0, "what": "undo"}',
        '{"revision": 0, "what": "point", "junk": "' + "x" * 20_000 + '"}',
    ],
)  # fmt: skip
def test_what_cannot_be_meant_changes_nothing(client, desk, body):
    answer = client.post("/api/change", content=body, headers={"content-type": "application/json"})
    assert answer.status_code == 400
    assert answer.json()["error"]
    assert desk.session.revision == 0
    assert not desk.session.path.exists()


def test_a_form_of_another_page_is_no_change(client, desk):
    body = json.dumps({"revision": 0, "what": "point", "side": "reference", "x": 1, "y": 2})
    answer = client.post("/api/change", content=body, headers={"content-type": "text/plain"})
    assert answer.status_code == 400
    assert desk.session.revision == 0


# The session


def test_undo_and_redo_walk_through_every_change(tmp_path):
    session = Session(tmp_path / "ties.csv")
    seen = [session.ties.pairs]
    for what, values in (
        ("point", {"side": "reference", "x": 1, "y": 2}),
        ("point", {"side": "reference", "x": 3, "y": 4}),  # the open pair's, clicked again
        ("point", {"side": "moving", "x": 5, "y": 6}),
        ("name", {"id": 1, "name": " brain\ncoral\x00 "}),
        ("move", {"id": 1, "side": "moving", "x": 7, "y": 8}),
        ("delete", {"id": 1}),
    ):
        session.change(session.revision, what, values)
        seen.append(session.ties.pairs)
    assert [len(pairs) for pairs in seen] == [0, 1, 1, 1, 1, 1, 0]
    assert seen[5][0] == TiePair(1, "brain coral", (3.0, 4.0), (7.0, 8.0))
    for pairs in reversed(seen[:-1]):
        session.change(session.revision, "undo", {})
        assert read_ties(session.path).pairs == pairs
    for pairs in seen[1:]:
        session.change(session.revision, "redo", {})
        assert read_ties(session.path).pairs == pairs
    assert session.revision == 18


def test_many_hands_at_once_lose_nothing_and_break_nothing(tmp_path):
    session = Session(tmp_path / "ties.csv")
    done, refused = [], []

    def work(who: int) -> None:
        for k in range(12):
            try:
                values = {"side": "reference", "x": who, "y": k}
                session.change(session.revision, "point", values)
                session.change(session.revision, "point", {**values, "side": "moving"})
                done.append((who, k))
            except StaleError:
                refused.append((who, k))

    threads = [threading.Thread(target=work, args=(who,)) for who in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(done) + len(refused) == 48
    assert read_ties(session.path).pairs == session.ties.pairs
    assert session.revision <= 96


def test_a_file_changed_by_another_program_is_shown_before_it_is_written(tmp_path):
    path = tmp_path / "ties.csv"
    session = Session(path)
    session.change(0, "point", {"side": "reference", "x": 1, "y": 2})
    theirs = TiePoints((TiePair(7, "theirs", (8.0, 9.0), (1.0, 1.0)),))
    write_ties(theirs, path)
    with pytest.raises(StaleError, match="another program"):
        session.change(1, "point", {"side": "moving", "x": 3, "y": 4})
    assert session.ties.pairs == theirs.pairs == read_ties(path).pairs
    session.change(2, "point", {"side": "moving", "x": 3, "y": 4})
    assert [pair.id for pair in read_ties(path).pairs] == [7, 8]
    path.write_text("broken")
    with pytest.raises(InputError):
        session.change(3, "delete", {"id": 7})
    assert path.read_text() == "broken"
    path.unlink()  # one that is gone is written again
    session.change(3, "delete", {"id": 8})
    assert [pair.id for pair in read_ties(path).pairs] == [7]


def test_what_cannot_be_written_is_not_counted(tmp_path, monkeypatch):
    session = Session(tmp_path / "ties.csv")
    session.change(0, "point", {"side": "reference", "x": 1, "y": 2})
    with monkeypatch.context() as patch:
        patch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError(28, "full")))
        with pytest.raises(OutputError, match="full"):
            session.change(1, "point", {"side": "moving", "x": 3, "y": 4})
    assert session.revision == 1
    assert session.ties.pairs == read_ties(session.path).pairs
    session.change(1, "point", {"side": "moving", "x": 3, "y": 4})


def test_a_file_of_another_crs_is_refused(tmp_path):
    write_ties(TiePoints((TiePair(1, "", (1.0, 2.0)),), "EPSG:32755"), tmp_path / "ties.csv")
    with pytest.raises(UsageError, match="EPSG:32755"):
        Session(tmp_path / "ties.csv", "EPSG:32756")


def test_a_second_pick_of_the_same_file_is_kept_out(tmp_path):
    code = (
        "import sys; from pathlib import Path\n"
        "from meshreg.ties.session import only_one\n"
        "with only_one(Path(sys.argv[1])): print('in')"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "ties.csv")]
    with only_one(tmp_path / "ties.csv"):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert "is open in another" in done.stderr
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout == "in\n"
    assert list(tmp_path.iterdir()) == []


# Pictures


def test_tiles_are_the_pictures_own_cells(folder, tmp_path):
    bands = picture(tmp_path / "a.tif", (530, 771), seed=4)
    source = TileSource(tmp_path / "a.tif")
    assert source.levels == 3
    assert source.resolutions == [0.04, 0.02, 0.01]
    whole = np.zeros((3 * SIDE, 4 * SIDE, 4), np.uint8)
    for row in range(3):
        for column in range(4):
            tile = np.array(Image.open(io.BytesIO(source.tile(2, column, row))))
            whole[row * SIDE : (row + 1) * SIDE, column * SIDE : (column + 1) * SIDE] = tile
    assert np.array_equal(whole[:530, :771], bands)
    assert not whole[530:].any()
    assert not whole[:, 771:].any()
    for level, column, row in ((2, 4, 0), (2, 0, 3), (3, 0, 0), (-1, 0, 0), (2, -1, 0)):
        assert source.tile(level, column, row) is None
    source.close()


def test_coarse_tiles_are_means_of_whole_blocks(tmp_path):
    bands = picture(tmp_path / "a.tif", (640, 896), seed=5)
    source = TileSource(tmp_path / "a.tif")
    half = np.array(Image.open(io.BytesIO(source.tile(1, 0, 0)))).astype(float)
    mean = bands[: 2 * SIDE, : 2 * SIDE, :3].reshape(SIDE, 2, SIDE, 2, 3).mean(axis=(1, 3))
    inside = (slice(60, 250), slice(80, 250))
    assert np.abs(half[..., :3][inside] - mean[inside]).max() <= 1
    source.close()


@pytest.mark.parametrize("shape", [(531, 1083), (1037, 777), (40, 1500)])
def test_coarse_tiles_lie_where_they_belong(tmp_path, shape):
    """A ramp to the east and one to the south: a grey value is a place."""
    rows, cols = shape
    ramp = np.zeros((*shape, 3), np.uint8)
    ramp[..., 0] = np.linspace(0, 255, cols)[None, :]
    ramp[..., 1] = np.linspace(0, 255, rows)[:, None]
    seen = np.ones(shape, bool)
    height = np.zeros(shape, np.float32)
    grid = Grid(0.0, 20.0, 0.01, shape)
    raster = SurveyRaster(grid, height, ramp, seen, seen, seen.astype(np.uint16))
    write_raster(raster, tmp_path / "ramp.tif", "color")
    source = TileSource(tmp_path / "ramp.tif")
    for level in range(source.levels - 1):
        step = round(source.resolutions[level] / 0.01)
        tile = np.array(Image.open(io.BytesIO(source.tile(level, 0, 0)))).astype(float)
        i, j = np.nonzero(tile[..., 3] == 255)
        assert len(i) >= min(SIDE, rows // step) * min(SIDE, cols // step)
        red = 255 * ((j + 0.5) * step - 0.5) / (cols - 1)
        green = 255 * ((i + 0.5) * step - 0.5) / (rows - 1)
        half_a_cell = 0.5 * step * 255
        assert np.abs(tile[i, j, 0] - red).max() < half_a_cell / cols + 1.5
        if rows >= step:
            assert np.abs(tile[i, j, 1] - green).max() < half_a_cell / rows + 1.5
    source.close()


def test_threads_do_not_share_a_handle(folder):
    source = TileSource(folder / "reference.tif")
    first = source.tile(2, 1, 1)
    with ThreadPoolExecutor(4) as pool:
        tiles = list(pool.map(lambda _: source.tile(2, 1, 1), range(40)))
    assert all(tile == first for tile in tiles)
    assert 1 < len(source._open) <= 5
    source.close()


def test_a_dem_is_no_picture(tmp_path):
    grid = Grid(0.0, 10.0, 0.1, (100, 100))
    flat, seen = np.zeros((100, 100), np.float32), np.ones((100, 100), bool)
    color = np.zeros((100, 100, 3), np.uint8)
    raster = SurveyRaster(grid, flat, color, seen, seen, seen.astype(np.uint16))
    write_raster(raster, tmp_path / "dem.tif", "height")
    with pytest.raises(InputError, match="1 bands of float32"):
        TileSource(tmp_path / "dem.tif")


def test_overlap_is_where_both_are_seen(folder):
    reference, moving = (TileSource(folder / f"{n}.tif") for n in ("reference", "moving"))
    found = overlap_points(reference, moving, lambda points: points)
    # reference: 500-509 by 893-900; moving: 498-507 by 892-899; both lack their north-west corner
    low, high = found.min(axis=0), found.max(axis=0)
    assert np.allclose(low, [500, 893], atol=0.15)
    assert np.allclose(high, [507, 899], atol=0.15)
    cell = reference.mask(96)[1]
    assert len(found) * cell**2 == pytest.approx(7 * 6, rel=0.06)
    for source in (reference, moving):
        source.close()


def test_points_of_a_registered_picture_go_back_to_the_survey(folder, tmp_path):
    """A result's own picture shows the registered survey; the file says where it was delivered."""
    registration = made_registration("accepted")
    transform = registration.transform
    placing = Placing(registration)
    sources = [TileSource(folder / f"{name}.tif") for name in ("reference", "moving")]
    desk = PickState(*sources, ("a", "b"), Session(tmp_path / "t.csv"), placing, registered=True)
    place = transform.pivot + np.array([3.0, -4.0, 0.0])
    shown = transform.apply(place)
    desk.change(0, "point", {"side": "moving", "x": shown[0], "y": shown[1]})
    desk.change(1, "point", {"side": "reference", "x": shown[0], "y": shown[1]})
    pair = read_ties(tmp_path / "t.csv").pairs[0]
    assert pair.moving == pytest.approx(tuple(place[:2]), abs=1e-4)
    state = desk.state()
    assert state["pairs"][0]["moving"] == pytest.approx(list(shown[:2]), abs=1e-4)
    registered, delivered = (desk._links(None)[name] for name in ("registration", "delivered"))
    assert registered.angle == pytest.approx(0.0, abs=1e-9)
    assert delivered.angle == pytest.approx(
        -math.atan2(transform.rotation[1, 0], transform.rotation[0, 0]), abs=1e-9
    )
    # laid down as delivered, the picture is where the survey's own coordinates have it
    assert np.allclose(delivered.to_shown([place[:2]]), [shown[:2]], atol=1e-6)
    for source in sources:
        source.close()


# The command


def test_the_server_speaks_on_this_machine_alone_and_stops(desk):
    server = PickServer(desk)
    assert server.url.startswith(f"http://127.0.0.1:{server.port}/?token=")
    assert server._socket.getsockname()[0] == "127.0.0.1"
    with pytest.raises(OutputError, match="cannot be used"):
        PickServer(desk, server.port)
    thread = threading.Thread(target=server.run)
    thread.start()
    import httpx2 as httpx

    with httpx.Client() as client:
        assert client.get(server.url).status_code == 200
        assert client.get(f"http://127.0.0.1:{server.port}/api/job").json()["file"] == "ties.csv"
    server.stop()
    thread.join(20)
    assert not thread.is_alive()


def test_pick_says_what_it_lacks(tmp_path, capsys):
    out = tmp_path / "OUT"
    out.mkdir()
    ties = ["-o", str(tmp_path / "ties.csv")]
    assert cli.run(["pick", str(out), *ties]) == 2
    assert "pairs are picked in two" in " ".join(capsys.readouterr().err.split())
    rejected = registration_document(made_registration("rejected"))
    (out / "registration.json").write_text(to_json(rejected))
    assert cli.run(["pick", str(out), *ties]) == 3
    assert "meshreg pick REFERENCE MOVING" in " ".join(capsys.readouterr().err.split())
    assert cli.run(["pick", str(out), "-o", str(tmp_path / "none" / "ties.csv")]) == 2
    assert cli.run(["pick", str(out), "--registration", str(out), *ties]) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["OUT"]


# What others may send


@pytest.mark.parametrize("number", ["9" * 4301, "-1", "1.5", "\u0663", "1" * 10, "0x1", " 1"])
def test_a_tile_number_of_any_kind_is_a_tile_that_is_not_there(client, number):
    for place in (f"{number}/0/0", f"0/{number}/0", f"0/0/{number}"):
        assert client.get(f"/tiles/reference/{place}.png").status_code == 404


@pytest.mark.parametrize("value", ["1" * 4000, "1" * 5000, "1e400", "NaN", "[" * 5000, "1e300"])
def test_a_number_of_any_size_is_no_change(client, desk, value):
    body = f'{{"revision": 0, "what": "place", "side": "reference", "at": [{value}, 0]}}'
    answer = client.post("/api/change", content=body, headers={"content-type": "application/json"})
    assert answer.status_code == 400
    assert desk.session.revision == 0


def test_a_connection_that_asks_nothing_is_closed(desk, monkeypatch):
    """Neither silence, nor half a request, nor half a body keeps a connection open."""
    from meshreg.ties import server as serving

    monkeypatch.setattr(serving, "SLOWEST", 0.3)
    server = serving.PickServer(desk)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        for sent in (b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: "):
            with socket.create_connection(("127.0.0.1", server.port), timeout=20) as line:
                line.sendall(sent)
                assert line.recv(1000) == b""
        with socket.create_connection(("127.0.0.1", server.port), timeout=20) as line:
            line.sendall(b"GET /api/job HTTP/1.1\r\nHost: x\r\n\r\n")  # whole: it is answered
            assert line.recv(1000).startswith(b"HTTP/1.1 403")
    finally:
        server.stop()
        thread.join(20)
    assert not thread.is_alive()


def test_nothing_stays_behind_a_pick_that_is_killed(tmp_path):
    left = tmp_path / "meshreg-pick-x"
    left.mkdir()
    (left / "picture.tif").write_text("")
    code = (
        "import os, signal, sys\n"
        "from meshreg.cli.picking import _removed_in_any_case\n"
        "with _removed_in_any_case(sys.argv[1]):\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(left)], check=False)
    assert done.returncode == -signal.SIGKILL
    until = time.monotonic() + 20
    while left.exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert not left.exists()
