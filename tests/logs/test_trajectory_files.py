from decimal import Decimal

import numpy as np
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
    poses = rng.normal(size=(len(stamps), 7))
    path = tmp_path_factory.mktemp("tum") / "t.tum"
    trajectory = Trajectory.without_covariances(
        np.array(stamps), poses[:, :3], poses[:, 3:]
    )
    write_tum(path, trajectory)
    rows = [line.split() for line in path.read_text().splitlines()]
    assert [int(Decimal(row[0]) * 10**9) for row in rows] == stamps
    numbers = np.array([row[1:] for row in rows], float)
    np.testing.assert_array_equal(numbers, poses)


def test_landmarks_come_back_from_their_table_and_an_empty_map_is_a_header(tmp_path):
    rng = np.random.default_rng(0)
    covariances = rng.normal(size=(3, 3, 3))
    covariances += covariances.transpose(0, 2, 1)
    covariances[1] = np.nan
    ids = np.array([1, 6, 2**40])
    landmarks = LandmarkMap(ids, rng.normal(size=(3, 3)), covariances)
    path = tmp_path / "l.csv"
    write_landmarks_csv(path, landmarks)
    header, *lines = path.read_text().splitlines()
    assert header == "id,x_m,y_m,z_m,cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz"
    columns = np.array([line.split(",") for line in lines]).T
    assert columns[0].astype(int).tolist() == ids.tolist()
    upper = covariances[:, *np.triu_indices(3)]
    expected = np.hstack([landmarks.positions, upper]).T
    np.testing.assert_array_equal(columns[1:].astype(float), expected)
    write_landmarks_csv(path, LandmarkMap.empty())
    assert path.read_text() == f"{header}\n"
