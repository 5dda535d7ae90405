"""Pictures are drawn from the data that runs write; a failed one keeps the old file."""

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from torchrl_etl.analysis.pictures import (
    embedding,
    learning_curves,
    synergy_heatmap,
    vaf_curve,
)
from torchrl_etl.modules import SynergyDecoder


def colors_of(path):
    with Image.open(path) as image:
        return len(image.convert("RGB").getcolors(image.width * image.height))


def test_learning_curves_of_a_run_with_and_without_success(tmp_path):
    frames = [*range(2000, 12_000, 1000)]
    returns, solved = (frames, [*range(10)]), (frames[::2], [0.0, 0.2, 0.4, 0.6, 0.8])
    one = learning_curves(returns, tmp_path / "new folder" / "one.png")
    two = learning_curves(returns, tmp_path / "two.png", solved=solved, explore_frames=2000)
    assert colors_of(one) > 20 and colors_of(two) > 20
    with Image.open(one) as left, Image.open(two) as both:
        assert both.width == 2 * left.width


@pytest.mark.parametrize(("n", "d", "residual"), [(80, 4, 0.1), (3, 1, 0.0)])
def test_heatmap(tmp_path, n, d, residual):
    decoder = SynergyDecoder(d, n, low=0.0, residual=residual)
    path = synergy_heatmap(decoder, [f"muscle{i}" for i in range(n)], tmp_path / "map.png")
    assert colors_of(path) > 20
    with pytest.raises(ValueError, match=f"2 names for {n} actuators"):
        synergy_heatmap(decoder, ["a", "b"], path)


def test_vaf_curve_takes_a_method_measured_at_one_dimension(tmp_path):
    nan = float("nan")
    series = {"GMVAE": [nan, 0.8, nan], "PCA": [0.3, 0.6, 0.9], "NMF": [-0.2, 0.4, 0.8]}
    assert colors_of(vaf_curve([1, 4, 8], series, tmp_path / "vaf.png", chosen_d=4)) > 20
    with pytest.raises(ValueError, match="'PCA' has 1 values for 2"):
        vaf_curve([1, 2], {"PCA": [0.5]}, tmp_path / "vaf.png")


@pytest.mark.parametrize("k", [1, 2, 5])
def test_embedding_of_any_size(tmp_path, k):
    directions = torch.nn.functional.normalize(torch.randn(10, 30, k), dim=-1)
    path = embedding(directions * torch.rand(10, 30, 1), directions, tmp_path / "embedding.png")
    assert colors_of(path) > 20


@pytest.mark.filterwarnings("error")
def test_embedding_of_a_collapsed_encoder(tmp_path):
    assert embedding(np.zeros((9, 3)), np.eye(3)[[0, 1, 2] * 3], tmp_path / "e.png").exists()


def test_embedding_needs_one_direction_per_state(tmp_path):
    with pytest.raises(ValueError, match=r"\(9, 3\) and directions to \(3, 3\)"):
        embedding(np.zeros((9, 3)), np.eye(3), tmp_path / "e.png")


def test_failed_drawing_keeps_the_old_picture_and_leaves_no_other_file(tmp_path, monkeypatch):
    path = vaf_curve([1, 2], {"PCA": [0.5, 0.6]}, tmp_path / "vaf.png")
    before = path.read_bytes()

    def half_written(self, target, **kwargs):
        target.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(Figure, "savefig", half_written)
    with pytest.raises(OSError, match="disk full"):
        vaf_curve([1, 2], {"PCA": [0.1, 0.2]}, path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["vaf.png"]
