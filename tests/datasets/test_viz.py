"""The page about a data set: how it counts, what it plots, and where its legends are."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from damage import CAMERA, edit_json

from playslot_rl import keys
from playslot_rl.data.contents import read_contents
from playslot_rl.data.places import Problems
from playslot_rl.datasets import viz
from playslot_rl.datasets.repair import repair
from playslot_rl.visualization.charts import LIGHT, curve_figure, figure_bytes

pytestmark = pytest.mark.integration


@pytest.mark.parametrize(
    ("number", "words"),
    [(1, "1st"), (2, "2nd"), (3, "3rd"), (4, "4th"), (11, "11th"), (12, "12th"), (13, "13th"), (21, "21st"),
     (22, "22nd"), (101, "101st"), (111, "111th"), (112, "112th")],
)  # fmt: skip
def test_numbers_are_counted_as_people_do(number: int, words: str) -> None:
    assert viz.ordinal(number) == words


def test_a_long_episode_says_which_frames_it_shows(
    images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(viz, "ANIMATED", 4)
    text = viz.write_page(images, tmp_path / "page.html").read_text()
    assert "every 2nd frame" in text
    assert "every 2th" not in text


def test_states_are_plotted(ours: Path, images: Path) -> None:
    assert keys.FEATURE_STATE in viz._curves(read_contents(ours, Problems()))
    assert viz._curves(read_contents(images, Problems())) == ["action"]


def test_features_that_are_no_numbers_are_not_plotted(tmp_path: Path) -> None:
    from foreign_features import write_features

    root = write_features(tmp_path / "set")
    contents = read_contents(root, Problems())
    assert viz._curves(contents) == []
    assert "Episode 0" in viz.write_page(root, tmp_path / "page.html").read_text()


def test_no_legend_covers_a_curve() -> None:
    steps = np.linspace(0, 20, 50)
    panels = {
        "action": {f"left_shoulder_{n}.pos": np.sin(steps + n) for n in range(8)},
        "observation.state": {"x": steps, "y": -steps},
        "next.reward": {"0": steps},
        "next.success": {"0": steps},
    }
    figure = curve_figure(panels, LIGHT)
    figure.draw_without_rendering()
    for axes in figure.axes:
        legend = axes.get_legend()
        assert (legend is None) == (axes.get_title().startswith("next"))
        assert axes.get_window_extent().width > 100
        if legend is not None:
            assert not legend.get_window_extent().overlaps(axes.get_window_extent())
            assert not any(legend.get_window_extent().overlaps(other.get_window_extent()) for other in figure.axes)


def test_names_with_dollar_signs_are_names(images: Path, tmp_path: Path) -> None:
    figure = curve_figure({r"$\nothing{": {"$": [0.0, 1.0], r"$\frac": [1.0, 0.0]}}, LIGHT)
    assert figure_bytes(figure, LIGHT).startswith(b"\x89PNG")
    root = Path(shutil.copytree(images, tmp_path / "set"))
    edit_json(root, "meta/info.json", lambda info: info["features"]["action"].update(names=[r"$\nothing{", "<b>"]))
    text = viz.write_page(root, tmp_path / "page.html").read_text()
    assert CAMERA in text
    assert "<b>" not in text.partition("<body")[2].replace("<b>fact", "")


def test_the_set_one_stands_in_can_be_named_by_a_dot(
    images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(shutil.copytree(images, tmp_path / "set"))
    assert viz.write_page(".", None) == tmp_path / "set.html"
    assert repair(".").stated is None
    (tmp_path / "set/meta/stats.json").unlink()
    assert repair(".").root == tmp_path / "set"
