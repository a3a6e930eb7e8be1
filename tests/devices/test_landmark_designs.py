"""Designs are what their file draws, wherever one looks."""

from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest

from sonar_graph.devices import DEFAULT_DESIGNS, LandmarkDesign, load_designs
from sonar_graph.errors import CalibrationError

HALF = """
[[landmark]]
id = 7
name = "half"
size_m = 0.4
height_m = 0.02
shapes = [{ level_db = 5.0, polygon_m = [[0.0, 0.0], [0.2, 0.0], [0.2, 0.2], [0.0, 0.2]] }]
"""


NAMES = ("disc", "square", "triangle", "cross")


def written(folder: Path, text: str, name: str = "landmarks.toml") -> Path:
    (folder / name).write_text(text)
    return folder / name


def pictured(
    folder: Path, picture: np.ndarray, id_: int = 9, name: str = "ring"
) -> str:
    """A landmark with a picture, as text."""
    cv2.imwrite(str(folder / f"{name}.png"), picture)
    return f'[[landmark]]\nid = {id_}\nname = "{name}"\nsize_m = 0.4\npicture = "{name}.png"\n'


def test_four_distinct_designs_ship_with_areas_of_geometry():
    assert [(design.id, design.name) for design in DEFAULT_DESIGNS] == list(
        enumerate(NAMES, 1)
    )
    foam = [design.mask > 0 for design in DEFAULT_DESIGNS]
    side_m = 2 * 0.1602
    expected_m2 = [
        np.pi * 0.14**2,
        0.26**2,
        side_m**2 * np.sqrt(3) / 4,
        2 * 0.34 * 0.09 - 0.09**2,
    ]
    np.testing.assert_allclose(
        [one.sum() * 0.002**2 for one in foam], expected_m2, rtol=0.01
    )
    for one, other in combinations(foam, 2):
        assert (
            max(
                (np.rot90(one, k) & other).sum() / (np.rot90(one, k) | other).sum()
                for k in range(4)
            )
            < 0.9
        )


def test_level_is_that_of_the_shape_at_a_point_and_nan_elsewhere(tmp_path: Path):
    (half,) = load_designs(written(tmp_path, HALF))
    x_m, y_m = np.array([[0.1, -0.1, 0.1, 0.1, 0.21], [0.1, 0.1, -0.1, 0.19, 0.1]])
    np.testing.assert_array_equal(
        half.level_db(x_m, y_m), [5, np.nan, np.nan, 5, np.nan]
    )
    assert half.height_m == 0.02
    plain = LandmarkDesign(5, "plain", 0.2, np.full((1, 1), 3.0))
    assert plain.level_db(np.array(0.0), np.array(0.0)) == 3


def test_picture_means_what_its_greys_say(tmp_path: Path):
    picture = np.zeros((2, 2, 4), np.uint8)
    picture[0, 0], picture[0, 1], picture[1, 1] = (
        [255, 255, 255, 255],
        [0, 0, 0, 255],
        [51, 51, 51, 255],
    )
    (ring,) = load_designs(
        written(
            tmp_path, pictured(tmp_path, picture) + "black_db = -10\nwhite_db = 15\n"
        )
    )
    np.testing.assert_allclose(ring.mask, [[15, -10], [np.nan, -5]], atol=1e-12)
    # the first row is at +y, the first column at -x
    assert ring.level_db(np.array(-0.1), np.array(0.1)) == 15


