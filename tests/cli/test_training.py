"""The page of a training, and the window that follows it."""

import re

import pytest
from optional import import_or_skip
from training_previews import preview_of, write_preview_folder

from pcbench.cli.training import PAGE, TrainingPage

REFRESH = '<meta http-equiv="refresh" content="10">'


def test_the_page_follows_the_previews(tmp_path):
    lines = []
    write_preview_folder(tmp_path, (10,))
    page = TrainingPage(tmp_path, lines.append)
    page.update()  # the preview is that of an earlier run
    page.update(running=False)
    assert not (tmp_path / PAGE).exists()
    write_preview_folder(tmp_path, (10, 20))
    page.update()
    assert lines == [f"watch the training: pcbench view {tmp_path}, or open {tmp_path / PAGE} in a browser"]
    text = (tmp_path / PAGE).read_text()
    assert REFRESH in text and preview_of((10, 20)).sentence in text
    assert text.count("data:image/png;base64,") == 2
    assert text.count("<svg") == 4  # PSNR and number over the steps, PSNR and SSIM over the number
    assert "Few suffice." in text
    written = (tmp_path / PAGE).stat().st_mtime_ns
    page.update()
    assert (tmp_path / PAGE).stat().st_mtime_ns == written
    page.update(running=False)
    assert REFRESH not in (tmp_path / PAGE).read_text()
    assert len(lines) == 1


def test_a_page_that_cannot_be_written_does_not_end_the_training(tmp_path):
    page = TrainingPage(tmp_path, pytest.fail)
    folder = write_preview_folder(tmp_path, (10,))
    (folder / "rendering.png").unlink()
    page.update()
    assert not (tmp_path / PAGE).exists()


def test_curves_are_inside_the_chart(tmp_path):
    """Also a curve that is constant, and training without held-out photographs."""
    page = TrainingPage(tmp_path, lambda _: None)
    write_preview_folder(tmp_path, (7, 7, 7), held_out=False)
    page.update()
    for steps in ((7, 7, 7), (3, 990, 12345)):
        write_preview_folder(tmp_path, steps)
        page.update()
        for path in re.findall(r' d="([^"]*)"', (tmp_path / PAGE).read_text()):
            for command, numbers in re.findall(r"([MLHV])([^MLHV]*)", path):
                values = [*map(float, numbers.split())]
                assert command == "V" or 36 <= values[0] <= 508
                assert command == "H" or 26 <= values[-1] <= 220


@pytest.mark.usefixtures("off_screen")
def test_the_window_follows_the_previews(tmp_path, run, monkeypatch):
    import_or_skip("pyvista")
    from pcbench.report.plotters.training import TrainingViewer

    monkeypatch.setattr("pcbench.report.plotters.window.check_window", lambda *, off_screen: None)
    monkeypatch.chdir(tmp_path)
    folder = write_preview_folder(tmp_path / "a.work", (50,))
    assert run("view", "a.work", "--screenshot", "a.png") == (0, "", "")
    viewer = TrainingViewer(folder, off_screen=True)
    assert viewer.plotter.actors["cloud"].mapper.dataset.n_points == 50
    write_preview_folder(tmp_path / "a.work", (50, 80))
    viewer.reload()
    assert viewer.plotter.actors["cloud"].mapper.dataset.n_points == 80
    (folder / "preview.json").unlink()
    viewer.reload()
    assert viewer.preview == preview_of((50, 80))
    viewer.plotter.close()
