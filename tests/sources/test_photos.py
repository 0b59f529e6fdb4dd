"""Tables and pictures of a folder of photographs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vusfa.errors import SceneError
from vusfa.sources.photo_tables import edge_states, read_edges, read_poses
from vusfa.sources.photos import fit_picture, lay_out, read_features, read_photos

USUAL = ("MoveForward", "RotateRight", "RotateLeft", "MoveBackward")


def table(folder: Path, text: str, name: str = "table.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def the_faults(path: Path, error: pytest.ExceptionInfo[SceneError]) -> list[str]:
    """Lines of a message, without the file's name."""
    head, *rest = str(error.value).splitlines()
    assert head.startswith(f"{path}: ")
    return [line.removeprefix("  - ") for line in rest] or [head.removeprefix(f"{path}: ")]


def photograph(path: Path, colour: tuple[int, int, int] = (200, 100, 50), size=(40, 30), **options) -> Path:
    path.parent.mkdir(exist_ok=True)
    Image.new("RGB", size, colour).save(path, **options)
    return path


# ---- poses


def test_a_table_of_poses(tmp_path: Path) -> None:
    text = "\ufeffnote, FILE ,x,z,heading\r\n,a.jpg, 1.5,-2,90\r\n\r\nseen,b/c.png,0,0,1e1\r\n"
    path = tmp_path / "poses.csv"
    path.write_bytes(text.encode())
    poses = read_poses(path)
    assert poses.files == ("a.jpg", "b/c.png")
    assert poses.location.tolist() == [[1.5, -2.0], [0.0, 0.0]]
    assert poses.rotation.tolist() == [90.0, 10.0]
    assert poses.labels == ["line 2 (a.jpg)", "line 4 (b/c.png)"]


def test_all_faults_of_poses_at_once(tmp_path: Path) -> None:
    path = table(
        tmp_path,
        "file,x,z,heading\na.jpg,0,0,north\nb.jpg,nan,0\n,1,1,1\na.jpg,3,3,0\nc.jpg,1,1,90\n",
    )
    with pytest.raises(SceneError) as caught:
        read_poses(path)
    assert the_faults(path, caught) == [
        "line 2: 'heading' is 'north'; write a number, in degrees",
        "line 3: 'x' is 'nan'; write a number, in metres",
        "line 3: 'heading' is ''; write a number, in degrees",
        "line 4: column 'file' is empty; name the picture",
        "line 5: 'a.jpg' has a pose already, in line 2; every pose needs a picture of its own",
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"line 1: column 'file' is missing; .* file,x,z,heading \(found: nothing\)"),
        ("a.jpg,0,0,90\n", r"column 'file' is missing; .* \(found: 'a.jpg,0,0,90'\)"),
        ("file;x;z;heading\n", r"column 'file' is missing"),
        ("file,x,z\n", r"column 'heading' is missing"),
        ("file,x,z,heading\n\n", r"has no poses in it; write a line for every picture"),
    ],
)
def test_tables_without_their_columns_or_lines(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        read_poses(table(tmp_path, text))


def test_tables_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="there is no such file"):
        read_poses(tmp_path / "gone.csv")
    (tmp_path / "latin.csv").write_bytes("file,x,z,heading\nküche.jpg,0,0,0\n".encode("latin-1"))
    with pytest.raises(SceneError, match=r"cannot be read .*save it as UTF-8"):
        read_poses(tmp_path / "latin.csv")


# ---- edges


def test_edges_make_a_graph(tmp_path: Path) -> None:
    path = table(
        tmp_path,
        "state,action,next\nb,RotateRight,a\na,MoveForward,b\nb,MoveForward,\na,RotateLeft,-1\nb,RotateRight,a\n",
    )
    assert edge_states(path) == ("a", "b")
    graph, actions = read_edges(path, ["a", "b"])
    assert actions == USUAL
    assert graph.tolist() == [[1, -1, -1, -1], [-1, 0, -1, -1]]


def test_other_actions_keep_the_order_of_the_table(tmp_path: Path) -> None:
    path = table(tmp_path, "state,action,next\na,jump,b\nb,MoveForward,a\n")
    graph, actions = read_edges(path, ["b", "a"])
    assert actions == ("jump", "MoveForward")
    assert graph.tolist() == [[-1, 1], [0, -1]]


