from decimal import Decimal

import numpy as np
from evo.tools import file_interface
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.logs import write_landmarks_csv, write_tum
from sonar_graph.states import LandmarkMap, Trajectory

STAMPS = st.lists(
    st.integers(-(2**62), 2**62), min_size=1, max_size=20, unique=True
).map(sorted)


@given(STAMPS, st.integers(0, 99))
def test_not_a_nanosecond_nor_a_bit_is_lost(tmp_path_factory, stamps, seed):
    rng = np.random.default_rng(seed)
    n = len(stamps)
    written = Trajectory.without_covariances(
        np.array(stamps), rng.normal(size=(n, 3)), rng.normal(size=(n, 4))
    )
    path = tmp_path_factory.mktemp("tum") / "t.tum"
    write_tum(path, written)
    rows = [line.split() for line in path.read_text().splitlines()]
    assert [int(Decimal(row[0]) * 10**9) for row in rows] == stamps
    numbers = np.array([row[1:] for row in rows], float)
    np.testing.assert_array_equal(numbers[:, :3], written.positions)
    np.testing.assert_array_equal(numbers[:, 3:], written.quaternions_xyzw)


def test_evo_reads_the_same_poses(make_sequence, tmp_path):
    truth = make_sequence().truth
    write_tum(tmp_path / "t.tum", truth)
    theirs = file_interface.read_tum_trajectory_file(tmp_path / "t.tum")
    np.testing.assert_array_equal(theirs.positions_xyz, truth.positions)
    np.testing.assert_array_equal(
        theirs.orientations_quat_wxyz, truth.quaternions_xyzw[:, [3, 0, 1, 2]]
    )


def test_landmarks_come_back_from_their_table_and_an_empty_map_is_a_header(tmp_path):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3, 3))
    covariances = root + root.transpose(0, 2, 1)
    covariances[1] = np.nan
    landmarks = LandmarkMap(
        np.array([1, 6, 2**40]), rng.normal(size=(3, 3)), covariances
    )
    path = tmp_path / "l.csv"
    write_landmarks_csv(path, landmarks)
    header, *lines = path.read_text().splitlines()
    assert header == "id,x_m,y_m,z_m,cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz"
    ids, *columns = np.array([line.split(",") for line in lines]).T
    assert ids.astype(int).tolist() == landmarks.ids.tolist()
    upper = covariances[:, *np.triu_indices(3)]
    expected = np.hstack([landmarks.positions, upper]).T
    np.testing.assert_array_equal(np.array(columns, float), expected)
    write_landmarks_csv(path, LandmarkMap.empty())
    assert path.read_text() == f"{header}\n"
