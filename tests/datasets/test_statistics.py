"""Statistics: those of LeRobot to the last bit; what its own writer made is sound, whatever it shows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import edit_column

from playslot_rl.datasets.statistics import QUANTILES, Aggregate, of_frames, of_numbers, rounded
from playslot_rl.datasets.verify import verify

Frames = np.ndarray[Any, np.dtype[np.uint8]]
Draw = Callable[[np.random.Generator, tuple[int, ...]], Frames]
CAMERA = "observation.images.top"

BRIGHT: Draw = lambda generator, shape: generator.integers(235, 256, shape, np.uint8)  # noqa: E731
DARK: Draw = lambda generator, shape: generator.integers(0, 3, shape, np.uint8)  # noqa: E731
CONSTANT: Draw = lambda generator, shape: np.full(shape, 17, np.uint8)  # noqa: E731
ANY: Draw = lambda generator, shape: generator.integers(0, 256, shape, np.uint8)  # noqa: E731

WRITTEN: dict[str, tuple[str, Draw, tuple[int, ...], tuple[int, int]]] = {
    "bright images": ("image", BRIGHT, (60, 90), (64, 64)),
    "dark images": ("image", DARK, (60, 90), (64, 64)),
    "constant images": ("image", CONSTANT, (60, 90), (64, 64)),
    "large images": ("image", BRIGHT, (20,), (320, 640)),
    "many short episodes": ("image", BRIGHT, (3,) * 20, (16, 16)),
    "a long episode": ("image", BRIGHT, (700,), (16, 16)),
    "bright video": ("video", BRIGHT, (60, 90), (64, 64)),
    "constant video": ("video", CONSTANT, (60, 90), (64, 64)),
    "dark, large video": ("video", CONSTANT, (60,), (256, 288)),
    "a long episode in a video": ("video", BRIGHT, (700,), (16, 16)),
}
"""Storage, what the frames show, lengths of the episodes, height and width."""
SOME = ("dark images", "many short episodes", "a long episode", "constant video")
"""The others are slow."""


def write(root: Path, storage: str, draw: Draw, lengths: tuple[int, ...], size: tuple[int, int]) -> Path:
    """A data set by plain LeRobot, with numbers far from zero that hardly change."""
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features: dict[str, Any] = {
        CAMERA: {"dtype": storage, "shape": (*size, 3), "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": (3,), "names": None},
        "height": {"dtype": "float32", "shape": (1,), "names": None},
    }
    video = storage == "video"
    encoder = RGBEncoderConfig(vcodec="h264", pix_fmt="yuv444p", crf=0) if video else None
    dataset = LeRobotDataset.create("me/set", fps=10, features=features, root=root, use_videos=video,
                                    rgb_encoder=encoder)  # fmt: skip
    generator = np.random.default_rng(0)
    for length in lengths:
        for _ in range(length):
            state = generator.normal(1000, 0.01, 4).astype(np.float32)
            frame = draw(generator, (*size, 3))
            dataset.add_frame({CAMERA: frame, "observation.state": state[:3], "height": state[3:], "task": "look"})
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return root


@pytest.mark.integration
@pytest.mark.parametrize(
    "kind", [name if name in SOME else pytest.param(name, marks=pytest.mark.slow) for name in WRITTEN]
)
def test_what_lerobot_wrote_is_sound(kind: str, tmp_path: Path) -> None:
    result = verify(write(tmp_path / "set", *WRITTEN[kind]))
    assert (result.errors, result.warnings) == ((), ())


def test_one_wrong_frame_among_bright_ones_is_noticed(tmp_path: Path) -> None:
    import io

    from PIL import Image

    root = write(tmp_path / "set", "image", BRIGHT, (60,), (64, 64))
    black = io.BytesIO()
    Image.new("RGB", (64, 64)).save(black, "PNG")
    edit_column(root, "data/chunk-000/file-000.parquet", CAMERA, lambda cells: cells[7].update(bytes=black.getvalue()))
    assert any(f"of {CAMERA} that the frames" in line for line in verify(root).errors)


@pytest.mark.parametrize("draw", [BRIGHT, DARK, CONSTANT, ANY], ids=["bright", "dark", "constant", "any"])
def test_means_of_frames_are_those_of_lerobot_to_the_last_bit(draw: Draw) -> None:
    from lerobot.datasets.compute_stats import get_feature_stats

    frames = draw(np.random.default_rng(1), (40, 96, 128, 3))
    theirs = get_feature_stats(frames.transpose(0, 3, 1, 2), axis=(0, 2, 3), keepdims=True)
    mine = rounded(frame.reshape(-1, 3) for frame in frames)
    exact = of_frames(list(frames))
    for name in ("mean", "std"):
        assert np.array_equal(mine[name], theirs[name].reshape(-1))
        assert np.allclose(exact[name].reshape(-1), getattr(frames.reshape(-1, 3) / 255.0, name)(0))


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int64, np.bool_])
@pytest.mark.parametrize("shape", [(2,), (5000,), (2, 3), (5000, 3)])
def test_means_of_numbers_are_those_of_lerobot_to_the_last_bit(kind: Any, shape: tuple[int, ...]) -> None:
    from lerobot.datasets.compute_stats import get_feature_stats

    values = np.random.default_rng(2).normal(10, 1, shape).astype(kind)
    theirs = get_feature_stats(values, axis=0, keepdims=values.ndim == 1)
    mine = rounded(iter_once(values.reshape(shape[0], -1)))
    for name in ("mean", "std"):
        assert np.array_equal(mine[name], theirs[name].reshape(-1))
    assert np.allclose(of_numbers(values)["mean"], values.astype(np.float64).mean(0))


def iter_once(values: Any) -> Iterator[Any]:
    yield values


def test_statistics_of_all_are_the_weighted_ones_of_the_episodes() -> None:
    generator = np.random.default_rng(3)
    episodes = []
    for count in (5, 1, 40, 7):
        values = generator.normal(1e6, 2.0, (count, 3))
        episodes.append({"a": of_numbers(values), "b": of_numbers(values[:, 0])})
    running = Aggregate()
    for episode in episodes:
        running.add(episode)
    counts = np.array([episode["a"]["count"][0] for episode in episodes])
    for name, stats in running.result().items():
        means, deviations = (np.stack([episode[name][key] for episode in episodes]) for key in ("mean", "std"))
        mean = np.average(means, axis=0, weights=counts)
        variance = np.average(deviations**2 + (means - mean) ** 2, axis=0, weights=counts)
        assert stats["count"].tolist() == [counts.sum()]
        np.testing.assert_allclose(stats["mean"], mean, rtol=1e-9)
        np.testing.assert_allclose(stats["std"], np.sqrt(variance), rtol=1e-6)
        assert np.array_equal(stats["min"], np.min([episode[name]["min"] for episode in episodes], axis=0))


def test_quantiles_are_numpys_without_interpolation() -> None:
    generator = np.random.default_rng(4)
    for count in (1, 2, 9, 10, 21, 26, 100, 1000):
        values = generator.normal(size=(count, 2))
        expected = np.quantile(values, list(QUANTILES.values()), axis=0, method="inverted_cdf")
        found = of_numbers(values)
        assert np.array_equal(np.stack([found[name] for name in QUANTILES]), expected)