def test_all_faults_of_edges_at_once(tmp_path: Path) -> None:
    path = table(tmp_path, "state,action,next\na,go,c\n,go,a\na,,a\na,go,b\na,go,a\n")
    with pytest.raises(SceneError) as caught:
        read_edges(path, ["a", "b"])
    assert the_faults(path, caught) == [
        "line 2: there is no state 'c'; states are the pictures' names",
        "line 3: column 'state' is empty; fill it in",
        "line 4: column 'action' is empty; fill it in",
        "line 6: 'go' from 'a' has another result in line 5; take one of the lines out",
    ]
    with pytest.raises(SceneError, match="has no moves in it"):
        read_edges(table(tmp_path, "state,action,next\n", "empty.csv"), ["a"])


# ---- both together


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two places, two headings; a picture that is in no table."""
    folder = tmp_path / "flat"
    for name in ("a.jpg", "b.jpg", "c.png", "d.JPEG", "spare.jpg"):
        photograph(folder / name)
    (folder / "notes.txt").write_text("no picture")
    table(folder, "file,x,z,heading\na.jpg,0,0,0\nb.jpg,0,0,90\nc.png,0,1,0\nd.JPEG,0,1,90\n", "poses.csv")
    return folder


def test_poses_are_put_on_a_grid(folder: Path) -> None:
    found = lay_out(folder)
    assert found.files == ("a.jpg", "b.jpg", "c.png", "d.JPEG")
    assert found.actions == USUAL
    assert found.graph.tolist() == [[2, 1, -1, -1], [-1, -1, 0, -1], [-1, 3, -1, 0], [-1, -1, 2, -1]]
    assert found.found == "a grid of 1 m, headings 90 degrees apart"
    assert found.left_out == ("spare.jpg",)
    finer = lay_out(folder, step=0.5)
    assert "grid of 0.5 m" in finer.found
    assert finer.graph[:, 0].tolist() == [-1] * 4, "a step ahead there is no picture"
    assert "headings 45" in lay_out(folder, turn=45).found


def test_edges_win_over_the_grid_and_keep_the_poses(folder: Path) -> None:
    edges = table(folder, "state,action,next\nd.JPEG,MoveForward,a.jpg\n", "moves.csv")
    found = lay_out(folder, edges=edges)
    assert found.graph[3].tolist() == [0, -1, -1, -1]
    assert (found.graph[:3] == -1).all()
    assert found.location.tolist() == [[0, 0], [0, 0], [0, 1], [0, 1]]
    assert found.rotation.tolist() == [0, 90, 0, 90]
    with pytest.raises(SceneError, match="leave out step and turn"):
        lay_out(folder, edges=edges, step=1.0)


def test_edges_alone_will_do(folder: Path) -> None:
    (folder / "poses.csv").unlink()
    table(folder, "state,action,next\nc.png,go,a.jpg\n", "edges.csv")
    found = lay_out(folder)
    assert (found.files, found.actions) == (("a.jpg", "c.png"), ("go",))
    assert found.graph.tolist() == [[-1], [0]]
    assert (found.location == 0).all()
    assert found.left_out == ("b.jpg", "d.JPEG", "spare.jpg")


def test_pictures_that_are_not_there_are_all_named(folder: Path) -> None:
    (folder / "b.jpg").unlink()
    (folder / "d.JPEG").unlink()
    with pytest.raises(SceneError) as caught:
        lay_out(folder)
    assert the_faults(folder / "poses.csv", caught) == [
        f"line 3 (b.jpg): there is no such picture in {folder}; correct the name, or take it out",
        f"line 5 (d.JPEG): there is no such picture in {folder}; correct the name, or take it out",
    ]


def test_folders_without_tables(folder: Path) -> None:
    (folder / "poses.csv").unlink()
    with pytest.raises(SceneError, match=r"has neither poses.csv \(file,x,z,heading\) nor edges.csv"):
        lay_out(folder)
    with pytest.raises(SceneError, match="there is no such folder"):
        lay_out(folder / "gone")


# ---- pictures


def test_pictures_are_cut_around_their_middle(tmp_path: Path) -> None:
    wide = np.zeros((20, 80, 3), np.uint8)
    wide[:, 30:50] = 255
    Image.fromarray(wide).save(tmp_path / "wide.png")
    square = fit_picture(tmp_path / "wide.png", 10, 10)
    assert square[:, 1:-1].min() > 250
    assert fit_picture(tmp_path / "wide.png", 40, 10)[0, :, 0].tolist()[:10] == [0] * 10
    assert fit_picture(tmp_path / "wide.png", 8, 6).shape == (6, 8, 3)


def test_pictures_are_turned_upright(tmp_path: Path) -> None:
    sideways = np.zeros((30, 30, 3), np.uint8)
    sideways[:, :15] = (
        255,
        0,
        0,
    )  # red is left in the file; turned clockwise, as the camera noted, it is above
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(sideways).save(tmp_path / "phone.png", exif=exif)
    upright = fit_picture(tmp_path / "phone.png", 30, 30)
    assert upright[:10, :, 0].min() == 255
    assert upright[20:, :, 0].max() == 0


@pytest.mark.parametrize("mode", ["L", "RGBA", "P", "CMYK"])
def test_pictures_of_other_modes_are_made_rgb(tmp_path: Path, mode: str) -> None:
    path = tmp_path / ("a.jpg" if mode == "CMYK" else "a.png")
    Image.new("RGB", (40, 30), (128, 128, 128)).convert(mode, palette=Image.Palette.ADAPTIVE).save(path)
    small = fit_picture(path, 20, 15)
    assert (small.shape, small.dtype) == ((15, 20, 3), np.uint8)
    assert np.abs(small.astype(int) - 128).max() <= 3


def test_large_photographs_keep_their_content(tmp_path: Path) -> None:
    """They are decoded at a fraction of their size: the colours stay where they are."""
    large = np.zeros((1600, 2400, 3), np.uint8)
    large[:800] = (220, 30, 30)
    large[800:] = (30, 30, 220)
    Image.fromarray(large).save(tmp_path / "large.jpg", quality=95)
    small = fit_picture(tmp_path / "large.jpg", 60, 40).astype(int)
    assert np.abs(small[:18] - (220, 30, 30)).max() < 8
    assert np.abs(small[22:] - (30, 30, 220)).max() < 8


def test_all_unreadable_pictures_at_once(folder: Path) -> None:
    (folder / "a.jpg").write_bytes(b"no picture")
    whole = (folder / "c.png").read_bytes()
    (folder / "c.png").write_bytes(whole[: len(whole) // 2])
    files = ["a.jpg", "b.jpg", "c.png"]
    with pytest.raises(SceneError) as caught:
        read_photos(folder, files, 20, 15)
    faults = the_faults(folder, caught)
    assert faults[0] == "a.jpg: cannot be read as a picture (unknown format); replace it, or take it out"
    assert faults[1].startswith("c.png: cannot be read as a picture (")
    assert len(faults) == 2


def test_pictures_are_counted_and_kept_either_way(folder: Path) -> None:
    done = []
    jpegs = read_photos(folder, ["a.jpg", "c.png"], 20, 15, advance=lambda: done.append(1))
    assert len(done) == 2
    assert [jpeg[:2] for jpeg in jpegs] == [b"\xff\xd8"] * 2
    raw = read_photos(folder, ["a.jpg", "c.png"], 20, 15, raw=True)
    assert isinstance(raw, np.ndarray)
    assert (raw.shape, raw.dtype) == ((2, 15, 20, 3), np.uint8)
    assert np.abs(raw[1].astype(int) - (200, 100, 50)).max() <= 1, "PNG is exact"


# ---- features


def test_features_of_both_shapes(tmp_path: Path) -> None:
    values = np.arange(12, dtype=np.float64).reshape(4, 3)
    np.save(tmp_path / "a.npy", values)
    np.save(tmp_path / "b.npy", values.reshape(4, 3, 1))
    assert read_features(tmp_path / "a.npy", 4).tolist() == values[:, None].tolist()
    assert read_features(tmp_path / "b.npy", 4).shape == (4, 3, 1)
    assert read_features(tmp_path / "a.npy", 4).dtype == np.float32


def test_features_that_do_not_fit(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((4, 3)))
    np.save(tmp_path / "flat.npy", np.zeros(4))
    np.save(tmp_path / "text.npy", np.array([["a"]]))
    np.savez(tmp_path / "many.npz", a=np.zeros((4, 3)))
    (tmp_path / "junk.npy").write_text("junk")
    for name, message in [
        ("a.npy", "has 4 rows, but there are 5 states; write one for each"),
        ("flat.npy", r"holds float64 of shape \(4,\); write one array of numbers"),
        ("text.npy", "holds <U1 of shape"),
        ("many.npz", "its header is damaged"),
        ("junk.npy", "cannot be read"),
        ("gone.npy", "cannot be read"),
    ]:
        with pytest.raises(SceneError, match=message):
            read_features(tmp_path / name, 5)
