"""Files of check points: delimiters, decimal points, headers and encodings, and mistakes in them."""

import numpy as np
import pytest
from wording import check_error, check_text

from pcbench.io.check_points import read_check_points

POINTS = [[1.5, 2.25, 3.0], [4.0, 5.0, 6.5]]
FORMS = {
    "mark of byte order, CRLF and blank lines": b"\xef\xbb\xbfName,X,Y,Z\r\na,1.5,2.25,3.0\r\n\r\nb,4.0,5.0,6.5\r\n",
    "quotes and units": b'"id","easting","northing","height [m]"\n"a","1.5","2.25","3.0"\n"b","4","5","6.5"\n',
    "German spreadsheet": "Punkt;Rechtswert;Hochwert;Höhe\na;1,5;2,25;3,0\nb;4,0;5,0;6,5\n".encode("cp1252"),
    "Swedish names, tabs": "nr\tN\tE\tHöjd\na\t2,25\t1,5\t3\nb\t5\t4\t6,5\n".encode(),
    "blanks without header": b"a 1.5 2.25 3.0\nb 4 5 6.5",
    "blanks and decimal commas": b"a 1,5 2,25 3,0\nb 4,0 5,0 6,5",
    "header in a comment": b"# id x y z\na 1.5 2.25 3\nb 4 5 6.5\n",
    "header in a comment, commas": b"// GNSS\n#id,x,y,z\na,1.5,2.25,3\nb,4,5,6.5\n",
    "columns in another order": b"z;N;E;id\n3;2.25;1.5;a\n6.5;5;4;b\n",
    "UTF-16": "id,x,y,z\na,1.5,2.25,3\nb,4,5,6.5\n".encode("utf-16"),
    "trailing delimiters": b"id, x, y, z,\na, 1.5, 2.25, 3,\nb, 4, 5, 6.5,\n",
    "row of units": b"id;x;y;z;\n;m;m;m;\na;1,5;2,25;3,0;\nb;4,0;5,0;6,5;\n",
    "row of units in brackets": b"id x y z\n- [m] [m] [m]\na 1.5 2.25 3\nb 4 5 6.5\n",
    "trailing delimiters without header": b"a;1,5;2,25;3,0;\nb;4,0;5,0;6,5;\n",
    "other columns": b'id,code,x,y,z,remark\na,GR,1.5,2.25,3,"nice, flat"\nb,GR,4,5,6.5,\n',
}


def written(folder, content):
    path = folder / "points.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("content", FORMS.values(), ids=FORMS)
def test_all_forms_give_the_same_points(content, tmp_path):
    points = read_check_points(written(tmp_path, content))
    assert points.names == ("a", "b") and points.points.tolist() == POINTS
    assert not points.vegetated.any() and np.isnan(points.sigma_z).all() and np.isnan(points.measured).all()
    *others, unclassed = points.notes
    assert "class" in unclassed
    for note in others:
        check_text(note)


def test_points_without_names_are_numbered(tmp_path):
    points = read_check_points(written(tmp_path, "1.5 2.25 3\n4 5 6.5\n"))
    assert points.names == ("1", "2") and points.points.tolist() == POINTS


def test_classes_standard_errors_and_targets(tmp_path):
    text = (
        "id,x,y,z,class,sigma,sigma_z,measured_x,measured_y,measured_z\n"
        "a,1,2,3,NVA,0.02,0.03,1.1,2.1,3.1\nb,1,2,3,Tall weeds,,,,,\nc,1,2,3,,0.02,,,,3.2\n".replace(
            "Tall weeds", "weeds"
        )
    )
    points = read_check_points(written(tmp_path, text))
    assert points.vegetated.tolist() == [False, True, False]
    np.testing.assert_array_equal(points.sigma_xy, [0.02, np.nan, 0.02])
    np.testing.assert_array_equal(points.sigma_z, [0.03, np.nan, 0.02])
    np.testing.assert_array_equal(points.measured[[0, 2]], [[1.1, 2.1, 3.1], [np.nan, np.nan, 3.2]])
    (note,) = points.notes
    check_text(note)


def test_classes_of_las(tmp_path):
    points = read_check_points(written(tmp_path, "x,y,z,class\n1,2,3,2\n1,2,3,3\n1,2,3,5\n1,2,3,11\n"))
    assert points.vegetated.tolist() == [False, True, True, False]


MISTAKES = {
    "empty": "",
    "header alone": "id,x,y,z\n",
    "no header": "hello world\n",
    "a column missing": "id,x,y\na,1,2\n",
    "columns without names": "a,1,2,3,4\n",
    "pairs for registration": "a 1 2 3 4 5 6\n",
    "two columns for x": "id,x,easting,y,z\na,1,1,2,3\n",
    "degrees": "id,lon,lat,h\na,8,47,400\n",
    "NaN": "id,x,y,z\na,nan,2,3\n",
    "infinite": "a,1,inf,3\n",
    "a word": "id,x,y,z\na,1,two,3\n",
    "too short": "id,x,y,z\na,1,2\n",
    "thousands": "id;x;y;z\na;1.234,56;2;3\n",
    "one name twice": "id,x,y,z\na,1,2,3\n\na,4,5,6\n",
    "unknown class": "id,x,y,z,class\na,1,2,3,GCP\n",
    "negative": "id,x,y,z,sigma\na,1,2,3,-1\n",
    "different units": "id,x,y,z\n-,m,m,ft\na,1,2,3\n",
    "half a target": "id,x,y,z,measured_x,measured_y\na,1,2,3,1.1,\n",
    "a long line": "id,x,y,z\n" + "a" * 200_000 + ",1,2,3\n",
    "a cloud": "1 2 3\n" * 20_001,
    "binary": b"\0\1\2\3",
}


@pytest.mark.parametrize("content", MISTAKES.values(), ids=MISTAKES)
def test_mistakes_are_named_with_their_line(content, tmp_path):
    with check_error() as error:
        read_check_points(written(tmp_path, content))
    assert str(error.value).startswith(f"{tmp_path / 'points.csv'}: ")


def test_missing_files(tmp_path):
    with check_error():
        read_check_points(tmp_path / "none.csv")
    with check_error():
        read_check_points(tmp_path)
