"""Attributes with a direction: how they are found by their names, and how they turn."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshreg.io.frames.directions import Directions, find_directions, turn_columns
from meshreg.io.frames.mover import make_mover
from meshreg.records import Frame, SourceFile, Transform

RNG = np.random.default_rng(31)
REST = tuple(f"f_rest_{k}" for k in range(45))


def mover(rotation: Rotation, scale: float = 1.0, frame: Frame | None = None):
    transform = Transform(rotation.as_matrix(), scale=scale, offset=(3, -2, 1))
    return make_mover(SourceFile("a.ply", "ply", Frame()), transform, frame or Frame())


@pytest.mark.parametrize(
    "names",
    [
        "nx ny nz",
        "Nx Ny Nz",
        "NormalX NormalY NormalZ",
        "normal_x normal_y normal_z",
        "normal x|normal y|normal z",
        "Normal.X Normal.Y Normal.Z",
        "n_x n_y n_z",
        "X_Normal Y_Normal Z_Normal",
        "scalar_Nx scalar_Ny scalar_Nz",
        "nor:normalX nor:normalY nor:normalZ",
        "normal_0 normal_1 normal_2",
        "Normals[X]|Normals[Y]|Normals[Z]".replace("[", "_").replace("]", ""),
        "tangent_x tangent_y tangent_z",
        "viewDirectionX viewDirectionY viewDirectionZ",
    ],
)
def test_unit_vectors_are_found_whatever_they_are_called(names):
    names = tuple(names.split("|") if "|" in names else names.split())
    for order in ((0, 1, 2), (2, 0, 1), (1, 2, 0)):
        columns = ["x", "y", "z", "red", *(names[k] for k in order), "quality"]
        assert find_directions(columns, ("x", "y", "z", "red")) == Directions(vectors=(names,))
    assert find_directions(names, fixed=names[:1]) == Directions(kept=names)


@pytest.mark.parametrize(
    ("names", "kept"),
    [
        ("quality intensity s t scan_angle nothing", ()),
        ("texture_u texture_v red green blue", ()),
        ("Dip|Dip direction (degrees)|Strike_deg|scalar_Dip_direction", None),
        ("cov_xx cov_xy cov_xz cov_yy cov_yz cov_zz", None),
        ("sigma_x sigma_y sigma_z", None),
        ("vx vy vz", None),
        ("yaw pitch roll", None),
        ("sensorAzimuth", None),
    ],
)
def test_what_cannot_be_turned_is_named(names, kept):
    names = tuple(names.split("|") if "|" in names else names.split())
    found = find_directions(["x", "y", "z", *names], ("x", "y", "z"))
    assert found == Directions(kept=names if kept is None else kept)
    assert all(repr(name) in "".join(found.notes) for name in found.kept)
    assert bool(found.notes) == bool(found.kept)


def test_quaternions_and_splats_are_found():
    for names in ("qw qx qy qz", "quat_w quat_x quat_y quat_z", "q_0 q_1 q_2 q_3"):
        found = find_directions(reversed(names.split()))
        assert found == Directions(quaternions=(tuple(names.split()),))
    turn, size = ("rot_0", "rot_1", "rot_2", "rot_3"), ("scale_0", "scale_1", "scale_2")
    others = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity")
    normal = ("nx", "ny", "nz")
    found = find_directions([*others, *normal, *REST[::-1], *size, *turn], others[:3])
    assert found == Directions((normal,), (turn,), size, REST)
    found = find_directions([*REST[:10], *size, *turn])
    assert set(found.kept) == set(REST[:10])  # ten belong to no degree


def test_vectors_and_quaternions_turn_with_the_survey():
    rotation = Rotation.from_rotvec([0.3, -0.2, 1.1])
    move = mover(rotation)
    vectors, attitudes = RNG.normal(size=(20, 3)), Rotation.random(20, rng=5)
    found = find_directions(["nx", "ny", "nz", "rot_w", "rot_x", "rot_y", "rot_z"])
    columns = dict(zip(("nx", "ny", "nz"), vectors.T, strict=True))
    old = 1.7 * attitudes.as_quat(scalar_first=True)  # splats are not normalized
    columns |= dict(zip(found.quaternions[0], old.T, strict=True))
    new = turn_columns(found, move, np.zeros((20, 3)), columns)
    got = np.stack([new[name] for name in ("nx", "ny", "nz")], axis=1)
    assert got == pytest.approx(rotation.apply(vectors), abs=1e-12)
    got = np.stack([new[name] for name in found.quaternions[0]], axis=1)
    assert np.linalg.norm(got, axis=1) == pytest.approx(1.7, abs=1e-12)
    axes = Rotation.from_quat(got, scalar_first=True).as_matrix()
    assert axes == pytest.approx((rotation * attitudes).as_matrix(), abs=1e-12)


def color(coefficients, directions):
    """Color along directions by the complex harmonics of SciPy, in the order of splat files."""
    from scipy.special import sph_harm_y

    x, y, z = directions.T
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    total = np.zeros(len(directions))
    at = 0
    for level in range(1, 4):
        for m in range(-level, level + 1):
            value = sph_harm_y(level, abs(m), polar, azimuth)  # with the sign (-1)^m
            real = value.real if m == 0 else np.sqrt(2) * (value.imag if m < 0 else value.real)
            total += coefficients[at] * real
            at += 1
            if at == len(coefficients):
                return total
    raise AssertionError


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("mirrored", [False, True])
def test_splats_look_the_same_from_the_turned_place(degree, mirrored):
    frame = Frame(np.diag([1.0, 1.0, -1.0]) if mirrored else np.eye(3))
    rotation = Rotation.from_rotvec([0.5, 0.8, -0.9])
    move = mover(rotation, 1.25, frame)
    each = (degree + 1) ** 2 - 1
    names = [f"f_rest_{k}" for k in range(3 * each)]
    turn, size = [f"rot_{k}" for k in range(4)], [f"scale_{k}" for k in range(3)]
    found = find_directions([*names, *turn, *size])
    values = RNG.normal(size=(6, len(found.columns)))
    columns = dict(zip(found.columns, values.T, strict=True))
    new = turn_columns(found, move, np.zeros((6, 3)), columns)
    linear = frame.axes.T @ rotation.as_matrix()
    seen = RNG.normal(size=(200, 3))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    for row in range(6):
        for channel in range(3):
            part = names[channel * each : (channel + 1) * each]
            before = color([columns[name][row] for name in part], seen)
            after = color([new[name][row] for name in part], seen @ linear.T)
            assert after == pytest.approx(before, abs=1e-9)
        shapes = []
        for table in (columns, new):
            axes = Rotation.from_quat([table[k][row] for k in turn], scalar_first=True).as_matrix()
            lengths = np.exp([table[k][row] for k in size])
            shapes.append((axes * lengths**2) @ axes.T)
        assert shapes[1] == pytest.approx(1.25**2 * linear @ shapes[0] @ linear.T, abs=1e-9)


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply", ".csv"])
def test_a_bend_that_turns_no_direction_is_said(tmp_path, suffix, caplog):
    from meshreg.io import read_survey, rewrite_survey, write_survey
    from meshreg.records import Mesh, Survey, Warp

    path = tmp_path / f"a{suffix}"
    points = RNG.uniform(0, 9, (30, 3))
    normals = np.tile([0.0, 0.6, 0.8], (30, 1))
    faces = np.array([[k, k + 1, k + 2] for k in range(28)])
    if suffix == ".csv":
        table = np.hstack([points, normals])
        np.savetxt(path, table, "%.6f", ",", header="x,y,z,nx,ny,nz", comments="")
    elif suffix == ".ply":
        head = "ply\nformat ascii 1.0\nelement vertex 30\n" + "".join(
            f"property double {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz")
        )
        table = np.hstack([points, normals]).tolist()
        rows = "".join(" ".join(map(repr, row)) + "\n" for row in table)
        path.write_text(head + "end_header\n" + rows)
    else:
        write_survey(Survey("reef", Mesh(points, faces)), path)
        if suffix == ".obj":
            path.write_text(path.read_text() + "vn 0 0.6 0.8\n")
    survey = read_survey(path)
    warp = Warp("", "", (-15.0, -15.0), (15.0, 15.0), np.full((4, 4, 3), 0.01))
    rewrite_survey(survey, Transform(offset=(1, 2, 3)), tmp_path / "rigid")
    assert "not by the bend" not in caplog.text
    rewrite_survey(survey, Transform(offset=(1, 2, 3)), tmp_path / "bent", warp=warp)
    assert "turned with the survey as a whole, not by the bend" in caplog.text