def test_a_folder_gives_all_designs_and_a_missing_file_is_named(
    tmp_path: Path,
):
    written(tmp_path, HALF.replace("7", "8").replace("5.0", "6.0"), "b.toml")
    written(tmp_path, HALF, "a.toml")
    assert [design.id for design in load_designs(tmp_path)] == [7, 8]
    with pytest.raises(CalibrationError, match=r"nowhere\.toml: cannot be read"):
        load_designs(tmp_path / "nowhere.toml")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "no landmark designs"),
        ("[[landmark]\n", "not TOML"),
        (HALF + HALF, "half and half both have the id 7"),
        (
            HALF.replace("size_m = 0.4", "size_m = -1"),
            "landmark 'half': size_m: expected a number greater than or",
        ),
        (
            HALF.replace("polygon_m", "plygon_m"),
            "'half': shape 1.plygon_m: there is no .*did you mean polygon_m",
        ),
        (
            HALF.replace("size_m", "sizes_m"),
            "sizes_m: there is no such field; did you mean size_m",
        ),
        (
            HALF.replace('name = "half"', ""),
            r"\[\[landmark\]\] number 1: name: is missing",
        ),
        (HALF.replace("= 0.4", "= 0.0005"), "'half': size_m: .*not 0.0005"),
        (HALF.replace("= 0.02", "= nan"), "'half': height_m: .*not nan"),
        (
            HALF.replace("id = 7", "id = 100000000000000000000"),
            "'half': id: .*less than or equal to 2147483647",
        ),
        (HALF.replace("= 5.0", "= inf"), "'half': shape 1.level_db: .*not inf"),
        (
            HALF.replace("[0.0, 0.2]]", "[0.0, inf]]"),
            "'half': shape 1.polygon_m.3.1: .*not inf",
        ),
        (
            HALF.replace("= 5.0", "= 2.0"),
            "'half': nowhere more than 2 dB over the floor",
        ),
        (
            HALF.replace("0.0,", "0.3,"),
            "shape 1 covers nothing of the square, which reaches from -0.2 to 0.2 m",
        ),
        (
            HALF + HALF.replace("7", "8").replace("half", "twin"),
            r"half \(id 7\) and twin \(id 8\) look the same",
        ),
        (
            HALF.replace("[[landmark]]", "[landmark]"),
            r"landmark: write \[\[landmark\]\] with two brackets",
        ),
        ("[imu]\n", r"imu: unknown; a designs file has \[\[landmark\]\] tables only"),
        (HALF.replace("shapes", "#"), "give either shapes or picture"),
        (
            HALF + "[[landmarks]]\n",
            r"landmarks: unknown; did you mean \[\[landmark\]\]",
        ),
        (
            '[[landmark]]\nid = 1\nname = "a"\nsize_m = 1\npicture = "none.png"\n',
            "none.png is not a picture",
        ),
    ],
)
def test_impossible_files_are_refused_with_the_reason(
    tmp_path: Path, text: str, complaint: str
):
    with pytest.raises(CalibrationError, match=complaint) as refusal:
        load_designs(written(tmp_path, text))
    assert "\n" not in str(refusal.value)
    assert "landmarks.toml" in str(refusal.value)


def barely_transparent(kind: type[np.unsignedinteger]) -> np.ndarray:
    """Of 16 bits the limit lies in their middle, not at 128."""
    picture = np.full((4, 4, 4), np.iinfo(kind).max, kind)
    picture[..., 3] = np.iinfo(kind).max // 2 - 1
    return picture


@pytest.mark.parametrize(
    ("picture", "complaint"),
    [
        *(
            (barely_transparent(kind), "'ring': its picture is wholly transparent")
            for kind in (np.uint8, np.uint16)
        ),
        (
            np.full((4, 4), 102, np.uint8),
            "'ring': nowhere more than 0 dB over the floor",
        ),
        (
            np.full((2001, 2001), 255, np.uint8),
            "2001 x 2001; make it 2000 x 2000 or smaller",
        ),
        (np.zeros((2, 3), np.uint8), "3 x 2, not square"),
    ],
    ids=["transparent", "transparent, 16 bits", "even", "huge", "oblong"],
)
def test_impossible_pictures_are_refused_with_the_reason(
    tmp_path: Path, picture: np.ndarray, complaint: str
):
    with pytest.raises(CalibrationError, match=complaint):
        load_designs(written(tmp_path, pictured(tmp_path, picture)))
