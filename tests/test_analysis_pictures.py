"""Pictures are drawn from the data that runs write; a failed one keeps the old file."""

import csv

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from torchrl_etl.analysis.pictures import (
    _curve,
    embedding,
    learning_curves,
    synergy_heatmap,
    vaf_curve,
)
from torchrl_etl.modules import SynergyDecoder


def colors_of(path):
    with Image.open(path) as image:
        return len(image.convert("RGB").getcolors(image.width * image.height))


def rows(seed=0, solved=True, start=0):
    return [
        {"frames": start + 1000 * i, "return": float(i + seed), "seed": seed}
        | ({"solved": i / 10} if solved else {})
        for i in range(10)
    ]


def test_learning_curves_take_rows_a_mapping_or_a_csv_file(tmp_path):
    table = tmp_path / "evaluations.csv"
    with open(table, "w", newline="") as file:
        writer = csv.DictWriter(file, ["frames", "return", "seed", "solved"])
        writer.writeheader()
        writer.writerows(rows())
    several = {"ETL": rows(0, start=2000) + rows(1, start=2000), "SAC": rows(2, solved=False)}
    for name, runs in {"one": rows(), "csv": table, "several": several}.items():
        path = learning_curves(runs, tmp_path / "new folder" / f"{name}.png", explore_frames=2000)
        assert colors_of(path) > 20


def test_curve_averages_over_the_frames_that_all_seeds_reached():
    short = [{"frames": f, "return": 10.0, "seed": 1} for f in (0, 1000)]
    long = [{"frames": f, "return": 20.0, "seed": 2} for f in (500, 1500, 3000)]
    frames, mean, low, high = _curve(
        [*short, *long, {"frames": 9e9, "return": ""}][:5], "return", 1
    )
    assert frames.tolist() == [500, 1000]
    assert mean.tolist() == [15.0, 15.0]
    assert (low < mean).all() and (mean < high).all()
    with pytest.raises(ValueError, match="no frames in common: one ends at 1000 before another"):
        _curve(short + long[1:], "return", 1)


def test_curves_skip_missing_values_and_refuse_a_log_without_any(tmp_path):
    holes = [{"frames": 1, "return": "", "solved": None}, {"frames": 2, "return": "nan"}]
    assert _curve([*holes, {"frames": 3, "return": "4.5"}], "return", 1)[0].tolist() == [3]
    with pytest.raises(ValueError, match="'return' or 'solved'"):
        learning_curves({"ETL": holes}, tmp_path / "curves.png")
    assert not list(tmp_path.iterdir())


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
